"""Ensembles: one search, read-outs fitted to resamples of the rows, and noise from what was unseen.

What a simulator of few rows does not know shows where networks that learned from other rows
disagree. Searching is what takes time, so it is done once: the members share the product units
that a search over all rows found, and each has a read-out of its own, fitted to a bootstrap
resample (Breiman 1996). What the search itself may have got wrong is the same for all members and
is left to the noise model, which is learned from residuals of read-outs that had not seen the row
(cross-validation). The product units had seen it; what flattery there is in that is measured by one
more search, on half of the rows: as far as its residuals are larger in the other half, so, by half
(twice the rows), are the noise's. Rows are drawn in stretches of time, because
neighbours share a place on the board and a state of the battery.

Networks whose activations are not linear have no read-out to fit: each member is then a search on
a random half of the rows. An estimate from half of them strays from that of all as far as that
strays from the truth (Shao and Tu 1995, the delete-half jackknife).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from neurosim.networks import Perceptron, ProductSummationNetwork
from neurosim.simulators import MotionNetwork
from neurosim.training.base import PursuitSettings, Trainer, TrainingData
from neurosim.training.noise import fit_noise, search_optimism
from neurosim.training.readout import Readout

#: Of read-outs, where the trainer has none of its own.
RIDGE = 1e-6

#: Stretches of time that rows are drawn in, and folds that read-outs are cross-validated in.
STRETCHES, FOLDS = 40, 5


@dataclass(frozen=True)
class Share(TrainingData):
    """Some of the rows, scaled as all of them are.

    Attributes:
        scale: the input scale of all rows, [I].
    """

    scale: Tensor

    @property
    def input_scale(self) -> Tensor:
        """The scale of all rows, [I]."""
        return self.scale


class EnsembleTrainer:
    """Trains an ensemble of any trainer's networks, and its noise model; itself a trainer.

    Args:
        kind: the class of trainer.
        data: all training rows, in the order of time.
        network: the shape of the networks.
        settings: of the trainer.
        seed: of all that is drawn.
        device: where to compute.
        members: networks of each output.
        generations: of each search.
        noise: whether to learn a noise model.
        order: number of each row's command, [N]; neighbours differ by one. Tells which rows
            followed each other.

    Raises:
        ValueError: if a noise model is asked of a single member whose activations are not
            linear: there would be no row that it has not seen.
    """

    def __init__(
        self,
        kind: type[Trainer],
        data: TrainingData,
        network: ProductSummationNetwork | Perceptron,
        settings: object,
        seed: int,
        device: str,
        *,
        members: int,
        generations: int,
        noise: bool,
        order: Tensor,
    ):
        if noise and members == 1 and not network.linear:
            raise ValueError("the noise of curved activations is learned from 2 members or more")
        self._make = lambda rows, seed: kind(rows, network, settings, seed, device)
        self._data, self._network, self._order = data, network, order
        self._settings = settings
        self._members, self._noise, self._seed = members, noise, seed
        self._each = generations
        # Of linear networks the first search sees all rows, and another is for the noise alone.
        searches = int(noise) if network.linear else members * (members > 1)
        generator = torch.Generator().manual_seed(seed)
        self._stretch = stretches(len(data.x))
        self._seen = _halves(self._stretch, searches, generator)
        if network.linear or not searches:
            everything = torch.ones_like(self._stretch, dtype=torch.bool)
            self._seen = torch.cat([everything.unsqueeze(0), self._seen])
        self._draws = _resamples(self._stretch, members, generator)
        self._finished: list[dict[str, Tensor]] = []
        self._done = 0
        self._search = self._begin(0)

    @property
    def generations(self) -> int:
        """Generations of all the searches together."""
        return self._each * len(self._seen)

    def _begin(self, search: int) -> Trainer:
        seen, data = self._seen[search], self._data
        if seen.all():
            return self._make(data, self._seed)
        # Searches differ by seed too, for all that is drawn in them.
        return self._make(
            Share(data.inputs, data.x[seen], data.y[seen], data.input_scale),
            self._seed + search,
        )

    def advance(self) -> Tensor:
        """Work one generation of a search; return its least mean squared error so far, [3]."""
        if self._done == self._each:
            self._finished.append(self._search.state())
            self._search, self._done = self._begin(len(self._finished)), 0
        mse = self._search.advance()
        self._done += 1
        return mse

    def result(self) -> MotionNetwork:
        """Return the ensemble with its noise model."""
        found = []
        for number, state in enumerate(self._finished):
            search = self._begin(number)
            search.load(state)
            found.append(search.result())
        found.append(self._search.result())
        return self._refitted(found) if self._network.linear else self._joined(found)

    def _refitted(self, found: list[MotionNetwork]) -> MotionNetwork:
        simulator = found[0]
        if self._members > 1:
            readout = self._readout(simulator)
            genes = [readout.genes(count) for count in self._draws]
            simulator = readout.simulator(torch.stack(genes))
        if self._noise:
            said, *by_halves = [self._cross_validated(member) for member in found]
            noise = fit_noise(simulator, self._data, said, self._order)
            widening = search_optimism(simulator, self._data, by_halves, self._seen[1:])
            simulator.noise = noise.widened(widening)
        return simulator

    def _readout(self, simulator: MotionNetwork) -> Readout:
        pursuit = isinstance(self._settings, PursuitSettings)
        ridge = self._settings.ridge if pursuit else RIDGE
        return Readout(self._data, simulator, ridge, weigh=pursuit)

    def _cross_validated(self, simulator: MotionNetwork) -> Tensor:
        """Return what read-outs that had not seen a row say of it, [N, O]."""
        readout, fold = self._readout(simulator), self._stretch % FOLDS
        outputs = torch.zeros(len(fold), simulator.genes.shape[1], dtype=torch.float64)
        for k in fold.unique():
            out = fold == k
            without = readout.simulator(readout.genes((~out).double()))
            outputs[out] = without.outputs(self._data.x[out])[:, 0]
        return outputs

    def _joined(self, found: list[MotionNetwork]) -> MotionNetwork:
        first = found[0]
        simulator = MotionNetwork(
            first.inputs,
            first.network,
            torch.cat([member.genes for member in found]),
            first.input_scale,
            torch.cat([member.output_scale for member in found]),
            first.coordinates,
            dead_zone=first.dead_zone,
        )
        if self._noise:
            unseen = (~self._seen).double().unsqueeze(-1)  # [M, N, 1]
            said = simulator.outputs(self._data.x).transpose(0, 1)
            said = (said * unseen).sum(0) / unseen.sum(0)
            simulator.noise = fit_noise(simulator, self._data, said, self._order)
        return simulator

    def state(self) -> dict[str, Tensor]:
        """Return the state: what was found, and the search that is under way."""
        state = {f"search.{name}": value for name, value in self._search.state().items()}
        state["done"] = torch.tensor([len(self._finished), self._done])
        for number, finished in enumerate(self._finished):
            state |= {f"finished.{number}.{name}": value for name, value in finished.items()}
        return state

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Go on from a state, bit for bit."""

        def part(prefix: str) -> dict[str, Tensor]:
            return {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}

        finished, self._done = state["done"].tolist()
        self._finished = [part(f"finished.{number}.") for number in range(finished)]
        self._search = self._begin(finished)
        self._search.load(part("search."))


def stretches(rows: int) -> Tensor:
    """Return the number of the stretch of time, up to :data:`STRETCHES`, of each row, [N]."""
    return torch.arange(rows) * min(STRETCHES, rows) // rows


def _halves(stretch: Tensor, searches: int, generator: torch.Generator) -> Tensor:
    """Return which rows each search sees, [S, N]: halves, two by two complementary."""
    count = int(stretch[-1]) + 1
    seen = [torch.ones(0, count, dtype=torch.bool)]
    for _ in range(0, searches, 2):
        half = torch.randperm(count, generator=generator) < count // 2
        seen += [half[None], ~half[None]]
    return torch.cat(seen)[:searches, stretch]


def _resamples(stretch: Tensor, members: int, generator: torch.Generator) -> Tensor:
    """Return how often each row counts for each member, [M, N]: stretches drawn at random."""
    count = int(stretch[-1]) + 1
    drawn = torch.randint(count, (members, count), generator=generator)
    counts = torch.zeros(members, count, dtype=torch.float64)
    counts.scatter_add_(1, drawn, torch.ones_like(counts))
    return counts[:, stretch]
