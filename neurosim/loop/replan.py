"""Receding horizon: a plan that is replanned after every command, in a learned simulator.

Before each command the robot's pose is measured. A new search begins with the rest of the plan. It
starts at the pose, after the commands so far, and maximises the probability of success over random
samples. The first command of the best plan is given; then all this is repeated. So errors do not
add up, and a robot that was pushed finds another path.

Mayne, Rawlings, Rao and Scokaert, Constrained model predictive control: stability and optimality,
Automatica 36, 2000, describe the principle; the search is the genetic algorithm of plans.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim.base import se2
from neurosim.base.declared import Checked, Count, Placing, Seconds, SecondsOrNone
from neurosim.base.threads import one_core, one_thread
from neurosim.base.trajectory import RUN_DOWN, Draws, Trajectory
from neurosim.controllers.plan import Command, Plan, commands_of, stop_after
from neurosim.evolution.genetic import GeneticSettings
from neurosim.loop.evaluate import Evaluator
from neurosim.loop.search import Search, new_optimiser
from neurosim.loop.settings import EvolveSettings
from neurosim.robots.base import Clock
from neurosim.simulators.base import Simulator
from neurosim.simulators.sampling import placed
from neurosim.tasks.base import Interval, Judgement, Records, Task

#: Probability of success without further commands at which the task counts as done; below it, a
#: robot without a better command searches again.
DONE = 0.5
#: Longest time between the poses amid a command that are judged, s.
_PIECE = 0.25
#: Mutation of the first population, around the rest of the plan.
GENETIC = GeneticSettings(population=80, tournament=5, mutation=0.15, eta=2.0, mutation_scale=0.05)


@dataclass(frozen=True)
class ReplanSettings(Checked):
    """How a plan is replanned.

    Attributes:
        generations: Most generations of a search.
        think: Time for a search, while the command before continues, s.
        draws: Random samples for every plan of a search.
        placing: error of the robot's measured pose: standard deviations, m and rad.
        settle: time that a robot whose task may be done stands before its pose is measured again,
            s.
        most: largest number of commands, as a multiple of the plan's slots.
        genetic: the genetic algorithm of a search.
    """

    generations: Count = 30
    think: SecondsOrNone = 0.3
    draws: Count = 24
    placing: Placing = (0.002, math.radians(0.5))
    settle: Seconds = 0.5
    most: Count = 3
    genetic: GeneticSettings = GENETIC


class Foreseen(NamedTuple):
    """The predictions at the time when a command was given.

    Attributes:
        pose: [3] expected pose at the beginning of the command (m, m, rad).
        after: [3] expected pose after the command.
        rest: [3] expected pose after the whole plan.
        probability: probability of success, by the samples of the search.
        generations: number of generations of the search.
        seconds: duration of the search, by the clock.
    """

    pose: tuple[float, ...]
    after: tuple[float, ...]
    rest: tuple[float, ...]
    probability: float
    generations: int
    seconds: float


class Replanner:
    """Plans the rest of a task before every command; see the module.

    Attributes:
        steps: largest number of commands.
        foreseen: the predictions at each command so far.
    """

    def __init__(
        self,
        simulator: Simulator,
        task: Task,
        plan: Plan,
        commands: Sequence[Command | None] = (),
        settings: ReplanSettings | None = None,
        *,
        seed: int = 0,
        clock: Clock | None = None,
    ):
        """Prepare a trial.

        Args:
            simulator: the simulator for planning.
            task: the task.
            plan: the family of plans, whose slots limit the commands of the rest.
            commands: of the first plan, at most as many.
            settings: how.
            seed: of the searches.
            clock: limits the time of a search. After a shorter search the rest of the time is
                waited for: in a lab whose time stands still meanwhile, it takes as long as on a
                robot. None: no limit.

        Raises:
            UserError: if the plan's commands are not those of the simulator.
        """
        self._settings = settings or ReplanSettings()
        self._simulator, self._plan, self._seed, self._clock = simulator, plan, seed, clock
        self._given = list(commands)[: plan.slots]
        self._stepper = simulator.stepper()
        self._onward = _Onward(simulator, task, plan, placing=self._settings.placing)
        self._nothing = plan.encode([None] * plan.slots)
        self.steps = self._settings.most * plan.slots
        self.begin()

    def begin(self) -> None:
        """Begin a trial with the first plan, before any command."""
        self._genes = self._of(self._given)
        self._rng = np.random.default_rng([self._seed, 0x4EC4])
        self._state = np.empty((0, 0))
        self._commands: list[Command] = []
        self._poses: list[NDArray[np.float64]] = []
        #: Poses amid each command, [M, 3], as simulated on the way to where it was seen.
        self._amid: list[NDArray[np.float64]] = []
        self.foreseen: list[Foreseen] = []

    def next(self, pose: NDArray[np.float64], ahead: float = 0.0) -> Command | None:
        """Return the next command; None if the task is probably done.

        Args:
            pose: [3] measured pose of the robot (m, m, rad), its heading up to whole turns.
            ahead: time from the measurement to the beginning of the command, s.
        """
        began = 0.0 if self._clock is None else self._clock.now()
        self._arrive(np.asarray(pose, np.float64), ahead)
        self._onward.here(self._state[0], self._poses, self._amid, np.array(self._commands))
        self._genes, probability, rest, generations = self._search(began)
        slots = commands_of(self._plan, self._genes)
        place = next((i for i, command in enumerate(slots) if command is not None), None)
        if place is not None:
            command = slots[place]
            assert command is not None
            self._genes = self._of(slots[place + 1 :])
        elif self._moves or probability < DONE:
            command = (*self._stop, self._settings.settle)
        else:
            return None
        after = self._stepper.step(self._state, np.array([command]), None)[0, :3]
        here = self._state[0, :3]
        seconds = 0.0 if self._clock is None else self._clock.now() - began
        known = probability, generations, seconds
        self.foreseen.append(Foreseen(_tuple(here), _tuple(after), _tuple(rest), *known))
        if self._clock is not None:
            self._clock.sleep_until(began + self._settings.think)
        self._commands.append(command)
        return command

    def simulate(self, start: ArrayLike, seed: int = 0) -> tuple[Judgement, Trajectory]:
        """Drive a trial in the simulator, through one random sample.

        Before each command the pose is measured with an error, ``placing`` of the settings.

        Args:
            start: [3] first pose of the robot (m, m, rad).
            seed: of the sample and of the errors.

        Returns:
            The task's judgement of the trial, and its trajectory, whose intervals are commands; in
            the last one the robot stops.
        """
        self.begin()
        simulator, rng = self._simulator, np.random.default_rng(seed)
        member = rng.integers(0, simulator.members, 1) if simulator.members > 1 else None
        seeds = rng.integers(2**64, size=1, dtype=np.uint64)
        state = self._stepper.start(np.array([start], np.float64), member)
        poses, given = [state[0, :3]], list[Command]()
        while True:
            seen = placed(state[:, :3], self._settings.placing, rng)[0]
            command = self.next(seen) if len(given) < self.steps else None
            given.append(command or (*self._stop, RUN_DOWN))
            count = np.array([len(given) - 1])
            noise = self._stepper.noise(seeds, count) if simulator.has_noise else None
            state = self._stepper.step(state, np.array([given[-1]]), noise)
            poses.append(state[0, :3])
            if command is None:
                break
        commands, active = np.array(given), np.arange(len(given)) < len(given) - 1
        driven = Trajectory(np.array(poses), commands, commands[:, -1], active=active)
        return self._onward.task.judge(driven), driven

    @property
    def _moves(self) -> bool:
        """Whether the last command made the robot move."""
        return bool(self._commands) and self._commands[-1][:-1] != self._stop

    @property
    def _stop(self) -> tuple[float, ...]:
        """The numbers of a stop after the last command."""
        last = self._commands[-1] if self._commands else [0.0] * len(self._plan.names)
        return tuple(stop_after(last, self._plan.units))

    def _of(self, commands: Sequence[Command | None]) -> NDArray[np.float64]:
        """Return the genes of commands, filled up to the slots by null ones."""
        missing = self._plan.slots - len(commands)
        return self._plan.encode([*commands, *[None] * missing])

    def _arrive(self, pose: NDArray[np.float64], ahead: float) -> None:
        """Advance the simulated state by the last command, and correct it by the measured pose."""
        if not self._commands:
            self._state = self._stepper.start(pose[None])
            self._poses.append(pose)
            return
        *numbers, duration = self._commands[-1]
        pieces = max(math.ceil(duration / _PIECE), 1)
        piece, state, amid = np.array([[*numbers, duration / pieces]]), self._state, []
        for _ in range(pieces):
            state = self._stepper.step(state, piece, None)
            amid.append(state[0, :3])
        ahead = min(max(ahead, 0.0), duration)
        for part in (duration - ahead, ahead):
            seen = self._state[0, :3]
            if part > 0:
                command = np.array([[*numbers, part]])
                self._state = self._stepper.step(self._state, command, None)
        turned = seen[2] + se2.wrapped(pose[2] - seen[2])
        true = np.array([pose[0], pose[1], turned])
        self._state[0, :3] = se2.compose(true, se2.between(seen, self._state[0, :3]))
        self._poses.append(self._state[0, :3].copy())
        off = self._poses[-1] - amid[-1]
        fractions = np.arange(1, pieces)[:, None] / pieces
        self._amid.append(np.array(amid)[:-1] + fractions * off)

    def _search(self, began: float) -> tuple[NDArray[np.float64], float, NDArray[np.float64], int]:
        """Return the best plan [G] found in time, and its predictions.

        These are the probability of success, and the final pose [3]. If no command is needed, the
        plan is empty.
        """
        how, onward = self._settings, self._onward
        seed = int(self._rng.integers(2**31))
        settings = EvolveSettings(genetic=how.genetic)
        optimiser = new_optimiser(self._plan, settings, seed, self._first()[None])
        # A robot that is measured just inside the tolerance may be outside it.
        uncertain = self._simulator.uncertain or any(how.placing)
        search = Search(
            onward,
            optimiser,
            objective="probability",
            samples=how.draws if uncertain else 0,
            refresh=how.generations,
            seed=[seed, 0],
        )
        while search.done < how.generations:
            search.generation()
            if self._clock is not None and self._clock.now() - began > how.think:
                break
        # Estimated on other samples than those of the choice.
        both = np.stack([search.top[0], self._nothing])
        draws = onward.draw(4 * how.draws, self._rng) if uncertain else onward.expectation()
        with onward.threads_for(len(draws)):
            judged, _ = onward.judge(both, draws)
            drives, stands = judged.success.mean(axis=1).tolist()
            best = int(stands > 0.0 and stands >= drives)
            expected = onward.run(both[[best]], onward.expectation())
        assert expected.poses is not None
        return both[best], (drives, stands)[best], expected.poses[0, 0, -1], search.done

    def _first(self) -> NDArray[np.float64]:
        """Return a first population [P, G]: most individuals are near the rest of the plan, if any.

        One individual gives no command.
        """
        genetic = self._settings.genetic
        first = self._rng.random((genetic.population, self._plan.genes))
        first[-1] = self._nothing
        if not any(commands_of(self._plan, self._genes)):
            return first
        near = 3 * genetic.population // 4
        changed = self._rng.random((near, self._plan.genes)) < 2.0 * genetic.mutation
        noise = genetic.mutation_scale * self._rng.standard_normal(changed.shape)
        first[:near] = np.clip(self._genes + np.where(changed, noise, 0.0), 0.0, 1.0)
        first[0] = self._genes
        return first


def _tuple(pose: NDArray[np.float64]) -> tuple[float, ...]:
    return tuple(map(float, pose))


class _Onward(Evaluator):
    """Judges the rest of plans, from the present pose and after the commands so far."""

    _earlier: Records | None = None

    def here(
        self,
        state: NDArray,
        poses: Sequence[NDArray],
        amid: Sequence[NDArray],
        commands: NDArray,
    ) -> None:
        """Set the state [S]: after K + 1 poses [3], K commands [K, C], poses amid each [M, 3]."""
        self._state, self._earlier = state, None
        if not len(commands):
            return
        self._earlier = Records(self.task, poses[0][None])
        for path, pose, command in zip(amid, poses[1:], commands, strict=True):
            # A curve, and a spin all the more, is not the arc between its ends.
            lasts = command[None, -1] / (len(path) + 1)
            for seen in path:
                self._earlier.add(Interval(seen[None], lasts, ends=False, commands=command[None]))
            self._earlier.add(Interval(pose[None], lasts, commands=command[None]))

    def scored(self, trajectory: Trajectory) -> Judgement:
        return self.task.judge(trajectory, self._earlier)

    @contextmanager
    def threads_for(self, individuals: int) -> Iterator[None]:
        # A computation with a deadline does not wait for a core that others are using.
        with one_core(True), one_thread():
            yield

    def starts(self, count: int, rng: np.random.Generator) -> tuple[NDArray[np.float64], bool]:
        return np.tile(self._state[:3], (count, 1)), False

    def draw(self, trials: int, rng: np.random.Generator | int, repeats: int = 1) -> Draws:
        return replace(super().draw(trials, rng, repeats), state=self._state)

    def expectation(self, seed: int = 0) -> Draws:
        return replace(super().expectation(seed), state=self._state)
