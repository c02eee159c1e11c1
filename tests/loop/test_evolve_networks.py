"""Evolution of networks continues on a robot, whose connection may be lost, and is resumed."""

from dataclasses import replace

import numpy as np
import pytest
from hill_climber import HillClimber
from khepera_data import made_up
from motion_networks import random_motion_network

from neurosim.base.errors import LinkLost, UserError
from neurosim.base.place import Place
from neurosim.controllers import Network, Plan, read_controller
from neurosim.evolution.genetic import GeneticSettings
from neurosim.evolution.optimisers import OPTIMISERS
from neurosim.lab import VirtualKheperaRig
from neurosim.loop.evaluate import Evaluator
from neurosim.loop.evolve import evolve
from neurosim.loop.journal import read_trials
from neurosim.loop.settings import NETWORK_GENETIC, EvolveSettings
from neurosim.loop.transfer import AGAIN, TRIALS_AGAIN
from neurosim.simulators import TableSimulator
from neurosim.tasks.go_to import GoTo
from neurosim.tasks.nine_rectangles import NineRectangles
from neurosim.tasks.obstacle_avoidance import ObstacleAvoidance
from neurosim.trials.floor import OnFloor
from neurosim.trials.realities import open_reality

GENETIC = replace(NETWORK_GENETIC, population=6, parents=2)
SETTINGS = EvolveSettings(
    generations=3, genetic=GENETIC, samples=1, objective="steady", selection=4, final_draws=4
)
TASK = ObstacleAvoidance(steps=20, starts=2)
FAMILY = Network(tuple(f"sensor_{number}" for number in range(8)))


class Judge:
    """Tries networks as a robot would, with luck; fails once, at the trial ``at``."""

    def __init__(self, at=None, error=LinkLost):
        self.at, self.error, self.tried = at, error, []

    def trial(self, genes, number):
        if len(self.tried) == self.at:
            self.at = None
            raise self.error("the robot is gone")
        self.tried.append(genes)
        return genes[0] + 0.1 * np.random.default_rng(number).normal()

    def describe(self):
        return {"kind": "judge"}


def evolved(out, judge, **others):
    others = {"settings": SETTINGS, "real_generations": 3, "seed": 5, **others}
    sim = TableSimulator(made_up())
    (made,) = evolve(sim, TASK, FAMILY, out=out, reality=judge, progress=False, **others)
    return made


@pytest.mark.slow
@pytest.mark.parametrize("at", [0, 4, 6, 17])
def test_a_lost_robot_is_gone_on_with_as_if_nothing_had_been(tmp_path, at):
    whole = evolved(tmp_path / "whole", Judge())
    assert not (tmp_path / "whole.checkpoint").exists()
    judge = Judge(at)
    with pytest.raises(
        LinkLost, match=r"gone; the best controller so far is in .*, continue with --res"
    ):
        evolved(tmp_path / "net", judge)
    so_far = read_controller(tmp_path / "net")
    assert so_far.evolution["interrupted"]
    done = SETTINGS.generations + at // GENETIC.population
    assert so_far.evolution["history"]["best"] == whole.evolution["history"]["best"][:done]
    resumed = evolved(tmp_path / "net", judge, resume=True)
    # No network was tried twice before the last best ones were repeated; a copy is not tried again.
    kinds = len({genes.tobytes() for genes in judge.tried})
    assert len(judge.tried) == kinds + AGAIN * TRIALS_AGAIN <= 3 * GENETIC.population + 20
    assert resumed.evolution["history"] == whole.evolution["history"]
    assert (resumed.genes == whole.genes).all()
    assert not resumed.evolution["interrupted"]
    assert (read_controller(tmp_path / "net").genes == whole.genes).all()
    assert not (tmp_path / "net.checkpoint").exists()


