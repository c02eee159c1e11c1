"""The default trainer: a drive model, and a Gaussian process for its residuals.

Three parts are learned one after the other:

1. the drive model (:mod:`neurosim.training.trainers.drive_fit`): lags, delay, kinematics;
2. a Gaussian process of its residuals (:mod:`neurosim.training.trainers.gaussian_process`).
   Held-out rows decide for each output how much it counts (stacking: Wolpert 1992, Breiman 1996),
   so that it does not count if the rows do not support it;
3. the floor (:mod:`neurosim.training.trainers.floor_fit`), if rows have the robot's poses and show
one. Drive model and process are then fitted again to the rows without its effect.

Each member of the ensemble learns the first two from rows with random weights (the Bayesian
bootstrap: Rubin 1981) and from a draw of the process' prior, and has its own floor. So the members
span all remaining uncertainty.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from msgspec import Meta
from torch import Tensor

from neurosim.base.declared import Checked, Count
from neurosim.base.errors import UserError
from neurosim.base.se2 import tensors as se2
from neurosim.base.threads import one_thread
from neurosim.networks import ProductSummationNetwork
from neurosim.networks.product_units import Weights
from neurosim.simulators import MotionNetwork
from neurosim.simulators.motion.derived import Derived, can_swing
from neurosim.simulators.motion.drive import DriveModel, Reached, Underway
from neurosim.simulators.motion.excess import Excess
from neurosim.simulators.motion.floor import Floor
from neurosim.simulators.motion.kernel_units import KernelUnits
from neurosim.simulators.motion.network import can_drive, rows_underway
from neurosim.simulators.motion.noise import CommandFeatures, NoiseModel, disturb, residual
from neurosim.training.base import TrainingData, Within
from neurosim.training.error_size import row_weights
from neurosim.training.excess import fit_excess
from neurosim.training.noise import USUAL_SPREAD, fit_noise, fit_spread
from neurosim.training.trainers.drive_fit import Fit, Motion, fit_again, fit_drive
from neurosim.training.trainers.floor_fit import FloorFit, evened, fit_floor
from neurosim.training.trainers.gaussian_process import Process, choose_centres, learn_process
from neurosim.training.trainers.windows import LENGTHS, Chains, Windows, runs_of, windows_of

OUTPUTS = 3
#: Parts that can be left out, to measure their effect.
MECHANISMS = (
    *("laws", "modes", "symmetry", "car", "straight", "drift", "dead_band", "swing", "process"),
    *("row_weights", "drive_members", "floor", "spread", "excess"),
)
#: Number of stretches of time; alternate ones form the two halves of the rows.
STRETCHES = 24
#: Part of the Gaussian process' uncertainty that members have even where it does not count.
UNPROVEN = 0.5
#: Rows for each unit of the Gaussian process, beyond the first number of units.
ROWS_PER_CENTRE = 3
#: Number of rows that parts of all commands together count as for the noise, at most; those of one
#: command repeat the same noise, and count as one row. Where rows are few, they tell how it depends
#: on the time; but they make that of whole commands too wide (by a tenth for three robots of 400
#: rows without this limit).
NOISE_PARTS = 80.0
#: Number of rows up to which a drive model's residuals on its own rows are much smaller than on
#: others.
FEW = 250
#: Noise of the model of all rows, as a fraction of that of models of halves, which err more.
OF_HALVES = 0.88
#: Number of rows up to which laws are searched again in halves, because the first search is the
#: larger part of the uncertainty (24 rows: 80 % intervals of the turn contain 84 %, otherwise 69).
SCARCE = 50
#: Parts of a log, each predicted by drive models of the others, the largest number of rows of a
#: block in one, and samples of the noise, for the spread of windows.
PARTS, BLOCK, SPREAD_DRAWS = 4, 300, 50
#: Largest number of windows of a log that the process learns from. And the least kinds of windows
#: that are tried for its lengths: there are more short ones, but longer ones show more.
MOST_WINDOWS, OF_LENGTHS = 12_000, (0, 1)
#: Number of blocks of a log at which its members differ twice as much as those of a long one: less
#: than a minute of driving does not show all that a robot can do.
FEW_BLOCKS = 20.0
#: Number of steps of the tried weights of the Gaussian process.
_FRACTIONS = 10
#: If a chord is shorter than this fraction of its arc, its end tells nothing about the speed.
_LEAST = 1e-3
#: Largest distance from a reversal, in half turns, at which a caster may swing to the other side.
SWINGS = (-0.03, 0.03)
#: Gain in log-likelihood for accepting an input for the change of direction.
_BELIEVED = 5.0
#: Number of commands for the process' lengths.
_ROWS = 400
#: Number of standard deviations at which an error of a window counts half.
_FAR = 3.0
#: Number of random commands, some of which become centres.
_RANDOM = 1000
#: Shortest part of a command that is learned from, s.
_SHORTEST = 0.1
#: Difference at which a speed counts as settled.
_SETTLED = 0.05
#: Reduction of the loss's logarithm for accepting twice as many units of the Gaussian process.
_WORTH = 0.03
#: Smallest reduction of the loss, as a fraction, for which the process counts.
_SIMPLER = 0.01
#: The same for windows of a log, in standard errors of the reduction (Breiman et al. 1984 take 1).
_SURE = 0.25
#: Number of times that the floor is learned; the second time for a robot that was learned on an
#: even one.
_PASSES = 2
#: Ridge of the projection of a member's drive model on units, as a fraction of a unit's square.
_RIDGE = 1e-6


@dataclass(frozen=True)
class CombinedSettings(Checked):
    """Settings of the trainer.

    Attributes:
        members: Simulators in the ensemble; 1: no ensemble. Eight are sometimes alike by chance, so
            that a plan which fails in reality completes in all of them.
        noise: Fit a noise model.
        dead_band: Dead band of each input, as a fraction of its largest value; by default it is
            estimated from the data.
        centres: Kernel centres of the Gaussian process at the start. They are doubled for as long
            as that lessens the errors of held-out rows, and there are :data:`ROWS_PER_CENTRE` rows
            each.
        most_centres: Largest number of kernel centres.
        part_weight: Weight of a part of a command, relative to a whole command.
        most_parts: Largest number of poses within commands that are used.
        noise_rows: Largest number of rows from which the noise is learned.
        whole_commands: Learn from whole commands alone, not from parts of them.
        without: Parts of the trainer to leave out, to measure their effect: ``laws`` (lag, delay
            and other parameters of the actuators), ``modes`` (these laws for a body that is slower
            than its actuators), ``symmetry`` (of such a body), ``car`` (a robot that turns only
            while it drives), ``straight`` (speeds proportional to commands), ``drift`` (a lag of
            products and losses), ``dead_band``, ``swing`` (how a caster turns when the direction
            changes), ``process`` (the Gaussian process), ``row_weights`` (rows with larger errors
            count less), ``drive_members`` (a drive model for each member), ``floor`` (a map of the
            slip over the board), ``spread`` (the size of noise and of members' differences by runs
            of commands or windows of a log), ``excess`` (how long a speed that is measured lasts;
            learned with ``spread``).
    """

    members: Annotated[int, Meta(ge=1, le=1000)] = 16
    noise: bool = True
    dead_band: tuple[Annotated[float, Meta(ge=0, lt=1)], ...] | None = None
    centres: Count = 75
    most_centres: Count = 1200
    part_weight: Annotated[float, Meta(ge=1e-6, le=1000)] = 0.3
    most_parts: Count = 40000
    noise_rows: Count = 20000
    whole_commands: bool = False
    without: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.without:
            if name not in MECHANISMS:
                raise UserError(f"without: expected {', '.join(MECHANISMS)}, found {name!r}")


class Residuals(NamedTuple):
    """The residuals of the drive model.

    Attributes:
        x: scaled inputs, [N, I].
        y: displacements, [N, 3].
        given: inputs of the process, [N, J].
        left: residuals of displacements in the frame of the last piece's middle, [N, 3] (m, m,
            rad).
        factor: factor of each of the process' outputs in ``left``, [N, 3].
        weight: of the rows, [N].
    """

    x: Tensor
    y: Tensor
    given: Tensor
    left: Tensor
    factor: Tensor
    weight: Tensor


class _Parts(NamedTuple):
    """Parts of commands, [K] each.

    Attributes:
        command: index of the whole row.
        begins: in the command, s.
        lasts: s.
        y: displacements, [K, 3].
    """

    command: Tensor
    begins: Tensor
    lasts: Tensor
    y: Tensor


class _Instants(NamedTuple):
    """Instants of a log at which the robot was seen, [K], in the order of time.

    Attributes:
        row: the row in which each is, or which it ends.
        since: time since the row's beginning, s.
        moved: displacement since then, [K, 3].
        ends: number of the instant at which each row ends, [N].
        time: since the log's beginning, without its gaps, s.
        drive: number of the drive in which each is.
    """

    row: Tensor
    since: Tensor
    moved: Tensor
    ends: Tensor
    time: Tensor
    drive: Tensor


class CombinedTrainer:
    """Learns a motion network with a drive model, its members and its noise; see the module."""

    source = (
        "A drive model, and a Gaussian process (Rasmussen and Williams 2006) of its residuals that "
        "counts as much as held-out rows support (stacking: Breiman 1996)"
    )
    settings_type = CombinedSettings
    #: The drive model, the Gaussian process, and the members.
    generations = 3
    device = "cpu"

    def __init__(
        self, data: TrainingData, settings: CombinedSettings, seed: int, device: str = "cpu"
    ):
        """Prepare to learn; ``device`` is not used: loops are compiled for the CPU."""
        names = tuple(entry["name"] for entry in data.inputs)
        if not can_drive(names):
            raise ValueError(
                "it needs a duration and the previous value of each input; use the trainer ga"
            )
        self._data, self._settings, self._seed = data.once(), settings, seed
        self._columns = CommandFeatures.of(names)
        self._longest = float(self._data.input_scale[self._columns.duration])
        self._done: list[Tensor] = []
        self._floor: FloorFit | None = None
        self._excess: Excess | None = None

    def advance(self) -> Tensor:
        """Learn the next part; return mean squared errors, [3]."""
        stages = (self._learn_drive, self._learn_process, self._learn_members)
        with one_thread():
            self._done.append(stages[len(self._done)]())
        return self._done[-1]

    def result(self) -> MotionNetwork:
        """Return the simulator: the mean, its members and its noise; the same on any cores."""
        while len(self._done) < self.generations:
            self.advance()
        return self._simulator

    # The drive model

    def _learn_drive(self) -> Tensor:
        data, settings = self._data, self._settings
        x, y = data.scaled_inputs, data.y
        driven, band = list(self._columns.driven), None
        if settings.dead_band is not None:
            names = [one["name"] for one in data.inputs]
            if len(settings.dead_band) != len(names):
                raise UserError(
                    f"dead_band: expected {len(names)} numbers, one for each input "
                    f"({', '.join(names)}), not {len(settings.dead_band)}"
                )
            band = torch.tensor(settings.dead_band, dtype=x.dtype)[driven]
        elif "dead_band" in settings.without:
            band = torch.zeros(len(driven), dtype=x.dtype)
        within = None if settings.whole_commands else data.within
        self._windows: Windows | None = None
        #: Windows that the process learns from, if rows are shorter: an error of a pose is one of
        #: both rows that it lies between, and cancels in a window.
        self._short: Windows | None = None
        self._motion: Motion | Chains
        if data.joined is None:
            self._motion = Motion(x, y, data.follows, self._columns, self._longest, within)
        else:
            time = data.x[:, self._columns.duration]
            self._windows = windows_of(time, data.joined)
            if float(time.median()) < LENGTHS[1]:
                self._short = self._windows.some(MOST_WINDOWS)
            self._motion = Chains.of(x, y, data.joined, self._columns, self._longest, within)
        self._band = band
        return self._leave(fit_drive(self._motion, band, settings.without))

    def _leave(self, fit: Fit) -> Tensor:
        """Store a drive model's residuals; return mean squared errors, [3]."""
        data, settings = self._data, self._settings
        x, y = data.scaled_inputs, data.y
        self._fit, self._drive = fit, fit.drive
        inputs, under = self._inputs(fit)
        self._dead_band = torch.zeros_like(x[0])
        for places in (self._columns.driven, self._columns.before):
            self._dead_band[list(places)] = fit.band
        rows = self._residuals(inputs, y, torch.ones_like(y[:, 0]), under)
        #: Index of each row's command.
        self._command, self._cut = torch.arange(len(x)), self._parts(rows.x)
        if self._cut is not None:
            parts = self._part_inputs(self._drive, rows.x)
            weight = torch.full_like(self._cut.y[:, 0], settings.part_weight)
            more = self._residuals(parts, self._cut.y, weight)
            rows = Residuals(*(torch.cat(pair) for pair in zip(rows, more, strict=True)))
            self._command = torch.cat([self._command, self._cut.command])
        self._rows = rows
        return rows.left[: len(x)].square().mean(0)

    def _inputs(self, fit: Fit) -> tuple[Tensor, Underway | None]:
        """Return a drive model's inputs of the whole rows.

        For windows also return the actuators' state there, which the inputs contain only in part.
        """
        if isinstance(self._motion, Chains):
            return self._motion.inputs(fit, self._data.scaled_inputs)
        return self._motion.inputs(fit), None

    def _phases(
        self, drive: DriveModel, x: Tensor, under: Underway | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return :meth:`DriveModel.phases` of inputs [N, I]."""
        columns = self._columns
        under = rows_underway(drive, columns, x) if under is None else under
        time = x[:, columns.duration] * self._longest
        return drive.phases(under, x[:, list(columns.driven)], time)

    def _residuals(
        self, x: Tensor, y: Tensor, weight: Tensor, under: Underway | None = None
    ) -> Residuals:
        phases = self._phases(self._drive, x, under)
        left, factor = _left(*phases, x[:, self._columns.duration], y)
        return Residuals(x, y, x[:, : len(self._data.inputs)], left, factor, weight)

    def _parts(self, x: Tensor) -> _Parts | None:
        """Return the parts of commands that are learned from; None: whole commands alone.

        Alternate instants give the beginning until then, or the rest from then on.

        Args:
            x: inputs of the whole rows by the drive model.
        """
        within, columns = self._data.within, self._columns
        if self._settings.whole_commands or within is None or not len(within.row):
            return None
        # A limited number, with several parts for each command.
        stride = -(-len(within.row) // self._settings.most_parts)
        stride += stride > 1 and stride % 2 == 0  # the two kinds take turns
        within = Within(*(part[::stride] for part in within))
        time, moved = within.time.to(x), within.moved.to(x)
        left = x[within.row, columns.duration] * self._longest - time
        odd = torch.arange(len(within.row)) % 2 == 1
        until, since = ~odd & (time >= _SHORTEST), odd & (left >= _SHORTEST)
        # A rest is like a separate command only if no command is pending.
        commanded, reached = self._when(self._drive, x, within.row[since], time[since])
        settled = (commanded - reached.speed).abs().amax(1) < _SETTLED
        since[since.clone()] = settled | (time[since] >= self._drive.delay)
        after = se2.between(moved[since], self._data.y.to(x)[within.row[since]])
        command = torch.cat([within.row[until], within.row[since]])
        begins = torch.cat([torch.zeros_like(time[until]), time[since]])
        lasts = torch.cat([time[until], left[since]])
        return _Parts(command, begins, lasts, torch.cat([moved[until], after]))

    def _when(
        self, drive: DriveModel, x: Tensor, row: Tensor, time: Tensor
    ) -> tuple[Tensor, Reached]:
        """Return the commands of rows [K], and what is reached at a time (s) in them."""
        under = rows_underway(drive, self._columns, x[row])
        commanded = x[row][:, list(self._columns.driven)]
        return commanded, drive.reached(under, commanded, time)

    def _part_inputs(self, drive: DriveModel, x: Tensor) -> Tensor:
        """Return the inputs of parts of commands, from a drive model's of the whole rows."""
        assert self._cut is not None
        command, begins, lasts, _ = self._cut
        inputs, rest = x[command].clone(), begins > 0.0
        commanded, reached = self._when(drive, x, command[rest], begins[rest])
        there = inputs[rest]
        there[:, list(self._columns.before)] = reached.speed
        # It acts already.
        there[:, len(self._data.inputs) :] = torch.cat([commanded, reached.drift], 1)
        inputs[rest] = there
        inputs[:, self._columns.duration] = lasts / self._longest
        return inputs

    # The Gaussian process

    def _learn_process(self) -> Tensor:
        """Learn the process and the floor, then drive model and process again on an even floor."""
        self._fit_process()
        uneven, once = self._data, torch.ones(1, len(self._data.x), dtype=torch.float64)
        for _ in range(_PASSES):
            floor = self._fit_floor(uneven)
            if floor is None:
                break
            self._floor, self._data = floor, _on_even_floor(uneven, floor.floor)
            self._motion = _moved(self._motion, self._data)
            rows = _moved(self._fit.rows, self._data)
            self._leave(fit_again(self._fit._replace(rows=rows), once)[0])
            self._use(self._derived)
            self._trust = self._trusted()
            self._best = self._judged(self._best.process)
        #: Weights of the units, learned from all rows, [3, K].
        rows, best = self._rows, self._best
        once = torch.ones_like(rows.weight)
        designs = (self._design(best.units, o) for o in range(OUTPUTS))
        posteriors = (self._posterior(best.process, one, o, once) for o, one in enumerate(designs))
        self._mean = torch.stack([mean for mean, _ in posteriors])
        outputs = best.fractions[:, None] * (self._mean @ best.units.T)
        return (rows.left - rows.factor * outputs.T)[: len(self._data.x)].square().mean(0)

    def _fit_floor(self, data: TrainingData) -> FloorFit | None:
        """Learn the floor from the residuals of drive model and process on original whole rows."""
        whole = len(data.x)
        if data.start is None or data.joined is not None or "floor" in self._settings.without:
            return None
        if self._glides:
            return None  # errors last for several rows, and would be taken for a floor
        x, under = self._inputs(self._fit)
        changing, twist = self._phases(self._drive, x, under)
        unseen = (self._best.unseen * self._best.fractions.unsqueeze(1)).T[:whole]
        twist = twist + x[:, self._columns.duration, None] * unseen
        left = residual(se2.compose(changing, se2.exp(twist)), data.y.to(x))[:, :2]
        trust = row_weights(self._rows.given[:whole], left.T).T.square()
        generator = torch.Generator().manual_seed(self._seed)
        members = self._settings.members
        return fit_floor(data.start, data.y, left, trust, members, generator)

    def _fit_process(self) -> None:
        """Choose the process' inputs, lengths and centres."""
        self._trust = self._trusted()
        generator = torch.Generator().manual_seed(self._seed)
        count = int(self._command.amax()) + 1
        separate = [torch.arange(count)]
        if self._short is not None:
            separate = [self._short.separate(kind) for kind in OF_LENGTHS]
            count = len(separate[0])
        elsewhere, tried = self._elsewhere(generator), []
        for own in separate:
            if not tried or len(own) > 1:
                chosen = own[torch.randperm(len(own), generator=generator)[:_ROWS]]
                process, derived = self._with_lengths(chosen, elsewhere)
                self._use(derived)
                tried.append((self._judged(process), derived))
        self._best, derived = min(tried, key=lambda one: one[0].loss)
        self._use(derived)
        elsewhere = derived.append(self._columns, elsewhere)
        self._widen(elsewhere, min(self._settings.most_centres, count // ROWS_PER_CENTRE))

    def _use(self, derived: Derived) -> None:
        """Give the process derived inputs."""
        self._derived = derived
        self._rows = self._rows._replace(given=derived.append(self._columns, self._plain))

    @property
    def _plain(self) -> Tensor:
        """The inputs of the process without derived ones, [N, I]."""
        return self._rows.x[:, : len(self._data.inputs)]

    def _with_lengths(self, chosen: Tensor, elsewhere: Tensor) -> tuple[Process, Derived]:
        """Return a process whose lengths are learned from these rows or windows, and its input."""
        rows = self._rows
        left, factor = self._observed(rows.left), self._observed(rows.factor)
        known = factor.abs() >= _LEAST
        value = torch.where(known, left / torch.where(known, factor, 1.0), 0.0)
        weight = torch.where(known, factor.square() * self._trust, 0.0)
        if self._short is not None:
            weight /= self._counted(self._short).unsqueeze(1)
        least, result = math.inf, None
        for swing in (None, *SWINGS) if self._swings else (None,):
            derived = Derived(swing)
            given, other = (derived.append(self._columns, one) for one in (self._plain, elsewhere))
            seen = self._observed_inputs(given)
            process, loss = learn_process(
                seen, value, weight, self._settings.centres, other, chosen
            )
            if loss < least - (_BELIEVED if result is not None else 0.0):
                least, result = loss, (process, derived)
        assert result is not None
        return result

    def _widen(self, elsewhere: Tensor, most: int) -> None:
        """Double the number of centres while this lessens the loss on unseen rows."""
        count, seen = self._settings.centres, self._observed_inputs(self._rows.given)
        best = self._best
        while best.fractions.any() and count <= len(best.process.centres) and 2 * count <= most:
            count *= 2
            centres = choose_centres(seen, elsewhere, best.process.lengths, count)
            wider = self._judged(replace(best.process, centres=centres))
            if wider.loss > best.loss - _WORTH:
                break
            best = wider
        self._best = best

    @property
    def _glides(self) -> bool:
        """Whether the motion depends on more than the last command before one, as a ship's."""
        return self._drive.memory > float(self._data.x[:, self._columns.duration].median())

    @property
    def _swings(self) -> bool:
        """Whether the process may have an input for the change of direction."""
        return can_swing(self._columns) and "swing" not in self._settings.without

    def _observed(self, values: Tensor) -> Tensor:
        """Return values of rows and parts [N, ...], or their sums over windows of rows, [O, ...].

        The process learns from these.
        """
        return values if self._short is None else self._short.sums(values[: len(self._data.x)])

    def _observed_inputs(self, given: Tensor) -> Tensor:
        """Return the inputs [N, J] of the process, or their means in windows, [O, J]."""
        if self._short is None:
            return given
        time = self._rows.x[:, self._columns.duration, None]
        return self._observed(time * given) / self._observed(time)

    def _counted(self, windows: Windows) -> Tensor:
        """Return the weights of windows, [W]: in all as many as fit the log of the shortest."""
        time = self._data.x[:, self._columns.duration].sum()
        return windows.weight * (time / LENGTHS[0] / windows.weight.sum())

    def _trusted(self) -> Tensor:
        """Return the weight of each row or window for each output, [O, 3].

        Of windows it is relative to those of the shortest kind.
        """
        rows, windows = self._rows, self._short
        equal = "row_weights" in self._settings.without or not rows.left.any()
        counts = rows.weight if windows is None else self._counted(windows)
        trust = counts.unsqueeze(1).repeat(1, OUTPUTS)
        if windows is None:
            return trust if equal else trust * row_weights(rows.given, rows.left.T).T.square()
        left, sizes = self._observed(rows.left).square(), []
        for kind in windows.kind.unique():
            own = windows.kind == kind
            sizes.append(2.25 * left[own].median(0).values.clamp(min=1e-18))  # 1.5 medians
            far = 0.0 if equal else left[own] / _FAR**2
            trust[own] *= sizes[0] / (sizes[-1] + far)
        return trust

    def _elsewhere(self, generator: torch.Generator) -> Tensor:
        """Return inputs of the process [M, J] of random commands after random speeds."""
        x = self._plain
        low, high = x.amin(0), x.amax(0)
        # An input with one sign may have the other.
        for places in (self._columns.driven, self._columns.before):
            size = torch.maximum(low.abs(), high.abs())[list(places)]
            low[list(places)], high[list(places)] = -size, size
        uniform = torch.rand(_RANDOM, x.shape[1], generator=generator, dtype=x.dtype).to(x)
        return low + (high - low) * uniform

    def _judged(self, process: Process) -> _Judged:
        """Return a process with its predictions for each part of the rows from the other parts."""
        units, part = process.units(self._rows.given), self._part
        unseen = torch.zeros(OUTPUTS, len(units), dtype=torch.float64)
        for o in range(OUTPUTS):
            design = self._design(units, o)
            for number in part.unique():
                others = (part != number).to(units)
                weights, _ = self._posterior(process, design, o, others)
                unseen[o, part == number] = units[part == number] @ weights
        return _Judged(process, units, unseen, *self._stacked(unseen))

    def _design(self, units: Tensor, output: int) -> Tensor:
        """Return the factors [O, K] of the units' weights in an output, from units [N, K]."""
        return self._observed(self._rows.factor[:, output, None] * units)

    def _posterior(
        self,
        process: Process,
        design: Tensor,
        output: int,
        weight: Tensor,
        off: Tensor | float = 0.0,
    ) -> tuple[Tensor, Tensor]:
        """Return :meth:`Process.posterior` of an output, learned from rows or windows.

        Args:
            process: the process.
            design: of :meth:`_design`, [O, K].
            output: its number.
            weight: factor of each row's weight, [N]; 0: windows with this row do not count.
            off: known part of the output at each row, [N].
        """
        factor = self._rows.factor[:, output]
        left = self._observed(self._rows.left[:, output] - factor * off)
        counts = self._observed(weight)
        if self._short is not None:
            counts = counts / (self._short.end - self._short.first)
            counts = torch.where(self._observed((weight == 0.0).to(weight)) > 0.0, 0.0, counts)
        return process.posterior(design, left, self._trust[:, output] * counts, output)

    @property
    def _part(self) -> Tensor:
        """The number of the part of the rows that each is in, [N]; parts have their command's.

        Halves of alternate stretches of time; of a log the earlier and the later half, or quarters.
        """
        whole = len(self._data.x)
        count = STRETCHES if self._windows is None else 2 if self._short is None else PARTS
        stretch = torch.arange(whole) * count // whole
        return (stretch % 2 if self._windows is None else stretch)[self._command]

    def _of_others(
        self, outputs: Tensor, part: Tensor, instants: _Instants | None = None
    ) -> Tensor:
        """Return displacements [N, 3] of rows by drive models of the other parts' rows.

        Args:
            outputs: outputs [N, 3] of the process, which has not seen the rows either; of whole
                rows, or also of parts of commands.
            part: number of each whole row's part.
            instants: K, if displacements [K, 3] until these are to be returned instead.
        """
        seen = torch.stack([part != k for k in range(int(part.max()) + 1)]).to(outputs)
        if len(part) > SCARCE:
            fits = fit_again(self._fit, seen)
        else:
            each = map(self._motion.weighted, seen)
            own, without = self._fit.rows, set(self._settings.without)
            chosen = {"modes": own.modes is not None, "car": own.steered, "straight": own.straight}
            chosen["drift"] = max(own.drift) > 0.0
            without |= {name for name, there in chosen.items() if not there}
            fits = [fit_drive(rows, self._band, without) for rows in each]
        means = []
        for fit in fits:
            x, under = self._inputs(fit)
            if instants is not None:
                means.append(self._until(fit.drive, x, under, outputs, instants))
                continue
            phases = [self._phases(fit.drive, x, under)]
            if len(outputs) > len(x):
                x = torch.cat([x, self._part_inputs(fit.drive, x)])
                phases.append(self._phases(fit.drive, x[len(part) :]))
            changing, twist = (torch.cat(both) for both in zip(*phases, strict=True))
            twist = twist + x[:, self._columns.duration, None] * outputs
            means.append(se2.compose(changing, se2.exp(twist)))
        number = part[self._command[: len(outputs)] if instants is None else instants.row]
        return torch.stack(means)[number, torch.arange(len(number))]

    def _until(
        self,
        drive: DriveModel,
        x: Tensor,
        under: Underway | None,
        outputs: Tensor,
        instants: _Instants,
    ) -> Tensor:
        """Return displacements [K, 3] until instants within rows of inputs [N, I]."""
        there = x[instants.row]
        there[:, self._columns.duration] = fraction = instants.since / self._longest
        own = None if under is None else Underway(*(each[instants.row] for each in under))
        changing, twist = self._phases(drive, there, own)
        twist = twist + fraction.unsqueeze(1) * outputs[instants.row]
        return se2.compose(changing, se2.exp(twist))

    def _instants(self) -> _Instants | None:
        """Return when a robot was seen, to learn its excess; None: it has none."""
        within, y = self._data.within, self._data.y
        joined = self._data.joined
        if joined is None and self._glides:
            joined = self._data.follows
        if joined is None or "excess" in self._settings.without:
            return None
        lasts = self._data.x[:, self._columns.duration]
        first, whole = torch.nonzero(~joined).squeeze(1), torch.arange(len(y))
        row, since = torch.cat([first, whole]), torch.cat([0.0 * lasts[first], lasts])
        moved = torch.cat([0.0 * y[first], y])
        if within is not None and not self._settings.whole_commands:
            row, since = torch.cat([row, within.row]), torch.cat([since, within.time])
            moved = torch.cat([moved, within.moved])
        order = torch.from_numpy(np.lexsort((since.numpy(), row.numpy())))
        ends = torch.searchsorted(row[order], whole, right=True) - 1
        row, since = row[order], since[order]
        time, drive = (lasts.cumsum(0) - lasts)[row] + since, (~joined).cumsum(0)[row]
        return _Instants(row, since, moved[order], ends, time, drive)

    def _stacked(self, unseen: Tensor) -> tuple[Tensor, float]:
        """Return the weight of the process for each output, [3].

        Also return the mean logarithm of the outputs' losses on held-out rows.
        """
        rows, count = self._rows, None
        judged = [(unseen[o], rows.left[:, o], rows.factor[:, o]) for o in range(OUTPUTS)]
        if self._windows is not None:
            windows, count = self._windows, float(self._windows.weight.sum())
            judged = [self._composed(*one, windows) for one in judged]
        else:
            judged = [(*one, self._trust[:, o]) for o, one in enumerate(judged)]
        allowed = "process" not in self._settings.without
        fitted = [_fraction(*one, allowed, count) for one in judged]
        losses = torch.tensor([max(loss, 1e-30) for _, loss in fitted])
        fractions = torch.tensor([fraction for fraction, _ in fitted], dtype=torch.float64)
        return fractions, float(losses.log().mean())

    def _composed(
        self, outputs: Tensor, left: Tensor, factor: Tensor, windows: Windows
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return an output in windows of whole rows, as arguments of _fraction.

        A row adds the same to the turn of a window, and nearly to its path, as to its own.
        """
        both = windows.sums(torch.stack([factor * outputs, left])[:, : len(self._data.x)], 1)
        trust = windows.weight.clone()
        for kind in range(len(LENGTHS)):
            own = windows.kind == kind
            trust[own] /= both[1, own].square().mean().clamp(min=1e-18)
        return both[0], both[1], torch.ones_like(trust), trust

    # The ensemble

    def _learn_members(self) -> Tensor:
        """Learn the members and the noise; return mean squared errors, [3]."""
        rows, best, settings = self._rows, self._best, self._settings
        count = settings.members if settings.members > 1 else 0
        generator = torch.Generator().manual_seed(self._seed)
        random = self._random_weights(count, generator)
        inputs, units = rows.given.shape[1], len(best.process.centres)
        linear = torch.zeros(1 + count, OUTPUTS, inputs + 1, dtype=torch.float64)
        kernel = torch.zeros(1 + count, OUTPUTS, units, dtype=torch.float64)
        mean, fractions = self._mean, best.fractions.unsqueeze(1)
        kernel[0] = fractions * mean
        trusted = fractions.clamp(min=UNPROVEN * ("process" not in settings.without))
        if count:
            changes = self._changes(random, generator)
            priors = [best.process.prior(o) for o in range(OUTPUTS)]
            designs = [self._design(best.units, o) for o in range(OUTPUTS)]
        for m in range(count):
            change, own = changes[m], torch.zeros_like(mean)
            off = self._units_of(rows.given, best.units) @ change.T
            weight = random[m][self._command]
            for o in range(OUTPUTS):
                centre, triangle = self._posterior(best.process, designs[o], o, weight, off[:, o])
                draw = priors[o] @ torch.randn(units, 1, generator=generator, dtype=mean.dtype)
                own[o] = centre + torch.cholesky_solve(draw, triangle).squeeze(1)
            linear[1 + m], part = change[:, : inputs + 1], change[:, inputs + 1 :]
            kernel[1 + m] = kernel[0] + part + trusted * (own - mean)
        simulator = self._made(linear, kernel)
        unseen = (best.unseen * fractions).T
        if settings.noise:
            simulator.noise = noise = self._noise(simulator, unseen)
            if "spread" not in settings.without:
                each = self._spread(noise, unseen, torch.cat([linear, kernel], 2))
                linear, kernel = (
                    part[:1] + each[1] * (part - part[:1]) for part in (linear, kernel)
                )
                simulator = self._made(linear, kernel)
                simulator.noise = noise.times(each[0])
        simulator.meta = {"composition": self._composition()}
        self._simulator = simulator
        return (rows.left - rows.factor * unseen)[: len(self._data.x)].square().mean(0)

    def _made(self, linear: Tensor, kernel: Tensor) -> MotionNetwork:
        """Return the simulator of weights: one and inputs [M, 3, 1 + J], units [M, 3, K]."""
        process = self._best.process
        network = ProductSummationNetwork(linear.shape[2] - 1, products=0, summations=1)
        none = torch.zeros(*linear.shape[:2], 0, linear.shape[2] - 1, dtype=torch.float64)
        of_unit = torch.ones(*linear.shape[:2], 1, dtype=torch.float64)
        weights = Weights(
            exponents=none,
            product_weights=none[..., 0],
            summation=linear[..., 1:].unsqueeze(2),
            summation_bias=torch.zeros_like(of_unit),
            summation_weights=of_unit,
            bias=linear[..., 0],
        )
        return MotionNetwork(
            self._data.inputs,
            network,
            network.join(weights),
            self._data.input_scale,
            torch.ones(OUTPUTS),
            "residual-twist",
            dead_band=self._dead_band,
            central=len(linear) > 1,
            derived=self._derived,
            drive=self._drive,
            kernel_units=KernelUnits(process.centres, process.lengths, kernel),
            floor=None if self._floor is None else self._floor.floor,
            excess=self._excess,
        )

    def _noise(self, simulator: MotionNetwork, unseen: Tensor) -> NoiseModel:
        """Learn the noise, which includes the uncertainty of halves of the rows.

        Members do not show it, because their mistakes are similar.

        Args:
            simulator: without noise.
            unseen: outputs [N, 3] of the process for rows that it has not seen.
        """
        rows, whole = self._rows, len(self._data.x)
        moved = self._moved_evenly()
        few = whole <= FEW
        some = slice(None, None, -(-len(unseen) // self._settings.noise_rows))
        if few:
            mean = self._of_others(unseen, self._part[:whole])[some]
        else:
            mean = simulator.from_outputs(unseen[some], rows.x[some])
        weight = torch.ones_like(rows.weight)
        parts = self._command[whole:]
        counts = min(1.0, NOISE_PARTS / whole)
        weight[whole:] = counts / parts.bincount(minlength=whole)[parts]
        noise = fit_noise(self._columns, rows.x[some], mean, moved[some], weight[some])
        return noise.times(OF_HALVES) if few else noise

    def _moved_evenly(self) -> Tensor:
        """Return the displacements [N, 3] of rows, without what the floor adds to the turn."""
        moved = self._rows.y.clone()
        if self._floor is not None:
            moved[: len(self._data.x), 2] -= self._floor.unseen
        return moved

    def _spread(self, noise: NoiseModel, unseen: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Return factors of the noise [3], and of the members' differences [3, 1], for windows.

        The noise of a row includes that of the poses at its ends, which does not add up in a
        window; mistakes do, those of a slow robot more than the members' differences.

        Args:
            noise: learned from rows.
            unseen: outputs [N, 3] of the process for rows that it has not seen.
            weights: of the mean and the members, of one, inputs and units, [M, 3, 1 + J + K].
        """
        rows, whole = self._rows, len(self._data.x)
        windows = runs_of(whole) if self._windows is None else self._windows
        windows = windows.some(self._settings.noise_rows)
        row, block = torch.arange(whole), min(-(-whole // PARTS), BLOCK)
        known = self._instants()
        mean = self._of_others(unseen[:whole], row // block % PARTS, known)
        if known is not None:
            moves = (mean, known.moved)
            paths = (se2.compose(se2.path(one[known.ends])[known.row], one) for one in moves)
            self._excess = fit_excess(known.time, *paths, known.drive)
            mean = mean[known.ends]

        generator, own = torch.Generator().manual_seed(self._seed), []
        for _ in range(SPREAD_DRAWS):
            z = noise.draw(whole, 1, generator).squeeze(1)
            drawn = disturb(noise, self._columns, rows.x[:whole], mean, z)
            own.append(windows.sums(residual(mean, drawn)))
        inputs = self._units_of(rows.given[:whole], self._best.units[:whole])
        differs = torch.einsum("nk,mok->mno", inputs, (weights - weights[:1])[1:])
        differs = (differs * rows.factor[:whole]).roll(1, -1)  # the turn first
        error = windows.sums(residual(mean, self._moved_evenly()[:whole]))
        sums = torch.stack(own), windows.sums(differs, 1)
        usual = USUAL_SPREAD
        if self._windows is not None:
            usual *= 1.0 + FEW_BLOCKS / (int(self._blocks[-1]) + 1)
        of_noise, of_members = fit_spread(error, *sums, windows.weight, usual)
        return of_noise, of_members.roll(-1).unsqueeze(1)

    @property
    def _blocks(self) -> Tensor:
        """The number of the independent block of each whole row, [N].

        Rows that are shorter than a window share one, because their errors are similar.
        """
        time = self._data.x[:, self._columns.duration]
        if self._windows is None:
            return torch.arange(len(time))
        block = ((time.cumsum(0) - time) / LENGTHS[-1]).long()
        return block.unique(return_inverse=True)[1]

    def _random_weights(self, members: int, generator: torch.Generator) -> Tensor:
        """Return random weights of rows with a mean of about 1, [M, N] (Rubin 1981)."""
        block = self._blocks
        blocks = int(block[-1]) + 1
        uniform = torch.rand(members, blocks, generator=generator, dtype=torch.float64)
        weights = -torch.log1p(-uniform)
        return (weights / weights.mean(1, keepdim=True))[:, block].to(self._rows.x)

    def _changes(self, random: Tensor, generator: torch.Generator) -> Tensor:
        """Return how members' drive models differ from the mean's in outputs, [M, 3, 1 + J + K].

        They are the best weights of one, of inputs and of units of the process.

        Args:
            random: weights of rows, [M, N].
            generator: of the commands at which models are compared.
        """
        columns = self._columns
        given = self._elsewhere(generator)
        raw = given.clone()
        places = list(columns.driven)
        given[:, places] = self._drive.shaped(raw[:, places])
        scaled = given[:, columns.duration].clamp(min=_SHORTEST / self._longest)
        given[:, columns.duration] = scaled
        full = self._derived.append(columns, given)
        features = self._units_of(full, self._best.process.units(full))
        if "drive_members" in self._settings.without:
            return torch.zeros(len(random), OUTPUTS, features.shape[1], dtype=torch.float64)
        time = scaled * self._longest

        def phases(drive: DriveModel) -> tuple[Tensor, Tensor]:
            under = rows_underway(drive, columns, given)
            return drive.phases(under, drive.shaped(raw[:, places]), time)

        mean, changes = phases(self._drive), []
        for fit in fit_again(self._fit, random):
            changing, twist = phases(fit.drive)
            there = se2.compose(changing, se2.exp(twist))
            left, factor = _left(*mean, scaled, there)
            change = []
            for o in range(OUTPUTS):
                design = features * factor[:, o, None]
                square = design.T @ design
                square.diagonal().add_(_RIDGE * square.diagonal().mean())
                change.append(torch.linalg.solve(square, design.T @ left[:, o]))
            changes.append(torch.stack(change))
        return torch.stack(changes)

    @staticmethod
    def _units_of(given: Tensor, units: Tensor) -> Tensor:
        """Return one, inputs [N, J] and units [N, K] as columns."""
        return torch.cat([torch.ones_like(given[:, :1]), given, units], 1)

    def _composition(self) -> dict[str, Any]:
        """Return the parts of the simulator in words."""
        drive, names = self._drive, [entry["name"] for entry in self._data.inputs]
        driven = [names[place] for place in self._columns.driven]
        # For two commands in each direction, because a static curve need not be steady.
        commands = {"full_back": -1.0, "half_back": -0.5, "half": 0.5, "full": 1.0}
        every = torch.ones(len(driven), dtype=torch.float64)
        reached = {f"speed_at_{name}": drive.shaped(u * every) for name, u in commands.items()}
        laws = [
            {
                **{law: float(getattr(drive, law)[c]) for law in drive.LAWS},
                **{name: float(speeds[c]) for name, speeds in reached.items()},
            }
            for c in range(len(driven))
        ]
        bands = [{"dead_band": float(self._dead_band[place])} for place in self._columns.driven]
        if self._fit.rows.modes is None:
            laws = [own | band for own, band in zip(laws, bands, strict=True)]
            actuators = dict(zip(driven, laws, strict=True))
        else:
            modes = [
                " ".join(f"{part:+.2f} {name}" for part, name in zip(mode, driven, strict=True))
                for mode in drive.modes.tolist()
            ]
            actuators = dict(zip([*modes, *driven], [*laws, *bands], strict=True))
        return {
            "actuators": actuators,
            "delay": float(drive.delay),
            "drift": drive.drift.tolist(),
            "swing": self._derived.swing,
            "floor": None if self._floor is None else self._floor.described(),
            "kernel_units": len(self._best.process.centres),
            "process": dict(
                zip(("dx", "dy", "dtheta"), self._best.fractions.tolist(), strict=True)
            ),
        }


def _on_even_floor(data: TrainingData, floor: Floor) -> TrainingData:
    """Return rows as they would have been on an even floor."""
    assert data.start is not None
    y, within = evened(floor, data.start, data.y), data.within
    if within is not None:
        moved = evened(floor, data.start[within.row], within.moved)
        within = within._replace(moved=moved)
    return replace(data, y=y, within=within)


def _moved(rows: Motion, data: TrainingData) -> Motion:
    """Return rows with the displacements of data, also within commands if these are known."""
    within = None if rows.within is None else data.within
    return replace(rows, y=data.y.to(rows.y), within=within)


class _Judged(NamedTuple):
    """A Gaussian process and its results on held-out rows.

    Attributes:
        process: the process.
        units: of the rows, [N, K].
        unseen: predictions for each row from the other parts of the rows, [3, N].
        fractions: weight of the process for each output, [3].
        loss: the mean logarithm of the outputs' losses.
    """

    process: Process
    units: Tensor
    unseen: Tensor
    fractions: Tensor
    loss: float


def _left(changing: Tensor, twist: Tensor, duration: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Return a drive model's residuals of displacements, and the factor of the outputs in them.

    Args:
        changing, twist: of :meth:`DriveModel.phases`, [N, 3].
        duration: scaled durations, [N].
        y: displacements, [N, 3].

    Returns:
        Both [N, 3], in the frame of the last piece's middle.
    """
    moved = se2.mid_turn(se2.between(changing, y))
    chord = se2.chord(moved[:, 2])
    chord = torch.where(chord.abs() < _LEAST, 0.0, chord)
    length = torch.stack([chord, chord, torch.ones_like(chord)], dim=1)
    left = torch.where(length == 0.0, 0.0, moved - length * twist)
    return left, length * duration.unsqueeze(1)


def _fraction(
    outputs: Tensor,
    left: Tensor,
    factor: Tensor,
    trust: Tensor,
    allowed: bool,
    count: float | None = None,
) -> tuple[float, float]:
    """Return the weight of a process, 0..1, and the loss.

    Args:
        outputs: outputs of read-outs for unseen rows, [N].
        left, factor: targets of the output and its factor in them, [N].
        trust: weights of the rows, [N].
        allowed: whether it may count.
        count: equivalent number of independent rows; if given, the process counts only if it
            reduces the loss by more than :data:`_SURE` standard errors.
    """
    best, least = 0.0, math.inf
    root = trust.sqrt()
    corner = 2.0 * (left * root).abs().median().clamp(min=1e-12)
    without = torch.zeros(0)
    for step in range(_FRACTIONS + 1 if allowed else 1):
        fraction = step / _FRACTIONS
        error = ((left - factor * fraction * outputs) * root).abs()
        # Huber's loss, so that unpredictable rows do not decide.
        loss = torch.where(error < corner, error.square(), corner * (2 * error - corner))
        # Without an improvement the process does not count.
        value = loss.mean().item() * (1.0 + _SIMPLER * (step > 0))
        if count is not None and step == 0:
            without = loss
        elif count is not None:
            value += _SURE * (without - loss).std().item() / math.sqrt(count)
        if value < least:
            best, least = fraction, value
    return best, least
