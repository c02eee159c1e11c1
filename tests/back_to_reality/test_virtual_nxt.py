"""The wheeled robot: its simulator has another floor, and a few trials adapt it to reality."""

import json
import math
import shutil
import sys

import numpy as np
import pytest
import torch
from ideal_simulator import IdealWheels
from motion_networks import NAMES

from neurosim.back_to_reality import settings_named
from neurosim.back_to_reality.run import back_to_reality, start_genes
from neurosim.base.errors import RobotError, UserError
from neurosim.cli.main import main
from neurosim.controllers import FixedPlan, Network, Plan, SavedController, read_controller
from neurosim.controllers.gait import Gait
from neurosim.controllers.plan import commands_of
from neurosim.networks import ProductSummationNetwork
from neurosim.simulators import MotionNetwork, read_simulator
from neurosim.simulators.adjustable import Adjustable
from neurosim.simulators.motion.drive import CURVES, DriveModel
from neurosim.simulators.registry import write_simulator
from neurosim.tasks.go_to import GoTo
from neurosim.tasks.nine_rectangles import NineRectangles
from neurosim.testing import check_reality
from neurosim.trials.realities import make_reality

FAMILY, TASK = Plan(slots=4), NineRectangles()
#: Up into the first rectangle and to the right.
COMMANDS = ((40.0, 40.0, 1.5), None, (30.0, -30.0, 0.6), (40.0, 36.0, 1.2))


def nxt(forward=1.0, turn=1.0, yaw=0.0):
    """Return a simulator of the lab's typical robot on a floor where it moves differently."""
    wheel, track = 0.25, 0.13  # m/s at 50 %, m
    kinematics = [[0.5 * wheel, 0.0, sign * wheel / track] for sign in (-1.0, 1.0)]
    other = torch.tensor([[forward, 0.0, yaw], [0.0, 1.0, 0.0], [0.0, 0.0, turn]]).double()
    laws = (0.1, 1.0, 0.5, 50.0, 0.0)
    network = ProductSummationNetwork(len(NAMES), 1, 1)
    return MotionNetwork(
        [{"name": name, "unit": "s" if name == "duration" else "%"} for name in NAMES],
        network,
        torch.zeros(1, 3, network.genes),
        torch.tensor([50.0] * 4 + [3.0]),
        torch.ones(3),
        "residual-twist",
        drive=DriveModel(
            *(torch.tensor([law, law]) for law in laws),
            torch.zeros(2, CURVES),
            torch.tensor([0.04]),
            torch.cat([torch.tensor(kinematics).double() @ other, torch.zeros(3, 3)]),
        ),
    )


@pytest.mark.slow
def test_a_trial_is_judged_and_tracked():
    reality = make_reality("virtual-nxt", FAMILY, TASK, lab_seed=3)
    genes = FAMILY.encode(COMMANDS)
    result, again = reality.trial(genes, 1), reality.trial(genes, 1)
    assert np.array_equal(result.poses, again.poses, equal_nan=True)
    assert np.isnan(result.poses).all(axis=1).tolist() == [False, True, False, False, False]
    assert result.fitness == pytest.approx(1 - 0.2)  # the first rectangle, with the first command
    # 20 cm/s, and 2.3 rad/s to the right for 0.6 s; the lags take some of both.
    x, y, heading = TASK.start
    assert result.poses[0] == pytest.approx([x, y + 0.28, heading], abs=0.03)
    assert result.poses[0, 2] - result.poses[2, 2] == pytest.approx(1.15, abs=0.2)
    assert reality.trial(genes, 2).poses[0, 1] != result.poses[0, 1]
    # The left wheel is the smaller, so it turns left.
    worn = make_reality("virtual-nxt", FAMILY, TASK, lab_seed=3, worn=0.1).trial(genes, 1)
    assert worn.poses[0, 2] > result.poses[0, 2] + 0.1
    assert json.dumps(reality.describe())


def test_what_a_plan_without_commands_does():
    reality = make_reality("virtual-nxt", FAMILY, TASK)
    result = reality.trial(FAMILY.encode([None] * 4), 0)
    assert result.poses.tolist() == [list(TASK.start)] * 5
    assert result.fitness == 0.0
    check_reality(reality, FAMILY.encode([None] * 4))


def test_what_cannot_be_is_refused():
    with pytest.raises(UserError, match=r"slip: expected a number from 0 to 0.9, found 1"):
        make_reality("virtual-nxt", FAMILY, TASK, slip=1.0)
    with pytest.raises(UserError, match="has two wheels; a controller of the kind gait commands"):
        make_reality("virtual-nxt", Gait(), TASK)


@pytest.mark.slow  # a trial in the lab, filmed
def test_a_network_is_tracked_at_every_step():
    task = GoTo(goals=((0.2, 0.1, 0.0),), seconds=1.0)
    family = Network(("x", "y", "goal_x"))
    reality = make_reality("virtual-nxt", family, task, lab_seed=3)
    result = reality.trial(np.full(family.genes, 0.4), 0)
    assert result.poses.shape == (task.episode.steps + (task.episode.rest > 0), 3)
    assert np.isfinite(result.poses).all()
    assert np.ptp(result.poses[:, :2], axis=0).max() > 0.02


