"""``neurosim dataset``: tracked recordings, or another format, -> dataset."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from neurosim.base.declared import Delay, Seconds
from neurosim.base.errors import UserError, counted
from neurosim.base.files import check_free
from neurosim.cli._common import emit, is_given, json_option, next_step
from neurosim.cli._types import PATH, Listed, Pairs, ranged

#: Options of some sources only: parameter -> the sources.
_ONLY: dict[str, tuple[str, ...]] = {
    "as_sent": ("recording",),
    "mixed": ("recording",),
    "doubtful": ("recording",),
    **dict.fromkeys(("longest", "shortest", "longest_gap", "delay", "step"), ("mrclam", "csv")),
    **dict.fromkeys(
        (
            "columns",
            "units",
            "rows",
            "from_rest",
            "session",
            "counters",
            "keep",
            "length",
            "angle",
            "time",
            "y",
            "frame",
        ),
        ("csv",),
    ),
}


def _unit(name: str, values: list[str], help: str) -> Callable[[Callable], Callable]:
    choice = click.Choice(values)
    return click.option(
        f"--{name}", type=choice, default=values[0], show_default=True, help=f"csv: {help}"
    )


def _seconds(name: str, default: float | None, help: str) -> Callable[[Callable], Callable]:
    return click.option(
        f"--{name}",
        type=ranged(Seconds),
        default=default,
        show_default=default is not None,
        help=f"csv, mrclam: {help}",
    )


@click.command()
@click.argument("recordings", nargs=-1, required=True, type=PATH)
@click.option("-o", "--out", type=PATH, required=True, help="Folder of the new dataset.")
@click.option(
    "--from",
    "source",
    type=click.Choice(["recording", "mrclam", "csv"]),
    default="recording",
    show_default=True,
    help="mrclam: the UTIAS files *_Odometry.dat and *_Groundtruth.dat. csv: logs of time, pose "
    "and command, or files with a line for each command (docs/own-data.md).",
)
@click.option(
    "--as-sent",
    is_flag=True,
    help=(
        "Count displacements from the time of sending commands, not from the time when the "
        "motors answered."
    ),
)
@click.option("--mixed", is_flag=True, help="Allow recordings of different robots.")
@click.option(
    "--doubtful",
    is_flag=True,
    help="Also use poses that track marked as doubtful: they may not be the robot's.",
)
@click.option(
    "--columns",
    type=Pairs("NAME=COLUMN,...", "time=t,x=pos_x,v=speed", alone=True),
    help=(
        "csv: names of the file's columns. A log has time, x, y, heading; rows have duration (or "
        "start, end), dx, dy, dtheta (or x0, y0, heading0, x1, y1, heading1). Any other name is "
        "a command; prev_ and its name, in rows, is the command before."
    ),
)
@click.option(
    "--units",
    type=Pairs("NAME=UNIT,...", "v=m/s,w=rad/s"),
    help="csv: units of the commands, for reports.  [default: m/s of v, rad/s of w]",
)
@click.option(
    "--rows",
    is_flag=True,
    help="csv: each line is a command, not a sample; needed if the columns do not show it.",
)
@click.option(
    "--from-rest",
    is_flag=True,
    help=(
        "csv, rows: the robot stood before each command; otherwise the line above is the command "
        "before."
    ),
)
@click.option(
    "--session",
    metavar="COLUMN",
    help=(
        "csv: the column with the drive of each line of a log.  [default: another one begins "
        "where the clock starts again, or is silent for long]"
    ),
)
@click.option(
    "--counters",
    type=Listed(click.STRING),
    metavar="NAME,...",
    help="csv: commands of a log that are counters, as of wheels: how fast they count is used.",
)
@click.option("--keep", is_flag=True, help="csv: keep headings that do not fit the motion.")
@_unit("length", ["m", "cm", "mm"], "unit of x, y, dx, dy.")
@_unit("angle", ["rad", "deg"], "unit of headings and dtheta.")
@_unit("time", ["s", "ms", "us", "ns"], "unit of times and durations.")
@_unit(
    "y",
    ["left", "right"],
    "where y points, looking along x; right (pictures, y down) has headings clockwise.",
)
@_unit("frame", ["body", "world"], "frame of dx, dy: the robot's at the start, or heading0's.")
@_seconds("longest", 3.0, "cut a command that is held into pieces of at most this length, s.")
@_seconds("shortest", 0.5, "leave out pieces shorter than this, s.")
@_seconds("step", 0.1, "with --windows, join commands that are shorter than this, s.")
@click.option(
    "--windows/--held",
    default=None,
    help=(
        "Learn from windows of the log, in which commands may change, or only from commands that "
        "were held.  [default: windows where few commands were held]"
    ),
)
@_seconds(
    "longest-gap",
    None,
    "leave out pieces with no sample or pose for longer, s.  [default: 0.5, or 2.5 times the usual "
    "time between them]",
)
@click.option(
    "--delay",
    type=ranged(Delay),
    help=(
        "csv, mrclam: delay of the poses relative to the commands, s.  [default: "
        "estimated from the data]"
    ),
)
@json_option
def dataset(
    recordings: tuple[Path, ...],
    out: Path,
    source: str,
    as_sent: bool,
    mixed: bool,
    doubtful: bool,
    columns: dict[str, str] | None,
    units: dict[str, str] | None,
    rows: bool,
    from_rest: bool,
    session: str | None,
    counters: tuple[str, ...] | None,
    keep: bool,
    longest: float,
    shortest: float,
    step: float,
    windows: bool | None,
    longest_gap: float | None,
    delay: float | None,
    as_json: bool,
    **conventions: str,
) -> None:
    """Turn tracked RECORDINGS into rows of (command -> displacement).

    Give a guided recording as one folder, with all its rounds. With --from, RECORDINGS are files.
    """
    from neurosim.recording.rounds import parts_of
    from tracking.datasets.dataset import build
    from tracking.datasets.logs import Settings

    for name, sources in _ONLY.items():
        if is_given(name) and source not in sources:
            option = "--" + name.replace("_", "-")
            raise UserError(f"{option} is for --from {' or '.join(sources)}, not {source}")
    if source == "recording":
        for folder in recordings:
            check_free(folder, "recorded into")
        parts = [part for folder in recordings for part in parts_of(folder)]
        made = build(
            parts,
            out,
            correct_delay=not as_sent,
            mixed=mixed,
            doubtful=doubtful,
            windows=windows,
        )
    else:
        pieces = Settings(shortest, longest, longest_gap, step, windows, keep, delay)
        if source == "mrclam":
            from tracking.datasets.mrclam import import_mrclam

            made = import_mrclam(list(recordings), out, settings=pieces)
        else:
            from tracking.datasets.csv_files import Conventions, import_csv

            made = import_csv(
                recordings,
                out,
                columns=columns,
                units=units,
                rows=rows or None,
                from_rest=from_rest,
                conventions=Conventions(**conventions),
                settings=pieces,
                session=session,
                counters=counters or (),
            )
    warnings = [*made.meta.get("warnings", ()), *_too_few(len(made))]
    for warning in warnings:
        click.echo(f"warning: {warning}", err=True)
    left_out = made.meta.get("left_out", {})
    delays = made.meta.get("motor_delays", [])
    result: dict[str, Any] = {
        "dataset": str(out),
        "rows": len(made.table),
        "within": len(made.within),
        "windows": bool(made.meta.get("windows")),
        "left_out": left_out,
        "motor_delays": delays,
        "warnings": warnings,
    }
    late = "".join(
        f"{each['recording']}, session {each['session']}: the motors answered "
        f"{1000 * each['delay']:z.0f} ms after their commands (standard deviation "
        f"{1000 * each['sd']:.0f} ms), {'corrected' if each['corrected'] else 'not corrected'}.\n"
        for each in delays
    )
    chained = (
        "Rows follow one another: training composes them to windows (--held: held commands alone)."
        "\n"
        if made.meta.get("windows")
        else ""
    )
    reasons = ", ".join(f"{count} {reason}" for reason, count in left_out.items() if count)
    emit(
        result,
        as_json,
        f"{out}: {counted(len(made.table), 'row')}, {len(made.within)} poses within them; "
        f"left out: {reasons or 'none'}.\n"
        + chained
        + late
        + ("" if _too_few(len(made.table)) else next_step("train", out, "-o", "SIMULATOR")),
    )


def _too_few(rows: int) -> list[str]:
    from tracking.datasets.dataset import FEWEST_ROWS

    if rows >= FEWEST_ROWS:
        return []
    return [f"{counted(rows, 'row')}; neurosim train needs at least {FEWEST_ROWS}"]
