"""``neurosim report``: datasets, simulators, controllers and trials -> one HTML page."""

from __future__ import annotations

from pathlib import Path

import click

from neurosim.cli._common import emit, json_option
from neurosim.cli._types import PATH


@click.command()
@click.argument("folders", nargs=-1, required=True, type=PATH)
@click.option(
    "-o",
    "--out",
    type=PATH,
    default=Path("report.html"),
    show_default=True,
    help="Output page, .html.",
)
@json_option
def report(folders: tuple[Path, ...], out: Path, as_json: bool) -> None:
    """Show datasets, simulators, controllers and trials (FOLDERS) on one page."""
    from neurosim.reports import write_report

    result = write_report(list(folders), out)
    emit(result, as_json, f"{result.get('verdict', '')}\n{out.resolve()}".strip())
