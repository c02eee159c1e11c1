"""``neurosim dataset``: tracked recordings, or another format, -> dataset."""

from __future__ import annotations

from pathlib import Path

import click

from neurosim.cli._common import emit, json_option, next_step
from neurosim.cli._types import PATH


@click.command()
@click.argument("recordings", nargs=-1, required=True, type=PATH)
@click.option("-o", "--out", type=PATH, required=True, help="Folder of the new dataset.")
@click.option(
    "--from",
    "source",
    type=click.Choice(["recording", "mrclam"]),
    default="recording",
    show_default=True,
    help="mrclam: the UTIAS files *_Odometry.dat and *_Groundtruth.dat.",
)
@click.option(
    "--as-sent",
    is_flag=True,
    help="Count displacements from when commands were sent, not from when the motors were seen to "
    "answer.",
)
@click.option("--mixed", is_flag=True, help="Allow recordings of different robots.")
@json_option
def dataset(
    recordings: tuple[Path, ...], out: Path, source: str, as_sent: bool, mixed: bool, as_json: bool
) -> None:
    """Turn RECORDINGS that were tracked into rows of (command -> displacement).

    A guided recording's rounds are recordings; its folder stands for all of them.
    """
    from neurosim.recording.rounds import parts_of
    from tracking.datasets.dataset import build
    from tracking.datasets.mrclam import import_mrclam

    if source == "mrclam":
        made = import_mrclam(list(recordings), out)
    else:
        parts = [part for folder in recordings for part in parts_of(folder)]
        made = build(parts, out, correct_delay=not as_sent, mixed=mixed)
    left_out = made.meta.get("left_out", {})
    delays = made.meta.get("motor_delays", [])
    result = {
        "dataset": str(out),
        "rows": len(made.table),
        "within": len(made.within),
        "left_out": left_out,
        "motor_delays": delays,
    }
    late = "".join(
        f"{each['recording']}, session {each['session']}: the motors answered "
        f"{1000 * each['delay']:z.0f} ms after their commands (standard deviation "
        f"{1000 * each['sd']:.0f} ms), {'corrected' if each['corrected'] else 'not corrected'}.\n"
        for each in delays
    )
    reasons = ", ".join(f"{count} {reason}" for reason, count in left_out.items() if count)
    emit(
        result,
        as_json,
        f"{out}: {len(made.table)} rows, {len(made.within)} poses within them; left out: "
        f"{reasons or 'none'}.\n" + late + next_step("train", out, "-o", "SIMULATOR"),
    )
