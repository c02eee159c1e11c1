"""The ideal unicycle, the baseline for every learned simulator.

It drives at constant forward and angular velocity for a whole command, independent of earlier
commands: without motor lag or slip.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurosim.base import se2
from tracking.datasets.dataset import Dataset


@dataclass(frozen=True)
class Unicycle:
    """Predicts displacements of exact circular arcs.

    Attributes:
        inputs: names of the columns of an input array.
        forward: metres per second for each unit of v, or of mean motor command.
        turning: radians per second for each unit of w, or of right minus left motor command.
        description: origin of the two factors.
    """

    inputs: tuple[str, ...]
    forward: float
    turning: float
    description: str

    def displacement(self, inputs: NDArray) -> NDArray:
        """Return the displacements (N, 3) for inputs (N, I)."""
        speed, turn, duration = _drive(self.inputs, inputs)
        zero = np.zeros_like(speed)
        return se2.exp(
            np.stack(
                [self.forward * speed * duration, zero, self.turning * turn * duration], axis=-1
            )
        )


def unicycle(rows: Dataset) -> Unicycle | None:
    """Return the unicycle for a dataset, None if its inputs do not fit one.

    If the inputs are velocities (v in m/s, w in rad/s), nothing is fitted. If they are motor
    commands, or velocities in other units, the two factors that convert them to velocities are
    fitted to ``rows`` by least squares.
    """
    names = rows.inputs
    units = {entry["name"]: entry.get("unit") for entry in rows.meta["inputs"]}
    kind = "unicycle"
    if {"v", "w", "duration"} <= set(names):
        if (units["v"], units["w"]) == ("m/s", "rad/s"):
            return Unicycle(names, 1.0, 1.0, "ideal unicycle")
    elif {"left", "right", "duration"} <= set(names):
        kind = "differential drive"
    else:
        return None
    speed, turn, duration = _drive(names, rows.input_array())
    ahead, _, turned = se2.mid_turn(rows.output_array()).T
    return Unicycle(
        names,
        _slope(se2.chord(turned) * speed * duration, ahead),
        _slope(turn * duration, turned),
        f"ideal {kind}, two factors fitted",
    )


def _drive(names: tuple[str, ...], inputs: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    column = {name: inputs[..., place] for place, name in enumerate(names)}
    if "v" in column:
        return column["v"], column["w"], column["duration"]
    mean = (column["left"] + column["right"]) / 2
    return mean, column["right"] - column["left"], column["duration"]


def _slope(x: NDArray, y: NDArray) -> float:
    power = float(x @ x)
    return float(x @ y) / power if power > 0 else 0.0
