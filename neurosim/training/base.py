"""The protocol of trainers, and their data."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple, Protocol

import numpy as np
import torch
from msgspec import Meta
from torch import Tensor

from neurosim.simulators import MotionNetwork
from neurosim.simulators.motion.network import follows


class Within(NamedTuple):
    """Poses within commands, [K] each.

    Attributes:
        row: index of the command.
        time: since its beginning, s.
        moved: displacement since its beginning, [K, 3] m, m, rad.
    """

    row: Tensor
    time: Tensor
    moved: Tensor


@dataclass(frozen=True)
class TrainingData:
    """The training rows, and their scale for a network.

    Attributes:
        inputs: names and units of the inputs, [{name, unit}].
        x: inputs, [N, I], float64, in the dataset's units.
        y: displacements, [N, 3], in m, m and rad.
        within: poses within the commands, if known.
        scale: divisors of the inputs, [I]; None: the largest magnitude of each.
        joined: whether a row begins at the end of the previous one, [N] bool, for learning from
            windows of several rows; None: rows are independent.
        start: pose of the robot at each command's beginning, [N, 3] m, m, rad, in a common frame;
            None: unknown.
    """

    inputs: list[dict[str, str]]
    x: Tensor
    y: Tensor
    within: Within | None = None
    scale: Tensor | None = None
    joined: Tensor | None = None
    start: Tensor | None = None

    @property
    def input_scale(self) -> Tensor:
        """The divisors of the inputs, [I]: scaled inputs lie in [-1, 1]."""
        if self.scale is not None:
            return self.scale
        scale = self.x.abs().amax(0)
        names = [entry["name"] for entry in self.inputs]
        # A previous speed has the scale of the command.
        for place, name in enumerate(names):
            before = f"prev_{name}"
            if before in names:
                largest = torch.maximum(scale[place], scale[names.index(before)])
                scale[place] = scale[names.index(before)] = largest
        return _not_zero(scale)

    def once(self) -> TrainingData:
        """Return the data without duplicate rows, which would count twice."""
        rows = torch.cat([self.x, self.y], dim=1).numpy()
        first = np.sort(np.unique(rows, axis=0, return_index=True)[1])
        return self if len(first) == len(rows) else self.part(torch.from_numpy(first))

    def part(self, rows: Tensor | slice) -> TrainingData:
        """Return some of the rows, by indices or a slice, with their own scale."""
        chosen = torch.arange(len(self.x))[rows]
        within = self.within
        if within is not None:
            place = torch.full((len(self.x),), -1)
            place[chosen] = torch.arange(len(chosen))
            kept = place[within.row] >= 0
            row, time, moved = (part[kept] for part in within)
            within = Within(place[row], time, moved)
        joined = self.joined
        if joined is not None:
            next_to = torch.diff(chosen, prepend=torch.tensor([-2])) == 1
            joined = joined[chosen] & next_to
        start = None if self.start is None else self.start[chosen]
        return replace(
            self, x=self.x[chosen], y=self.y[chosen], within=within, joined=joined, start=start
        )

    @property
    def follows(self) -> Tensor:
        """Whether each row's command followed that of the previous row, [N] bool."""
        return follows([entry["name"] for entry in self.inputs], self.x)

    @property
    def scaled_inputs(self) -> Tensor:
        """Inputs divided by their scale, [N, I]."""
        return self.x / self.input_scale


def root_mean_square(values: Tensor) -> Tensor:
    """Return the root mean square of each column, 1 where it is zero."""
    return _not_zero(values.square().mean(0).sqrt())


def _not_zero(scale: Tensor) -> Tensor:
    return torch.where(scale > 0, scale, 1.0)


#: Numbers of units of a kind.
Units = Annotated[int, Meta(ge=1, le=4096)]


class _LBFGS(torch.optim.LBFGS):
    """L-BFGS without PyTorch's compiler, which would take three seconds to import."""

    add_param_group = inspect.unwrap(torch.optim.Optimizer.add_param_group)


#: Value of a function where it is not finite.
_WORST = 1e100


def minimise(parameters: Sequence[Tensor], loss: Callable[[], Any], *, steps: int) -> None:
    """Minimise a function by L-BFGS whose line search fulfils the strong Wolfe conditions.

    Nocedal and Wright 2006, algorithms 7.5 and 3.5.

    Args:
        parameters: its arguments; they are changed to the best that were tried.
        loss: returns its value, and sets new gradients of the arguments.
        steps: most iterations.
    """
    least, best = math.inf, [one.detach().clone() for one in parameters]

    def finite() -> float:
        nonlocal least, best
        value = loss()
        value = value.item() if isinstance(value, Tensor) else float(value)
        if not math.isfinite(value):  # too long a step: the line search tries a shorter one
            for one in parameters:
                one.grad = torch.zeros_like(one)
            return _WORST
        if value < least:
            least, best = value, [one.detach().clone() for one in parameters]
        return value

    optimiser = _LBFGS(list(parameters), max_iter=steps, line_search_fn="strong_wolfe")
    optimiser.step(finite)
    with torch.no_grad():
        for one, kept in zip(parameters, best, strict=True):
            one.copy_(kept)


class Trainer(Protocol):
    """Learns a motion network, generation by generation.

    Attributes:
        source: publication of the method.
        settings_type: class of its settings, a frozen dataclass.
        generations: number of calls of :meth:`advance`.
        device: where it computes, which may differ from the wanted one.
    """

    source: str
    settings_type: type
    generations: int
    device: str

    def __init__(self, data: TrainingData, settings: Any, seed: int, device: str) -> None: ...

    def advance(self) -> Tensor:
        """Run one generation; return the lowest mean squared errors so far, [3], in SI units."""
        ...

    def result(self) -> MotionNetwork:
        """Return the best simulator so far."""
        ...