@pytest.mark.slow
def test_ctrl_c_keeps_the_best_so_far(tmp_path):
    whole = evolved(tmp_path / "whole", Judge())
    judge = Judge(8, KeyboardInterrupt)
    assert evolved(tmp_path / "net", judge).evolution["interrupted"]
    with pytest.raises(UserError, match="has an interrupted evolution: continue it"):
        evolved(tmp_path / "net", judge)
    with pytest.raises(UserError, match="begun with seed = 5, not 6"):
        evolved(tmp_path / "net", judge, resume=True, seed=6)
    resumed = evolved(tmp_path / "net", judge, resume=True)
    assert resumed.evolution["history"] == whole.evolution["history"]
    with pytest.raises(UserError, match="not empty"):
        evolved(tmp_path / "net", judge, resume=True)


class Comparing(Judge):
    """Fails when it is first to drive for the report."""

    def __init__(self, error, calls):
        super().__init__()
        self.calls, self._error = calls, error

    def compare(self, genes, seed):
        self.calls.append(genes)
        if len(self.calls) == 1:
            raise self._error("gone")
        return [{"simulated": [], "robot": []}]


@pytest.mark.slow
@pytest.mark.parametrize("error", [LinkLost, KeyboardInterrupt])
def test_a_robot_lost_while_both_worlds_are_compared(tmp_path, error):
    calls, whole = [], evolved(tmp_path / "whole", Judge())
    if error is LinkLost:
        with pytest.raises(LinkLost, match="continue with --resume"):
            evolved(tmp_path / "net", Comparing(error, calls))
    else:
        assert evolved(tmp_path / "net", Comparing(error, calls)).evolution["interrupted"]
    judge = Comparing(error, calls)
    made = evolved(tmp_path / "net", judge, resume=True)
    assert not judge.tried
    assert (calls[0] == calls[1]).all()
    assert made.evolution["trajectories"] == [{"simulated": [], "robot": []}]
    assert made.evolution["history"] == whole.evolution["history"]
    assert (made.genes == whole.genes).all()


def test_another_robot_does_not_go_on(tmp_path):
    with pytest.raises(LinkLost):
        evolved(tmp_path / "net", Judge(4))

    class Other(Judge):
        def describe(self):
            return {"kind": "another"}

    with pytest.raises(UserError, match=r"begun with robot\.kind = 'judge', not 'another'"):
        evolved(tmp_path / "net", Other(), resume=True)
    with pytest.raises(UserError, match="begun with real_generations = 3, not 4"):
        evolved(tmp_path / "net", Judge(), resume=True, real_generations=4)


def test_a_robot_goes_on_with_one_run_that_is_not_robust(tmp_path):
    with pytest.raises(UserError, match="need a single run"):
        evolved(tmp_path / "net", Judge(), settings=replace(SETTINGS, runs=2))
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_left_where_nothing_came_of_it(tmp_path):
    sim = TableSimulator(made_up()).changed(place=Place.rectangle(0.05, 0.05))
    with pytest.raises(UserError, match="no room for the robot"):
        evolve(sim, TASK, FAMILY, out=tmp_path / "net", settings=SETTINGS, progress=False)
    assert list(tmp_path.iterdir()) == []


def on_the_floor(rig, robot):
    return OnFloor(
        robot,
        Evaluator(TableSimulator(made_up()), TASK, FAMILY),
        place=lambda pose: rig.lab.place(*pose),
        pose=lambda _: lambda: rig.lab.pose,
        about={"virtual": True},
    )


@pytest.mark.slow
def test_the_virtual_robot_is_switched_off_under_way(tmp_path):
    with VirtualKheperaRig(1) as rig:
        rig.robot._timeout = 0.2
        with rig.robot as robot, pytest.raises(LinkLost, match=r"stopped answering.*--resume"):
            reality = on_the_floor(rig, robot)
            trial = reality.trial

            def ninth_is_the_last(genes, number):
                if number == 9:
                    rig.switch_off()
                return trial(genes, number)

            reality.trial = ninth_is_the_last
            evolved(tmp_path / "net", reality)
    assert len(read_trials(tmp_path / "net.checkpoint" / "trials.jsonl")) == 9
    with VirtualKheperaRig(1) as rig, rig.robot as robot:
        made = evolved(tmp_path / "net", on_the_floor(rig, robot), resume=True)
    assert len(made.evolution["history"]["best"]) == 6
    assert made.evolution["robot"]["virtual"] is True


