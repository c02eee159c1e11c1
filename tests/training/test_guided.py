from dataclasses import replace

import numpy as np
import pytest
import torch
from driven_robot import drive_data

from neurosim.base import se2
from neurosim.recording.commands import Command, FixedCommands, RandomCommands
from neurosim.training.guided import (
    Committee,
    GuidedSettings,
    Place,
    choose,
    motor_data,
    taken_away,
)

QUICK = GuidedSettings(members=6, candidates=6)


@pytest.fixture(scope="module")
def committee(robot_data):
    return Committee(motor_data(*robot_data(90, 1)), 5, QUICK)


class Believer:
    """Predicts straight motion, 0.5 m/s at full speed, and prefers long distances."""

    def displacements(self, x):
        forward = 0.5 * x[:, 2] / 100 * x[:, 4]
        return torch.stack([forward, 0 * forward, 0 * forward], dim=1)[None]

    def worth(self, x, predicted):
        return (x[:, 2] * x[:, 4]).abs()


@pytest.mark.slow
def test_what_was_never_seen_is_worth_most():
    data = drive_data(900, wobble=0.2)
    forwards = (data.x[:, 2:4] >= 0).all(1)
    assert forwards.sum() > 30
    committee = Committee(replace(data.part(forwards), within=None), 1, QUICK)
    fresh = drive_data(400, seed=3).x.numpy()
    inputs = torch.tensor(fresh)
    worth = committee.worth(inputs, committee.displacements(inputs)).numpy()
    moving = np.abs(fresh[:, 2:4]).sum(1) > 0
    seen = moving & (fresh[:, 2:4] >= 0).all(1)
    unseen = moving & (fresh[:, 2:4] < 0).all(1)
    assert np.median(worth[unseen]) > 2 * np.median(worth[seen])


def test_what_an_outcome_takes_away_is_what_conditioning_on_it_leaves_out():
    variance, noise = 0.3, 0.8
    rng = np.random.default_rng(0)
    belief = rng.normal(0, np.sqrt(variance), 400_000)
    outcome = belief + rng.normal(0, np.sqrt(noise), belief.shape)
    slope, offset = np.polyfit(outcome, belief, 1)
    left = np.var(belief - slope * outcome - offset)
    result = taken_away(torch.tensor(variance), torch.tensor(noise)).item()
    assert result == pytest.approx(variance - left, rel=0.02)
    assert taken_away(torch.tensor(0.0), torch.tensor(noise)) == 0.0


@pytest.mark.slow
def test_the_same_seed_chooses_the_same_commands(committee, robot_data):
    again = Committee(motor_data(*robot_data(90, 1)), 5, QUICK)
    source = RandomCommands(seed=3)
    assert choose(again, source, range(20, 30), settings=QUICK) == choose(
        committee, source, range(20, 30), settings=QUICK
    )


def test_each_command_is_the_best_of_its_candidates_after_the_one_before(committee):
    source = RandomCommands(seed=3)
    speeds = (0.0, 0.0)
    for number, command in zip(
        range(20, 30), choose(committee, source, range(20, 30), settings=QUICK), strict=True
    ):
        commands_sampled = [source.command(6 * number + k) for k in range(6)]
        x = torch.tensor([[*speeds, *c.row] for c in commands_sampled])
        predicted = committee.displacements(x.double())
        assert command == commands_sampled[int(committee.worth(x.double(), predicted).argmax())]
        speeds = command.numbers


def test_chosen_commands_keep_to_the_source_s_limits_and_to_the_rectangle(committee):
    source = RandomCommands(40, (0.5, 2.0), seed=8)
    place = Place((0.5, -0.2, 1.0), 2.0, 1.4)
    commands = choose(committee, source, range(20, 60), place, GuidedSettings(candidates=12))
    pose, speeds = np.array(place.pose), (0.0, 0.0)
    for command in commands:
        assert max(map(abs, command.numbers)) <= 40
        assert 0.5 <= command.duration <= 2.0
        x = torch.tensor([[*speeds, *command.row]])
        moved = committee.displacements(x.double()).mean(0).numpy()[0]
        pose, speeds = se2.compose(pose, moved), command.numbers
        assert (np.abs(pose[:2]) <= [1.0, 0.7]).all()


def test_a_command_that_leads_out_is_taken_only_if_all_do_and_then_the_nearest():
    ahead = [Command((50, 50), 2.0), Command((50, 50), 1.0), Command((10, 10), 1.0)]
    settings = GuidedSettings(candidates=3)

    def first(x):
        place = Place((x, 0.0, 0.0), 2.0, 1.0)
        return choose(Believer(), FixedCommands(ahead), [0], place, settings)[0]

    assert first(0.0) == ahead[0]  # 0.5 m ahead is inside
    assert first(0.7) == ahead[1]  # 0.25 m is, 0.5 m is not
    assert first(0.999) == ahead[2]  # nothing is
    assert choose(Believer(), FixedCommands(ahead), [0], None, settings) == [ahead[0]]
