"""Checks for the additions of other packages: each reports the first fault in one sentence.

Call one in a test of yours; it raises AssertionError::

    from neurosim.testing import check_task

    def test_my_task():
        check_task(MyTask())
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurosim.base.commands import Commands
from neurosim.base.errors import UserError
from neurosim.base.trajectory import Draws, Episode, Tracked, Trajectory
from neurosim.controllers.base import Controller
from neurosim.controllers.network import Network
from neurosim.controllers.registry import CONTROLLERS, make_controller
from neurosim.evolution.climb import resumable
from neurosim.evolution.genetic import GeneticSettings
from neurosim.evolution.space import SearchSpace
from neurosim.loop.journal import Reality
from neurosim.loop.stepped import SteppedRollouts
from neurosim.networks.control import NOT_READINGS
from neurosim.robots.base import (
    Battery,
    Counters,
    Lamp,
    Proximity,
    Robot,
    SelfStopping,
    Sensors,
    WholeSpeeds,
)
from neurosim.robots.lines.conformance import check_lines
from neurosim.simulators.base import Simulator
from neurosim.tasks.base import Judgement, Task
from neurosim.training.base import Trainer, TrainingData

__all__ = [
    "check_controller",
    "check_lines",
    "check_optimiser",
    "check_reality",
    "check_robot",
    "check_simulator",
    "check_task",
    "check_trainer",
]

#: Number of rows of the tried batches.
_ROWS = 5


def check_robot(make: Callable[[], Robot]) -> None:
    """Check that a driver has the abilities that its robot reports.

    The robot drives slowly for half a second, and its lamp goes on and off: give it free space.

    Args:
        make: returns the robot, not connected; it is called twice.

    Raises:
        AssertionError: saying what is wrong.
    """
    robot = make()
    members = ("clock", "connect", "close", "drive", "stop", "describe", "__enter__", "__exit__")
    lacking = [name for name in members if not hasattr(robot, name)]
    _require(not lacking, f"a robot has {', '.join(lacking)}, too: see neurosim.robots.base.Robot")
    about = robot.describe()
    _json("describe()", about)
    kind = about.get("kind")
    _require(isinstance(kind, str) and kind, "describe() must say the robot's kind, a name")
    robot.close()  # also one that was never connected
    robot = make()
    with robot as entered:
        _require(entered is robot, "entering the robot as a context must return the robot")
        about = robot.describe()
        _json("describe() of a connected robot", about)
        _require(about.get("kind") == kind, "its kind must not change when it is connected")
        _require(
            about.get("virtual", False) in (True, False),
            "virtual in describe() must be true or false",
        )
        _check_clock(robot)
        takes = robot.commands
        gentle = [0.2 * one.high if one.speed else 0.0 for one in takes.numbers]
        beyond = _beyond(gentle, takes)
        for wrong in beyond:
            _refuses(f"drive({wrong})", robot.drive, wrong)
        if isinstance(robot, Counters):
            _check_counters(robot)
        robot.drive(gentle)
        robot.stop()
        if isinstance(robot, Sensors):
            _check_sensors(robot)
        if isinstance(robot, WholeSpeeds):
            _require(
                isinstance(robot.full_speed, int) and robot.full_speed > 0 < robot.speed_unit,
                "full_speed must be a whole number above 0, and speed_unit above 0 m/s",
            )
            robot.set_speeds(1, -1)
            robot.stop()
        if isinstance(robot, Battery):
            volts = robot.battery()
            _require(not volts <= 0, f"battery() must be volts above 0 or NaN, not {volts}")
        if isinstance(robot, SelfStopping):
            for wrong in beyond:
                _refuses(f"drive_for({wrong}, 0.1)", robot.drive_for, wrong, 0.1)
            robot.drive_for(gentle, 0.1)
            robot.stop()
        if isinstance(robot, Lamp):
            robot.lamp(True)
            robot.lamp(False)
    robot.close()  # never raises


def _beyond(command: list[float], takes: Commands) -> list[list[float]]:
    """Return commands with each number in turn beyond its limits, and one without numbers."""
    commands = []
    for place, one in enumerate(takes.numbers):
        for value in (one.high + 0.01 * abs(one.high), 2.0 * one.low - one.high, math.nan):
            commands.append([*command[:place], value, *command[place + 1 :]])
    return commands


def _check_clock(robot: Robot) -> None:
    begin = robot.clock.now()
    robot.clock.sleep_until(begin + 0.05)
    robot.clock.sleep_until(begin)
    now = robot.clock.now()
    _require(now >= begin + 0.05, f"clock.sleep_until({begin + 0.05}) returned at {now}")


def _check_counters(robot: Any) -> None:
    _require(
        robot.pulses_per_metre > 0 and robot.geometry.wheel_base > 0,
        "pulses_per_metre and geometry.wheel_base must be above 0",
    )
    robot.stop()
    robot.set_counts(100, -100)
    counts = tuple(robot.read_counts())
    _require(counts == (100, -100), f"set_counts(100, -100) and then read_counts() gave {counts}")
    takes = robot.commands
    robot.drive(takes.straight([0.2 * one.high if one.speed else 0.0 for one in takes.numbers]))
    robot.clock.sleep_until(robot.clock.now() + 0.5)
    after = tuple(robot.read_counts())
    robot.stop()
    _require(
        all(b > a for a, b in zip(counts, after, strict=True)),
        f"driving forward must count up on both wheels; the counters went from {counts} to {after}",
    )


def _check_sensors(robot: Any) -> None:
    names = tuple(robot.sensor_names)
    _require(len(set(names)) == len(names), f"sensor_names must differ, not {names}")
    clash = sorted(set(names) & set(NOT_READINGS))
    _require(not clash, f"{clash} are inputs of pose, goal and time, not sensors")
    readings = robot.read_sensors()
    _require(
        tuple(readings) == names,
        f"read_sensors() gives {tuple(readings)}, sensor_names say {names}",
    )
    for name, value in readings.items():
        _require(0.0 <= value <= 1.0, f"a reading lies in 0 to 1, but {name} is {value}")
    if isinstance(robot, Proximity):
        activations = np.asarray(robot.activations())
        near = [name for name in names if name.startswith("sensor_")]
        _require(
            activations.shape == np.shape(robot.angles) == (len(near),),
            "activations() and angles must have one number for each sensor_0, sensor_1, ...",
        )


def check_simulator(
    simulator: Simulator, *, steps: int = 8, tolerance: float = 1e-3, falls: bool = False
) -> None:
    """Check a simulator: shapes, no hidden state, independent rows, noise, compiled rollouts.

    Args:
        simulator: any simulator.
        steps: number of steps for comparing compiled rollouts with stepped ones.
        tolerance: largest difference of these, m and rad.
        falls: whether its robot can fall, and then has the pose NaN.

    Raises:
        AssertionError: saying what is wrong.
    """
    _check_names(simulator)
    rng = np.random.default_rng(0)
    pose, command = _poses(simulator, rng), _commands(simulator, rng)
    state = simulator.start(pose)
    _shape("start(pose)", state, (_ROWS, len(simulator.state_names)))
    _equal("the first three columns of start(pose) are the pose", state[:, :3], pose)
    _check_function("step", simulator.step, state, command)
    after = simulator.step(state, command)
    poses = after[:, :3].nan_to_num(nan=0.0) if falls else after[:, :3]
    _shape("step(state, command)", torch.cat([poses, after[:, 3:]], dim=1), state.shape)
    if simulator.reading_names:
        readings = simulator.sense(after)
        _shape("sense(state)", readings, (_ROWS, len(simulator.reading_names)))
        _require(bool(((readings >= 0) & (readings <= 1)).all()), "readings must lie in 0 to 1")
        _check_function("sense", simulator.sense, after)
    _check_noise(simulator, state, command)
    if simulator.members > 1:
        mean = simulator.start_as(pose, torch.full((_ROWS,), -1))
        _equal("start_as() the member -1 moves as start()", simulator.step(mean, command), after)
        for member in range(simulator.members):
            one = simulator.start_as(pose, torch.full((_ROWS,), member))
            _shape(f"start_as() the member {member}", one, state.shape)
    _check_rollouts(simulator, pose.numpy(), steps, tolerance)


def _check_names(simulator: Simulator) -> None:
    names = simulator.command_names
    _require(
        tuple(simulator.state_names[:3]) == ("x", "y", "theta"),
        f"the first three state_names must be x, y, theta, not {simulator.state_names[:3]}",
    )
    for what in (simulator.state_names, names, simulator.reading_names):
        _require(len(set(what)) == len(what), f"names must differ, not {what}")
    _require(
        len(names) > 0 and "duration" not in names[:-1],
        f"there must be a command, a duration at its end, not {names}",
    )
    unknown = sorted(set(simulator.domain) - set(names))
    _require(not unknown, f"domain has limits of {unknown}, which are not commands ({names})")
    for name, (low, high) in simulator.domain.items():
        _require(low <= high, f"domain[{name!r}] must be lowest and highest, not {low}, {high}")
    _require(simulator.members >= 1, f"members must be at least 1, not {simulator.members}")


def _poses(simulator: Simulator, rng: np.random.Generator) -> Tensor:
    poses = simulator.free_poses(_ROWS, rng)
    if poses is None:
        poses = rng.uniform(-0.3, 0.3, (_ROWS, 3))
    _shape("free_poses(count, rng)", torch.as_tensor(poses), (_ROWS, 3))
    return torch.as_tensor(np.array(poses, np.float64))


def _commands(simulator: Simulator, rng: np.random.Generator) -> Tensor:
    usual = {name: (0.2, 0.6) if name == "duration" else (-50.0, 50.0)
             for name in simulator.command_names}  # fmt: skip
    limits = {**usual, **simulator.domain}
    columns = []
    for name in simulator.command_names:
        low, high = limits[name]
        low = max(low, 1e-3) if name == "duration" else low
        columns.append(rng.uniform(low, high, _ROWS))
    return torch.from_numpy(np.column_stack(columns))


def _check_function(name: str, function: Callable[..., Tensor], *inputs: Tensor) -> None:
    """Check that a function of batches has no memory, changes no argument, and mixes no rows."""
    kept = [one.clone() for one in inputs]
    first = function(*inputs)
    for before, after in zip(kept, inputs, strict=True):
        _require(torch.equal(before, after), f"{name}() must not change what it is given")
    function(*(one.flip(0) for one in inputs))
    _equal(
        f"{name}() gives the same for the same, whatever it did before", function(*inputs), first
    )
    for row in range(_ROWS):
        alone = function(*(one[row : row + 1] for one in inputs))
        _equal(f"{name}() gives a row alone what it gives it in a batch", alone[0], first[row])


def _check_noise(simulator: Simulator, state: Tensor, command: Tensor) -> None:
    def seeded(seed: int) -> list[Tensor]:
        generator = torch.Generator().manual_seed(seed)
        results = [simulator.step(state, command, generator)]
        results += [simulator.sense(state, generator)] if simulator.reading_names else []
        return [one.nan_to_num() for one in results]

    mean = [simulator.step(state, command)]
    mean += [simulator.sense(state)] if simulator.reading_names else []
    mean = [one.nan_to_num() for one in mean]
    noisy = seeded(1)
    _require(all(map(torch.equal, noisy, seeded(1))), "the same seed must give the same noise")
    differs = not all(map(torch.equal, mean, noisy))
    if simulator.has_noise:
        _require(differs, "has_noise is true, but a generator makes no difference")
    else:
        _require(not differs, "has_noise is false, but a generator makes a difference")
    if simulator.noise_width:
        rows, steps, width = _ROWS, 2, simulator.noise_width
        numbers = simulator.noise_of(np.arange(rows, dtype=np.uint64), steps)
        assert numbers is not None
        noise = torch.from_numpy(numbers).double()
        _shape("noise_of(seeds, steps)", noise, (rows, steps, width))

        def given(s: Tensor, c: Tensor, z: Tensor) -> Tensor:
            return simulator.step(s, c, z=z)  # type: ignore[call-arg]

        _check_function("step(..., z)", given, state, command, noise[:, 0])


def _check_rollouts(
    simulator: Simulator, starts: NDArray[np.float64], steps: int, tolerance: float
) -> None:
    for controller, episode in _families(simulator, steps):
        compiled = simulator.rollouts(controller, episode)
        if compiled is None:
            continue
        stepped = SteppedRollouts(simulator, controller, episode)
        genes = 0.5 * controller.first(3, torch.Generator().manual_seed(2)).numpy()
        samples = compiled.draw(starts, 3)
        same = [Draws(starts)] if samples.seeds is not None else [Draws(starts), samples]
        for draws in same:
            wanted, got = stepped.run(genes, draws), compiled.run(genes, draws)
            assert wanted.poses is not None
            assert got.poses is not None
            _require(
                got.poses.shape == wanted.poses.shape,
                f"compiled rollouts of a {controller.kind} have poses {got.poses.shape}, "
                f"stepped ones {wanted.poses.shape}",
            )
            away = float(np.abs(got.poses - wanted.poses).max())
            _require(
                away <= tolerance,
                f"compiled rollouts of a {controller.kind} are {away:.2g} (m or rad) away from "
                f"stepped ones after {steps} steps; at most {tolerance:g} is allowed",
            )


def _families(simulator: Simulator, steps: int) -> Iterator[tuple[Controller, Episode]]:
    episode = Episode(0.1, steps, 0.3)
    plan = make_controller("plan", simulator, slots=max(steps // 2, 1), durations=(0.2, 0.6))
    if tuple(plan.outputs) == tuple(simulator.command_names):
        yield plan, episode
    outputs = tuple(name for name in simulator.command_names if name != "duration")
    inputs = (*simulator.reading_names, "x", "sin_heading", "time")
    yield Network(inputs, (3,), outputs, 40.0), episode


def check_controller(controller: Controller) -> None:
    """Check a family of controllers: batches are rows, memory, first genes, settings.

    Raises:
        AssertionError: saying what is wrong.
    """
    count = controller.genes
    _require(isinstance(count, int) and count >= 0, f"genes must be a number, not {count!r}")
    _require(len(controller.outputs) > 0, "a controller has outputs")
    first, again = (controller.first(_ROWS, torch.Generator().manual_seed(1)) for _ in range(2))
    _shape("first(count, generator)", first, (_ROWS, count))
    _require(torch.equal(first, again), "first() must draw from the generator alone")
    _json("settings()", controller.settings())
    if controller.open_loop:
        _check_open_loop(controller, first.numpy())
    else:
        _check_seeing(controller, first)
    if controller.kind in CONTROLLERS.names() and controller.settings():
        made = CONTROLLERS.make(controller.kind, json.loads(json.dumps(controller.settings())))
        for name in ("inputs", "outputs", "genes", "memory"):
            _require(
                getattr(made, name) == getattr(controller, name),
                f"settings() make a family with other {name}: {getattr(made, name)}",
            )


def _check_open_loop(controller: Controller, genes: NDArray[np.float64]) -> None:
    plain, _ = controller.commands(genes, 0.0)
    for rest in (0.0, 0.5):
        commands, active = controller.commands(genes, rest)
        steps = plain.shape[1] + (rest > 0)
        shape = (_ROWS, steps, len(controller.outputs))
        _require(
            commands.shape == shape and active.shape == shape[:2],
            f"commands(genes, {rest}) must have shapes {shape} and {shape[:2]}, not "
            f"{commands.shape} and {active.shape}",
        )
        _require(np.isfinite(commands).all(), "commands() must be finite")
        _require(bool((commands[..., -1][active] > 0).all()), "a command lasts longer than 0 s")
        if rest > 0:
            stop = commands[:, -1]
            _require(
                not active[:, -1].any() and not stop[:, :-1].any() and (stop[:, -1] == rest).all(),
                "with a rest, the last command is a stop of this duration, and not active",
            )
        for row in range(_ROWS):
            alone, _ = controller.commands(genes[row : row + 1], rest)
            _require(
                np.array_equal(alone[0], commands[row]),
                "commands() must give a row alone what it gives it in a batch",
            )


def _check_seeing(controller: Controller, genes: Tensor) -> None:
    memory = controller.start(_ROWS)
    _shape("start(rows)", memory, (_ROWS, controller.memory))
    seen = torch.rand(
        _ROWS, len(controller.inputs), generator=torch.Generator().manual_seed(2),
        dtype=torch.float64,
    )  # fmt: skip
    for _ in range(2):  # from the first memory, and from a later one
        command, after = controller.act(genes, seen, memory)
        _shape("the commands of act()", command, (_ROWS, len(controller.outputs)))
        _shape("the memory of act()", after, (_ROWS, controller.memory))

        def together(*inputs: Tensor) -> Tensor:
            return torch.cat(controller.act(*inputs), dim=1)

        _check_function("act", together, genes, seen, memory)
        memory = after


def check_task(task: Task) -> None:
    """Check a task: shapes over leading axes, NaN, missing parts, its description.

    Raises:
        AssertionError: saying what is wrong.
    """
    _require(isinstance(task, Task), "a task is a subclass of neurosim.Task")
    _require(isinstance(task.name, str) and task.name, "a task has a name")
    _require(
        len(task.reasons) > 0 and all(isinstance(one, str) and one for one in task.reasons),
        "reasons must say how a trial can fail",
    )
    start = np.asarray(task.start, float)
    _require(start.shape == (3,) and np.isfinite(start).all(), "start must be x, y, heading")
    episode = task.episode
    _require(episode.step > 0 and episode.steps >= 1, "an episode has steps of some seconds")
    goals = episode.goals
    _require(goals is None or np.shape(goals)[1:] == (3,), "goals must be poses [N, 3]")
    about = task.describe()
    _json("describe()", about)
    _require(about.get("name") == task.name, "describe() must give name and settings")
    again = type(task)(**json.loads(json.dumps(about["settings"]))).describe()
    _require(json.dumps(again) == json.dumps(about), "the settings of describe() make another task")
    whole = _walks(task)
    judged = _check_judgement(task, whole, (2, 3))
    for a in range(2):
        one = _check_judgement(task, _picked(whole, (a, 0)), ())
        _close("judge() gives a trial alone what it gives it in a batch", one.fitness,
               judged.fitness[a, 0])  # fmt: skip
    assert whole.poses is not None
    lost = np.full_like(whole.poses, np.nan)
    lost[..., 0, :] = whole.poses[..., 0, :]
    _check_judgement(task, Trajectory(lost, whole.commands, whole.durations, whole.readings,
                                      whole.active), (2, 3))  # fmt: skip
    _close_shape("whole(fitness)", task.whole(np.ones((4, task.trial_starts))), (4,))
    _close_shape("region(poses)", task.region(whole.poses), whole.poses.shape[:-1])
    _json("outline()", task.outline())


def _walks(task: Task) -> Trajectory:
    """Return random walks [2, 3] from the task's start, with readings of eight sensors."""
    rng, steps = np.random.default_rng(0), 12
    moves = rng.normal(0, [0.1, 0.1, 0.3], (2, 3, steps, 3))
    start = np.broadcast_to(np.asarray(task.start, float), (2, 3, 1, 3))
    active = np.ones((2, 3, steps), np.bool_)
    active[..., -1] = False
    return Trajectory(
        np.concatenate([start, start + np.cumsum(moves, axis=2)], axis=2),
        rng.uniform(-100, 100, (2, 3, steps, 2)),
        np.broadcast_to(np.full(steps, task.episode.step), (2, 3, steps)),
        rng.random((2, 3, steps, 8)),
        active,
    )


