"""Evolution of networks goes on on a robot, which may be lost, and is resumed."""

from dataclasses import replace

import numpy as np
import pytest
from khepera_data import made_up

from neurosim.base.errors import LinkLost, UserError
from neurosim.controllers import Network, read_controller
from neurosim.lab import VirtualKheperaRig
from neurosim.loop.evaluate import Evaluator
from neurosim.loop.evolve import evolve
from neurosim.loop.reality import AGAIN, TRIALS_AGAIN
from neurosim.loop.settings import NETWORK_GENETIC, EvolveSettings
from neurosim.simulators import TableSimulator
from neurosim.simulators.tables.arena import Arena
from neurosim.tasks.obstacle_avoidance import ObstacleAvoidance
from neurosim.trials.reality import RobotTrials

GENETIC = replace(NETWORK_GENETIC, population=6, parents=2)
SETTINGS = EvolveSettings(
    generations=3, genetic=GENETIC, outcomes=1, objective="steady", selection=4, final_draws=4
)
TASK = ObstacleAvoidance(steps=20, starts=2)
FAMILY = Network(tuple(f"sensor_{number}" for number in range(8)))


class Judge:
    """Tries networks as a robot would, from what is drawn; fails once, at the trial ``at``."""

    def __init__(self, at=None, error=LinkLost):
        self.at, self.error, self.tried = at, error, []

    def fitness(self, genes, rng):
        found = []
        for one in genes:
            luck = rng.normal()
            if len(self.tried) == self.at:
                self.at = None
                raise self.error("the robot is gone")
            self.tried.append(one)
            found.append(one[0] + 0.1 * luck)
        return np.array(found)

    def compare(self, genes, seed):
        return []

    def describe(self):
        return {"kind": "judge"}


def evolved(out, judge, **others):
    others = {"settings": SETTINGS, "real_generations": 3, "seed": 5, **others}
    sim = TableSimulator(made_up())
    (made,) = evolve(sim, TASK, FAMILY, out=out, reality=judge, progress=False, **others)
    return made


@pytest.mark.parametrize("at", [0, 4, 6, 17])
def test_a_lost_robot_is_gone_on_with_as_if_nothing_had_been(tmp_path, at):
    whole = evolved(tmp_path / "whole", Judge())
    assert not (tmp_path / "whole.checkpoint").exists()
    judge = Judge(at)
    with pytest.raises(
        LinkLost, match=r"gone; the best controller so far is in .*, go on with --res"
    ):
        evolved(tmp_path / "net", judge)
    so_far = read_controller(tmp_path / "net")
    assert so_far.evolution["interrupted"]
    done = SETTINGS.generations + at // GENETIC.population
    assert so_far.evolution["history"]["best"] == whole.evolution["history"]["best"][:done]
    resumed = evolved(tmp_path / "net", judge, resume=True)
    # Nobody was tried twice before the last best were tried again.
    assert len(judge.tried) == 3 * GENETIC.population + AGAIN * TRIALS_AGAIN
    assert resumed.evolution["history"] == whole.evolution["history"]
    assert (resumed.genes == whole.genes).all()
    assert not resumed.evolution["interrupted"]
    assert (read_controller(tmp_path / "net").genes == whole.genes).all()
    assert not (tmp_path / "net.checkpoint").exists()


def test_ctrl_c_keeps_the_best_so_far(tmp_path):
    whole = evolved(tmp_path / "whole", Judge())
    judge = Judge(8, KeyboardInterrupt)
    assert evolved(tmp_path / "net", judge).evolution["interrupted"]
    with pytest.raises(UserError, match="not empty"):
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


@pytest.mark.parametrize("error", [LinkLost, KeyboardInterrupt])
def test_a_robot_lost_while_both_worlds_are_compared(tmp_path, error):
    calls, whole = [], evolved(tmp_path / "whole", Judge())
    if error is LinkLost:
        with pytest.raises(LinkLost, match="go on with --resume"):
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

    with pytest.raises(UserError, match="begun with robot = 'judge', not 'another'"):
        evolved(tmp_path / "net", Other(), resume=True)
    with pytest.raises(UserError, match="begun with real_generations = 3, not 4"):
        evolved(tmp_path / "net", Judge(), resume=True, real_generations=4)


def test_a_robot_goes_on_with_one_run_that_is_not_robust(tmp_path):
    with pytest.raises(UserError, match="after one run, which is not made robust"):
        evolved(tmp_path / "net", Judge(), settings=replace(SETTINGS, runs=2))
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_left_where_nothing_came_of_it(tmp_path):
    sim = TableSimulator(made_up()).changed(arena=Arena.rectangle(0.05, 0.05))
    with pytest.raises(UserError, match="no room for the robot"):
        evolve(sim, TASK, FAMILY, out=tmp_path / "net", settings=SETTINGS, progress=False)
    assert list(tmp_path.iterdir()) == []


def test_the_virtual_robot_is_switched_off_under_way(tmp_path):
    def on(rig, robot, after=None):
        class Trials(RobotTrials):
            count = 0

            def fitness(self, genes, rng):
                if self.count == after:
                    rig.switch_off()
                self.count += 1
                return super().fitness(genes, rng)

        trials = Trials(
            robot,
            Evaluator(TableSimulator(made_up()), TASK, FAMILY),
            place=lambda pose: rig.lab.place(*pose),
            pose=lambda _: lambda: rig.lab.pose,
            about={**robot.describe(), "virtual_lab": rig.describe()},
        )
        return evolved(tmp_path / "net", trials, resume=after is None)

    with VirtualKheperaRig(1) as rig:
        rig.robot._timeout = 0.2
        with rig.robot as robot, pytest.raises(LinkLost, match=r"stopped answering.*--resume"):
            on(rig, robot, after=9)
    with VirtualKheperaRig(1) as rig, rig.robot as robot:
        made = on(rig, robot)
    assert len(made.evolution["history"]["best"]) == 6
    assert made.evolution["robot"]["virtual"] is True


def test_a_trial_takes_as_long_as_it_says():
    evaluator = Evaluator(TableSimulator(made_up()), TASK, FAMILY)
    with VirtualKheperaRig(1) as rig, rig.robot as robot:
        trials = RobotTrials(robot, evaluator, place=None, pose=None, about={})
        begin = robot.clock.now()
        trials.fitness(np.zeros((2, 18)), np.random.default_rng(0))
        took = robot.clock.now() - begin
    assert 2 * trials.seconds <= took < 2.2 * trials.seconds
