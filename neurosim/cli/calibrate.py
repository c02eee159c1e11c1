"""``neurosim calibrate``: photographs of a chessboard and marked points -> camera model."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import click
from msgspec import Meta

from neurosim.base.declared import Metres
from neurosim.base.errors import UserError
from neurosim.cli._common import emit, json_option
from neurosim.cli._types import PATH, PATTERN, PIXEL, PIXELS, Numbers, Option, Real


@click.command()
@click.argument("photographs", nargs=-1, required=True, type=PATH)
@click.option("--marker", type=Real(Metres, "mm"), help="Side of a ChArUco board's markers, mm.")
@click.option(
    "--dictionary",
    default="4X4_50",
    show_default=True,
    help="ArUco dictionary of a ChArUco board's markers.",
)
@click.option(
    "-o",
    "--out",
    type=PATH,
    default=Path("calibration.json"),
    show_default=True,
    help="Output file.",
)
@click.option(
    "--pattern",
    cls=Option,
    type=PATTERN,
    default="9x6",
    show_default=True,
    help="Inner corners of the chessboard or ChArUco board.",
)
@click.option(
    "--square",
    type=Real(Metres, "mm"),
    default="25",
    show_default=True,
    help="Side of a square, mm.",
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
    cls=Option,
    type=Numbers("U,V,X,Y", ",", PIXELS, "12,471,-1.38,-0.92"),
    multiple=True,
    help="One marked point, as in --points; give it four times or more.",
)
@click.option(
    "--corners",
    cls=Option,
    type=PIXEL,
    nargs=4,
    help=(
        "Without a chessboard: pixels of the board's four corners in a photograph, clockwise "
        "from the top left corner."
    ),
)
@click.option(
    "--board",
    cls=Option,
    type=Numbers("LENGTHxWIDTH", "x", Annotated[float, Meta(ge=0.01, le=100)], "2.76x1.84"),
    help="With --corners, which needs it: length and width of the board, m.",
)
@click.option("--overwrite", is_flag=True, help="Replace an existing calibration.")
@json_option
def calibrate(
    photographs: tuple[Path, ...],
    out: Path,
    pattern: tuple[int, int],
    square: float,
    points: Path | None,
    given: tuple[tuple[float, ...], ...],
    marker: float | None,
    dictionary: str,
    corners: tuple[tuple[float, float], ...] | None,
    board: tuple[float, float] | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Learn the camera from PHOTOGRAPHS of a chessboard: files, a folder of them, or a video.

    Without marked points the lens alone is learned, and poses stay in pixels. With --corners one
    photograph of the board is enough; a usual lens is assumed.
    """
    from neurosim.base.files import check_new_file
    from tracking.camera.calibrate import calibrate as calibrate_
    from tracking.camera.calibrate import from_corners
    from tracking.camera.lens import FEWEST_PHOTOGRAPHS, describe_left_out

    check_new_file(out, "calibration", overwrite=overwrite)
    if points is not None and given:
        raise UserError("give the marked points with --points or with --point, not with both")
    if corners is None and board is not None:
        raise UserError("--board needs --corners: give the pixels of the board's corners")
    source = photographs[0] if len(photographs) == 1 else list(photographs)
    if corners is None:
        model = calibrate_(
            source,
            pattern,
            square,
            points or list(given) or None,
            marker=marker,
            dictionary=dictionary,
        )
    elif points is not None or given or len(photographs) > 1:
        raise UserError("--corners takes one photograph of the board and no other points")
    elif board is None:
        raise UserError(
            "--corners needs the size of the board: measure length (top left to top right corner) "
            "and width, and name them with --board, such as 2.76x1.84"
        )
    else:
        model = from_corners(photographs[0], list(corners), board)
    model.write(out)
    for each in model.left_out:
        click.echo(describe_left_out(each), err=True)
    if model.uncertainty is None:
        click.echo(
            f"{model.photographs} photographs are too few or too similar to estimate the "
            f"uncertainty: take at least {FEWEST_PHOTOGRAPHS + 1}, better 20, with the chessboard "
            "tilted in several directions and over the whole image",
            err=True,
        )
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
        "left_out": list(model.left_out),
    }
    deviation = model.uncertainty or {}
    entries = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}
    errors = ", ".join(
        f"{name} {matrix[entry]:.1f}" + (f" +- {deviation[name]:.1f}" if name in deviation else "")
        for name, entry in entries.items()
    )
    where = (
        f"; a position {100 * deviation['height_m']:.0f} cm over the board to "
        f"{1000 * deviation['board_m']:.1f} mm"
        if "board_m" in deviation
        else ""
    )
    how = (
        "a usual lens and the board's four corners"
        if corners is not None
        else f"{model.photographs} photographs, RMS reprojection error {model.rms_px:.3f} px"
    )
    meaning = " (standard deviations)" if deviation else ""
    emit(result, as_json, f"{out}: {how}, {errors} px{where}{meaning}")
