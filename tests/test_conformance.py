"""All that neurosim contains passes the checks that it offers; classes with one fault do not."""

import importlib.util
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
import torch
from simulators_of_tests import Walker, motion_network, tables

import neurosim as ns
from neurosim.controllers import FixedPlan, Function, Network, Plan, Recurrent
from neurosim.controllers.gait import HAND_TUNED, Gait, genes_of
from neurosim.controllers.sine_gait import SineGait
from neurosim.evolution.optimisers import OPTIMISERS
from neurosim.lab import (
    VirtualKheperaRig,
    VirtualLinesRig,
    VirtualRig,
    VirtualRosRig,
    VirtualThymioRig,
)
from neurosim.robots.khepera.driver import Khepera
from neurosim.robots.lines.driver import Lines
from neurosim.robots.nxt.driver import NXT
from neurosim.robots.ros.driver import Ros
from neurosim.robots.thymio.driver import Thymio
from neurosim.tasks.registry import TASKS
from neurosim.testing import (
    check_controller,
    check_optimiser,
    check_reality,
    check_robot,
    check_simulator,
    check_task,
    check_trainer,
)
from neurosim.training.trainers.registry import TRAINERS


def nxt(rig, kind=NXT, **options):
    return lambda: kind(clock=rig.lab.clock, deadline=60.0, **{**rig.address, **options})


def khepera(rig, kind=Khepera, **options):
    return lambda: kind(rig.address, clock=rig.lab.clock, timeout=10.0, **options)


def test_our_robots():
    with VirtualRig(1, camera=False) as rig:
        check_robot(nxt(rig))
        check_robot(nxt(rig, lamp=None, light_left=None, light_right=None))
    with VirtualKheperaRig(1) as rig:
        check_robot(khepera(rig))
    for kind in ("wheels", "car", "omni"):
        with VirtualLinesRig(1, kind=kind, camera=False) as rig:
            check_robot(lambda: Lines(rig.address, clock=rig.lab.clock, timeout=10.0))
    with VirtualThymioRig(1, camera=False) as rig:
        check_robot(lambda: Thymio(rig.address, clock=rig.lab.clock, timeout=10.0))
    with VirtualRosRig(1, camera=False) as rig:
        check_robot(lambda: Ros(url=rig.address, clock=rig.lab.clock, timeout=10.0))
        options = {"odom": "none", "laser": "/scan", "stops_after": 0.5, "timeout": 10.0}
        check_robot(lambda: Ros(url=rig.address, clock=rig.lab.clock, **options))


@pytest.mark.parametrize("make", [motion_network, tables, Walker])
def test_our_simulators(make):
    check_simulator(make())


@pytest.mark.parametrize(
    "controller",
    [
        Plan(slots=4),
        FixedPlan(((20.0, 30.0, 1.0), None, (0.0, 10.0, 0.5))),
        Network(("sensor_0", "x"), (3,)),
        Gait(),
        SineGait(),
        Recurrent(("sensor_0",), 2),
        Recurrent(("sensor_0",), 2, "ctrnn"),
        Function(lambda seen, genes: (seen["x"] * genes[:, 0], genes[:, 1]), ("x",), 2),
    ],
    ids=lambda controller: controller.kind,
)
def test_our_controllers(controller):
    check_controller(controller)


def test_our_legged_robots():
    pytest.importorskip("mujoco")
    from neurosim.simulators.legged.quadratot import QuadraTot
    from neurosim.simulators.legged.simulator import LeggedSimulator

    check_simulator(LeggedSimulator(), falls=True)
    check_simulator(LeggedSimulator(QuadraTot()), falls=True)


@pytest.mark.parametrize("name", TASKS.names())
def test_our_tasks(name):
    check_task(ns.make_task(name))


@pytest.mark.parametrize("name", OPTIMISERS.names())
def test_our_optimisers(name):
    if name == "cma" and importlib.util.find_spec("cma") is None:
        pytest.skip("pycma is not installed")
    check_optimiser(OPTIMISERS.get(name))


@pytest.mark.parametrize("name", TRAINERS.names())
@pytest.mark.slow
def test_our_trainers(name):
    check_trainer(TRAINERS.get(name))


@pytest.mark.slow
def test_our_realities():
    pytest.importorskip("mujoco")
    from neurosim.lab.walker import VirtualWalker

    check_reality(VirtualWalker(Gait()), genes_of(HAND_TUNED))


class Wordless:
    def trial(self, genes, number):
        return None


class Uneven(Wordless):
    def trial(self, genes, number):
        return float(number)

    def trials(self, genes, numbers):
        return np.zeros(len(genes))


@pytest.mark.parametrize(
    ("reality", "says"),
    [(Wordless(), "a fitness is None"), (Uneven(), "what trial"), (object(), "has trial")],
)
def test_realities_that_are_none(reality, says):
    with pytest.raises(AssertionError, match=says):
        check_reality(reality, [0.5])


class Unnamed(Khepera):
    def describe(self):
        return {"port": "x"}


