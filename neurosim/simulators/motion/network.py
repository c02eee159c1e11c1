"""The motion network: three networks predict how a command displaces the robot.

Pretorius et al. 2009, section 5.3: the networks are given the motors' speeds before and during
the command and its duration, and predict the displacement in the robot's own frame; displacements
are composed into a path. Which inputs there are is the dataset's matter: those called ``prev_...``
are remembered in the state, the others are the command.

Beyond the paper, a simulator may be an ensemble of such networks with a learned noise model: the
members disagree where there was little to learn from, the noise is what no network can foresee.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurosim.base.se2 import tensors as se2
from neurosim.base.trajectory import Episode
from neurosim.networks import Perceptron, Prediction, ProductSummationNetwork
from neurosim.networks.expanded import sign_patterns
from neurosim.simulators.base import Rollouts, Simulator
from neurosim.simulators.motion.closed_loop import MotionClosedLoop
from neurosim.simulators.motion.derived import Derived, can_swing
from neurosim.simulators.motion.kernels import Arrays
from neurosim.simulators.motion.noise import DRAWS, CommandFeatures, NoiseModel, disturb
from neurosim.simulators.motion.plans import MotionPlans

OUTPUTS = ("dx", "dy", "dtheta")

#: What the networks' outputs are, and how many networks that takes: the displacement itself; or
#: the constant body twist whose exponential it nearly is (see :mod:`neurosim.base.se2`), the
#: duration taken as unit time, and what is added: an offset (x, y) in the frame at the command's
#: start, where the speed changes.
COORDINATES = {"displacement": 3, "twist-offset": 5}


class MotionNetwork(Simulator):
    """A simulator of a robot in the plane, learned from a dataset.

    A trajectory keeps one member of the ensemble from its start to its end; the column
    ``member`` of its state says which, -1 standing for the mean of all. A simulator of one member,
    as in the paper, has no such column.

    Attributes:
        inputs: names and units of the inputs, [{name, unit}].
        network: the shape that its networks have.
        genes: their weights, [M, O, G], float64: M members of as many networks as
            :data:`COORDINATES` says; if ``central``, [1 + M, O, G], the mean's before them.
        central: whether the mean of the ensemble is a network of its own, which has learned from
            all rows; if not, it is the members' average.
        input_scale: [I]; inputs are divided by it.
        output_scale: as genes, [M, O]; the networks' outputs times this are in metres and radians.
        coordinates: one of :data:`COORDINATES`.
        noise: the noise model, or None.
        dead_zone: [I]; scaled inputs that are smaller count as zero: a motor that is told to turn
            too slowly stands.
        derived: inputs of the networks that follow from the others and stand after them.
        meta: what else simulator.json says: training, test errors, source.
    """

    kind = "motion-network"

    def __init__(
        self,
        inputs: Sequence[Mapping[str, str]],
        network: ProductSummationNetwork | Perceptron,
        genes: Tensor,
        input_scale: Tensor,
        output_scale: Tensor,
        coordinates: str = "displacement",
        meta: Mapping[str, Any] | None = None,
        noise: NoiseModel | None = None,
        dead_zone: Tensor | None = None,
        central: bool = False,
        derived: Derived | None = None,
    ):
        """Make a simulator.

        ``genes`` [O, G] are those of a single member, an ``output_scale`` [O] is that of all.
        """
        names = tuple(entry["name"] for entry in inputs)
        remembered = tuple(name for name in names if name.startswith("prev_"))
        self.command_names = tuple(name for name in names if name not in remembered)
        for name in remembered:
            if name.removeprefix("prev_") not in self.command_names:
                raise ValueError(f"there is an input {name}, but no {name.removeprefix('prev_')}")
        genes = genes.unsqueeze(0) if genes.ndim == 2 else genes
        if coordinates not in COORDINATES:
            raise ValueError(f"coordinates must be one of {', '.join(COORDINATES)}")
        shape = (len(genes), COORDINATES[coordinates], network.genes)
        derived = derived or Derived()
        if (
            len(names) + len(derived) != network.inputs
            or genes.shape != shape
            or len(genes) <= central
        ):
            raise ValueError("inputs, network and genes do not fit each other")
        self.inputs = [dict(entry) for entry in inputs]
        self.network = network
        self.genes = genes.double()
        self.central = central
        self.input_scale = input_scale.to(self.genes)
        self.output_scale = output_scale.to(self.genes).expand(shape[:2]).contiguous()
        zero = torch.zeros_like(self.input_scale)
        self.dead_zone = zero if dead_zone is None else dead_zone.to(zero)
        self.coordinates = coordinates
        self.noise = noise
        self.meta = dict(meta or {})
        self.state_names = ("x", "y", "theta", *remembered)
        if self.members > 1:
            self.state_names += ("member",)
        given = (*remembered, *self.command_names)
        device = self.genes.device
        self._columns = CommandFeatures.of(names)
        if derived.swing is not None and not can_swing(self._columns):
            raise ValueError("a swing takes two remembered inputs")
        self.derived = derived
        self._predict = Prediction(network, self.genes.flatten(0, 1))
        self._predict_mean = Prediction(network, self.genes[0]) if central else None
        self._remembered = slice(3, 3 + len(remembered))
        self._order = torch.tensor([given.index(name) for name in names], device=device)
        self._next = torch.tensor(
            [self.command_names.index(name.removeprefix("prev_")) for name in remembered],
            dtype=torch.long,
            device=device,
        )

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the inputs, in the order of :meth:`displacement`'s columns."""
        return tuple(entry["name"] for entry in self.inputs)

    @property
    def members(self) -> int:  # type: ignore[override]
        """How many networks of each output there are."""
        return len(self.genes) - self.central

    @property
    def has_noise(self) -> bool:  # type: ignore[override]
        """Whether there is a noise model."""
        return self.noise is not None

    @property
    def noise_width(self) -> int:  # type: ignore[override]
        """How many numbers the noise of a command is made of."""
        return 0 if self.noise is None else DRAWS

    @property
    def domain(self) -> dict[str, tuple[float, float]]:
        """The largest commands that it has learned from."""
        largest = dict(zip(self.input_names, self.input_scale.tolist(), strict=True))
        return {
            name: (0.0 if name == "duration" else -largest[name], largest[name])
            for name in self.command_names
        }

    def draw_noise(self, rows: int, steps: int, generator: torch.Generator) -> Tensor:
        """Return the numbers [rows, steps, noise_width] that noise of trajectories is made of."""
        assert self.noise is not None
        return self.noise.draw(rows, steps, generator)

    def start(
        self,
        pose: Tensor,
        generator: torch.Generator | None = None,
        member: Tensor | int | None = None,
    ) -> Tensor:
        """Return the states [B, S] of robots that stand still at ``pose`` [B, 3].

        Args:
            pose: x (m), y (m), heading (rad).
            generator: each trajectory draws its member; without one it follows the mean.
            member: 0..M-1, or -1 for the mean, of all or of each [B]; not drawn then.
        """
        pose = pose.to(self.genes)
        rows = len(pose)
        state = torch.cat([pose, pose.new_zeros(rows, len(self.state_names) - 3)], dim=1)
        if self.members > 1:
            if member is None:
                member = -1 if generator is None else self.draw_members(rows, generator)
            state[:, self._remembered.stop] = torch.as_tensor(member).to(state)
        return state

    def start_as(self, pose: Tensor, member: Tensor) -> Tensor:
        """Return the states [B, S] of robots that move as the members [B], -1 for the mean."""
        return self.start(pose, member=member)

    def draw_members(self, rows: int, generator: torch.Generator) -> Tensor:
        """Return a member for each trajectory, [rows], all alike probable."""
        device = generator.device
        return torch.randint(self.members, (rows,), generator=generator, device=device)

    def step(
        self,
        state: Tensor,
        command: Tensor,
        generator: torch.Generator | None = None,
        z: Tensor | None = None,
    ) -> Tensor:
        """Return the states [B, S] after ``command`` [B, C] was carried out from ``state``.

        With a generator, and where there is a noise model, fresh noise is drawn for every row; or
        it is made of the numbers ``z`` [B, noise_width]. Without either the answer is the mean of
        the row's member.
        """
        inputs = torch.cat([state[:, self._remembered], command], dim=1)[:, self._order]
        member = state[:, self._remembered.stop].long() if self.members > 1 else -1
        moved = self.displacement(inputs, member)
        rest = state[:, self._remembered.stop :]
        if generator is not None and self.noise is not None:
            z = self.noise.draw(len(moved), 1, generator)[:, 0]
        if z is not None:
            moved = self.disturbed(inputs, moved, z)
        pose = se2.compose(state[:, :3], moved)
        return torch.cat([pose, command[:, self._next], rest], dim=1)

    def displacement(self, inputs: Tensor, member: Tensor | int = -1) -> Tensor:
        """Return the mean displacements [B, 3] (m, m, rad) that follow from ``inputs`` [B, I].

        They are in the robot's frame at the command's start, REP 103.

        Args:
            inputs: in the dataset's units.
            member: of the ensemble, for all rows or for each [B]; -1: the mean.
        """
        if self._predict_mean is not None and isinstance(member, int) and member < 0:
            outputs = self._predict_mean(self.network_inputs(inputs)) * self.output_scale[0]
        else:
            outputs = _of_member(self._outputs(inputs), member, self.central)
        return self.from_outputs(outputs)

    def scaled(self, inputs: Tensor) -> Tensor:
        """Return ``inputs`` [B, I] scaled, those within the dead zone zero."""
        scaled = inputs / self.input_scale
        return torch.where(scaled.abs() < self.dead_zone, 0.0, scaled)

    def network_inputs(self, inputs: Tensor) -> Tensor:
        """Return ``inputs`` [B, I] as the networks take them, the derived ones appended."""
        return self.derived.append(self._columns, inputs, self.scaled(inputs))

    def outputs(self, inputs: Tensor) -> Tensor:
        """Return what every member's networks say [B, M, O] (SI units) of ``inputs`` [B, I]."""
        return self._outputs(inputs)[:, int(self.central) :]

    def _outputs(self, inputs: Tensor) -> Tensor:
        outputs = self._predict(self.network_inputs(inputs))
        return outputs.unflatten(-1, (len(self.genes), -1)) * self.output_scale

    def from_outputs(self, outputs: Tensor) -> Tensor:
        """Return the displacements [B, 3] that networks' outputs [B, O] stand for."""
        if self.coordinates == "displacement":
            return outputs
        moved = se2.exp(outputs[:, :3])
        return torch.cat([moved[:, :2] + outputs[:, 3:], moved[:, 2:]], dim=1)

    def disturbed(self, inputs: Tensor, mean: Tensor, z: Tensor) -> Tensor:
        """Return displacements [B, 3] with noise of the draws ``z`` [B, DRAWS].

        Args:
            inputs: [B, I], in the dataset's units.
            mean: of :meth:`displacement`, [B, 3].
            z: of :meth:`NoiseModel.draw`.
        """
        if self.noise is None:
            return mean
        return disturb(self.noise, self._columns, self.scaled(inputs), mean, z)

    def rollouts(self, controller: Any, episode: Episode) -> Rollouts | None:
        """Return compiled rollouts where the units are linear and the commands are these."""
        if not self.network.linear:
            return None
        if controller.blind and tuple(controller.outputs) == self.command_names:
            return MotionPlans(self, controller, episode)
        # A step's duration is put behind the outputs, where it is a command.
        outputs = tuple(controller.outputs)
        fits = self.command_names in (outputs, (*outputs, "duration"))
        if fits and "duration" not in outputs and controller.arrays() is not None:
            return MotionClosedLoop(self, controller, episode)
        return None

    def input_sources(self) -> NDArray[np.int64]:
        """Return where each input comes from, as compiled rollouts take it, [I].

        c for column c of the command, -c - 1 for column c of the command before.
        """
        names = self.command_names
        return np.array(
            [
                names.index(name) if name in names else -names.index(name.removeprefix("prev_")) - 1
                for name in self.input_names
            ],
            np.int64,
        )

    def arrays(self) -> Arrays:
        """Return what :mod:`neurosim.simulators.motion.kernels` computes with.

        Raises:
            ValueError: if the networks' activations are not linear.
        """
        if not self.network.linear:
            raise ValueError("compiled simulators are of networks with linear activations")
        assert isinstance(self.network, ProductSummationNetwork)
        parts = self.network.expand(self.genes.cpu()).times(self.output_scale.cpu())
        shapes = NoiseModel.SHAPES
        noise = {
            name: torch.zeros(shapes[name]) if self.noise is None else getattr(self.noise, name)
            for name in shapes
        }
        tensors = {
            "exponents": parts.exponents,
            "ceiling": parts.ceilings,
            "signed": parts.signed(sign_patterns(self.network.inputs)),
            "linear": parts.linear,
            "bias": parts.bias,
            "input_scale": self.input_scale,
            "dead_zone": self.dead_zone,
            **{f"noise_{name}": value for name, value in noise.items()},
        }
        return Arrays(
            **{k: np.ascontiguousarray(v.cpu().numpy(), np.float64) for k, v in tensors.items()},
            floor=self.network.floor,
            twist=self.coordinates != "displacement",
            central=self.central,
            noisy=self.noise is not None,
            driven=np.array(self._columns.driven, np.int64),
            before=np.array(self._columns.before, np.int64),
            duration=self._columns.duration,
            moving=self.derived.moving,
            swing=math.nan if self.derived.swing is None else self.derived.swing,
        )


def _of_member(outputs: Tensor, member: Tensor | int, central: bool) -> Tensor:
    """Return the outputs [N, O] of a member, of outputs [N, M, O], or [N, 1 + M, O] if central."""
    if isinstance(member, int):
        return outputs.mean(1) if member < 0 else outputs[:, member + central]
    place = (member + central).clamp(min=0)[:, None, None]
    own = torch.take_along_dim(outputs, place, 1).squeeze(1)
    average = member < 0
    if central or not average.any():  # the mean's own network is the one before the first
        return own
    return torch.where(average.unsqueeze(-1), outputs.mean(1), own)