def _picked(whole: Trajectory, index: tuple[int, ...]) -> Trajectory:
    names = ("poses", "commands", "durations", "readings", "active")
    return Trajectory(*(np.array(getattr(whole, name)[index]) for name in names))


def _check_judgement(task: Task, trajectory: Trajectory, shape: tuple[int, ...]) -> Judgement:
    given = {name: np.copy(getattr(trajectory, name)) for name in ("poses", "commands")}
    judged = task.judge(trajectory)
    for name, value in given.items():
        same = np.array_equal(value, getattr(trajectory, name), equal_nan=True)
        _require(same, f"judge() must not change the trajectory's {name}")
    for name in ("fitness", "success", "reason", "segment", "progress", "over"):
        actual = np.shape(getattr(judged, name))
        _require(actual == shape, f"{name} of a trajectory {shape} must be {shape}, not {actual}")
    _require(
        np.isfinite(judged.fitness).all(),
        "fitness must be finite, whatever the poses are: where the robot was not seen they are NaN "
        "(advance() keeps what was known before)",
    )
    reason = np.asarray(judged.reason)
    _require(
        bool(((reason == -1) == judged.success).all()) and (reason < len(task.reasons)).all(),
        "reason must be -1 where the task is done and an index into reasons where it is not",
    )
    segment, last = np.asarray(judged.segment), trajectory.commands.shape[-2] - 1
    _require(bool(((segment >= 0) & (segment <= last)).all()), f"segment must lie in 0 to {last}")
    return judged


