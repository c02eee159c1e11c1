"""Pictures of running trials: the place, each robot and its path."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import gymnasium
import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.envs.face import place
from neurosim.simulators.base import Simulator
from neurosim.tasks.base import Task

#: Pixels of the longer side.
SIZE = 480
#: Radius of a robot of unknown size, m.
RADIUS = 0.08
_PAPER, _INK, _FORBIDDEN = (255, 255, 255), (120, 120, 120), (225, 200, 200)
_PATH, _ROBOT = (60, 110, 200), (20, 60, 140)


def check_mode(mode: str | None, modes: Sequence[str]) -> str | None:
    """Return a render mode.

    Raises:
        UserError: if the name is unknown.
    """
    if mode is not None and mode not in modes:
        raise UserError(f"render_mode is one of {', '.join(modes)}, not {mode!r}")
    return mode


class Picture:
    """Draws B trials."""

    def __init__(self, simulator: Simulator, task: Task, count: int):
        self._shapes = [*simulator.outline(), *task.outline()]
        self._radius = simulator.radius or RADIUS
        self._low, high = place(simulator, task)
        width, height = high - self._low
        self._scale = SIZE / max(width, height)
        self._size = int(np.ceil(height * self._scale)), int(np.ceil(width * self._scale))
        self._paths: list[list[NDArray[np.float64]]] = [[] for _ in range(count)]
        self._ground = self._place()
        self._window: Any = None

    def begin(self, rows: Sequence[int] | NDArray, poses: NDArray[np.float64]) -> None:
        """Begin again in rows [K], at poses [K, 3]."""
        for row, pose in zip(rows, poses, strict=True):
            self._paths[row] = [np.array(pose)]

    def add(self, poses: NDArray[np.float64]) -> None:
        """Continue to poses [B, 3]; an unknown pose (NaN) is left out."""
        for path, pose in zip(self._paths, poses, strict=True):
            if np.isfinite(pose).all():
                path.append(np.array(pose))

    def draw(self, row: int) -> NDArray[np.uint8]:
        """Return a picture [height, width, 3] of a trial, red, green and blue in 0..255."""
        image, path = self._ground.copy(), np.array(self._paths[row])
        cv2.polylines(image, [self._at(path[:, :2])], False, _PATH, 2, cv2.LINE_AA)
        x, y, heading = path[-1]
        centre, radius = self._at(path[-1, :2]), max(round(self._radius * self._scale), 3)
        cv2.circle(image, tuple(map(int, centre)), radius, _ROBOT, 2, cv2.LINE_AA)
        nose = np.array([x, y]) + self._radius * np.array([np.cos(heading), np.sin(heading)])
        ends = tuple(map(int, centre)), tuple(map(int, self._at(nose)))
        cv2.line(image, *ends, _ROBOT, 2, cv2.LINE_AA)
        return image

    def show(self, rate: float) -> None:
        """Show the first trial in a window, for 1 / ``rate`` s at least."""
        from matplotlib import pyplot

        if self._window is None:
            if pyplot.get_backend().lower() == "agg":
                gymnasium.logger.warn("there is no display: nothing is shown")
            figure, axes = pyplot.subplots(num="neurosim")
            axes.set_axis_off()
            self._window = figure, axes.imshow(self.draw(0))
        figure, shown = self._window
        shown.set_data(self.draw(0))
        figure.canvas.draw_idle()
        figure.canvas.flush_events()
        if pyplot.get_backend().lower() != "agg":
            pyplot.pause(1.0 / rate)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            from matplotlib import pyplot

            pyplot.close(self._window[0])
            self._window = None

    def _at(self, places: NDArray[np.float64]) -> NDArray[np.int32]:
        """Return the pixels [..., 2] of places [..., 2] (m); y points up."""
        at = (np.nan_to_num(places) - self._low) * self._scale
        at[..., 1] = self._size[0] - at[..., 1]
        return np.clip(np.rint(at), -10_000, 10_000).astype(np.int32)

    def _place(self) -> NDArray[np.uint8]:
        image = np.full((*self._size, 3), _PAPER, np.uint8)
        for shape in self._shapes:
            colour = _FORBIDDEN if shape.get("forbidden") else None
            if "polygon" in shape:
                corners = self._at(np.array(shape["polygon"], float))
                if colour and len(corners) > 2:
                    cv2.fillPoly(image, [corners], colour)
                thick = max(round(shape.get("width", 0.0) * self._scale), 1)
                cv2.polylines(image, [corners], True, _INK, thick, cv2.LINE_AA)
            if "circle" in shape:
                x, y, radius = shape["circle"]
                at = tuple(map(int, self._at(np.array([x, y], float))))
                pixels = max(round(radius * self._scale), 1)
                if colour:
                    cv2.circle(image, at, pixels, colour, -1, cv2.LINE_AA)
                cv2.circle(image, at, pixels, _INK, 1, cv2.LINE_AA)
            if "text" in shape:
                at = tuple(map(int, self._at(np.array(shape["at"], float))))
                face = cv2.FONT_HERSHEY_SIMPLEX
                cv2.putText(image, str(shape["text"]), at, face, 0.4, _INK, 1, cv2.LINE_AA)
        return image