class Backwards(Khepera):
    def read_counts(self):
        left, right = super().read_counts()
        return -left, -right

    def set_counts(self, left, right):
        super().set_counts(-left, -right)


class Raw(Khepera):
    def read_sensors(self):
        return {name: 1023 * value for name, value in super().read_sensors().items()}


class Careless(Khepera):
    def drive(self, command):
        left, right = command
        self.set_speeds(round(np.nan_to_num(left) / 10), round(right / 10))


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        (Unnamed, "must say the robot's kind"),
        (Backwards, "must count up on both wheels"),
        (Raw, "a reading lies in 0 to 1, but sensor_0 is"),
        (Careless, r"drive\(\[101.0, 20.0\]\) must raise a UserError"),
    ],
)
def test_a_driver_that_is_wrong(kind, says):
    with VirtualKheperaRig(1) as rig, pytest.raises(AssertionError, match=says):
        check_robot(khepera(rig, kind))


class Single(Walker):
    def step(self, state, command, generator=None):
        return super().step(state, command, generator).float()


class Remembers(Walker):
    before = 0.0

    def step(self, state, command, generator=None):
        after = super().step(state, command, generator) + self.before
        self.before = 1e-3 * float(command.sum())
        return after


class Mixes(Walker):
    def step(self, state, command, generator=None):
        return super().step(state, command - command.mean(0), generator)


class Silent(Walker):
    has_noise = False


class Loud(Walker):
    def sense(self, state, generator=None):
        return 5 * super().sense(state, generator)


class OtherCompiled(Walker):
    """Its compiled rollouts are those of another robot."""

    has_noise = False

    def step(self, state, command, generator=None):
        return super().step(state, command)

    def rollouts(self, controller, episode):
        from neurosim.loop.stepped import SteppedRollouts

        return SteppedRollouts(Sideways(), controller, episode)


class Sideways(Walker):
    has_noise = False

    def step(self, state, command, generator=None):
        return super().step(state, command) + torch.tensor([0.0, 0.01, 0.0, 0.0]).double()


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        (Single, "of float64, not"),
        (Remembers, "gives the same for the same"),
        (Mixes, "gives a row alone what it gives it in a batch"),
        (Silent, "has_noise is false, but a generator makes a difference"),
        (Loud, "readings must lie in 0 to 1"),
        (OtherCompiled, r"compiled rollouts of a plan are 0\.\d+ \(m or rad\) away"),
    ],
)
def test_a_simulator_that_is_wrong(kind, says):
    with pytest.raises(AssertionError, match=says):
        check_simulator(kind())


class Forgetful(Recurrent):
    def act(self, genes, observation, memory):
        memory += 1.0
        return super().act(genes, observation, memory)


def test_controllers_that_are_wrong():
    def mean(seen):
        return seen["x"].mean(), seen["x"]

    with pytest.raises(AssertionError, match="gives a row alone what it gives it in a batch"):
        check_controller(Function(mean, ("x",)))
    with pytest.raises(AssertionError, match="must not change what it is given"):
        check_controller(Forgetful(("x",), 2))


@dataclass(frozen=True)
class Task(ns.Task):
    name: ClassVar[str] = "away"

    far: float = 0.3

    def fitness(self, record):
        return np.linalg.norm(record[:, 4:6], axis=-1)

    def worth(self, record):
        fitness = self.fitness(record)
        return ns.Judgement.of(fitness, fitness > self.far)


class NotSafe(Task):
    def fitness(self, record):
        return np.where(record[:, 7] > 0, np.nan, 0.0)


class OneAtATime(Task):
    def judge(self, trajectory, record=None):
        return super().judge(trajectory, record).mapped(np.ravel)


class Relative(Task):
    def fitness(self, record):
        result = super().fitness(record)
        return result - result.mean()


class Nameless(Task):
    def describe(self):
        return {"name": "away", "settings": {"far": 2 * self.far}}


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        (NotSafe, "fitness must be finite, whatever the poses are"),
        (OneAtATime, r"fitness of a trajectory \(2, 3\) must be \(2, 3\), not \(6,\)"),
        (Nameless, "the settings of describe\\(\\) make another task"),
        (Relative, "gives a trial alone what it gives it in a batch"),
    ],
)
def test_a_task_that_is_wrong(kind, says):
    check_task(Task())
    with pytest.raises(AssertionError, match=says):
        check_task(kind())


class Stays:
    """Returns the same population again and again."""

    def __init__(self, space):
        self.genes = np.random.default_rng(space.seed).random((8, space.genes))

    def ask(self):
        return self.genes

    def tell(self, fitness):
        pass


def test_an_optimiser_that_is_wrong():
    with pytest.raises(AssertionError, match="found nothing better than the first"):
        check_optimiser(Stays)


class Wanders(TRAINERS.get("ga")):
    made = 0

    def __init__(self, data, settings, seed, device="cpu"):
        super().__init__(data, settings, seed + Wanders.made, device)
        Wanders.made += 1


def test_a_trainer_that_is_wrong():
    with pytest.raises(AssertionError, match="the same seed must give the same errors"):
        check_trainer(Wanders)