def check_optimiser(make: Callable[[SearchSpace], Any]) -> None:
    """Check an optimiser: populations, seeds, that it climbs, and resuming.

    Args:
        make: the registered function: space -> optimiser.

    Raises:
        AssertionError: saying what is wrong.
    """
    rng = np.random.default_rng(1)
    given = rng.standard_normal((2, 20, 5))
    settings = GeneticSettings(population=20, tournament=3)
    space = SearchSpace(given.mean(axis=1), (1,), settings, 1.0, given=given)

    def fitness(genes: NDArray[np.float64]) -> NDArray[np.float64]:
        return -np.square(genes - 0.5).sum(axis=-1)

    def generation(optimiser: Any) -> NDArray[np.float64]:
        genes = np.array(optimiser.ask(), np.float64)
        many = genes.ndim == 3 and genes.shape[0] == space.runs
        _require(
            (many or genes.ndim == 2) and genes.shape[-1] == space.genes,
            f"ask() must return [P, {space.genes}], or [2, P, {space.genes}] of 2 runs, "
            f"not {genes.shape}",
        )
        _require(np.isfinite(genes).all(), "ask() must return finite genes")
        optimiser.tell(fitness(genes))
        return genes

    optimiser, twin = (resumable(make(space)) for _ in range(2))
    seen = [generation(optimiser) for _ in range(30)]
    _require(
        all(np.array_equal(a, generation(twin)) for a in seen[:3]),
        "the same seed must give the same populations",
    )
    first, best = fitness(seen[0]).max(), max(fitness(genes).max() for genes in seen)
    _require(
        best > first, f"30 generations on a sphere found nothing better than the first ({first:g})"
    )
    kept = {name: np.array(value) for name, value in optimiser.state().items()}
    expected, resumed = [generation(optimiser) for _ in range(2)], resumable(make(space))
    resumed.load(kept)
    _require(
        all(np.array_equal(genes, generation(resumed)) for genes in expected),
        "a resumed search must continue as if it had not been interrupted",
    )