def test_a_trial_takes_as_long_as_it_says_and_a_trial_given_up_ends():
    with VirtualKheperaRig(1) as rig, rig.robot as robot:
        reality = on_the_floor(rig, robot)
        begin = robot.clock.now()
        reality.trial(np.zeros(18), 0)
        took = robot.clock.now() - begin
        assert reality.seconds <= took < 1.1 * reality.seconds
        reality.stop()
        with pytest.raises(LinkLost, match="given up"):
            reality.trial(np.zeros(18), 1)


def test_what_the_floor_does_not_give_is_refused():
    sim = TableSimulator(made_up())
    for task, family, message in (
        (GoTo(), Network(("sensor_0",)), "needs the robot's poses"),
        (TASK, Network(("x",)), "needs the robot's pose, and nobody knows where it wanders"),
    ):
        with pytest.raises(UserError, match=message), VirtualKheperaRig(1) as rig:
            OnFloor(rig.robot, Evaluator(sim, task, family), place=None, pose=None, about={})
    with (
        pytest.raises(UserError, match=r"of the kind motion-network has none: .*--reality"),
        open_reality("virtual-khepera", Plan(slots=2), NineRectangles(), random_motion_network()),
    ):
        pass


def test_a_plan_is_driven_on_the_floor():
    with VirtualKheperaRig(1) as rig, rig.robot as robot:
        family = Plan(slots=2, durations=(0.2, 0.4))
        evaluator = Evaluator(TableSimulator(made_up()), TASK, family)
        reality = OnFloor(robot, evaluator, place=None, pose=None, about={})
        fast = family.encode([(40.0, 40.0, 0.4), (40.0, 40.0, 0.4)])
        slow = family.encode([(10.0, 10.0, 0.4), None])
        assert reality.trial(fast, 0) > reality.trial(slow, 1) > 0.0
        reality.trial(family.encode([None, None]), 2)


@pytest.mark.parametrize("name", ["ga", "cma", "own"])
def test_plans_and_any_optimiser_go_on_in_reality_and_are_resumed(tmp_path, monkeypatch, name):
    if name == "cma":
        pytest.importorskip("cma")
    monkeypatch.setitem(OPTIMISERS._registered, "own", HillClimber)
    genetic = GeneticSettings(population=6, tournament=2)
    settings = EvolveSettings(name, generations=2, runs=1, genetic=genetic, final_draws=8)

    def run(out, judge, **others):
        return evolve(
            random_motion_network(), "nine-rectangles", Plan(slots=3), out=tmp_path / out,
            settings=settings, reality=judge, real_generations=2, seed=3, progress=False, **others,
        )  # fmt: skip

    (whole,) = run("whole", Judge())
    judge = Judge(7)
    # The best in the simulator may be a plan that gives no command.
    with pytest.raises((LinkLost, UserError), match=r"is gone|no plan has a command yet"):
        run("cut", judge)
    (resumed,) = run("cut", judge, resume=True)
    assert resumed.commands == whole.commands
    assert resumed.evolution == whole.evolution


@pytest.mark.slow  # trials in the lab, filmed
@pytest.mark.parametrize("family", [Plan(slots=2), Network(("x", "y", "goal_x"))], ids=str)
def test_an_nxt_of_the_lab_is_where_evolution_goes_on(family):
    task = GoTo(goals=((0.2, 0.1, 0.0),), seconds=1.0)
    genetic = GeneticSettings(population=2, tournament=2)
    with open_reality("virtual-nxt", family, task, lab_seed=2) as reality:
        (controllers,) = evolve(
            random_motion_network(), task, family, generations=1, runs=1, genetic=genetic,
            samples=0, extrapolate=True, reality=reality, real_generations=1, progress=False,
        )  # fmt: skip
    assert controllers.evolution["robot"]["kind"] == "virtual-nxt"
    assert len(controllers.evolution["history"]["best"]) == 2
    assert controllers.evolution["robot_fitness"]["trials"] == TRIALS_AGAIN
