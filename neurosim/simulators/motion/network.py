"""The motion network: three networks predict how a command displaces the robot.

Pretorius et al. 2009, section 5.3: the networks get the motors' speeds before and during the
command and its duration, and predict the displacement in the robot's own frame; displacements are
composed into a path. The dataset determines the inputs: those called ``prev_...`` are kept in the
state, the others are the command.

Beyond the paper, a simulator may be an ensemble of such networks with a learned noise model: the
members disagree where the data is sparse; the noise is the part that no network can predict.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import asdict, astuple
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurosim.base.errors import UserError
from neurosim.base.perimeter import Perimeter
from neurosim.base.se2 import tensors as se2
from neurosim.networks import Prediction, ProductSummationNetwork
from neurosim.networks.expanded import sign_patterns
from neurosim.simulators.adjustable import Adjustable
from neurosim.simulators.base import Simulator
from neurosim.simulators.motion.correction import Correction
from neurosim.simulators.motion.derived import Derived, can_swing
from neurosim.simulators.motion.domain import Domain
from neurosim.simulators.motion.drive import DriveModel, Reached, Underway
from neurosim.simulators.motion.excess import NAMES as EXCESS
from neurosim.simulators.motion.excess import Excess
from neurosim.simulators.motion.floor import Floor, even
from neurosim.simulators.motion.kernel_units import KernelUnits
from neurosim.simulators.motion.kernels import HALF_LOG2_E, LANES, MotionModel
from neurosim.simulators.motion.noise import (
    DRAWS,
    CommandFeatures,
    NoiseModel,
    added,
    disturb,
    draw,
)
from neurosim.simulators.motion.sensors import Sensors, no_sensors

OUTPUTS = ("dx", "dy", "dtheta")

#: A command continues up to the longest duration, within this fraction.
HELD = 0.05

#: Number of commands after which an actuator's remaining difference is dropped; more if they are
#: shorter in all than this time, s, and this number of lags, up to a limit.
_LINKS, _DIES, _LAGS, _MOST_LINKS = 4, 1.0, 5.0, 400

#: Outputs of the networks: the displacement; or, with a drive model, the twist by which the robot
#: deviates from it, in the time of the longest command.
COORDINATES = ("displacement", "residual-twist")


#: Columns of the state of a robot that drifts, see :class:`Underway`.
DRIFT = ("began_drift_x", "began_drift_y", "drift_x", "drift_y")


class _State(NamedTuple):
    """A state with a drive model in parts, [B, ...], in the order of its columns."""

    pose: Tensor
    speed: Tensor
    push: Tensor
    commanded: Tensor
    elapsed: Tensor
    displaced: Tensor
    noise: Tensor
    began_speed: Tensor
    began_push: Tensor
    acts: Tensor
    goals: Tensor
    began_drift: Tensor
    drift: Tensor
    excess: Tensor
    member: Tensor


def _flat(under: Underway) -> dict[str, Tensor]:
    """Return the actuators' state at the beginning of a command, as parts of a state."""
    names = ("began_speed", "began_push", "goals", "acts", "began_drift")
    flat = under._replace(goals=under.goals.flatten(1))
    return dict(zip(names, flat, strict=True))