def check_reality(reality: Any, genes: Any) -> None:
    """Check a reality: its description, and two trials of an individual.

    Args:
        reality: any reality, see :class:`neurosim.loop.journal.Reality`.
        genes: [G] of an individual that it can try.

    Raises:
        AssertionError: saying what is wrong.
    """
    row = np.asarray(genes, np.float64)
    assert isinstance(reality, Reality), "a reality has trial(genes, number)"
    if hasattr(reality, "describe"):
        about = reality.describe()
        assert isinstance(about, dict), "describe() returns a dict"
        json.dumps(about)
    instruction = getattr(reality, "instruction", None)
    assert instruction is None or isinstance(instruction, str), "instruction is a sentence"
    trials: list[Any] = [reality.trial(row, number) for number in range(2)]
    if hasattr(reality, "trials"):
        several = reality.trials(np.stack([row, row]), np.arange(2))
        assert np.shape(several) == (2,), "trials() returns a fitness for each individual"
        alike = np.allclose([_fitness(value) for value in several], [*map(_fitness, trials)])
        assert alike, "trials() returns what trial() does for its number"
        trials += list(several)
    for value in trials:
        if isinstance(value, Tracked):
            steps = {np.shape(one.poses) for one in trials if isinstance(one, Tracked)}
            alike = len(steps) == 1 and np.shape(value.poses)[1:] == (3,)
            assert alike, "poses are [K, 3], of all trials alike"
        value = _fitness(value)
        number = math.nan if value is None else float(value)
        assert math.isfinite(number), f"a fitness is {value!r}"


