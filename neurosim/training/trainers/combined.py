"""The default trainer: a drive model, and product units and a Gaussian process for the rest.

Three things are learned one after the other, each of what those before it leave:

1. the drive model (:mod:`neurosim.training.trainers.drive_fit`): lags, delay, kinematics;
2. a network of product units whose exponents are searched for
   (:mod:`neurosim.training.trainers.pursuit`);
3. beside it, of the same residuals, a Gaussian process
   (:mod:`neurosim.training.trainers.gaussian_process`).

The last two are weighed by cross-validation (stacking: Wolpert 1992, Breiman 1996), each output for
itself, so that what the rows do not support counts for nothing. Both are linear in what weighs
their units, and there the members of the ensemble differ: they are draws from the posterior of
these weights, and lean to one of the two or to the other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple

import torch
from msgspec import Meta
from torch import Tensor

from neurosim.base.declared import Count, Fraction
from neurosim.base.errors import UserError
from neurosim.base.se2 import tensors as se2
from neurosim.base.threads import one_thread
from neurosim.networks import Expanded, ProductSummationNetwork
from neurosim.simulators import MotionNetwork
from neurosim.simulators.motion.derived import Derived, can_swing
from neurosim.simulators.motion.drive import Underway
from neurosim.simulators.motion.kernel_units import KernelUnits
from neurosim.simulators.motion.network import can_drive, rows_underway
from neurosim.simulators.motion.noise import CommandFeatures
from neurosim.training.base import PursuitSettings, TrainingData, Units, Within
from neurosim.training.noise import fit_noise
from neurosim.training.trainers.dead_zone import find_dead_zone
from neurosim.training.trainers.drive_fit import Motion, fit_drive
from neurosim.training.trainers.gaussian_process import Process, choose_centres, learn_process
from neurosim.training.trainers.pursuit import Pursuit, row_weights
from neurosim.training.trainers.swing import find_swing
from neurosim.training.trainers.windows import LENGTHS, Chains, Windows, windows_of

OUTPUTS = 3
#: What can be left out, to see what it is good for.
MECHANISMS = ("laws", "dead_zone", "swing", "product_units", "process", "row_weights")
#: Stretches of time, every other one of which makes a half of the rows.
STRETCHES = 24
#: How much of the Gaussian process' uncertainty members show even where it counts for nothing.
UNPROVEN = 0.5
#: Rows for each unit of the Gaussian process, where there are more than at first.
ROWS_PER_CENTRE = 3
#: How much a part of a command counts for the noise.
NOISE_PART = 0.03
#: The most by which members are moved away from their mean.
WIDEST = 5.0
#: Steps of the shares that product units and Gaussian process are tried with.
_SHARES = 10
#: Where a chord is shorter than this share of its arc, where the arc led says nothing of its speed.
_LEAST = 1e-3


@dataclass(frozen=True)
class CombinedSettings(PursuitSettings):
    """Settings of the trainer.

    Attributes:
        members: Networks of each output in the ensemble; 1: no ensemble.
        noise: Fit a noise model.
        hidden: product units of a network at most; one is added in each generation.
        floor: the smallest magnitude of an input in a product unit.
        dead_zone: scaled inputs that are smaller count as zero, one number an input; found from
            the data if not given.
        swing_rows: with fewer rows, no change of direction is looked for.
        search_rows: commands that product units are searched for with, and
        search_parts: parts of commands; read-outs are of all rows.
        centres: units of the Gaussian process at first. They are doubled for as long as that
            lessens the errors of held-out rows, and there are :data:`ROWS_PER_CENTRE` rows each;
        most_centres: never beyond this number.
        part_weight: weight of a part of a command, relative to a whole command.
        most_parts: poses within commands that are learned from.
        noise_rows: rows that the noise is learned from.
        lean: how far members lean to product units or to the Gaussian process.
        whole_commands: learn from whole commands alone, not from parts of them.
        without: mechanisms that are left out, to measure their effect: ``laws`` (all of a drive
            model but its kinematics), ``dead_zone``, ``swing``, ``product_units``, ``process``,
            ``row_weights``.
    """

    members: Annotated[int, Meta(ge=1, le=1000)] = 8
    noise: bool = True
    hidden: Units = 24
    floor: Annotated[float, Meta(ge=1e-6, lt=1)] = 0.02
    dead_zone: tuple[Annotated[float, Meta(ge=0, lt=1)], ...] | None = None
    swing_rows: Count = 300
    search_rows: Count = 6000
    search_parts: Count = 2000
    centres: Count = 75
    most_centres: Count = 1200
    part_weight: Annotated[float, Meta(ge=1e-6, le=1000)] = 0.3
    most_parts: Count = 40000
    noise_rows: Count = 20000
    lean: Fraction = 0.25
    whole_commands: bool = False
    without: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.without:
            if name not in MECHANISMS:
                raise UserError(f"without is of {', '.join(MECHANISMS)}, not {name!r}")


class Residuals(NamedTuple):
    """What the drive model leaves of rows.

    Attributes:
        x: scaled inputs, [N, I].
        y: displacements, [N, 3].
        given: inputs of the networks, [N, J].
        left: of displacements in the frame of the last piece's middle, [N, 3] (m, m, rad).
        factor: of each of the networks' outputs in that, [N, 3].
        weight: of the rows, [N].
    """

    x: Tensor
    y: Tensor
    given: Tensor
    left: Tensor
    factor: Tensor
    weight: Tensor


class CombinedTrainer:
    """Learns a motion network with a drive model, its members and its noise; see the module."""

    source = (
        "Orthogonal least squares (Chen, Cowan, Grant 1991) over product units (Durbin and "
        "Rumelhart 1989), stacked (Breiman 1996) with a Gaussian process (Rasmussen and Williams "
        "2006), on the residuals of a drive model"
    )
    settings_type = CombinedSettings

    def __init__(
        self, data: TrainingData, settings: CombinedSettings, seed: int, device: str = "cpu"
    ):
        names = tuple(entry["name"] for entry in data.inputs)
        if not can_drive(names):
            raise ValueError(
                "it needs a duration and the previous value of each input; use the trainer ga"
            )
        self._data, self._settings, self._seed = data.once(), settings, seed
        self.generations = settings.hidden
        self._device = device
        self._columns = CommandFeatures.of(names)
        with one_thread(device):
            self._begin(names)
        self._network = ProductSummationNetwork(
            self._rows.given.shape[1],
            settings.hidden,
            1,
            floor=settings.floor,
            phases=True,
            ceilings=True,
        )
        #: In all rows and in each half of them: see :meth:`_by_halves`.
        self._searches = [
            self._new_searches(seen, number)
            for number, seen in enumerate((None, self._half, ~self._half))
        ]

    # The drive model

    def _begin(self, names: tuple[str, ...]) -> None:
        data, settings, device = self._data, self._settings, self._device
        x, y = data.scaled_inputs.to(device), data.y.to(device)
        longest = float(data.input_scale[self._columns.duration])
        self._longest = longest
        if settings.dead_zone is not None:
            self._dead_zone = torch.tensor(settings.dead_zone, dtype=x.dtype, device=device)
        elif "dead_zone" in settings.without:
            self._dead_zone = torch.zeros_like(x[0])
        else:
            self._dead_zone = find_dead_zone(names, x, y)
        x = torch.where(x.abs() < self._dead_zone, 0.0, x)
        within = None if settings.whole_commands else data.within
        laws, under = "laws" not in settings.without, None
        self._windows: Windows | None = None
        if data.joined is None:
            motion = Motion(x, y, data.follows.to(device), self._columns, longest, within)
            self._drive = fit_drive(motion, laws=laws)
            inputs = motion.inputs(self._drive)
        else:
            self._windows = windows_of(data.x[:, self._columns.duration], data.joined)
            chains = Chains.of(x, y, data.joined.to(device), self._columns, longest, within)
            self._drive = fit_drive(chains, laws=laws)
            inputs, under = chains.inputs(self._drive, x)
        rows = self._residuals(inputs, y, torch.ones_like(y[:, 0]), under)
        self._derived = Derived()
        enough = len(x) >= settings.swing_rows and "swing" not in settings.without
        if enough and can_swing(self._columns):
            self._derived = find_swing(
                self._columns,
                rows.given,
                rows.left[:, 2],
                rows.factor[:, 2],
                settings,
                settings.floor,
            )
        #: Of which command each row is a part.
        self._command = torch.arange(len(x))
        if not settings.whole_commands and data.within is not None and len(data.within.row):
            parts, commands = self._parts(rows.x)
            rows = Residuals(*(torch.cat(pair) for pair in zip(rows, parts, strict=True)))
            self._command = torch.cat([self._command, commands])
        self._rows = rows._replace(given=self._derived.append(self._columns, rows.given))

    def _residuals(
        self, x: Tensor, y: Tensor, weight: Tensor, under: Underway | None = None
    ) -> Residuals:
        columns = self._columns
        share = x[:, columns.duration]
        under = rows_underway(self._drive, columns, x) if under is None else under
        changing, twist = self._drive.phases(
            under, x[:, list(columns.driven)], share * self._longest
        )
        moved = se2.mid_turn(se2.between(changing, y))
        chord = se2.chord(moved[:, 2])
        chord = torch.where(chord.abs() < _LEAST, 0.0, chord)
        length = torch.stack([chord, chord, torch.ones_like(chord)], dim=1)
        left = torch.where(length == 0.0, 0.0, moved - length * twist)
        given = x[:, : len(self._data.inputs)]
        return Residuals(x, y, given, left, length * share.unsqueeze(1), weight)

    def _parts(self, x: Tensor) -> tuple[Residuals, Tensor]:
        """Return rows of parts of commands, and the commands that they are of.

        One instant in two tells of the beginning until then, the other of the rest from then on.
        """
        within, columns = self._data.within, self._columns
        assert within is not None
        # Of very many, so many that a command still counts in several ways.
        stride = -(-len(within.row) // self._settings.most_parts)
        stride += stride > 1 and stride % 2 == 0  # the two kinds take turns
        within = Within(*(part[::stride] for part in within))
        time, moved = within.time.to(x), within.moved.to(x)
        left = x[within.row, columns.duration] * self._longest - time
        odd = torch.arange(len(within.row)) % 2 == 1
        until, since = ~odd & (time >= _SHORTEST), odd & (left >= _SHORTEST)
        begun, rest = x[within.row[until]].clone(), x[within.row[since]].clone()
        begun[:, columns.duration] = time[until] / self._longest
        told = rest[:, list(columns.driven)]
        under = rows_underway(self._drive, columns, rest)
        speed, _ = self._drive.reached(under, told, time[since])
        rest[:, list(columns.before)] = speed
        rest[:, len(self._data.inputs) :] = told  # it acts already
        rest[:, columns.duration] = left[since] / self._longest
        after = se2.between(moved[since], self._data.y.to(x)[within.row[since]])
        # A rest is like a command of its own only if no command is still waiting.
        alike = ((told - speed).abs().amax(1) < _SETTLED) | (time[since] >= self._drive.delay)
        inputs, y = torch.cat([begun, rest[alike]]), torch.cat([moved[until], after[alike]])
        weight = torch.full_like(y[:, 0], self._settings.part_weight)
        commands = torch.cat([within.row[until], within.row[since][alike]])
        return self._residuals(inputs, y, weight), commands

    # The product units

    def _new_searches(self, seen: Tensor | None, number: int) -> list[Pursuit]:
        """Return the searches for the turn and for both translations.

        Args:
            seen: which rows they see, [N]; None for all.
            number: of the searches, other ones draw other numbers.
        """
        settings, rows = self._settings, self._searched(seen)
        generator = torch.Generator(self._device).manual_seed(self._seed + number)
        root = rows.weight.sqrt()
        left, factor = (rows.left * root[:, None]).T, (rows.factor * root[:, None]).T
        none = torch.zeros_like(factor[0])
        shift = torch.stack([torch.stack([factor[0], none]), torch.stack([none, factor[1]])])
        often = replace(settings, refine_every=1, refine_steps=2 * settings.refine_steps)
        rest = (self._network.products, generator, settings.floor)
        return [
            Pursuit(rows.given, factor[None, 2:], left[2:], often, *rest),
            Pursuit(rows.given, shift, left[:2], settings, *rest),
        ]

    def _searched(self, seen: Tensor | None) -> Residuals:
        """Return rows that units are searched for with; each also counts for those left out.

        Of one half of the rows half as many.
        """
        rows, whole = self._rows, torch.arange(len(self._rows.x)) < len(self._data.x)
        found = []
        most_of = self._settings.search_rows, self._settings.search_parts
        for kind, most in zip((whole, ~whole), most_of, strict=True):
            kept = torch.nonzero(kind if seen is None else kind & seen).squeeze(1)
            few = min(len(kept), most if seen is None else most // 2)
            chosen = kept[torch.arange(few) * len(kept) // max(few, 1)]
            part = Residuals(*(column[chosen] for column in rows))
            found.append(part._replace(weight=part.weight * (len(kept) / max(few, 1))))
        return Residuals(*(torch.cat(pair) for pair in zip(*found, strict=True)))

    def advance(self) -> Tensor:
        """Give the turn one unit more and the translation two; return mean squared errors [3]."""
        if "product_units" not in self._settings.without:
            with one_thread(self._device):
                for turn, shift in self._searches:
                    turn.grow()
                    for _ in range(2):
                        shift.grow()
        turn, shift = (search.mean_squared_error for search in self._searches[0])
        return torch.cat([shift, turn]).cpu()

    # All together

    def result(self) -> MotionNetwork:
        """Return the simulator: the mean, its members and its noise; the same on any cores."""
        with one_thread(self._device):
            return self._result()

    def _result(self) -> MotionNetwork:
        rows, settings = self._rows, self._settings
        learners = self._product_units(self._searches[0])
        trust = self._trust(learners)
        generator = torch.Generator().manual_seed(self._seed)
        known = rows.factor.abs() >= _LEAST
        value = torch.where(known, rows.left / torch.where(known, rows.factor, 1.0), 0.0)
        commands, elsewhere = int(self._command.amax()) + 1, self._elsewhere(generator)
        process = learn_process(
            rows.given,
            value,
            torch.where(known, rows.factor.square() * trust, 0.0),
            settings.centres,
            commands,
            elsewhere,
            generator,
        )
        best, count = self._judged(process, trust), settings.centres
        most = min(settings.most_centres, commands // ROWS_PER_CENTRE)
        while best.shares[:, 1].any() and count <= len(best.process.centres) and 2 * count <= most:
            count *= 2
            centres = choose_centres(rows.given, elsewhere, process.lengths, count)
            wider = self._judged(replace(process, centres=centres), trust)
            if wider.loss > best.loss - _WORTH:
                break
            best = wider
        return self._assembled(learners, best, trust)

    def _judged(self, process: Process, trust: Tensor) -> _Judged:
        """Return what held-out rows say of a Gaussian process beside the product units."""
        kernel = _Kernel(process, self._rows)
        said = self._by_halves(kernel, trust)
        return _Judged(process, kernel, said, *self._stacked(said, trust))

    def _elsewhere(self, generator: torch.Generator) -> Tensor:
        """Return networks' inputs [M, J] of random commands after random speeds."""
        x = self._rows.x[:, : len(self._data.inputs)]
        low, high = x.amin(0), x.amax(0)
        # What went one way only may go the other.
        for places in (self._columns.driven, self._columns.before):
            size = torch.maximum(low.abs(), high.abs())[list(places)]
            low[list(places)], high[list(places)] = -size, size
        drawn = torch.rand(_RANDOM, x.shape[1], generator=generator, dtype=x.dtype).to(x)
        return self._derived.append(self._columns, low + (high - low) * drawn)

    def _product_units(self, searches: list[Pursuit]) -> list[_ProductUnits]:
        """Return the units that searches found best, of each output."""
        functions = []
        for search in (searches[1], searches[0]):
            functions += zip(*search.best_units(), strict=True)
        return [
            _ProductUnits(self._network, f, self._rows, self._settings.ridge) for f in functions
        ]

    def _by_halves(self, kernel: _Kernel, trust: Tensor) -> Tensor:
        """Return what learners say that have seen one half of the rows, [2, 3, 2, N].

        Units that were searched for with a row flatter themselves there. So they are searched for
        in each half of the rows too; the other half judges. By half, by output, of product
        units and of the Gaussian process.
        """
        said = torch.zeros(2, OUTPUTS, 2, len(trust), dtype=torch.float64)
        for number, seen in enumerate((self._half, ~self._half)):
            for o, own in enumerate(self._product_units(self._searches[number + 1])):
                for k, learner in enumerate((own, kernel)):
                    weights, _ = learner.posterior(trust[:, o] * seen, o)
                    said[number, o, k] = learner.features @ weights
        return said

    @property
    def _half(self) -> Tensor:
        """Which rows the first half is, [N]: stretches of time, parts with their commands."""
        whole = int(self._command.amax()) + 1
        stretches = STRETCHES if self._windows is None else 2
        return (torch.arange(whole) * stretches // whole % 2 == 0)[self._command]

    def _unseen(self, said: Tensor) -> Tensor:
        """Return of every row what the half said that had not seen it; the last axis is rows."""
        return torch.where(self._half, said[1], said[0])

    def _stacked(self, said: Tensor, trust: Tensor) -> tuple[Tensor, float]:
        """Return how much product units and Gaussian process count for each output, [3, 2].

        And the mean logarithm of the outputs' losses on held-out rows.
        """
        rows, unseen = self._rows, self._unseen(said)
        without = self._settings.without
        allowed = tuple(name not in without for name in ("product_units", "process"))
        count = None
        judged = [
            (unseen[o], rows.left[:, o], rows.factor[:, o], trust[:, o]) for o in range(OUTPUTS)
        ]
        if self._windows is not None:
            judged = [self._composed(*one[:3], self._windows) for one in judged]
            count = float(self._windows.weight.sum())
        found = [_shares(*one, allowed, count) for one in judged]
        losses = torch.tensor([max(loss, 1e-30) for _, loss in found])
        return torch.stack([shares for shares, _ in found]), float(losses.log().mean())

    def _composed(
        self, said: Tensor, left: Tensor, factor: Tensor, windows: Windows
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return an output in windows of whole rows, as it is in rows: arguments of _shares.

        What a row adds to the turn of a window, and nearly to its way, is what it adds to its own.
        """
        whole = len(self._data.x)
        both = torch.cat([factor * said, left[None]])[:, :whole]
        until = torch.cat([torch.zeros_like(both[:, :1]), both.cumsum(1)], 1)
        both = until[:, windows.end] - until[:, windows.first]
        trust = windows.weight.clone()
        for kind in range(len(LENGTHS)):
            own = windows.kind == kind
            trust[own] /= both[2, own].square().mean().clamp(min=1e-18)
        return both[:2], both[2], torch.ones_like(trust), trust

    def _trust(self, learners: list[_ProductUnits]) -> Tensor:
        """Return how much each row counts for each output, [N, 3]."""
        rows = self._rows
        plain = rows.weight.unsqueeze(1).repeat(1, OUTPUTS)
        if "row_weights" in self._settings.without:
            return plain
        error = torch.zeros_like(rows.left)
        for o, learner in enumerate(learners):
            weights, _ = learner.posterior(plain[:, o], o)
            error[:, o] = rows.left[:, o] - rows.factor[:, o] * (learner.features @ weights)
        if not error.any():
            return plain
        return plain * row_weights(rows.given, error.T).T.square()

    def _composition(
        self, learners: list[_ProductUnits], process: Process, shares: Tensor
    ) -> dict[str, Any]:
        """Return what the simulator is made of, for people."""
        drive, names = self._drive, [entry["name"] for entry in self._data.inputs]
        driven = [names[place] for place in self._columns.driven]
        # Of two commands each way: a static curve need not be steady.
        commands = {"full_back": -1.0, "half_back": -0.5, "half": 0.5, "full": 1.0}
        every = torch.ones(len(driven), dtype=torch.float64)
        reached = {f"speed_at_{name}": drive.shaped(u * every) for name, u in commands.items()}
        return {
            "actuators": {
                name: {
                    **{law: float(getattr(drive, law)[c]) for law in drive.LAWS},
                    **{name: float(speeds[c]) for name, speeds in reached.items()},
                    "dead_zone": float(self._dead_zone[self._columns.driven[c]]),
                }
                for c, name in enumerate(driven)
            },
            "delay": float(drive.delay),
            "swing": self._derived.swing,
            "product_units": [learner.count for learner in learners],
            "kernel_units": len(process.centres),
            "shares": {
                name: dict(zip(("product_units", "process"), pair, strict=True))
                for name, pair in zip(("dx", "dy", "dtheta"), shares.tolist(), strict=True)
            },
        }

    def _assembled(
        self, learners: list[_ProductUnits], best: _Judged, trust: Tensor
    ) -> MotionNetwork:
        process, kernel, said, shares, _ = best
        generator, rows = torch.Generator().manual_seed(self._seed), self._rows
        members = self._settings.members
        count = 1 + (members if members > 1 else 0)
        products = max(1, *(learner.count for learner in learners))
        network = replace(self._network, products=products)
        genes = torch.zeros(count, OUTPUTS, network.genes, dtype=torch.float64)
        units = torch.zeros(count, OUTPUTS, len(process.centres), dtype=torch.float64)
        for o in range(OUTPUTS):
            pair = learners[o], kernel
            fits = [learner.posterior(trust[:, o], o) for learner in pair]
            mean = [share * weights for share, (weights, _) in zip(shares[o], fits, strict=True)]
            off = [self._members_off(fits, shares[o], m, generator) for m in range(1, count)]
            wider = self._widening(pair, off, said[:, o], shares[o], o)
            for m in range(count):
                own = mean
                if m > 0:
                    own = [a + wider * b for a, b in zip(mean, off[m - 1], strict=True)]
                genes[m, o] = learners[o].genes(network, own[0])
                units[m, o] = own[1]
        simulator = MotionNetwork(
            self._data.inputs,
            network,
            genes,
            self._data.input_scale,
            torch.ones(OUTPUTS),
            "residual-twist",
            dead_zone=self._dead_zone.cpu(),
            central=count > 1,
            derived=self._derived,
            drive=self._drive,
            kernel_units=KernelUnits(process.centres, process.lengths, units),
        )
        simulator.meta = {"composition": self._composition(learners, process, shares)}
        if self._settings.noise:
            unseen = (self._unseen(said) * shares.unsqueeze(2)).sum(1).T
            # Noise of the parts of a command is the same noise again.
            weight = torch.where(rows.weight < 1.0, NOISE_PART, 1.0).to(rows.weight)
            # What halves of the rows leave open stays in it: members are alike in their mistakes.
            some = slice(None, None, -(-len(weight) // self._settings.noise_rows))
            simulator.noise = fit_noise(
                simulator,
                rows.x[some],
                rows.y[some],
                unseen[some],
                weight[some],
                besides_members=False,
            )
        return simulator

    def _members_off(
        self,
        fits: list[tuple[Tensor, Tensor]],
        shares: Tensor,
        number: int,
        generator: torch.Generator,
    ) -> list[Tensor]:
        """Return by how much a member's weights of both kinds of units differ from the mean's."""
        lean = self._settings.lean * shares.sum() * (1.0 if number % 2 else -1.0)
        own = (shares + torch.stack([lean, -lean])).clamp(min=0.0)
        own = own * (shares.sum() / own.sum().clamp(min=1e-12))
        drawn = [_drawn(*fit, generator) for fit in fits]
        # What the networks have not bettered the drive model by may be there nevertheless.
        trusted = own.clamp(min=torch.tensor([0.0, UNPROVEN], dtype=own.dtype))
        return [
            (part - share) * mean + scale * (weights - mean)
            for part, share, scale, weights, (mean, _) in zip(
                own, shares, trusted, drawn, fits, strict=True
            )
        ]

    def _widening(
        self,
        pair: tuple[_ProductUnits, _Kernel],
        off: list[list[Tensor]],
        said: Tensor,
        shares: Tensor,
        output: int,
    ) -> float:
        """Return how many times as far from the mean as drawn the members are to be.

        Learners that saw one half of the rows each differ by what half of the rows leaves open,
        twice; what all of them leave open has a fourth of the variance of their difference.
        """
        if not off or shares.sum() == 0.0:
            return 1.0
        open_ = (torch.einsum("hkn,k->hn", said, shares).diff(dim=0) / 2.0).square()
        drawn = torch.stack(
            [sum(one.features @ w for one, w in zip(pair, own, strict=True)) for own in off]
        )
        wanted = self._rows.factor[:, output].square() * self._rows.weight
        ratio = (open_.squeeze(0) * wanted).mean() / (drawn.square().mean(0) * wanted).mean()
        return float(ratio.sqrt().clamp(1.0, WIDEST))


class _Judged(NamedTuple):
    """A Gaussian process and what held-out rows say of it.

    Attributes:
        process: itself.
        kernel: its read-out.
        said: see :meth:`CombinedTrainer._by_halves`.
        shares: how much product units and process count for each output, [3, 2].
        loss: the mean logarithm of the outputs' losses.
    """

    process: Process
    kernel: _Kernel
    said: Tensor
    shares: Tensor
    loss: float


class _ProductUnits:
    """The read-out of a function's product units: weights of units, inputs and one.

    Attributes:
        features: [N, P + J + 1].
    """

    def __init__(
        self,
        network: ProductSummationNetwork,
        units: tuple[Tensor, Tensor, Tensor],
        rows: Residuals,
        ridge: float,
    ):
        self._units, self._rows, self._ridge = units, rows, ridge
        exponents, phases, ceilings = units
        hidden = network.product_units(exponents, rows.given, phases, ceilings).T
        one = torch.ones_like(rows.given[:, :1])
        self.features = torch.cat([hidden, rows.given, one], dim=1)

    @property
    def count(self) -> int:
        return len(self._units[0])

    def posterior(self, trust: Tensor, output: int) -> tuple[Tensor, Tensor]:
        """Return mean [F] and Cholesky factor [F, F] of the precision, rows counting ``trust``."""
        factor, left = self._rows.factor[:, output], self._rows.left[:, output]
        columns = self.features * factor.unsqueeze(1)
        square = columns.T @ (trust.unsqueeze(1) * columns)
        size = square.diagonal().sqrt().clamp(min=1e-12)
        square = square / size / size.unsqueeze(1)
        square.diagonal().add_(self._ridge)
        triangle = torch.linalg.cholesky(square)
        cross = (columns.T @ (trust * left) / size).unsqueeze(1)
        mean = torch.cholesky_solve(cross, triangle).squeeze(1) / size
        error = left - columns @ mean
        freedom = (trust.sum() - len(size)).clamp(min=0.1 * trust.sum())
        spread = ((trust * error.square()).sum() / freedom).sqrt().clamp(min=1e-12)
        return mean, triangle * size.unsqueeze(1) / spread

    def genes(self, network: ProductSummationNetwork, weights: Tensor) -> Tensor:
        """Return the genes of a network of these units."""
        inputs = self._rows.given.shape[1]
        split = [self.count, inputs, 1]
        own, linear, bias = weights.split(split)
        return network.pack(Expanded(*self._units, own, linear, bias.squeeze(0)))


class _Kernel:
    """The read-out of a Gaussian process; as :class:`_ProductUnits`."""

    def __init__(self, process: Process, rows: Residuals):
        self._process, self._rows = process, rows
        self.features = process.units(rows.given)

    def posterior(self, trust: Tensor, output: int) -> tuple[Tensor, Tensor]:
        """Return mean [K] and Cholesky factor [K, K] of the precision, rows counting ``trust``."""
        factor, left = self._rows.factor[:, output], self._rows.left[:, output]
        return self._process.posterior(self.features, factor, left, trust, output)


def _drawn(mean: Tensor, triangle: Tensor, generator: torch.Generator) -> Tensor:
    """Draw weights [F] from a posterior of this mean and precision L L^T."""
    normal = torch.randn(len(mean), 1, generator=generator, dtype=mean.dtype)
    return mean + torch.linalg.solve_triangular(triangle.T, normal, upper=True).squeeze(1)


def _shares(
    said: Tensor,
    left: Tensor,
    factor: Tensor,
    trust: Tensor,
    allowed: tuple[bool, ...],
    count: float | None = None,
) -> tuple[Tensor, float]:
    """Return how much each of two learners counts, [2], with a sum of 1 at most, and the loss.

    Args:
        said: by read-outs that had not seen the row, [2, N].
        left, factor: targets of the output and its factor in them, [N].
        trust: how much rows count, [N].
        allowed: which of the two may count.
        count: how many independent rows these are worth; then the two count only if they lessen the
            loss by more than its standard error (Breiman et al. 1984).
    """
    best, least = torch.zeros(2, dtype=left.dtype), math.inf
    root = trust.sqrt()
    corner = 2.0 * (left * root).abs().median().clamp(min=1e-12)
    without = torch.zeros(0)
    for first in range(_SHARES + 1 if allowed[0] else 1):
        for second in range(_SHARES + 1 - first if allowed[1] else 1):
            shares = torch.tensor([first, second], dtype=left.dtype) / _SHARES
            error = ((left - factor * (shares @ said)) * root).abs()
            # Huber's loss: rows that nobody foresees do not decide.
            loss = torch.where(error < corner, error.square(), corner * (2 * error - corner))
            # Nothing at all is preferred to what is not better.
            value = loss.mean().item() * (1.0 + _SIMPLER * (first + second > 0))
            if count is not None and first + second == 0:
                without = loss
            elif count is not None:
                value += (without - loss).std().item() / math.sqrt(count)
            if value < least:
                best, least = shares, value
    return best, least


#: Random commands of which some become centres.
_RANDOM = 1000
#: Parts of commands that are shorter than this, s, are not learned from.
_SHORTEST = 0.1
#: A speed is settled when it is so near.
_SETTLED = 0.05
#: Twice as many units of the Gaussian process must lessen the logarithm of the loss by this.
_WORTH = 0.03
#: The networks must lessen the loss by this share to count.
_SIMPLER = 0.01
