"""``neurosim calibrate``: photographs of a chessboard and marked points -> camera model."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click

from neurosim.base.errors import UserError
from neurosim.cli._common import PATH, POSITIVE, emit, is_given, json_option


class _Pattern(click.ParamType):
    name = "COLSxROWS"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int, int]:
        if isinstance(value, tuple):
            return value
        try:
            columns, rows = (int(part) for part in value.lower().split("x"))
        except ValueError:
            self.fail(f"{value!r} is not a pattern such as 9x6", param, ctx)
        return columns, rows


@click.command()
@click.argument("photographs", nargs=-1, required=True, type=PATH)
@click.option("--marker", type=POSITIVE, help="Side of a ChArUco board's markers, in mm.")
@click.option(
    "--dictionary", default="4X4_50", show_default=True, help="Of a ChArUco board's markers."
)
@click.option(
    "-o", "--out", type=PATH, default=Path("calibration.json"), show_default=True, help="The file."
)
@click.option(
    "--pattern",
    type=_Pattern(),
    default="9x6",
    show_default=True,
    help="Inner corners of the chessboard or ChArUco board.",
)
@click.option(
    "--square", type=POSITIVE, default=25.0, show_default=True, help="Side of a square, in mm."
)
@click.option(
    "--points",
    type=PATH,
    help="CSV with columns u,v (pixels) and x,y (metres on the board): at least four points "
    "marked in a picture of the board.",
)
@click.option(
    "--point",
    "given",
    multiple=True,
    metavar="U,V,X,Y",
    help="One marked point; give it four times or more.",
)
@click.option(
    "--corners",
    metavar="U,V U,V U,V U,V",
    help="Without any chessboard: the pixels of the corners of the board in a photograph, from the "
    "top left one clockwise as seen.",
)
@click.option(
    "--board", default="2.76x1.84", show_default=True, help="Length and width with --corners, in m."
)
@json_option
def calibrate(
    photographs: tuple[Path, ...],
    out: Path,
    pattern: tuple[int, int],
    square: float,
    points: Path | None,
    given: tuple[str, ...],
    marker: float | None,
    dictionary: str,
    corners: str | None,
    board: str,
    as_json: bool,
) -> None:
    """Learn the camera from PHOTOGRAPHS of a chessboard: files, a folder of them, or a video.

    Without marked points the lens alone is learned, and poses stay in pixels. With --corners one
    photograph of the board is enough, of a lens that is taken to be a usual one.
    """
    from tracking.camera.calibrate import calibrate as calibrate_
    from tracking.camera.calibrate import from_corners

    if points is not None and given:
        raise UserError("give the marked points with --points or with --point, not with both")
    if corners is None and is_given("board"):
        raise UserError("--board is of --corners: name the pixels of the board's corners, too")
    source = photographs[0] if len(photographs) == 1 else list(photographs)
    if corners is None:
        side = None if marker is None else marker / 1000
        model = calibrate_(
            source,
            pattern,
            square / 1000,
            points or _points(given),
            marker=side,
            dictionary=dictionary,
        )
    elif points is not None or given or len(photographs) > 1:
        raise UserError("--corners takes one photograph of the board and no other points")
    else:
        model = from_corners(photographs[0], _corners(corners), _board(board))
    model.write(out)
    matrix = model.camera_matrix
    result = {
        "calibration": str(out),
        "photographs": model.photographs,
        "rms_px": model.rms_px,
        "fx": matrix[0, 0],
        "fy": matrix[1, 1],
        "cx": matrix[0, 2],
        "cy": matrix[1, 2],
        "distortion": model.distortion,
        "uncertainty": model.uncertainty,
    }
    sure = model.uncertainty or {}
    numbers = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}
    said = ", ".join(
        f"{name} {matrix[place]:.1f}" + (f" +- {sure[name]:.1f}" if name in sure else "")
        for name, place in numbers.items()
    )
    where = (
        f"; a position {100 * sure['height_m']:.0f} cm over the board to "
        f"{1000 * sure['board_m']:.1f} mm"
        if "board_m" in sure
        else ""
    )
    how = (
        "a usual lens and the board's four corners"
        if corners is not None
        else f"{model.photographs} photographs, RMS reprojection error {model.rms_px:.3f} px"
    )
    emit(result, as_json, f"{out}: {how}, {said} px{where} (standard deviations)")


def _points(given: tuple[str, ...]) -> list[tuple[float, ...]] | None:
    points = []
    for text in given:
        try:
            point = tuple(float(part) for part in text.split(","))
        except ValueError:
            point = ()
        if len(point) != 4 or not all(map(math.isfinite, point)):
            raise UserError(f"--point {text!r}: expected four numbers, U,V,X,Y")
        points.append(point)
    return points or None


def _corners(text: str) -> list[tuple[float, float]]:
    try:
        corners = [tuple(float(part) for part in pair.split(",")) for pair in text.split()]
    except ValueError:
        corners = []
    finite = all(math.isfinite(part) for corner in corners for part in corner)
    if len(corners) != 4 or any(len(corner) != 2 for corner in corners) or not finite:
        raise UserError(
            f"--corners {text!r}: expected four pixels, such as '10,8 630,9 628,470 12,471'"
        )
    return corners


def _board(text: str) -> tuple[float, float]:
    try:
        length, width = (float(part) for part in text.lower().split("x"))
    except ValueError:
        length = width = 0.0
    if not (0 < length < math.inf and 0 < width < math.inf):
        raise UserError(f"--board {text!r}: expected length x width in metres, such as 2.76x1.84")
    return length, width