def _fitness(trial: Any) -> Any:
    return trial.fitness if isinstance(trial, Tracked) else trial


def check_trainer(trainer: type[Trainer], *, generations: int = 2) -> None:
    """Check a trainer: errors, the simulator it makes, and seeds.

    Args:
        trainer: the registered class.
        generations: number of generations to run.

    Raises:
        AssertionError: saying what is wrong.
    """
    for name in ("source", "settings_type"):
        _require(hasattr(trainer, name), f"a trainer has {name}")
    generator = torch.Generator().manual_seed(1)
    x = torch.rand(120, 5, generator=generator, dtype=torch.float64) * 100 - 50
    x[:, 4] = x[:, 4] / 50 + 1.5
    y = torch.stack([x[:, 2] * x[:, 4], x[:, 3] * 0.1, (x[:, 3] - x[:, 2]) * x[:, 4]], dim=1) / 200
    names = ("prev_left", "prev_right", "left", "right", "duration")
    units = ("%", "%", "%", "%", "s")
    inputs = [{"name": n, "unit": u} for n, u in zip(names, units, strict=True)]
    data = TrainingData(inputs, x, y)
    one, twin = (trainer(data, trainer.settings_type(), 3, "cpu") for _ in range(2))
    _require(one.generations >= 1, f"generations must be at least 1, not {one.generations}")
    for _ in range(generations):
        error = one.advance()
        _require(
            tuple(error.shape) == (3,) and bool((error >= 0).all()),
            f"advance() must return the mean squared error of x, y and heading, not {error}",
        )
        _require(torch.equal(error, twin.advance()), "the same seed must give the same errors")
    simulator = one.result()
    _require(isinstance(simulator, Simulator), "result() must be a simulator")
    check_simulator(simulator)


