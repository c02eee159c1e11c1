"""A batch of trials of a task in a simulator, stepped together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim.base.errors import UserError
from neurosim.base.threads import WORTH_SHARING, one_core
from neurosim.envs.face import Face
from neurosim.loop.evaluate import draw_starts
from neurosim.simulators.base import Simulator
from neurosim.simulators.sampling import PLACING, Stepper, placed
from neurosim.tasks.base import EVERY, Interval, Judgement, Rows, Task

#: Number of samples, and of steps of noise, drawn at once: a call takes longer than the numbers.
SAMPLES, STEPS = 64, 16


class Samples:
    """The random conditions of each trial of a batch: start, member of the ensemble, and seed of
    its noise.

    Each row has its own generator, so that its samples do not depend on the batch's size.
    """

    def __init__(
        self,
        simulator: Simulator,
        task: Task,
        count: int,
        noise: bool,
        placing: tuple[float, float],
    ):
        self._simulator, self._task = simulator, task
        self._noise, self._placing = noise, placing
        self._starts = np.zeros((count, SAMPLES, 3))
        self._member = np.full((count, SAMPLES), -1)
        self._seeds = np.zeros((count, SAMPLES), np.uint64)
        self._next = np.full(count, SAMPLES)

    def forget(self, row: int) -> None:
        """Drop a row's samples, because it has another generator now."""
        self._next[row] = SAMPLES

    def take(
        self, rows: NDArray[np.int64], rngs: Sequence[np.random.Generator]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.uint64]]:
        """Return starts [K, 3], members [K] and seeds [K] of the next trials in rows [K].

        Args:
            rows: of the batch.
            rngs: of all rows of the batch.
        """
        for row in rows[self._next[rows] == SAMPLES]:
            self._draw(row, rngs[row])
        at = self._next[rows]
        self._next[rows] += 1
        return self._starts[rows, at], self._member[rows, at], self._seeds[rows, at]

    def _draw(self, row: int, rng: np.random.Generator) -> None:
        starts, by_task = draw_starts(self._simulator, self._task, SAMPLES, rng)
        if self._noise:
            if not by_task:
                starts = placed(starts, self._placing, rng)
            if self._simulator.members > 1:
                self._member[row] = rng.integers(self._simulator.members, size=SAMPLES)
            self._seeds[row] = rng.integers(2**64, size=SAMPLES, dtype=np.uint64)
        self._starts[row], self._next[row] = starts, 0


class Noise:
    """The noise of the present and the next step of each trial of a batch, drawn in blocks.

    The numbers of a row depend on its seed and step alone, so blocks change nothing.

    Attributes:
        seeds: [B] of the present trials.
    """

    def __init__(self, stepper: Stepper, count: int):
        self._stepper = stepper
        self.seeds, self._steps = np.zeros(count, np.uint64), np.zeros(count, np.int64)
        self._draw()

    def begin(self, rows: NDArray[np.int64], seeds: NDArray[np.uint64]) -> NDArray:
        """Begin rows [K] with new seeds [K]; return the noise [K, Z] of their first step."""
        self.seeds[rows], self._steps[rows] = seeds, 0
        count = STEPS + 2 - self._now
        numbers = self._stepper.noises(seeds, self._steps[rows], count)
        self._numbers[rows, self._now :] = numbers
        return numbers[:, 0]

    def of(self, rows: Rows) -> tuple[NDArray, int]:
        """Return noise [K, N, Z] of rows, and which of the N steps is the present; a next is there.

        The noise of all rows is not copied.
        """
        if isinstance(rows, slice):
            return self._numbers[rows], self._now
        return self._numbers[rows, self._now : self._now + 2], 0

    def go_on(self) -> None:
        """Advance all rows by a step."""
        self._steps += 1
        self._now += 1
        if self._now > STEPS:
            self._draw()

    def _draw(self) -> None:
        self._numbers = self._stepper.noises(self.seeds, self._steps, STEPS + 2)
        self._now = 0


