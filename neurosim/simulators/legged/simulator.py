"""The simulator of the walking robot, with the adjustable parameters of Zagal et al. 2004.

Section 5.1.2: four masses, four parameters of the dynamics, four of the joints. The paper's slip in
two directions is that of ODE, where a foot creeps with a speed proportional to the force. MuJoCo's
friction also creeps, because its constraints are soft: with a speed about proportional to the
tangential force and to the time constant of ``solreffriction``. This constant is the same for both
directions; their regularisation differs, in proportion to one over the square of a direction's
friction coefficient. So ``slip`` is the time constant, and ``slip_ratio`` is the ratio of a foot's
creep to the side over that ahead; the coefficient to the side is divided by its square root.

The model is compiled again for other parameters, because inertias depend on the masses.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurosim.base import files, formats
from neurosim.base.errors import UserError
from neurosim.base.trajectory import Draws, Episode, OfTime, Trajectory
from neurosim.simulators.adjustable import Adjustable, adjustables
from neurosim.simulators.base import FORMAT, VERSION, Rollouts, Simulator
from neurosim.simulators.legged.build import Build, LeggedBuild, ServoBuild, compile_model
from neurosim.simulators.legged.physics import Physics, poses_of
from neurosim.simulators.legged.quadratot import QuadraTot
from neurosim.simulators.sampling import draw_samples

#: Oldest version that can be read.
_OLDEST = 12
#: The kinds of robots by their names in files.
BUILDS: dict[str, type[LeggedBuild]] = {one.robot: one for one in (Build, ServoBuild, QuadraTot)}


class LeggedSimulator(Simulator):
    """A four-legged robot on a flat floor; commands are joint angles (rad), held for a duration of
    whole frames: 8 ms of the walking robot, 25 ms of a QuadraTot.

    A walking robot that has fallen has no pose: NaN. After the pose, the state has MuJoCo's.

    Attributes:
        build: the robot's build.
    """

    kind = "legged"

    def __init__(self, build: LeggedBuild | None = None, physics: Physics | None = None):
        """Make the simulator of a build.

        Args:
            build: by default the walking robot's.
            physics: threads and memory of another simulator, to share them.

        Raises:
            UserError: if MuJoCo is not installed, or a parameter is out of bounds.
        """
        self.build: LeggedBuild = build or Build()
        adjustables(self.build, self.build.ranges)  # checks the bounds
        self._shared = physics

    @cached_property
    def model(self) -> Any:
        """The compiled model, an ``MjModel``."""
        return compile_model(self.build)

    @cached_property
    def physics(self) -> Physics:
        """The physics of its trials."""
        return self._shared or Physics(self.model, make=type(self.build))

    @property
    def command_names(self) -> tuple[str, ...]:  # type: ignore[override]
        """The joints' angles (rad), and their duration (s)."""
        return (*self.build.joints, "duration")

    @property
    def radius(self) -> float:  # type: ignore[override]
        """Of the robot, m."""
        return self.build.radius

    @property
    def state_names(self) -> tuple[str, ...]:  # type: ignore[override]
        """The columns of a state."""
        return ("x", "y", "theta", *(f"physics_{n}" for n in range(self.physics.size)))

    @property
    def domain(self) -> dict[str, tuple[float, float]]:
        """The angles (rad) that the joints allow."""
        return dict(zip(self.build.joints, self.build.limits(), strict=True))

    @property
    def parameters(self) -> tuple[Adjustable, ...]:
        """Its adjustable parameters."""
        return adjustables(self.build, self.build.ranges)

    def adjusted(self, values: NDArray[np.float64]) -> LeggedSimulator:
        """Return the simulator with other values [K] of its parameters.

        Raises:
            UserError: if their number is wrong, or one is out of bounds.
        """
        names = tuple(self.build.ranges)
        if np.shape(values) != (len(names),):
            raise UserError(f"expected {len(names)} parameters, got {np.shape(values)}")
        changes = dict(zip(names, np.asarray(values, np.float64).tolist(), strict=True))
        return LeggedSimulator(replace(self.build, **changes), self.physics)

    def conditions(self) -> dict[str, Any]:
        """Return its build."""
        return {"build": asdict(self.build)}

    def start(self, pose: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Return the states [B, S] of robots that stand at poses [B, 3]."""
        states = torch.from_numpy(self.physics.standing(pose.double().numpy(), self.model))
        return torch.cat([pose.double(), states], dim=1)

    def step(
        self, state: Tensor, command: Tensor, generator: torch.Generator | None = None
    ) -> Tensor:
        """Return the states [B, S] after ``command`` [B, C] was held for its duration (s).

        Raises:
            UserError: if a duration is shorter than half a frame.
        """
        before, given = state.numpy(), command.double().numpy()
        after = before.copy()
        if given[:, -1].min(initial=np.inf) < 0.5 * self.build.frame:
            raise UserError(
                f"the joints of the robot {self.build.robot} get a command every "
                f"{self.build.frame:g} s; {given[:, -1].min():g} s is too short for one (the task "
                f"walking has a step: --step {self.build.frame:g})"
            )
        frames = np.maximum(np.rint(given[:, -1] / self.build.frame), 1).astype(int)
        for count in np.unique(frames):  # one, if all have the same duration
            rows = frames == count
            held = np.repeat(given[rows, None, :-1], count, axis=1)
            states = np.ascontiguousarray(before[rows, 3:])
            walked = self.physics.frames(self.model, states, held)
            poses = poses_of(walked, before[rows, :3], type(self.build))
            after[rows] = np.concatenate([poses[:, -1], walked[:, -1]], axis=1)
        return torch.from_numpy(after)

    def rollouts(self, controller: Any, episode: Episode) -> Rollouts | None:
        """Return rollouts of a controller whose commands depend on time alone (``over``)."""
        whole = episode.step == self.build.frame and not episode.rest
        if not isinstance(controller, OfTime) or not whole:
            return None
        return _OpenLoop(self, controller, episode)

    def __getstate__(self) -> dict[str, Any]:
        """Return the settings for a copy, which gets its own threads."""
        return {"build": self.build, "_shared": None}

    def write(self, folder: str | Path) -> None:
        """Write it as a folder with ``simulator.json``.

        Raises:
            UserError: if the folder exists.
        """
        content = {
            "kind": self.kind,
            "robot": self.build.robot,
            "parameters": asdict(self.build),
        }
        with files.new_folder(folder) as partial:
            files.write_json(partial / "simulator.json", FORMAT, VERSION, content)

    @classmethod
    def read(cls, folder: str | Path, device: Any = "cpu") -> LeggedSimulator:
        """Read one.

        Raises:
            FileError: if the file is missing or wrong.
        """
        path = Path(folder) / "simulator.json"
        content = files.read_json(path, FORMAT, VERSION, formats.Legged, oldest=_OLDEST)
        build = BUILDS[content.get("robot", Build.robot)]
        fixed = {name: _fixed(value) for name, value in content["parameters"].items()}
        return files.made(path, "parameters", lambda **given: cls(build(**given)), fixed)


def _fixed(value: Any) -> Any:
    return tuple(map(_fixed, value)) if isinstance(value, list) else value


class _OpenLoop:
    """Rollouts of commands that are known in advance."""

    def __init__(self, simulator: LeggedSimulator, controller: Any, episode: Episode):
        self._simulator, self._controller = simulator, controller
        self._circle = episode.circle or None
        self._times = np.arange(episode.steps) * episode.step

    def draw(
        self,
        starts: NDArray[np.float64],
        rng: np.random.Generator | int,
        placing: tuple[float, float] | None = None,
    ) -> Draws:
        """Draw each robot's start; nothing else is uncertain."""
        return draw_samples(self._simulator, starts, rng, placing, len(self._times))

    def run(self, genes: NDArray[np.float64], draws: Draws, *, reuse: bool = False) -> Trajectory:
        simulator, samples = self._simulator, len(draws)
        commands = self._controller.over(genes, self._times)
        poses = simulator.physics.walk(
            simulator.model,
            np.tile(draws.starts, (len(genes), 1)),
            np.repeat(commands, samples, axis=0),
            self._circle,
        )
        shape = (len(genes), samples)
        given = np.broadcast_to(commands[:, None], (*shape, *commands.shape[1:]))
        return Trajectory(poses.reshape(*shape, *poses.shape[1:]), given, simulator.build.frame)
