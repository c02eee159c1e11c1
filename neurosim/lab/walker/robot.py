"""Walking robots of the lab, which take the place of a real robot.

A learner gets one number for each trial, and from a camera the robot's path. The physics differ
from the simulator's in ways that none of its adjustable parameters can express: another time step,
another friction cone, legs of unequal lengths, bumps, a battery that runs down, and noise between
trials. Backlash, dry friction in the joints, and servos with a lag and a largest speed are
parameters of :class:`~neurosim.simulators.legged.build.ServoBuild` alone.

The trial is the paper's (Zagal et al. 2004, section 5.2): the robot starts in the middle of a
circle with a radius of 200 cm, or the task's, and is stopped where it crosses the circle; its
fitness is the radius divided by the time. After a fall, or too much time, the fitness is 0.

The constants were fixed before anything was tuned. Settings are tuned on ``main``, the
spread of random parameter sets on ``carpet``, too; ``tiles`` and ``lawn`` were drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base.declared import Seed, checks
from neurosim.base.errors import UserError
from neurosim.base.trajectory import OfTime, Tracked
from neurosim.lab.walker.film import film
from neurosim.robots.quadruped import FRAME, JOINTS
from neurosim.simulators.legged.build import Build, compile_model
from neurosim.simulators.legged.physics import Physics, arrived

#: Radius of the circle, m, and the longest trial, s.
RADIUS, LONGEST = 2.0, 60.0
#: Longest film, s; and the time by which it lasts longer than its poses, s.
FILM, MORE = 5.0, 0.1
#: The physics of all: the time step is half the simulator's, the cone a pyramid.
SOLVER: dict[str, Any] = {"timestep": 0.002, "iterations": 30, "cone": "pyramidal"}


@dataclass(frozen=True)
class Ground:
    """A robot and its ground.

    Attributes:
        build: the robot's true measures, with a full battery.
        sag: fraction of torque and of the servos' speed that is lost from a full battery to an
            empty one.
        charge: number of trials from a full battery to an empty one, which is then charged.
        bumps: number per square metre.
        height: of the highest bump, m.
        scatter: standard deviations between trials: of the heading at the start, rad; of the
            friction, a fraction; of the measured time, s.
        seed: of the bumps' positions.
    """

    build: Build
    sag: float
    charge: int
    bumps: float
    height: float
    scatter: tuple[float, float, float]
    seed: int

    @classmethod
    def drawn(cls, seed: int) -> Ground:
        """Return a random robot and ground."""
        rng = np.random.default_rng([seed, 0x6F1D])

        def between(low: float, high: float) -> float:
            return round(float(rng.uniform(low, high)), 4)

        build = Build(
            head=between(0.16, 0.26),
            neck=between(0.06, 0.11),
            body=between(0.55, 0.85),
            leg=between(0.13, 0.19),
            friction=between(0.45, 1.0),
            slip=between(0.015, 0.07),
            slip_ratio=between(0.7, 1.7),
            p=between(3.5, 6.0),
            i=between(0.5, 3.5),
            d=between(0.05, 0.13),
            torque=between(0.65, 0.95),
            armature=between(0.0015, 0.0028),
            damping=between(0.01, 0.02),
            joint_friction=between(0.015, 0.05),
            backlash=between(0.015, 0.04),
            lag=between(0.015, 0.035),
            speed=between(5.0, 7.0),
            legs=(between(0.985, 1.015), between(0.985, 1.015), between(0.985, 1.015), 1.0),
            **SOLVER,
        )
        return cls(
            build,
            sag=between(0.1, 0.3),
            charge=int(rng.integers(30, 61)),
            bumps=between(2.0, 14.0),
            height=between(0.002, 0.004),
            scatter=(between(0.03, 0.07), between(0.03, 0.07), 0.05),
            seed=seed,
        )


#: By name.
FLOORS = {
    "main": Ground(
        Build(
            head=0.24,
            neck=0.09,
            body=0.72,
            leg=0.17,
            friction=0.62,
            gravity=9.81,
            slip=0.035,
            slip_ratio=1.6,
            p=4.5,
            i=2.0,
            d=0.08,
            torque=0.75,
            armature=0.002,
            damping=0.015,
            joint_friction=0.03,
            backlash=0.026,
            lag=0.025,
            speed=6.0,
            legs=(1.0, 0.99, 1.01, 1.0),
            **SOLVER,
        ),
        sag=0.2,
        charge=45,
        bumps=6.0,
        height=0.003,
        scatter=(0.05, 0.04, 0.05),
        seed=1,
    ),
    "carpet": Ground(
        Build(
            head=0.22,
            neck=0.07,
            body=0.66,
            leg=0.18,
            friction=0.9,
            gravity=9.81,
            slip=0.06,
            slip_ratio=0.8,
            p=5.5,
            i=1.0,
            d=0.12,
            torque=0.7,
            armature=0.0025,
            damping=0.02,
            joint_friction=0.045,
            backlash=0.017,
            lag=0.03,
            speed=5.5,
            legs=(1.01, 1.0, 0.99, 1.0),
            **SOLVER,
        ),
        sag=0.15,
        charge=60,
        bumps=12.0,
        height=0.002,
        scatter=(0.06, 0.05, 0.05),
        seed=2,
    ),
    "parquet": Ground(
        Build(
            head=0.18,
            neck=0.10,
            body=0.78,
            leg=0.15,
            friction=0.48,
            gravity=9.81,
            slip=0.02,
            slip_ratio=1.2,
            p=3.8,
            i=3.0,
            d=0.06,
            torque=0.85,
            armature=0.0018,
            damping=0.012,
            joint_friction=0.02,
            backlash=0.035,
            lag=0.02,
            speed=6.5,
            legs=(0.995, 1.0, 1.0, 1.015),
            **SOLVER,
        ),
        sag=0.25,
        charge=30,
        bumps=2.0,
        height=0.004,
        scatter=(0.04, 0.06, 0.05),
        seed=3,
    ),
    "tiles": Ground.drawn(4),
    "lawn": Ground.drawn(5),
}


class VirtualWalker:
    """A walking robot of the lab: controllers in, one number a trial out.

    It implements :class:`~neurosim.loop.journal.Reality`.

    Attributes:
        controller: the family of its individuals; its commands are angles of the joints by time.
        floor: the name of robot and floor.
        filmed: number of a trial's first frames of the joints that are filmed; 0: no camera.
    """

    @checks
    def __init__(
        self,
        controller: Any,
        floor: str = "main",
        seed: Seed = 0,
        task: Any = None,
        camera: str | None = None,
    ):
        """Make the robot of a floor.

        Args:
            controller: a controller whose commands depend on time alone, such as a gait.
            floor: The floor: main, carpet, parquet, tiles or lawn.
            seed: Random seed of the noise from trial to trial.
            task: the task walking, or None.
            camera: lab: a camera films the first :data:`FILM` of each trial, and its result has the
                tracked path; None: it has a fitness only.

        Raises:
            UserError: if the floor is unknown, the controller or the task is of another kind, the
                seed is negative, or there is no task of which a film is made.
        """
        if floor not in FLOORS:
            raise UserError(
                f"there is no floor {floor!r} in the lab; choose from {', '.join(FLOORS)}"
            )
        if not isinstance(controller, OfTime) or tuple(controller.outputs) != JOINTS:
            raise UserError(
                "the walking robot of the lab needs a gait; a controller of the kind "
                f"{controller.kind} commands no joint angles"
            )
        if task is not None and task.name != "walking":
            raise UserError(
                f"the walking robot of the lab does the task walking only, not {task.name}"
            )
        if camera not in (None, "lab"):
            raise UserError(
                "the walking robot of the lab is filmed by the lab's own camera: --camera lab"
            )
        if camera and (task is None or task.episode.step != FRAME):
            raise UserError(
                "the walking robot is filmed during the task walking, with a command every "
                f"{FRAME:g} s; use --task walking --step {FRAME:g}"
            )
        self.controller, self.floor, self._seed = controller, floor, seed
        self.filmed = 0
        if camera is not None and task is not None:
            self.filmed = min(task.episode.steps, round(FILM / FRAME))
        self._radius = (task.episode.circle if task is not None else 0.0) or RADIUS
        self._ground = FLOORS[floor]
        self._build = replace(self._ground.build, bumps=_bumps(self._ground))
        self._physics = Physics(compile_model(self._build))

    def describe(self) -> dict[str, Any]:
        """Return the robot's description."""
        about = {"kind": "virtual-walker", "virtual": True, "floor": self.floor, "seed": self._seed}
        return about | ({"filmed": self.filmed * FRAME} if self.filmed else {})

    def trial(self, genes: NDArray[np.float64], number: int) -> float | Tracked:
        """Return the fitness of an individual [G] in one trial, m/s; with a camera its path, too.

        Args:
            genes: of it.
            number: of the trial; it determines the battery's charge and the noise.
        """
        result: float | Tracked = self.trials(genes[None], np.array([number]))[0]
        return result

    def trials(
        self, genes: NDArray[np.float64], numbers: NDArray[np.int64]
    ) -> NDArray[np.float64] | list[Tracked]:
        """Return the results of individuals [N, G] in one trial each, as :meth:`trial` does."""
        ground = self._ground
        times = np.arange(round(LONGEST / FRAME)) * FRAME
        starts, models = np.zeros((len(genes), 3)), []
        commands, clocks = self.controller.over(genes, times), np.empty(len(genes))
        for row, number in enumerate(numbers):
            rng = np.random.default_rng([self._seed, int(number), 0x3A1C])
            heading, slippery, late = np.array(ground.scatter) * rng.standard_normal(3)
            left = 1.0 - ground.sag * (int(number) % ground.charge) / ground.charge
            starts[row, 2], clocks[row] = heading, late
            build = replace(
                self._build,
                friction=self._build.friction * float(np.exp(slippery)),
                torque=self._build.torque * left,
                speed=self._build.speed * left,
            )
            models.append(compile_model(build))
        poses = self._physics.walk(models, starts, commands, self._radius)
        crossed = arrived(poses, starts, self._radius)
        first = np.where(crossed.any(axis=1), crossed.argmax(axis=1), len(times))
        elapsed = np.maximum(first * FRAME + clocks, FRAME)
        fitness = np.where(crossed.any(axis=1), self._radius / elapsed, 0.0)
        if not self.filmed:
            return fitness
        more = round(MORE / FRAME)
        films = zip(poses, np.minimum(first, self.filmed).tolist(), numbers.tolist(), strict=True)
        paths = [
            film(path[: end + more + 1], FRAME, self.filmed, (self._seed, n))
            for path, end, n in films
        ]
        return [Tracked(*each) for each in zip(fitness.tolist(), paths, strict=True)]


def _bumps(ground: Ground) -> tuple[tuple[float, float, float, float], ...]:
    """Return flat bumps (x, y, radius, height) around the circle's middle, m."""
    rng = np.random.default_rng([ground.seed, 0xB0B5])
    side = 2.0 * (RADIUS + 0.3)
    count = round(ground.bumps * side * side)
    centres = rng.uniform(-0.5 * side, 0.5 * side, (count, 2))
    radii, heights = rng.uniform(0.03, 0.08, count), ground.height * rng.uniform(0.3, 1.0, count)
    # The floor is flat at the robot's start.
    kept: Sequence[bool] = (np.linalg.norm(centres, axis=1) > 0.3).tolist()
    rows = np.column_stack([centres, radii, heights]).tolist()
    return tuple(tuple(row) for row, keep in zip(rows, kept, strict=True) if keep)