def _require(condition: Any, message: str) -> None:
    if not condition:
        raise AssertionError(message)


def _shape(what: str, value: Tensor, shape: tuple[int, ...]) -> None:
    _require(
        tuple(value.shape) == tuple(shape) and value.dtype == torch.float64,
        f"{what} must be {list(shape)} of float64, not {list(value.shape)} of {value.dtype}",
    )
    _require(bool(value.isfinite().all()), f"{what} must be finite")


def _close_shape(what: str, value: Any, shape: tuple[int, ...]) -> None:
    _require(np.shape(value) == shape, f"{what} must be {shape}, not {np.shape(value)}")
    _require(np.isfinite(value).all(), f"{what} must be finite")


def _equal(what: str, value: Tensor, expected: Tensor) -> None:
    _close(what, value.numpy(), expected.numpy())


def _close(what: str, value: Any, expected: Any) -> None:
    away = np.nanmax(np.abs(np.asarray(value) - np.asarray(expected)), initial=0.0)
    # NaN: a robot that has fallen has no pose.
    same = np.allclose(value, expected, rtol=1e-9, atol=1e-12, equal_nan=True)
    _require(same, f"{what}; it is {away:.3g} away")


def _json(what: str, value: Any) -> None:
    try:
        json.dumps(value, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise AssertionError(f"{what} must be ready for JSON: {error}") from None


def _refuses(what: str, function: Callable[..., Any], *values: Any) -> None:
    try:
        function(*values)
    except UserError:
        return
    raise AssertionError(f"{what} must raise a UserError: commands.check(command) does this")
