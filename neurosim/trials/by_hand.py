"""A reality in which a person runs the robot and types the result."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from neurosim.base import se2
from neurosim.base.declared import checks
from neurosim.base.errors import UserError
from neurosim.base.trajectory import Tracked
from tracking.camera.camera_model import CameraModel
from tracking.datasets.recordings import DEFAULT_MARKERS
from tracking.poses import between
from tracking.track import track_video

#: A robot in a film begins to move where it leaves its first place by this, m or rad.
MOVES = 0.01
#: Height of markers above the floor, m.
Height = Annotated[float, Meta(ge=0, le=2)]


class ByHand:
    """A person sets the robot's parameters, starts it, and types the fitness; there is no driver.

    As in Zagal et al. 2004, section 5.2: the robot starts in the middle of a circle, and is stopped
    where it crosses the circle. With a camera's calibration the person films each trial, and names
    the film.

    Attributes:
        instruction: the person's task before every trial.
        patient: a person may take any time.
    """

    instruction = "Put the robot back to the start and press Enter when it is ready"
    patient = True

    @checks
    def __init__(
        self,
        controller: Any,
        task: Any = None,
        type_in: Callable[[str], str] | None = None,
        calibration: str | Path | None = None,
        height: Height = 0.1,
    ):
        """Prepare trials of a controller.

        Args:
            controller: the controller, whose parameters are shown.
            task: the task of the fitness.
            type_in: shows a message and returns the answer; by default on stderr and from stdin.
            calibration: of the camera that films; None: there are no films.
            height: Height of the pink marker in front and the blue one behind above the floor, m.

        Raises:
            UserError: if there is a calibration and no task, or it does not know the floor.
            FileError: if the calibration cannot be read.
        """
        if calibration is not None and task is None:
            raise UserError("films of trials need the task, whose trial they show")
        self._camera = None if calibration is None else CameraModel.read(calibration)
        if self._camera is not None and not self._camera.has_board:
            raise UserError(f"{calibration} has no points on the floor: calibrate the camera there")
        self._task, self._height = task, height
        self._controller, self._type_in = controller, type_in or answer_to
        unit = "" if task is None else task.fitness_unit
        self._asked = f"Fitness{unit and f' in {unit}'} (0 if it fell): "

    def describe(self) -> dict[str, Any]:
        """Describe the reality."""
        return {"kind": "by-hand", "virtual": False}

    def trial(self, genes: NDArray[np.float64], number: int) -> float | Tracked:
        """Show the individual [G]; return the fitness that is typed, and the path of the film."""
        given = self._controller.named(genes)
        given = given or {f"gene {n}": v for n, v in enumerate(genes.tolist())}
        shown = json.dumps({name: float(f"{value:.4g}") for name, value in given.items()})
        fitness, asked = math.nan, f"Trial {number + 1}: {shown}\n{self._asked}"
        while not math.isfinite(fitness):
            with suppress(ValueError):
                fitness = float(self._type_in(asked))
            asked = "A number, please: "
        asked = "Film of this trial (Enter: not filmed): "
        while self._camera is not None and (film := self._type_in(asked).strip()):
            try:
                return Tracked(fitness, self._path(film))
            except UserError as error:
                asked = f"{error}\nFilm of this trial (Enter: not filmed): "
        return fitness

    def _path(self, film: str) -> NDArray[np.float64]:
        """Return the poses [K, 3] in a film after each step, from the robot's first motion on.

        Raises:
            UserError: if it cannot be tracked.
        """
        colours = DEFAULT_MARKERS["front"]["colour"], DEFAULT_MARKERS["rear"]["colour"]
        tracked = track_video(film, colours, calibration=self._camera, height=self._height)
        moments, *columns = (
            np.array(tracked["poses"][name]) for name in ("time", "x", "y", "theta")
        )
        poses = np.stack(columns, axis=-1)
        away = poses - poses[np.isfinite(poses).all(axis=1)][0]
        moved = (np.hypot(away[:, 0], away[:, 1]) > MOVES) | (np.abs(away[:, 2]) > MOVES)
        begin = moments[max(int(moved.argmax()) - 1, 0)]
        episode = self._task.episode
        path = between(moments - begin, poses, np.arange(episode.steps + 1) * episode.step)
        return se2.between(path[0], path[1:])


def put_at(pose: Sequence[float] | NDArray[np.float64]) -> str:
    """Return the request to put the robot at a pose (m, m, rad), without an end."""
    x, y, heading = 100 * pose[0], 100 * pose[1], math.degrees(pose[2])
    return f"Put the robot at x {x:.1f} cm, y {y:.1f} cm, heading {heading:.0f} degrees"


def answer_to(message: str) -> str:
    """Return the number that a person types."""
    print(message, end="", file=sys.stderr, flush=True)
    return input()
