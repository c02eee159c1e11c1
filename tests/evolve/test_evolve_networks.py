"""Evolution of networks that is interrupted, in the simulator or on a robot, and gone on with."""

import numpy as np
import pytest
from khepera_data import made_up
from neurosim.loop.evolve_networks import AGAIN, TRIALS_AGAIN, evolve_networks
from neurosim.loop.network_evolution import NetworkSettings

from neurosim.base.checkpoint import Checkpoint
from neurosim.base.errors import LinkLost, UserError
from neurosim.controllers import read_controller
from neurosim.lab import VirtualKheperaRig
from neurosim.simulators import TableSimulator
from neurosim.simulators.tables.arena import Arena
from neurosim.tasks.obstacle_avoidance import ObstacleAvoidance
from neurosim.trials.reality import RobotTrials

SETTINGS = NetworkSettings(generations=3, population=6, parents=2)
TASK = ObstacleAvoidance(steps=20, starts=2)


class Judge:
    """Tries networks as a robot would, from what is drawn; fails once, at the trial ``at``."""

    def __init__(self, at=None, error=LinkLost):
        self.at, self.error, self.tried = at, error, []

    def __call__(self, genes, rng):
        found = []
        for one in genes:
            luck = rng.normal()
            if len(self.tried) == self.at:
                self.at = None
                raise self.error("the robot is gone")
            self.tried.append(one)
            found.append(one[0] + 0.1 * luck)
        return np.array(found)


def evolved(out, judge, **others):
    others = {"robot_generations": 3, "seed": 5, "progress": False, **others}
    sim = TableSimulator(made_up())
    return evolve_networks(sim, out, TASK, SETTINGS, on_robot=judge, **others)


@pytest.mark.parametrize("at", [0, 4, 6, 17])
def test_a_lost_robot_is_gone_on_with_as_if_nothing_had_been(tmp_path, at):
    whole = evolved(tmp_path / "whole", Judge())
    assert not (tmp_path / "whole.checkpoint").exists()
    judge = Judge(at)
    with pytest.raises(LinkLost, match=r"gone; the best network so far is in .*, go on with --res"):
        evolved(tmp_path / "net", judge)
    so_far = read_controller(tmp_path / "net")
    assert so_far.evolution["interrupted"]
    done = SETTINGS.generations + at // SETTINGS.population
    assert so_far.evolution["history"]["best"] == whole.evolution["history"]["best"][:done]
    resumed = evolved(tmp_path / "net", judge, resume=True)
    # Nobody was tried twice before the last best were tried again.
    assert len(judge.tried) == 3 * SETTINGS.population + AGAIN * TRIALS_AGAIN
    assert resumed.evolution["history"] == whole.evolution["history"]
    assert (resumed.weights == whole.weights).all()
    assert not resumed.evolution["interrupted"]
    assert (read_controller(tmp_path / "net").weights == whole.weights).all()
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


def test_a_robot_lost_while_both_worlds_are_compared(tmp_path):
    calls = []

    def compare(genes, trials):
        calls.append(genes)
        if len(calls) == 1:
            raise LinkLost("gone")
        return []

    with pytest.raises(LinkLost, match="go on with --resume"):
        evolved(tmp_path / "net", Judge(), compare=compare)
    judge = Judge()
    made = evolved(tmp_path / "net", judge, compare=compare, resume=True)
    assert not judge.tried
    assert (calls[0] == calls[1]).all()
    assert made.evolution["trajectories"] == []


def test_nothing_is_left_where_nothing_came_of_it(tmp_path):
    sim = TableSimulator(made_up())
    narrow = sim.changed(arena=Arena.rectangle(0.05, 0.05))
    with pytest.raises(UserError, match="no room for the robot"):
        evolve_networks(narrow, tmp_path / "net", TASK, SETTINGS, progress=False)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(UserError, match="no interrupted evolution"):
        evolve_networks(sim, tmp_path / "net", TASK, SETTINGS, progress=False, resume=True)


def test_a_damaged_checkpoint_is_named(tmp_path):
    with pytest.raises(LinkLost):
        evolved(tmp_path / "net", Judge(4))
    state = tmp_path / "net.checkpoint" / "state.safetensors"
    state.write_bytes(state.read_bytes()[:200])
    with pytest.raises(UserError, match=r"state\.safetensors"):
        evolved(tmp_path / "net", Judge(), resume=True)
    Checkpoint(tmp_path / "net", "evolution").save({"fitness": np.zeros(3)})
    with pytest.raises(UserError, match="is not the state of this evolution"):
        evolved(tmp_path / "net", Judge(), resume=True)


def test_the_virtual_robot_is_switched_off_under_way(tmp_path):
    def on(rig, robot, after=None):
        trials, count = RobotTrials(robot, TASK), 0

        def tried(genes, rng):
            nonlocal count
            if count == after:
                rig.switch_off()
                robot._timeout = 0.2
            count += 1
            return trials(genes, rng)

        return evolved(tmp_path / "net", tried, resume=after is None, robot=robot.describe())

    lost = pytest.raises(LinkLost, match=r"stopped answering.*--resume")
    with VirtualKheperaRig(1) as rig, rig.robot as robot, lost:
        on(rig, robot, after=9)
    with VirtualKheperaRig(1) as rig, rig.robot as robot:
        made = on(rig, robot)
    assert len(made.evolution["history"]["best"]) == 6
    assert made.evolution["robot"]["virtual"] is True


def test_a_trial_takes_as_long_as_it_says():
    with VirtualKheperaRig(1) as rig, rig.robot as robot:
        trials, begin = RobotTrials(robot, TASK), robot.clock.now()
        trials(np.zeros((2, 18)), np.random.default_rng(0))
        took = robot.clock.now() - begin
    assert 2 * trials.seconds <= took < 2.2 * trials.seconds