class Trials:
    """B trials of a task in a simulator, which begin and end independently.

    Attributes:
        face: spaces, observations, rewards.
        state: [B, S] of the simulator.
    """

    def __init__(
        self,
        simulator: Simulator,
        task: Task,
        count: int,
        *,
        observe: Sequence[str] | None = None,
        noise: bool = True,
        placing: tuple[float, float] = PLACING,
    ):
        """Prepare.

        Args:
            simulator: the simulator of the trials.
            task: the task.
            count: number of trials at once.
            observe: names of the observations; see :class:`Face`.
            noise: whether each trial is a random sample of the start, the member of the ensemble
                and the noise; otherwise it is the expected motion.
            placing: error in placing the robot where a trial starts at a mark: standard
                deviations in x and y (m) and in heading (rad).
        """
        self.face = Face(simulator, task, count, observe)
        self._stepper = simulator.stepper()
        noisy = noise and simulator.has_noise
        self._noise = Noise(self._stepper, count) if noisy else None
        self._samples = Samples(simulator, task, count, noise, placing)
        self.state = np.zeros((count, len(simulator.state_names)))
        self._steps = np.zeros(count, np.int64)
        self._readings: NDArray | None = None
        self._idle = np.nan_to_num(self.face.action_space.low, neginf=0.0)

    def __len__(self) -> int:
        return len(self.state)

    @property
    def poses(self) -> NDArray[np.float64]:
        """The robots' poses, [B, 3] (m, m, rad)."""
        return self.state[:, :3]

    def forget(self, row: int) -> None:
        """Drop a row's samples, because it has another generator now."""
        self._samples.forget(row)

    def begin(self, rows: NDArray[np.int64], rngs: Sequence[np.random.Generator]) -> None:
        """Begin trials in rows [K]; ``rngs`` are the generators of all rows of the batch."""
        starts, member, seeds = self._samples.take(rows, rngs)
        self.state[rows] = self._stepper.start(starts, member)
        self._steps[rows] = 0
        self.face.begin(rows, starts)
        with one_core(len(self) < WORTH_SHARING):
            noise = None if self._noise is None else self._noise.begin(rows, seeds)
            if self.face.reads:
                seen = self._stepper.sense(self.state[rows], noise)
                self._readings = self._kept(self._readings, rows, seen)

    def step(
        self, commands: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], Judgement]:
        """Advance all trials.

        A trial ends when its result is decided, or its time is over. In the latter case, if the
        task says so, the motors stop, and the motion until rest counts in this step.

        Args:
            commands: [B, C] of :meth:`Face.checked`.

        Returns:
            Rewards [B], the growth of the task's progress; whether each trial is decided, and
            whether its time is over, [B] bool each; and the trials' fitness.
        """
        with one_core(len(self) < WORTH_SHARING):
            return self._step(commands)

    def _step(
        self, commands: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], Judgement]:
        face, episode = self.face, self.face.episode
        self._go_on(EVERY, commands, episode.step, True)
        if self._noise is not None:
            self._noise.go_on()
        decided = face.records.over()
        late = (self._steps >= episode.steps) & ~decided
        if episode.rest > 0 and late.any():
            rows = np.flatnonzero(late)
            still = np.zeros((len(rows), len(self.face.outputs)))
            self._go_on(rows, self.face.lasting(still, episode.rest), episode.rest, False)
        rewards, judged = face.reward()
        return rewards, decided, late, judged

    def _go_on(
        self, rows: Rows, commands: NDArray[np.float64], duration: float, active: bool
    ) -> None:
        noises, at = (None, 0) if self._noise is None else self._noise.of(rows)
        readings = None if self._readings is None else self._readings[rows]
        self._steps[rows] += 1
        if self.face.reads:
            after, seen = self._stepper.step_and_sense(self.state[rows], commands, noises, at)
            self._readings = self._kept(self._readings, rows, seen)
        else:
            noise = None if noises is None else noises[:, at]
            after = self._stepper.step(self.state[rows], commands, noise)
        self.state = self._kept(self.state, rows, after)
        poses, touching = after[:, :3], None
        if self.face.episode.contacts:
            touching = self.face.simulator.touching(poses)
        moved = Interval(poses, duration, active, True, commands, readings, touching)
        self.face.add(rows, moved)

    def _kept(self, kept: NDArray | None, rows: Rows, new: NDArray) -> NDArray:
        if isinstance(rows, slice):
            return new
        if kept is None:
            kept = np.zeros((len(self), *new.shape[1:]), new.dtype)
        kept[rows] = new
        return kept

    def see(self, rows: Rows = EVERY) -> NDArray[np.float32]:
        """Return the observations of rows [K], [K, I]; call it once after a step."""
        readings = None if self._readings is None else self._readings[rows]
        times = np.minimum(self._steps[rows], self.face.episode.steps) * self.face.episode.step
        return self.face.observation(rows, self.state[rows, :3], readings, times)

    def checked(self, actions: ArrayLike, ignored: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return commands [B, C] for actions [B, ...]; ignored rows may have any action.

        Raises:
            UserError: if they are not in the action space.
        """
        if ignored.any():
            try:
                actions = np.array(actions, np.float32)
            except (TypeError, ValueError):
                raise UserError(f"actions must be numbers, not {actions!r:.60}") from None
            if len(actions.shape) == 2 and len(actions) == len(ignored):
                actions[ignored] = self._idle
        return self.face.checked(actions, len(self))
