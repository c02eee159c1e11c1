"""The default trainer: networks that grow by product units whose exponents are searched for.

Given its product units, a network with linear activations is linear in all its other weights, and
the best of these follow from one small system of equations; only the exponents need searching.

The networks learn a body twist, whose exponential is where the robot gets to at steady speeds, so
that what it does (drive at a speed, turn at a rate) is not hidden behind the sine and cosine of
where that led; and an offset, for what happens at the beginning of a command, before the speeds
are reached, when the robot still looks where it did.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neurosim.base.se2 import tensors as se2
from neurosim.base.threads import one_thread
from neurosim.networks import Expanded, ProductSummationNetwork
from neurosim.simulators import MotionNetwork
from neurosim.simulators.motion.derived import Derived, can_swing
from neurosim.simulators.motion.noise import CommandFeatures
from neurosim.training.base import PursuitSettings, TrainingData, root_mean_square
from neurosim.training.trainers.averaging import mean
from neurosim.training.trainers.dead_zone import find_dead_zone
from neurosim.training.trainers.pursuit import Pursuit
from neurosim.training.trainers.swing import find_swing

#: With fewer rows than these, inputs that are derived find what is not there; with fewer than
#: MANY_ROWS, so do finer searches and the word that a command is to move.
SOME_ROWS, MANY_ROWS = 300, 1000


@dataclass(frozen=True)
class ExponentsSettings(PursuitSettings):
    """Settings of the search.

    Attributes:
        floor: the smallest magnitude of an input in a product unit.
        dead_zone: scaled inputs that are smaller count as zero, one number an input; found from
            the data if not given.
        derived: inputs that follow from the others; found from the data if not given.
    """

    floor: float = 0.02
    dead_zone: tuple[float, ...] | None = None
    derived: Derived | None = None


class ExponentsTrainer:
    """A search or two for the turn, and one for twist and offset of the translation.

    The displacement of a constant body twist (vx, vy, omega) over unit time is, in the mid-turn
    frame (see :mod:`neurosim.base.se2`), (vx, vy) times the chord of omega. Fitting that chord
    times the networks' outputs to the displacement in that frame minimises the error of the
    displacement itself, and needs no logarithm, which has none near whole turns. The offset, in
    the frame of the start, is turned by minus half the turn there. Given the turn, both are linear.
    """

    source = (
        "Orthogonal least squares (Chen, Cowan, Grant 1991) over product units (Durbin and "
        "Rumelhart 1989) with exponents refined by variable projection (Golub and Pereyra 1973); "
        "twist coordinates: Lynch and Park 2017, section 3.3"
    )
    settings_type = ExponentsSettings
    default_generations = 24
    default_hidden = (24, 1)

    def __init__(
        self,
        data: TrainingData,
        network: ProductSummationNetwork,
        settings: ExponentsSettings,
        seed: int,
        device: str = "cpu",
    ):
        if not network.linear or network.summations < 1 or network.products < 1:
            raise ValueError("exponents are trained for linear activations and units of both kinds")
        self._data, self._settings = data, settings
        self._generator = torch.Generator(device).manual_seed(seed)
        self._device = device
        x, y = data.scaled_inputs.to(device), data.y.to(device)
        if settings.dead_zone is None:
            names = [entry["name"] for entry in data.inputs]
            with one_thread(device):
                self._dead_zone = find_dead_zone(names, x, y)
        else:
            self._dead_zone = torch.tensor(settings.dead_zone, dtype=x.dtype, device=device)
        x = torch.where(x.abs() < self._dead_zone, 0.0, x)
        self._derived, x = self._derive(x, y[:, 2])
        self._network = replace(
            network, inputs=x.shape[1], phases=True, ceilings=True, floor=settings.floor
        )
        targets = se2.mid_turn(y)
        self._scale = root_mean_square(targets)[[0, 2]]  # of translations and of turns
        translation = translation_factors(y[:, 2])
        search = (settings, network.products, self._generator, settings.floor)
        # It is one function, whose exponents can all be moved together after every unit; and its
        # search is short, so that the average of two can be had (Breiman 1996).
        often, turns = settings, 1
        if len(x) >= MANY_ROWS:
            often = replace(settings, refine_every=1, refine_steps=2 * settings.refine_steps)
            turns = 2
        turn = targets[:, 2:].T / self._scale[1]
        self._turns = [
            Pursuit(x, torch.ones_like(turn)[None], turn, often, *search[1:]) for _ in range(turns)
        ]
        self._shift = Pursuit(x, translation, targets[:, :2].T / self._scale[0], *search)

    def _derive(self, x: Tensor, turn: Tensor) -> tuple[Derived, Tensor]:
        """Return which derived inputs there are, and the scaled inputs with them."""
        columns = CommandFeatures.of(tuple(entry["name"] for entry in self._data.inputs))
        inputs, settings = self._data.x.to(x), self._settings
        derived = settings.derived
        if derived is None:
            derived = Derived(moving=len(x) >= MANY_ROWS and bool(self._dead_zone.any()))
            if len(x) >= SOME_ROWS and can_swing(columns):
                with one_thread(self._device):
                    derived = find_swing(
                        derived, columns, inputs, x, turn, settings, settings.floor
                    )
        return derived, derived.append(columns, inputs, x)

    @staticmethod
    def make_network(
        inputs: int, hidden: tuple[int, int], activations: tuple[str, str]
    ) -> ProductSummationNetwork:
        """Return the shape of the networks that it trains."""
        return ProductSummationNetwork(inputs, *hidden, *activations)

    def advance(self) -> Tensor:
        """Give the turn one unit more and the translation two; return the mean squared errors.

        Returns:
            [3], in SI units, of the units there are now. Those of dx and dy are of the
            displacement in the mid-turn frame, the turn taken as measured; that of the turn is
            the searches' average.
        """
        with one_thread(self._device):
            for search in self._turns:
                search.grow()
            for _ in range(2):
                self._shift.grow()
        turn = torch.stack([search.mean_squared_error for search in self._turns]).mean(0)
        errors = torch.cat([self._shift.mean_squared_error, turn])
        return (errors * self._scale[[0, 0, 1]].square()).cpu()

    def result(self) -> MotionNetwork:
        """Return the networks that promise to generalise best."""
        state = self.state()
        for search in (*self._turns, self._shift):
            search.settle()
        vx, vy, ox, oy = expansions(self._shift)
        omega = mean([function for turn in self._turns for function in expansions(turn)])
        products = max(self._network.products, len(omega.weights))
        network = replace(self._network, products=products)
        genes = torch.stack([network.pack(part) for part in (vx, vy, omega, ox, oy)]).cpu()
        self.load(state)
        translation, turn = self._scale.tolist()
        return MotionNetwork(
            self._data.inputs,
            network,
            genes,
            self._data.input_scale,
            torch.tensor([translation, translation, turn, translation, translation]),
            coordinates="twist-offset",
            dead_zone=self._dead_zone.cpu(),
            derived=self._derived,
        )

    def state(self) -> dict[str, Tensor]:
        """Return the state of all searches."""
        state = {
            "generator": self._generator.get_state(),
            "dead_zone": self._dead_zone.cpu(),
            "derived": self._derived.tensor(),
        }
        for name, search in self._searches():
            state |= {f"{name}.{key}": value for key, value in search.state().items()}
        return state

    def _searches(self) -> list[tuple[str, Pursuit]]:
        turns = [(f"turn{number}", search) for number, search in enumerate(self._turns)]
        return [*turns, ("shift", self._shift)]

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Go on from a state, bit for bit."""
        for name, search in self._searches():
            begin = f"{name}."
            search.load({k.removeprefix(begin): v for k, v in state.items() if k.startswith(begin)})
        self._generator.set_state(state["generator"])


def expansions(search: Pursuit) -> list[Expanded]:
    """Return each function that a search has found."""
    found = zip(search.exponents, search.phases, search.ceilings(), search.readout(), strict=True)
    return [
        Expanded(*units, weights, linear=linear[:-1], bias=linear[-1])
        for *units, (weights, linear) in found
    ]


def translation_factors(turn: Tensor) -> Tensor:
    """Return what (vx, vy, offset x, offset y) count in a translation in the mid-turn frame.

    Args:
        turn: [N], rad.

    Returns:
        [2, 4, N].
    """
    cos, sin, none = (turn / 2.0).cos(), (turn / 2.0).sin(), torch.zeros_like(turn)
    chord = se2.chord(turn)
    return torch.stack(
        [torch.stack([chord, none, cos, sin]), torch.stack([none, chord, -sin, cos])]
    )
