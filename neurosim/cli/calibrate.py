"""``neurosim calibrate``: photographs of a chessboard and marked points -> camera model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from neurosim.base.errors import UserError
from neurosim.cli._common import PATH, emit, json_option


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
@click.option(
    "-o", "--out", type=PATH, default=Path("calibration.json"), show_default=True, help="The file."
)
@click.option(
    "--pattern",
    type=_Pattern(),
    default="9x6",
    show_default=True,
    help="Inner corners of the chessboard.",
)
@click.option("--square", default=25.0, show_default=True, help="Side of a square, in mm.")
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
@json_option
def calibrate(
    photographs: tuple[Path, ...],
    out: Path,
    pattern: tuple[int, int],
    square: float,
    points: Path | None,
    given: tuple[str, ...],
    as_json: bool,
) -> None:
    """Learn the camera from PHOTOGRAPHS of a chessboard: files, a folder of them, or a video.

    Without marked points the lens alone is learned, and poses stay in pixels.
    """
    from tracking.calibrate import calibrate as calibrate_

    if points is not None and given:
        raise UserError("give the marked points with --points or with --point, not with both")
    source = photographs[0] if len(photographs) == 1 else list(photographs)
    model = calibrate_(source, pattern, square / 1000, points or _points(given))
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
    }
    emit(
        result,
        as_json,
        f"{out}: {model.photographs} photographs, RMS reprojection error {model.rms_px:.3f} px, "
        f"fx {matrix[0, 0]:.1f}, fy {matrix[1, 1]:.1f}, cx {matrix[0, 2]:.1f}, "
        f"cy {matrix[1, 2]:.1f} px",
    )


def _points(given: tuple[str, ...]) -> list[tuple[float, ...]] | None:
    points = []
    for text in given:
        try:
            point = tuple(float(part) for part in text.split(","))
        except ValueError:
            point = ()
        if len(point) != 4:
            raise UserError(f"--point {text!r}: expected four numbers, U,V,X,Y")
        points.append(point)
    return points or None
