"""Networks from what a robot observes to its motors: Figure 2 of Lund and Miglino 1996, and more.

Without hidden layers every input and a bias have a weight to each output; tanh of the sums is the
wheels' speed as a fraction of full speed. See :mod:`neurosim.networks.control` for the formulas.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import torch
from msgspec import Meta
from numpy.typing import NDArray
from torch import Tensor

from neurosim.base.declared import Number
from neurosim.base.errors import UserError
from neurosim.controllers.base import WHEELS, Controller
from neurosim.networks.control import CTRNN, ELMAN, FEED_FORWARD, NetworkArrays

#: Units of a hidden layer.
Units = Annotated[int, Meta(ge=1, le=4096)]


@dataclass(frozen=True)
class Network(Controller):
    """Feed-forward networks.

    Attributes:
        inputs: Names of its observations: readings, and x, y, cos_heading, sin_heading or goals.
        hidden: Units of each hidden layer; the paper has none.
        outputs: Columns of the command.
        scale: Largest command, percent: one number, or a list of one for each output.
    """

    kind: ClassVar[str] = "network"

    inputs: tuple[str, ...]
    hidden: tuple[Units, ...] = ()
    outputs: tuple[str, ...] = WHEELS
    scale: Number | tuple[Number, ...] = 100.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _freeze(self, "inputs", "hidden", "outputs", "scale")
        _check_scale(self)
        _check_names(self)

    @property
    def shapes(self) -> list[tuple[int, int]]:
        """Rows and columns of each layer's weights, the bias last."""
        sizes = (len(self.inputs), *self.hidden, len(self.outputs))
        return [(after, before + 1) for before, after in pairwise(sizes)]

    @property
    def genes(self) -> int:  # type: ignore[override]
        """Number of weights."""
        return sum(rows * columns for rows, columns in self.shapes)

    def act(self, genes: Tensor, observation: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        values, first = observation, 0
        for rows, columns in self.shapes:
            weights = genes[:, first : first + rows * columns].unflatten(1, (rows, columns))
            sums = (weights[..., :-1] * values.unsqueeze(1)).sum(-1) + weights[..., -1]
            values, first = sums.tanh(), first + rows * columns
        return _scale(self.scale, values) * values, memory

    def arrays(self) -> NetworkArrays:
        return _arrays(self, FEED_FORWARD)

    def settings(self) -> dict[str, Any]:
        return asdict(self)


def braitenberg(
    readings: Sequence[str], bearings: NDArray[np.float64], speed: float = 1.2, gain: float = 4.0
) -> tuple[Network, NDArray[np.float64]]:
    """Return a hand-written network that avoids obstacles, and its genes: a Braitenberg vehicle.

    Each wheel is slowed by near objects on the other side, most by those straight ahead.

    Args:
        readings: names of the sensors' readings.
        bearings: direction of each sensor, [S] rad to the left; NaN for one that sees nothing.
        speed: of the wheels if nothing is near, as the argument of tanh.
        gain: of a sensor that looks straight ahead.
    """
    network = Network(tuple(readings))
    ahead = gain * np.nan_to_num(np.maximum(np.cos(bearings), 0.0))
    left, right = (ahead * (side * np.nan_to_num(bearings) <= 0.0) for side in (1, -1))
    return network, np.concatenate([-left, [speed], -right, [speed]])


@dataclass(frozen=True)
class Recurrent(Controller):
    """Recurrent networks of one hidden layer, Elman's or continuous-time.

    Attributes:
        inputs: Names of its observations: readings, and x, y, cos_heading, sin_heading or goals.
        units: Hidden units.
        dynamics: How its hidden units change: elman, or ctrnn (in continuous time).
        outputs: Columns of the command.
        scale: Largest command, percent: one number, or a list of one for each output.
    """

    kind: ClassVar[str] = "recurrent"

    inputs: tuple[str, ...]
    units: Units = 5
    dynamics: Literal["elman", "ctrnn"] = "elman"
    outputs: tuple[str, ...] = WHEELS
    scale: Number | tuple[Number, ...] = 100.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _freeze(self, "inputs", "outputs", "scale")
        _check_scale(self)
        _check_names(self)

    @property
    def genes(self) -> int:  # type: ignore[override]
        """Number of weights and time constants."""
        own = self.units if self.dynamics == "ctrnn" else 0
        hidden = self.units * (len(self.inputs) + self.units + 1)
        return own + hidden + len(self.outputs) * (self.units + 1)

    @property
    def memory(self) -> int:  # type: ignore[override]
        """Size of the memory: one number for every hidden unit."""
        return self.units

    def act(self, genes: Tensor, observation: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return commands [B, C] and the hidden units' states [B, units]."""
        units, outputs = self.units, len(self.outputs)
        alpha: Tensor | float = 1.0
        if self.dynamics == "ctrnn":
            alpha, genes = 1.0 / (1.0 + genes[:, :units].exp()), genes[:, units:]
        columns = len(self.inputs) + units + 1
        hidden = genes[:, : units * columns].unflatten(1, (units, columns))
        last = genes[:, units * columns :].unflatten(1, (outputs, units + 1))
        seen = torch.cat([observation, memory.tanh()], dim=1)
        sums = (hidden[..., :-1] * seen.unsqueeze(1)).sum(-1) + hidden[..., -1]
        memory = memory + alpha * (sums - memory)
        out = (last[..., :-1] * memory.tanh().unsqueeze(1)).sum(-1) + last[..., -1]
        return _scale(self.scale, out) * out.tanh(), memory

    def arrays(self) -> NetworkArrays:
        return _arrays(self, ELMAN if self.dynamics == "elman" else CTRNN)

    def settings(self) -> dict[str, Any]:
        return asdict(self)


def _freeze(family: Network | Recurrent, *names: str) -> None:
    """Turn lists, which files have, into tuples."""
    for name in names:
        value = getattr(family, name)
        if not isinstance(value, int | float):
            object.__setattr__(family, name, tuple(value))


def _check_names(family: Network | Recurrent) -> None:
    if not family.inputs:
        raise UserError(
            f"a controller of the kind {family.kind} needs inputs (names of its observations): "
            f'make it with make_controller("{family.kind}", simulator, task), which uses all '
            'sensors and goals, or give inputs=("x", "y", "cos_heading", '
            '"sin_heading")'
        )
    if not family.outputs:
        raise UserError(
            f"a controller of the kind {family.kind} needs outputs, the columns of its commands, "
            "such as left, right"
        )


def _check_scale(family: Network | Recurrent) -> None:
    if isinstance(family.scale, tuple) and len(family.scale) != len(family.outputs):
        raise UserError(
            f"scale has {len(family.scale)} numbers for the {len(family.outputs)} outputs "
            f"{', '.join(family.outputs)}: give one number, or one for each"
        )


def _scale(scale: float | tuple[float, ...], like: Tensor) -> Tensor:
    return torch.as_tensor(scale, dtype=like.dtype, device=like.device)


def _arrays(family: Network | Recurrent, recurrence: int) -> NetworkArrays:
    hidden = family.hidden if isinstance(family, Network) else (family.units,)
    return NetworkArrays(
        len(family.inputs),
        np.array(hidden, np.int64),
        np.broadcast_to(np.asarray(family.scale, np.float64), (len(family.outputs),)).copy(),
        recurrence,
    )
