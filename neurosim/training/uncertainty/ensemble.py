"""Ensembles: networks that learned from other rows each, and noise from what was unseen.

For trainers that make one network. What a simulator of few rows does not know shows where networks
that learned from other rows disagree. The mean is a network of its own, trained on all rows. Each
member is trained on a random half of the rows: an estimate from half of the rows strays from that
of all as far as that strays from the truth (Shao and Tu 1995, the delete-half jackknife). Its
read-out is then fitted to all rows, in random weights (the Bayesian bootstrap, Rubin 1981): product
units that had seen nothing of a corner of the commands would be wild there.

The noise is learned from residuals of read-outs that had not seen the row (cross-validation). Rows
are drawn in stretches of time, because neighbours share a place on the board and a state of the
battery.

Networks whose activations are not linear have no read-out to fit: their members are trained on
halves alone, and the mean is the members' average.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from neurosim.base.threads import one_thread
from neurosim.networks import Perceptron, ProductSummationNetwork
from neurosim.simulators import MotionNetwork
from neurosim.training.base import Trainer, TrainingData
from neurosim.training.trainers.readout import Readout
from neurosim.training.uncertainty.noise import fit_noise

#: Of read-outs.
RIDGE = 1e-6

#: Stretches of time that rows are drawn in, and folds that read-outs are cross-validated in.
STRETCHES, FOLDS = 40, 5


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
    ):
        if noise and members == 1 and not network.linear:
            raise ValueError("the noise of curved activations is learned from 2 members or more")
        self._make = lambda rows, settings, seed: kind(rows, network, settings, seed, device)
        self._data, self._network = data, network
        self._settings = settings
        self._members, self._noise, self._seed = members, noise, seed
        self._each = generations
        generator = torch.Generator().manual_seed(seed)
        self._stretch = stretches(len(data.x))
        # A single network needs searches on both halves for its noise alone.
        halves = members if members > 1 else 2 * int(noise and network.linear)
        self._seen = _halves(self._stretch, halves, generator)
        if network.linear or not halves:
            everything = torch.ones(1, len(data.x), dtype=torch.bool)
            self._seen = torch.cat([everything, self._seen])
        self._weights = _random_weights(self._stretch, members, generator)
        self._finished: list[dict[str, Tensor]] = []
        self._done = 0
        self._search = self._begin(0)

    @property
    def generations(self) -> int:
        """Generations of all the searches together."""
        return self._each * len(self._seen)

    def _begin(self, search: int) -> Trainer:
        seen, data = self._seen[search], self._data
        if not seen.all():
            data = replace(data, x=data.x[seen], y=data.y[seen], scale=data.input_scale)
        # Searches differ by seed too, for all that is drawn in them.
        with one_thread():
            return self._make(data, self._settings, self._seed + search)

    def advance(self) -> Tensor:
        """Work one generation of a search; return its least mean squared error so far, [3]."""
        if self._done == self._each:
            self._finished.append(self._search.state())
            self._search, self._done = self._begin(len(self._finished)), 0
        mse = self._search.advance()
        self._done += 1
        return mse

    def result(self) -> MotionNetwork:
        """Return the ensemble with its noise model, the same on any number of cores."""
        with one_thread():
            return self._result()

    def _result(self) -> MotionNetwork:
        found = []
        for number, state in enumerate(self._finished):
            search = self._begin(number)
            search.load(state)
            found.append(search.result())
        found.append(self._search.result())
        return self._refitted(found) if self._network.linear else self._averaged(found)

    def _refitted(self, found: list[MotionNetwork]) -> MotionNetwork:
        simulator, searched = found[0], found[1:]
        if self._members > 1:
            members = []
            for member, weights in zip(searched, self._weights, strict=True):
                readout = self._readout(member)
                members.append(readout.simulator(readout.genes(weights)))
            simulator = _together([simulator, *members], central=True)
        if self._noise:
            said = self._cross_validated(found[0])
            simulator.noise = fit_noise(
                simulator, simulator.scaled(self._data.x), self._data.y, said
            )
        return simulator

    def _readout(self, simulator: MotionNetwork) -> Readout:
        return Readout(self._data, simulator, RIDGE)

    def _cross_validated(self, simulator: MotionNetwork) -> Tensor:
        """Return what read-outs that had not seen a row say of it, [N, O]."""
        readout, fold = self._readout(simulator), self._stretch % FOLDS
        outputs = torch.zeros(len(fold), simulator.genes.shape[1], dtype=torch.float64)
        for k in fold.unique():
            out = fold == k
            without = readout.simulator(readout.genes((~out).double()))
            outputs[out] = without.outputs(self._data.x[out])[:, 0]
        return outputs

    def _averaged(self, found: list[MotionNetwork]) -> MotionNetwork:
        simulator = _together(found, central=False)
        if self._noise:
            unseen = (~self._seen).double().unsqueeze(-1)  # [M, N, 1]
            said = simulator.outputs(self._data.x).transpose(0, 1)
            said = (said * unseen).sum(0) / unseen.sum(0)
            simulator.noise = fit_noise(
                simulator, simulator.scaled(self._data.x), self._data.y, said
            )
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
        with one_thread():
            self._search.load(part("search."))


def _together(found: list[MotionNetwork], central: bool) -> MotionNetwork:
    first = found[0]
    genes = [simulator.genes for simulator in found]
    network = first.network
    if isinstance(network, ProductSummationNetwork):
        products = max(simulator.network.products for simulator in found)
        network = replace(network, products=products)
        genes = [widened(n.network, n.genes, products) for n in found]
    return MotionNetwork(
        first.inputs,
        network,
        torch.cat(genes),
        first.input_scale,
        torch.cat([member.output_scale for member in found]),
        first.coordinates,
        dead_zone=first.dead_zone,
        central=central,
    )


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


def _random_weights(stretch: Tensor, members: int, generator: torch.Generator) -> Tensor:
    """Return how much each row counts for each member, [M, N]: stretches weigh exponentially."""
    uniform = torch.rand(members, int(stretch[-1]) + 1, generator=generator, dtype=torch.float64)
    return -torch.log1p(-uniform)[:, stretch]


def widened(network: ProductSummationNetwork, genes: Tensor, products: int) -> Tensor:
    """Return the genes [..., G] of the same networks with units that count for nothing."""
    w, missing = network.split(genes), products - network.products
    return replace(network, products=products).join(
        w._replace(
            exponents=pad(w.exponents, (0, 0, 0, missing)),
            phases=pad(w.phases, (0, 0, 0, missing)),
            product_weights=pad(w.product_weights, (0, missing)),
            ceilings=pad(w.ceilings, (0, missing)),
        )
    )