def write_plan(folder):
    """Write COMMANDS as a plan without predictions."""
    start = list(TASK.start)
    predicted = {"poses": [start] * 4, "rest": start, "fitness": 0.0, "completes": False}
    plan = FixedPlan(COMMANDS)
    SavedController(plan, np.empty(0), TASK.describe(), TASK.start, predicted).write(folder)


class Wheels(IdealWheels):
    """Wheels with a parameter; from the second command on the pose is NaN."""

    def __init__(self, scale=1.0):
        self.scale = scale

    @property
    def parameters(self):
        return [Adjustable("scale", self.scale, 0.5, 2.0)]

    def adjusted(self, values):
        return Wheels(*values.tolist())

    def step(self, state, command, generator=None):
        lost = (state[:, 3:] != 0.0).any(dim=1, keepdim=True)
        return super().step(state, command) + torch.where(lost, np.nan, 0.0)


def run_in_wheels(out, reality, start):
    settings = settings_named(
        "paper", generations=2, candidates=2, trials=1, policy_steps=0, adapt_generations=2
    )
    return back_to_reality(
        Wheels(), TASK, FAMILY, reality, out=out, start=start, settings=settings, progress=False
    )


@pytest.mark.slow
def test_another_network_in_the_same_folder_is_not_gone_on_with(tmp_path):
    answers = iter([0.5])

    def lost(genes):
        for answer in answers:
            return answer
        raise RobotError("the robot is gone")

    def run(**others):
        return back_to_reality(
            tmp_path / "simulator", TASK, FAMILY, lost, out=tmp_path / "out",
            start=FAMILY.encode(COMMANDS), progress=False,
            settings=settings_named("paper", trials=1, generations=2), **others,
        )  # fmt: skip

    write_simulator(nxt(), tmp_path / "simulator")
    with pytest.raises(RobotError):
        run()
    shutil.rmtree(tmp_path / "simulator")
    write_simulator(nxt(forward=1.2), tmp_path / "simulator")
    with pytest.raises(UserError, match=r"was begun with simulator\.sha256 = "):
        run(resume=True)


def test_the_best_plan_may_blow_up_in_the_simulator(tmp_path):
    """It is written with the last pose that was predicted."""
    genes = FAMILY.encode(COMMANDS)
    run_in_wheels(tmp_path / "out", lambda row: float((row == genes).all()), genes)
    saved = read_controller(tmp_path / "out" / "controller")
    poses = np.array(saved.predicted["poses"])
    assert math.isfinite(saved.predicted["fitness"])
    assert poses.shape == (4, 3)
    assert poses[1] == pytest.approx([TASK.start[0], TASK.start[1] + 0.3, TASK.start[2]])
    assert saved.predicted["rest"] == poses[3].tolist() == poses[2].tolist() == poses[1].tolist()


def test_a_best_plan_without_commands_is_not_written_but_all_else_is(tmp_path):
    nothing = FAMILY.encode([None] * 4)
    content = run_in_wheels(tmp_path / "out", lambda row: -float((row != nothing).any()), nothing)
    assert content["best"]["fitness"] == 0.0
    written = [path.name for path in (tmp_path / "out").iterdir()]
    assert sorted(written) == ["back-to-reality.json", "trials.jsonl"]


def test_a_plan_to_start_from(tmp_path):
    write_plan(tmp_path / "plan")
    longer = Plan(slots=6)
    commands = commands_of(longer, start_genes(longer, tmp_path / "plan"))
    assert commands[4:] == [None, None]
    given = [one for one in commands if one is not None]
    assert np.array(given) == pytest.approx(np.array([COMMANDS[0], *COMMANDS[2:]]))
    with pytest.raises(UserError, match="has 4 commands; expected at most 3"):
        start_genes(Plan(slots=3), tmp_path / "plan")


@pytest.mark.slow  # seven trials in the lab, filmed
def test_a_handful_of_trials_bring_a_simulator_of_another_floor_back(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_simulator(nxt(forward=1.2, turn=0.85, yaw=0.2), "simulator")
    write_plan("plan")
    line = (
        "back-to-reality --simulator simulator --task nine-rectangles --controller plan"
        " --commands 4 --reality virtual-nxt --lab-seed 3 --slip 0.08 --worn 0.02 --start plan"
        " -o found --settings paper --generations 6 --search-population 10 --candidates 3"
        " --adapt-generations 30 --adapt-population 20 --policy-steps 0 --trials 1 --json"
    )
    monkeypatch.setattr(sys, "argv", ["neurosim", *line.split()])
    main()
    content = json.loads(capsys.readouterr().out)
    assert content["trials"] <= 7
    adapted = content["cycles"][0]["L3"]
    for plans, fraction in (("compared", 0.4), ("held_out", 0.5)):
        assert adapted[plans]["after"]["poses"] < fraction * adapted[plans]["before"]["poses"]
    simulator = read_simulator("found/simulator")
    assert vars(simulator.correction) == pytest.approx(adapted["parameters"][0])
    rows = [json.loads(row) for row in (tmp_path / "found/trials.jsonl").read_text().splitlines()]
    assert all(len(row["poses"]) == 5 for row in rows[1:])
