"""A trial as a file for the viewer rerun: robot, prediction, samples, sensors, over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.base.files import atomic_path
from neurosim.reports.course import shape_corners
from neurosim.reports.film import filmed_trial

#: Colours of the paths: those of the report.
COLOURS = {"robot": (213, 94, 0), "predicted": (0, 114, 178), "samples": (140, 140, 140)}
#: Length of the arrows, m.
ARROW = 0.1
TIMELINE = "drive"


def export_rerun(
    folder: str | Path, out: str | Path, others: Sequence[str | Path] = (), seed: int = 0
) -> dict[str, Any]:
    """Write a trial as an ``.rrd`` file for the viewer of rerun.

    The timeline ``drive`` is the time since the first command. ``robot``, ``predicted`` and
    ``samples`` are in m, z up; ``sensors/NAME`` are readings from 0 to 1.

    Args:
        folder: of the trial.
        out: the new file, .rrd.
        others: folders of the trial's simulator and controller, for samples of the noise.
        seed: of the samples.

    Returns:
        The number of ``frames`` and ``samples``, and ``sensors``, their names.

    Raises:
        UserError: if rerun is missing, the folder is not a trial's, the robot was never seen, or
            ``out`` exists.
    """
    try:
        import rerun as rr
    except ImportError:
        raise UserError(
            "exporting to rerun needs the package rerun-sdk: pip install 'neurosim[rerun]'"
        ) from None
    out = Path(out)
    if out.suffix != ".rrd":
        raise UserError(f"{out}: the name of a file for rerun ends in .rrd")
    if out.exists():
        raise UserError(f"{out} exists; name a new file, or remove this one yourself")
    only = "only trials are exported to rerun"
    trial, scene, shown = filmed_trial([folder, *others], seed, only)
    with atomic_path(out) as partial:
        stream = rr.RecordingStream("neurosim", recording_id=trial.name)
        stream.save(partial)
        stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for kind, shapes in (("place", scene.place), ("task", scene.task)):
            lines = [_flat(shape_corners(shape)) for shape in shapes if "polygon" in shape]
            closed = [np.concatenate([line, line[:1]]) for line in lines]
            if closed:
                stream.log(kind, rr.LineStrips3D(closed), static=True)
        for number, time in enumerate(shown.times):
            stream.set_time(TIMELINE, duration=float(time))
            for name, poses in (("robot", shown.robot), ("predicted", shown.predicted)):
                pose = poses[number]
                if not np.isfinite(pose).all():
                    stream.log(name, rr.Clear(recursive=False))
                    continue
                x, y, theta = pose.tolist()
                ahead = [[ARROW * np.cos(theta), ARROW * np.sin(theta), 0.0]]
                colour = COLOURS[name]
                stream.log(name, rr.Arrows3D(origins=[[x, y, 0.0]], vectors=ahead, colors=colour))
                known = poses[: number + 1]
                known = known[np.isfinite(known).all(axis=1)]
                stream.log(f"{name}/path", rr.LineStrips3D([_flat(known)], colors=colour))
            if len(shown.samples):
                points = _flat(shown.samples[:, number])
                stream.log("samples", rr.Points3D(points, colors=COLOURS["samples"], radii=0.01))
            for sensor, name in enumerate(shown.names):
                reading = float(shown.readings[number, sensor])
                stream.log(f"sensors/{name}", rr.Scalars(reading))
        stream.disconnect()
    return {
        "frames": len(shown.times),
        "samples": len(shown.samples),
        "sensors": list(shown.names),
    }


def _flat(points: NDArray) -> NDArray[np.float64]:
    """Return points [N, 3] on the floor."""
    return np.column_stack([points[:, :2], np.zeros(len(points))])