class MotionNetwork(Simulator):
    """A simulator of a robot in the plane, learned from a dataset.

    A trajectory keeps one member of the ensemble from its start to its end; the column ``member``
    of its state has its number, -1 for the mean of all. A simulator of one member,
    as in the paper, has no such column.

    Attributes:
        inputs: names and units of the inputs, [{name, unit}].
        network: the shape of its networks.
        genes: their weights, [M, 3, G], float64, of M members; if ``central``, [1 + M, 3, G], the
            mean's first.
        central: whether the mean of the ensemble is a separate network, which has learned from all
            rows; if not, it is the members' average.
        input_scale: [I]; inputs are divided by it.
        output_scale: [M, O], in the order of genes; the networks' outputs times this are in metres
            and radians.
        coordinates: one of :data:`COORDINATES`.
        noise: the noise model, or None.
        dead_band: [I]; smaller scaled inputs count as zero: at a low command a motor stands.
        derived: the input of the networks that is computed from the others and follows them.
        drive: the drive model from which the robot deviates; with it a command may be cut into
            steps of any length. Without it, a step is a whole command.
        kernel_units: units in addition to the networks' own, or None.
        known: the commands from which it has learned; None: only the largest are known.
        correction: of drive model and all networks, to simulate another floor or robot than that of
            the data.
        sensors: its sensors, with their maps of the board; None: it has none.
        floor: map of the lost fraction of motion; None: the floor is even.
        excess: how a speed that is measured counts, see :meth:`seen`; None: it does not.
        meta: other parts of simulator.json: training, test errors, source.
        longest: the longest command in its data, s; infinite without a duration.
    """

    kind = "motion-network"

    def __init__(
        self,
        inputs: Sequence[Mapping[str, str]],
        network: ProductSummationNetwork,
        genes: Tensor,
        input_scale: Tensor,
        output_scale: Tensor,
        coordinates: str = "displacement",
        meta: Mapping[str, Any] | None = None,
        noise: NoiseModel | None = None,
        dead_band: Tensor | None = None,
        central: bool = False,
        derived: Derived | None = None,
        drive: DriveModel | None = None,
        kernel_units: KernelUnits | None = None,
        known: Domain | None = None,
        correction: Correction | None = None,
        sensors: Sensors | None = None,
        floor: Floor | None = None,
        excess: Excess | None = None,
    ):
        """Make a simulator.

        ``genes`` [O, G] belong to a single member, an ``output_scale`` [O] to all members.
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
        shape = (len(genes), len(OUTPUTS), network.genes)
        derived = derived or Derived()
        if (
            len(names) + len(derived) != network.inputs
            or genes.shape != shape
            or len(genes) <= central
        ):
            raise ValueError("inputs, network and genes do not fit each other")
        columns = CommandFeatures.of(names)
        if known is not None and known.names != self.command_names:
            raise ValueError("the domain has other commands")
        if (drive is not None) != (coordinates == "residual-twist"):
            raise ValueError("a residual twist needs a drive model")
        correction = correction or Correction()
        if drive is None and correction != Correction():
            raise ValueError("without a drive model there is nothing to correct")
        if drive is not None and not can_drive(names, len(drive.lag)):
            raise ValueError("a drive model needs a duration, and every input's command before")
        if derived.swing is not None and not can_swing(columns):
            raise ValueError("a swing needs two inputs with their previous values")
        if kernel_units is not None and (
            kernel_units.weights.shape[:2] != shape[:2]
            or len(kernel_units.lengths) != network.inputs
        ):
            raise ValueError("kernel units and networks do not fit each other")
        if floor is not None and len(floor.weights) != 1 + len(genes) - central:
            raise ValueError("the floor and networks do not fit each other")
        if drive is None and excess is not None:
            raise ValueError("an excess needs a drive model")
        self.inputs = [dict(entry) for entry in inputs]
        self.network = network
        self.genes = genes.double()
        self.central = central
        self.input_scale = input_scale.to(self.genes)
        self.output_scale = output_scale.to(self.genes).expand(shape[:2]).contiguous()
        zero = torch.zeros_like(self.input_scale)
        self.dead_band = zero if dead_band is None else dead_band.to(zero)
        self.coordinates = coordinates
        self.noise = noise
        self.meta = dict(meta or {})
        self.perimeter = Perimeter.from_json(self.meta.get("perimeter"))
        self.derived = derived
        self.drive = drive
        self.kernel_units = kernel_units
        self.known = known
        self.correction = correction
        self.sensors = sensors
        self.floor = floor
        self.excess = excess
        self._corrected = None if drive is None else correction.of_drive(drive)
        self.columns = columns
        place = columns.duration
        self.longest = math.inf if place < 0 else float(self.input_scale[place])
        if drive is None:
            self.state_names: tuple[str, ...] = ("x", "y", "theta", *remembered)
        else:
            driven = [names[place] for place in columns.driven]
            self.state_names = (
                *("x", "y", "theta"),
                *(f"speed_{name}" for name in driven),
                *(f"push_{name}" for name in driven),
                *(f"commanded_{name}" for name in driven),
                *("elapsed", "moved_x", "moved_y", "moved_theta"),
                *(f"noise_{number}" for number in range(DRAWS)),
                *(f"began_speed_{name}" for name in driven),
                *(f"began_push_{name}" for name in driven),
                *(f"waiting_{n}_acts" for n in range(drive.slots)),
                *(f"waiting_{n}_{name}" for n in range(drive.slots) for name in driven),
                *(DRIFT if drive.drifts else ()),
                *(() if excess is None else EXCESS),
            )
        if self.members > 1:
            self.state_names += ("member",)
        given = (*remembered, *self.command_names)
        device = self.genes.device
        self._predict = Prediction(network, self.genes.flatten(0, 1))
        self._predict_mean = Prediction(network, self.genes[0]) if central else None
        self._remembered = slice(3, 3 + len(remembered))
        self._order = torch.tensor([given.index(name) for name in names], device=device)
        self._next = torch.tensor(
            [self.command_names.index(name.removeprefix("prev_")) for name in remembered],
            dtype=torch.long,
            device=device,
        )
        self._driven = torch.tensor(columns.driven, dtype=torch.long, device=device)
        self._commanded = [self.command_names.index(names[place]) for place in columns.driven]

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the inputs, in the order of :meth:`displacement`'s columns."""
        return tuple(entry["name"] for entry in self.inputs)

    @property
    def members(self) -> int:  # type: ignore[override]
        """Number of networks of each output, without the mean's."""
        return len(self.genes) - self.central

    @property
    def dtype(self) -> torch.dtype:  # type: ignore[override]
        """Type of its numbers: that of its genes."""
        return self.genes.dtype

    @property
    def device(self) -> torch.device:  # type: ignore[override]
        """Device of its computations: that of its genes."""
        return self.genes.device

    @property
    def has_noise(self) -> bool:  # type: ignore[override]
        """Whether there is a noise model, or sensors, whose readings always have noise."""
        return self.noise is not None or self.sensors is not None

    @property
    def noise_width(self) -> int:  # type: ignore[override]
        """Number of random numbers for the noise of a command; the sensors' are last."""
        return (DRAWS + len(self.reading_names)) * self.has_noise

    @property
    def reading_names(self) -> tuple[str, ...]:  # type: ignore[override]
        """Names of the sensors, if any."""
        return () if self.sensors is None else self.sensors.names

    @property
    def domain(self) -> dict[str, tuple[float, float]]:
        """Lowest and highest command in its data, or the largest in both directions."""
        if self.known is not None:
            return self.known.ranges
        largest = dict(zip(self.input_names, self.input_scale.tolist(), strict=True))
        return {
            name: (0.0 if name == "duration" else -largest[name], largest[name])
            for name in self.command_names
        }

    @property
    def slack(self) -> float:  # type: ignore[override]
        """Fraction of its width by which a range may be exceeded."""
        return super().slack if self.known is None else self.known.slack

    @property
    def knows_gaps(self) -> bool:  # type: ignore[override]
        """Whether it knows gaps within the ranges."""
        return self.known is not None

    def supported(self, commands: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether commands [..., C] are like some in its data, [...]."""
        return super().supported(commands) if self.known is None else self.known.supported(commands)

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
            member: 0..M-1, or -1 for the mean, of all or of each [B]; it is not drawn then.
        """
        pose = pose.to(self.genes)
        rows = len(pose)
        state = torch.cat([pose, pose.new_zeros(rows, len(self.state_names) - 3)], dim=1)
        if self.members > 1:
            if member is None:
                member = -1 if generator is None else self.draw_members(rows, generator)
            state[:, -1] = torch.as_tensor(member).to(state)
        return state

    def start_as(self, pose: Tensor, member: Tensor) -> Tensor:
        """Return the states [B, S] of robots with ensemble members [B], -1 for the mean."""
        return self.start(pose, member=member)

    def over(self, state: Tensor) -> Tensor:
        """Return states [B, S] after the last command's end; the same command begins again."""
        if self.drive is None:
            return state
        parts = self._parts(state)
        under = self._after(self.drive, parts)
        parts = parts._replace(elapsed=torch.zeros_like(parts.elapsed), **_flat(under))
        return torch.cat(parts, dim=1)

    def standing(
        self, poses: NDArray[np.float64], member: NDArray[np.int64] | None = None
    ) -> NDArray[np.float64]:
        """Return the states [B, S] of robots that stand still at poses [B, 3]."""
        states = np.zeros((len(poses), len(self.state_names)))
        states[:, :3] = poses
        if self.members > 1:
            states[:, -1] = -1 if member is None else member
        return states

    def draw_members(self, rows: int, generator: torch.Generator) -> Tensor:
        """Return a random member for each trajectory, [rows], with equal probabilities."""
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

        With a generator and a noise model, new noise is drawn for every row; or it is computed from
        the numbers ``z`` [B, noise_width]. Without both the result is the mean of the row's member.
        """
        member = state[:, -1].long() if self.members > 1 else -1
        if generator is not None and self.noise is not None:
            z = self.noise.draw(len(state), 1, generator)[:, 0]
        z = None if self.noise is None or z is None else z[:, :DRAWS]
        if self.drive is not None:
            return self._step_within(state, command, member, z)
        given = torch.cat([state[:, self._remembered], command], dim=1)
        x = self.scaled(given[:, self._order])
        moved = self.displacement_of(x, member)
        if z is not None:
            moved = self.disturbed(x, moved, z)
        pose = se2.compose(state[:, :3], self.on_floor(state[:, :3], moved, member))
        return torch.cat([pose, command[:, self._next], state[:, self._remembered.stop :]], dim=1)

    def sense(
        self, state: Tensor, generator: torch.Generator | None = None, z: Tensor | None = None
    ) -> Tensor:
        """Return the readings [B, len(reading_names)], 0..1, of robots in ``state`` [B, S].

        With a generator new noise is drawn for every row; or it is computed from the numbers ``z``
        [B, noise_width]. Without both there is none.
        """
        if self.sensors is None:
            return super().sense(state, generator)
        if generator is not None:
            z = draw(len(state), 1, generator, self.noise_width)[:, 0]
        return self.sensors.read(state[:, :3], None if z is None else z[:, DRAWS:])

    def _step_within(
        self, state: Tensor, command: Tensor, member: Tensor | int, z: Tensor | None
    ) -> Tensor:
        """Step with a drive model.

        If the command is the same as before, it continues: the robot moves to the pose of a single
        longer step, from its present one, and the noise is that of the command's beginning. So the
        result does not depend on how a command is cut into steps.
        """
        drive = self._corrected
        assert drive is not None
        parts = self._parts(state)
        driven = command[:, self._commanded]
        step = command[:, [self.command_names.index("duration")]]
        longest = self.input_scale[self.columns.duration]
        same = (driven == parts.commanded).all(1, keepdim=True) & (parts.elapsed > 0.0)
        same &= parts.elapsed + step <= longest * (1.0 + HELD)
        began = _flat(self._after(drive, parts))
        began = {k: torch.where(same, getattr(parts, k), v) for k, v in began.items()}
        under = self._underway(parts._replace(**began))
        elapsed = torch.where(same, parts.elapsed, 0.0) + step
        displaced = torch.where(same, parts.displaced, 0.0)
        noise = torch.where(same, parts.noise, 0.0 if z is None else z.to(state))
        x = state.new_zeros(state.shape[0], len(self.inputs))
        x[:, list(self.columns.before)] = under.speed
        x[:, self._driven] = goals = self._speeds(driven)
        x[:, self.columns.duration] = elapsed.squeeze(1) / longest
        moved = self.displacement_of(x, member, under)
        if z is not None:
            moved = self.disturbed(x, moved, noise)
        since = self.on_floor(parts.pose, se2.between(displaced, moved), member)
        if self.excess is not None:
            more, left = self.excess.faded(parts.excess, step)
            since, parts = added(since, more), parts._replace(excess=left)
        pose = se2.compose(parts.pose, since)
        reached = drive.reached(under, goals, elapsed.squeeze(1))._asdict()
        now = parts._replace(pose=pose, commanded=driven, elapsed=elapsed, **reached)
        return torch.cat(now._replace(displaced=moved, noise=noise, **began), dim=1)

    def _parts(self, state: Tensor) -> _State:
        """Return states [B, S] in parts."""
        assert self.drive is not None
        count, slots = len(self.columns.driven), self.drive.slots
        sizes = [3, *[count] * 3, 1, 3, DRAWS, *[count] * 2, slots, slots * count]
        sizes += [2 * self.drive.drifts] * 2
        sizes += [0 if self.excess is None else len(EXCESS), int(self.members > 1)]
        return _State(*state.split(sizes, dim=1))

    def seen(self, state: Tensor, before: Tensor, moved: Tensor, seconds: float) -> Tensor:
        """Return states [B, S] of robots that are seen to move otherwise than simulated.

        They go on so for a while, where the rows showed that; see :class:`Excess`. Their poses and
        everything else remain, so a pose that was measured is to be set, too.

        Args:
            state: now, [B, S].
            before: the states from which these were simulated, [B, S].
            moved: measured displacements since then, [B, 3] m, m, rad in the frame of the robot
                then; NaN: not measured.
            seconds: since then, s.
        """
        if self.excess is None:
            return state
        parts = self._parts(state)
        simulated = se2.mid_turn(se2.between(before[:, :3], state[:, :3]))
        off = (se2.mid_turn(moved.to(state)) - simulated) / seconds
        return torch.cat(
            parts._replace(excess=self.excess.corrected(parts.excess, off, seconds)), dim=1
        )

    def _underway(self, parts: _State) -> Underway:
        """Return the actuators' state at the beginning of the last command."""
        goals = parts.goals.unflatten(1, (parts.acts.shape[1], len(self.columns.driven)))
        began = parts.began_speed, parts.began_push
        return Underway(*began, goals, parts.acts, parts.began_drift)

    def _after(self, drive: DriveModel, parts: _State) -> Underway:
        """Return the actuators' state at the end of the last command; 0 for a robot that stands."""
        under, time = self._underway(parts), parts.elapsed.squeeze(1)
        reached = Reached(parts.speed, parts.push, parts.drift)
        after = drive.after(under, self._speeds(parts.commanded), time, reached)
        # After the end of a command nothing is added.
        over = (time <= 0.0).unsqueeze(1)
        return after._replace(
            goals=torch.where(over.unsqueeze(2), under.goals, after.goals),
            acts=torch.where(over, under.acts, after.acts),
        )

    def _speeds(self, driven: Tensor) -> Tensor:
        """Return the final speeds [B, C] of driven inputs [B, C], in the dataset's units."""
        assert self.drive is not None
        scaled = driven / self.input_scale[self._driven]
        scaled = torch.where(scaled.abs() < self.dead_band[self._driven], 0.0, scaled)
        return self.drive.shaped(scaled)

    def displacement(self, inputs: Tensor, member: Tensor | int = -1) -> Tensor:
        """Return the mean displacements [B, 3] (m, m, rad) for ``inputs`` [B, I].

        They are in the robot's frame at the command's start, REP 103.

        Args:
            inputs: in the dataset's units.
            member: of the ensemble, for all rows or for each [B]; -1: the mean.
        """
        return self.displacement_of(self.scaled(inputs), member)

    def displacement_of(
        self, x: Tensor, member: Tensor | int = -1, under: Underway | None = None
    ) -> Tensor:
        """Return the mean displacements [B, 3] of scaled inputs.

        Args:
            x: inputs of :meth:`scaled` [B, I], or of :meth:`chained`.
            member: as in :meth:`displacement`.
            under: the actuators' state at the beginning of the commands; None: that of ``x``.
        """
        given = self.derived.append(self.columns, x[:, : len(self.inputs)])
        units = None if self.kernel_units is None else self.kernel_units.units(given)
        if self._predict_mean is not None and isinstance(member, int) and member < 0:
            outputs = self._predict_mean(given) * self.output_scale[0]
            if units is not None and self.kernel_units is not None:
                outputs = outputs + units @ self.kernel_units.weights[0].T
        else:
            outputs = _of_member(self._outputs_of(given, units), member, self.central)
        return self.from_outputs(outputs, x, under)

    def scaled(self, inputs: Tensor) -> Tensor:
        """Return ``inputs`` [B, I] scaled, those within the dead band zero.

        With a drive model the commands become their final speeds.
        """
        scaled = inputs / self.input_scale
        scaled = torch.where(scaled.abs() < self.dead_band, 0.0, scaled)
        if self.drive is not None:
            for places in (self.columns.driven, self.columns.before):
                scaled[:, list(places)] = self.drive.shaped(scaled[:, list(places)])
        return scaled

    def chained(self, inputs: Tensor) -> Tensor:
        """Return scaled inputs of commands [B, I], in the dataset's units, in the order of time.

        The speed that an actuator has at the end of a command is its speed at the beginning of the
        next. With a drive model there are more columns, see :func:`chain`.
        """
        x = self.scaled(inputs)
        if self.drive is None:
            return x
        return chain(self.drive, self.columns, x, follows(self.input_names, inputs), self.longest)

    def outputs(self, inputs: Tensor) -> Tensor:
        """Return the outputs [B, M, O] (SI units) of every member for ``inputs`` [B, I]."""
        given = self.derived.append(self.columns, self.scaled(inputs))
        units = None if self.kernel_units is None else self.kernel_units.units(given)
        return self._outputs_of(given, units)[:, int(self.central) :]

    def _outputs_of(self, given: Tensor, units: Tensor | None) -> Tensor:
        outputs = self._predict(given).unflatten(-1, (len(self.genes), -1)) * self.output_scale
        if units is not None:
            assert self.kernel_units is not None
            outputs = outputs + torch.einsum("bk,mok->bmo", units, self.kernel_units.weights)
        return outputs

    def from_outputs(self, outputs: Tensor, x: Tensor, under: Underway | None = None) -> Tensor:
        """Return the displacements [B, 3] for networks' outputs [B, O].

        Args:
            outputs: of the networks.
            x: scaled inputs, as in :meth:`displacement_of`.
            under: as in :meth:`displacement_of`.
        """
        if self.drive is None:
            return outputs
        columns, duration = self.columns, x[:, self.columns.duration]
        under = rows_underway(self.drive, columns, x) if under is None else under
        assert self._corrected is not None
        time = duration * self.longest
        changing, twist = self._corrected.phases(under, x[:, list(columns.driven)], time)
        if self.correction != Correction():
            outputs = self.correction.of_twists(outputs)
        return se2.compose(changing, se2.exp(twist + duration.unsqueeze(1) * outputs))

    def disturbed(self, x: Tensor, mean: Tensor, z: Tensor) -> Tensor:
        """Return displacements [B, 3] with noise from the draws ``z`` [B, DRAWS].

        Args:
            x: scaled inputs, [B, I].
            mean: of :meth:`displacement_of`, [B, 3].
            z: of :meth:`NoiseModel.draw`.
        """
        if self.noise is None:
            return mean
        return disturb(self.noise, self.columns, x, mean, z)

    def on_floor(self, pose: Tensor, moved: Tensor, member: Tensor | int = -1) -> Tensor:
        """Return displacements [B, 3] on the floor for those on an even one; see :class:`Floor`.

        Args:
            pose: their beginnings, [B, 3] m, m, rad, board frame.
            moved: displacements [B, 3] in the robots' frames there.
            member: as in :meth:`displacement`.
        """
        return moved if self.floor is None else self.floor.moved(pose, moved, member)

    @property
    def parameters(self) -> tuple[Adjustable, ...]:
        """Return the five numbers of its correction.

        Raises:
            UserError: if there is no drive model to correct.
        """
        if self.drive is None:
            raise UserError(
                "this simulator has no drive model to correct: train it with the default trainer"
            )
        return self.correction.parameters

    def adjusted(self, values: NDArray[np.float64]) -> MotionNetwork:
        """Return the simulator with another correction [5], instead of the one that it has.

        Raises:
            UserError: if their number is wrong, one is out of bounds, or there is no drive model.
        """
        parameters = self.parameters
        if np.shape(values) != (len(parameters),):
            raise UserError(f"expected {len(parameters)} parameters, got {np.shape(values)}")
        pairs = zip(parameters, np.asarray(values, np.float64).tolist(), strict=True)
        changed = copy(self)
        changed.__dict__.pop("_model", None)  # compiled with the correction before
        changed.meta = dict(self.meta)
        changed.correction = Correction(*(one.checked(value) for one, value in pairs))
        assert self.drive is not None
        changed._corrected = changed.correction.of_drive(self.drive)
        return changed

    def conditions(self) -> dict[str, Any]:
        """Return its correction, if any."""
        none = self.correction == Correction()
        return {} if none else {"correction": asdict(self.correction)}

    def for_export(self, dtype: torch.dtype) -> MotionNetwork:
        """Return this simulator computing in ``dtype``.

        Raises:
            UserError: if it has sensors, because only a step can be exported.
        """
        if self.sensors is not None:
            raise UserError(
                f"this simulator has sensors ({', '.join(self.sensors.names)}), which cannot be "
                "exported: export a simulator that was trained with --no-sensors"
            )
        return _in(dtype, self)

    def compiled(self) -> MotionModel:
        """Return the arguments of the compiled functions."""
        return self._model

    @cached_property
    def _model(self) -> MotionModel:
        names, states = self.command_names, self.state_names
        remembered = [name for name in self.input_names if name.startswith("prev_")]
        following = [names.index(name.removeprefix("prev_")) for name in remembered]
        source = [
            names.index(name)
            if name in names
            else -1 - (0 if self.drive is not None else states.index(name))
            for name in self.input_names
        ]
        noise = {
            f"noise_{name}": torch.zeros(shape) if self.noise is None else getattr(self.noise, name)
            for name, shape in NoiseModel.SHAPES.items()
        }
        shapes = DriveModel.shapes(len(self.columns.driven))
        drive = self._corrected or DriveModel(
            **{name: torch.ones(shapes[name]) for name in DriveModel.NAMES}
        )
        tensors = {
            "input_scale": self.input_scale,
            "dead_band": self.dead_band,
            **{name: getattr(drive, name) for name in DriveModel.NAMES},
            "correction": torch.tensor(astuple(self.correction)[:4], dtype=torch.float64),
            **noise,
        }
        arrays: dict[str, Any] = {
            k: np.ascontiguousarray(v.cpu().numpy(), np.float64) for k, v in tensors.items()
        }
        return MotionModel(
            **arrays,
            **self._laid_out(),
            source=np.array(source, np.int64),
            following=np.array(following, np.int64),
            driven=np.array(self.columns.driven, np.int64),
            before=np.array(self.columns.before, np.int64),
            duration=self.columns.duration,
            swing=math.nan if self.derived.swing is None else self.derived.swing,
            floor=self.network.floor,
            drives=self.drive is not None,
            drifts=self.drive is not None and self.drive.drifts,
            slots=0 if self.drive is None else self.drive.slots,
            longest=self.longest,
            members=self.members > 1,
            noisy=self.noise is not None,
            **(no_sensors() if self.sensors is None else self.sensors.arrays()),
            **(even() if self.floor is None else self.floor.arrays()),
            excess_lasts=np.zeros(0) if self.excess is None else self.excess.lasts.cpu().numpy(),
        )

    def _laid_out(self) -> dict[str, Any]:
        """Return the networks' arrays for :class:`MotionModel`: the mean, then the members."""
        parts = self.network.expand(self.genes.cpu()).times(self.output_scale.cpu())
        units = self.kernel_units or KernelUnits(
            torch.zeros(0, self.network.inputs),
            torch.ones(self.network.inputs),
            torch.zeros(*self.genes.shape[:2], 0),
        )
        centres, lengths = units.centres.cpu().numpy(), units.lengths.cpu().numpy()
        centres = _filled(centres.T).T
        signed_of = parts.signed(sign_patterns(self.network.inputs)).numpy()
        exponents = parts.exponents.numpy()
        plain = {
            "linear": parts.linear.numpy(),
            "bias": parts.bias.numpy(),
            "kernel_weights": _filled(units.weights.cpu().numpy()),
        }
        if not self.central:  # the mean is the members' average
            plain = {k: np.concatenate([v.mean(0, keepdims=True), v]) for k, v in plain.items()}
        count = len(self.genes)
        average = [(m, 1.0 / count) for m in range(count)]
        networks = [[(m, 1.0)] for m in range(count)]
        if not self.central:
            networks = [average, *networks]
        powers: list[NDArray] = []
        weights: list[NDArray] = []
        first = [0]
        for network in networks:
            for o in range(len(OUTPUTS)):
                own = [(m, factor, (signed_of[m, o] != 0.0).any(0)) for m, factor in network]
                powers.append(_filled(np.concatenate([exponents[m, o][u] for m, _, u in own]).T))
                row = [factor * signed_of[m, o][:, u] for m, factor, u in own]
                weights.append(_filled(np.concatenate(row, axis=1)))
                first.append(first[-1] + powers[-1].shape[1])
        outputs = len(networks) * len(OUTPUTS)
        arrays = {
            "exponents": np.concatenate(powers, axis=1),
            "first": np.array(first, np.int64),
            "signed": np.concatenate(weights, axis=1),
            "linear": plain["linear"].reshape(outputs, -1),
            "bias": plain["bias"].reshape(outputs),
            "kernel_weights": plain["kernel_weights"].reshape(outputs, -1),
            "centres": -2.0 * HALF_LOG2_E * (centres / lengths**2).T,
            "centre_square": HALF_LOG2_E * ((centres / lengths) ** 2).sum(1),
            "nearness": HALF_LOG2_E / lengths**2,
        }
        return {name: np.ascontiguousarray(value) for name, value in arrays.items()}


def _filled(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return numbers [..., N], filled with zeros up to a multiple of :data:`LANES`."""
    missing = -values.shape[-1] % LANES
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, missing)])


def can_drive(names: Sequence[str], actuators: int | None = None) -> bool:
    """Return whether a drive model is possible with inputs of these names."""
    columns = CommandFeatures.of(tuple(names))
    known = columns.duration >= 0 and len(columns.driven) > 0 and min(columns.before) >= 0
    return known and actuators in (None, len(columns.driven))


def follows(names: Sequence[str], inputs: Tensor) -> Tensor:
    """Return whether each row's command followed that of the previous row, [B] bool.

    It did if its previous command is that one.

    Args:
        names: of the inputs.
        inputs: rows in the order of time, [B, I].
    """
    columns = CommandFeatures.of(tuple(names))
    pairs = [pair for pair in zip(columns.driven, columns.before, strict=True) if pair[1] >= 0]
    same = torch.zeros(len(inputs), dtype=torch.bool, device=inputs.device)
    if pairs:
        now, before = (list(places) for places in zip(*pairs, strict=True))
        same[1:] = (inputs[1:][:, before] == inputs[:-1][:, now]).all(1)
    return same


def chain(
    drive: DriveModel, columns: CommandFeatures, x: Tensor, follows: Tensor, longest: float
) -> Tensor:
    """Return scaled inputs [B, I + C] in which commands begin with the reached speeds.

    The next C columns are the goals of the previous commands, which act until the delay has passed.
    Still earlier commands are assumed to have ended, because otherwise one would be shorter than
    the delay. Of a robot that drifts, the last two are the drift reached (m/s).

    Args:
        drive: the drive model.
        columns: of the inputs.
        x: scaled inputs, [B, I], with commanded speeds as previous ones.
        follows: [B] bool, whether a row's command followed that of the previous row.
        longest: scale of durations, s.
    """
    before, commanded = x[:, list(columns.before)], x[:, list(columns.driven)]
    time = x[:, columns.duration] * longest
    still = drive.begun(before, before)
    speed, drift = still.speed, still.drift
    # A remaining difference decays within a few commands, or seconds.
    dies = _DIES + _LAGS * drive.memory
    links = (
        max(_LINKS, min(math.ceil(dies / max(float(time.median()), 1e-3)), _MOST_LINKS))
        if len(x)
        else 0
    )
    for _ in range(links):
        earlier = speed, drift
        reached = drive.reached(drive.begun(speed, before, drift), commanded, time)
        pairs = (reached.speed, still.speed), (reached.drift, still.drift)
        speed, drift = (
            torch.cat([rest[:1], torch.where(follows[1:, None], there[:-1], rest[1:])])
            for there, rest in pairs
        )
        if all(map(torch.equal, earlier, (speed, drift))):
            break
    x = torch.cat([x, before, drift], 1)
    x[:, list(columns.before)] = speed
    return x


def rows_underway(drive: DriveModel, columns: CommandFeatures, x: Tensor) -> Underway:
    """Return the actuators' state at the beginning of scaled rows [B, I] or of :func:`chain`."""
    speed, count = x[:, list(columns.before)], len(columns.driven)
    inputs = max(*columns.driven, *columns.before, columns.duration) + 1
    if x.shape[1] < inputs + count:
        return drive.begun(speed)
    return drive.begun(speed, x[:, inputs : inputs + count], x[:, inputs + count :])


def _in(dtype: torch.dtype, thing: Any) -> Any:
    """Return a copy of an object with all its numbers in another precision."""
    if isinstance(thing, Tensor):
        return thing.to(dtype) if thing.is_floating_point() else thing
    if not type(thing).__module__.startswith("neurosim.") or not hasattr(thing, "__dict__"):
        return thing
    converted = copy(thing)
    for name, value in vars(thing).items():
        object.__setattr__(converted, name, _in(dtype, value))
    return converted


def _of_member(outputs: Tensor, member: Tensor | int, central: bool) -> Tensor:
    """Return the outputs [N, O] of a member, of outputs [N, M, O], or [N, 1 + M, O] if central."""
    if isinstance(member, int):
        return outputs.mean(1) if member < 0 else outputs[:, member + central]
    place = (member + central).clamp(min=0)[:, None, None]
    own = outputs.gather(1, place.expand(-1, 1, outputs.shape[2])).squeeze(1)
    if central:  # the mean's own network precedes the first
        return own
    return torch.where(member.unsqueeze(-1) < 0, outputs.mean(1), own)
