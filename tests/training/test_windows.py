"""Rows that follow one another: driven, cut into windows, learned from."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from neurosim.base import se2
from neurosim.controllers import make_controller
from neurosim.simulators.motion.drive import CURVES, DriveModel, Underway
from neurosim.simulators.motion.noise import CommandFeatures
from neurosim.training.base import Within
from neurosim.training.evaluate import compare, predict
from neurosim.training.train import domain_of, learn, training_data
from neurosim.training.trainers import combined
from neurosim.training.trainers.drive_fit import Actuators, Fit
from neurosim.training.trainers.windows import LENGTHS, Chains, runs_of, windows_of
from tracking.datasets.dataset import make
from tracking.datasets.logs import Log, Settings, any_rows_of, inputs_of

NAMES = ("prev_v", "prev_w", "v", "w", "duration")


def drive_model(delay=0.15, lag=(0.1, 0.3)):
    twist = torch.zeros(5, 3, dtype=torch.float64)
    twist[0, 0], twist[1, 2] = 0.5, 2.0
    ones = torch.ones(2, dtype=torch.float64)
    slower = torch.tensor([1.0, 1.5], dtype=torch.float64)
    laws = (
        torch.tensor(lag, dtype=torch.float64),
        slower,
        slower,
        8 * ones,
        0.02 * ones,
    )
    curve = torch.zeros(2, CURVES, dtype=torch.float64)
    curve[:, 0], curve[:, 3] = -0.1, 0.05
    return DriveModel(*laws, curve, torch.tensor([delay], dtype=torch.float64), twist)


def actuators_of(model: DriveModel) -> Actuators:
    names = (*DriveModel.LAWS, "curve", "delay", "drag")
    laws = (getattr(model, name).numpy()[None] for name in names)
    return Actuators(np.arange(2), np.ones(2), np.zeros((1, 2)), *laws)


def chains(rng, rows=60, breaks=(0, 25)):
    time = torch.tensor(rng.uniform(0.1, 0.6, rows))
    commanded = torch.tensor(rng.uniform(-1, 1, (rows, 2)))
    before = torch.cat([torch.zeros(1, 2, dtype=torch.float64), commanded[:-1]])
    joined = torch.ones(rows, dtype=torch.bool)
    joined[list(breaks)] = False
    x = torch.cat([before, commanded, time[:, None] / 3.0], 1)
    y = torch.zeros(rows, 3, dtype=torch.float64)
    y[:, 0] = 1.0
    return Chains.of(x, y, joined, CommandFeatures.of(NAMES), 3.0), x


@pytest.mark.parametrize("drift", [(0.0, 0.0), (0.7, 0.7), (0.0, 0.7), (0.4, 0.7)])
def test_rows_are_driven_as_the_drive_model_is_stepped(drift):
    rows, x = chains(np.random.default_rng(0))
    kinematics = drive_model().kinematics.clone()
    kinematics[3, :2] = torch.tensor([-0.2, -0.3])
    late = torch.tensor(drift, dtype=torch.float64)
    model = replace(drive_model(), kinematics=kinematics, drift=late)
    rows = replace(rows, drift=drift)
    actuators = actuators_of(model)
    none = torch.zeros(2, dtype=torch.float64)
    inputs, under = rows.inputs(Fit(model, rows, none, none, True, actuators), x)
    features, lasts, row, states = rows.driven(actuators.one(0))
    goals = model.shaped(rows.commanded)
    state = None
    for i in range(len(rows.time)):
        time, goal = rows.time[i : i + 1], goals[i : i + 1]
        if not rows.joined[i]:
            before = model.shaped(rows.before[i : i + 1])
            state = model.begun(before, before)
            # As many commands may be pending as in a simulator.
            missing = model.slots - state.goals.shape[1]
            state = state._replace(
                goals=torch.cat([state.goals[:, :1].repeat(1, missing, 1), state.goals], 1),
                acts=torch.zeros(1, model.slots, dtype=torch.float64),
            )
        assert states[i] == pytest.approx(torch.cat([state.speed, state.push], 1)[0], abs=1e-9)
        pieces = [piece.features for piece in model.pieces(state, goal, time)]
        # The distance does not depend on how the command is cut.
        assert features[row == i].sum(0)[:2] == pytest.approx(sum(pieces)[0, :2], abs=1e-9)
        assert lasts[row == i].sum() == pytest.approx(float(time))
        # The drift does a little.
        late_now = [own for own, lag in zip(under.drift[i].tolist(), drift, strict=False) if lag]
        assert late_now == pytest.approx(
            [own for own, lag in zip(state.drift[0].tolist(), drift, strict=False) if lag], abs=0.01
        )
        # Neither do the pending commands.
        again = Underway(*(part[i : i + 1] for part in under))
        assert model.reached(again, goal, time)[0] == pytest.approx(
            model.reached(state, goal, time)[0], abs=1e-9
        )
        state = model.after(state, goal, time, model.reached(state, goal, time))
    assert inputs[:, 2:4] == pytest.approx(goals)


def test_windows_by_hand():
    time = torch.full((12,), 0.25, dtype=torch.float64)
    joined = torch.tensor([False, *[True] * 7, False, *[True] * 3])
    windows = windows_of(time, joined)
    result = list(zip(*(part.tolist() for part in windows[:3]), strict=True))
    # Windows of 0.25 s are single rows; windows of about 1 s begin at each row; none crosses the
    # break.
    assert [f for f in result if f[2] == 0] == [(k, k + 1, 0) for k in range(12)]
    assert [f for f in result if f[2] == 2] == [(k, k + 4, 2) for k in (0, 1, 2, 3, 4)] + [
        (5, 8, 2),
        (8, 12, 2),
        (9, 12, 2),
    ]
    assert [f for f in result if f[2] == 3] == [(0, 8, 3), (2, 8, 3)]
    assert all(not first < 8 < end for first, end, _ in result)
    # Windows of a length that do not overlap have the weight of their duration over the longest.
    assert windows.weight[:12].tolist() == pytest.approx([0.25 / 2.0 / len(LENGTHS)] * 12)


def test_sums_over_windows_and_windows_that_share_no_row_by_hand():
    windows = windows_of(
        torch.full((9,), 0.125, dtype=torch.float64), torch.tensor([False] + [True] * 8)
    )
    sums = windows.sums(2.0 ** torch.arange(9))
    assert sums[windows.kind == 0].tolist() == [*(3 * 2.0**n for n in range(8)), 256.0]
    assert (
        windows.sums(torch.ones(2, 9), 1)[:, windows.kind == 1].tolist() == [[4.0] * 6 + [3.0]] * 2
    )
    shortest, longer = windows.separate(), windows.separate(1)
    assert windows.first[shortest].tolist() == [0, 2, 4, 6, 8]
    assert windows.end[shortest].tolist() == [2, 4, 6, 8, 9]
    assert windows.first[longer].tolist() == [0, 4]
    assert windows.end[longer].tolist() == [4, 8]
    some = windows.some(5)
    assert len(some.first) <= 5
    assert some.weight.tolist() == pytest.approx(
        (len(windows.first) + 4) // 5 * windows.weight[:: (len(windows.first) + 4) // 5]
    )


def test_stretches_of_a_log_keep_their_windows():
    rng, rows = np.random.default_rng(0), 900
    time = torch.tensor(rng.uniform(0.4, 0.6, rows))
    x = torch.cat([torch.tensor(rng.uniform(-1, 1, (rows, 4))), time[:, None] / 3.0], 1)
    y = torch.ones(rows, 3, dtype=torch.float64)
    joined = torch.ones(rows, dtype=torch.bool)
    joined[[0, 330]] = False
    # Every second row is cut at a pose within it.
    odd = torch.arange(1, rows, 2)
    within = Within(odd, 0.3 * time[odd], 0.3 * y[odd])
    log = Chains.of(x, y, joined, CommandFeatures.of(NAMES), 3.0, within)
    log = log.weighted(torch.arange(rows, dtype=torch.float64))
    # 80 rows that count as much as 400 short ones, which are 266 rows: two stretches.
    some = log.some(80)
    kept = [*range(133), *range(450, 583)]
    assert some.weight.tolist() == [float(row) for row in kept]
    assert torch.nonzero(~some.joined).flatten().tolist() == [0, 199]
    row_of = {duration: row for row, duration in enumerate(log.time.tolist())}
    rows_of = [row_of[duration] for duration in some.time.tolist()]
    assert rows_of == [*range(199), *range(675, 874)]
    assert [rows_of[place] for place in some.whole] == [int(log.whole[row]) for row in kept]
    known = {
        (first, end)
        for first, end in zip(log.windows.first.tolist(), log.windows.end.tolist(), strict=True)
        if end <= 199 or (first >= 675 and end <= 874)
    }
    ends = zip(some.windows.first.tolist(), some.windows.end.tolist(), strict=True)
    assert {(rows_of[first], rows_of[end - 1] + 1) for first, end in ends} == known
    assert torch.equal(log.some(900).windows.first, log.windows.first)


def test_runs_of_commands_by_hand():
    runs = runs_of(12)
    result = list(zip(*(part.tolist() for part in runs[:3]), strict=True))
    assert result[:12] == [(k, k + 1, 0) for k in range(12)]
    assert [one for one in result if one[2] == 1] == [(k, k + 3, 1) for k in range(10)]
    assert [one for one in result if one[2] == 2] == [(0, 10, 2), (2, 12, 2)]
    # Each length has a third of the weight, and runs of ten that do not overlap would weigh 1.
    assert runs.weight[runs.kind == 0].sum() == pytest.approx(12 / 10 / 3)
    assert runs.weight[runs.kind == 2].tolist() == pytest.approx([2 / 10 / 3] * 2)
    assert len(runs_of(1).first) == 1


def joystick(rng, seconds, model, held=(2, 8), dt=0.05, slower=0.0, blur=0.001):
    """Return a log of a robot of the drive model; commands change every 0.1 to 0.4 s.

    With ``slower`` it loses this fraction of its speed while it is not to turn. ``blur`` is the
    standard deviation of the poses' errors (m, m, rad).
    """
    count = round(seconds / dt)
    random = np.clip(np.cumsum(rng.normal(0, 0.4, (count, 2)), 0) % 4 - 2, -1, 1)
    commands = np.repeat(random, rng.integers(*held, count), axis=0)[:count]
    time = np.full(count, dt)
    tell = torch.tensor(commands)
    before = torch.cat([tell[:1], tell[:-1]])
    joined = torch.tensor([False, *[True] * (count - 1)])
    x = torch.cat([before, tell, torch.tensor(time)[:, None]], 1)
    y = torch.ones(count, 3, dtype=torch.float64)
    rows = Chains.of(x, y, joined, CommandFeatures.of(NAMES), 1.0)
    features, _, row, _ = rows.driven(actuators_of(model).one(0))
    pose, poses = np.zeros(3), [np.zeros(3)]
    twists = (features @ model.kinematics).numpy()
    twists[:, 0] *= 1.0 - slower * np.exp(-((commands[row.numpy(), 1] / 0.2) ** 2))
    for twist in twists:
        pose = se2.compose(pose, se2.exp(twist))
        poses.append(pose)
    ends = np.append(np.searchsorted(row.numpy(), np.arange(count)), len(row))
    poses = np.array(poses)[ends[:-1]] + rng.normal(0, blur, (count, 3))
    moment = np.arange(count) * dt
    return Log("hand", moment, commands, np.ones(count, bool), moment, poses)


def dataset_of(log, **settings):
    rows, left_out, windows = any_rows_of([log], ("v", "w"), Settings(**settings))
    inputs = inputs_of({"v": "", "w": ""})
    return make(rows, inputs, sources=[], left_out=left_out, settings={}, windows=windows)


@pytest.mark.slow
def test_a_robot_is_learned_from_commands_that_never_stay():
    rng = np.random.default_rng(2)
    model = drive_model(0.1, (0.15, 0.25))
    data = dataset_of(joystick(rng, 80.0, model))
    assert data.joined.mean() > 0.99
    simulator = learn(training_data(data), 0, members=1, noise=False)
    assert float(simulator.drive.delay) == pytest.approx(0.1, abs=0.03)
    assert simulator.drive.lag.tolist() == pytest.approx([0.15, 0.25], abs=0.05)
    other = dataset_of(joystick(np.random.default_rng(3), 40.0, model))
    # Pieces of 0.1 s are composed to windows: commands may last as long.
    simulator.known = domain_of(simulator, training_data(data), None)
    longest = float(data.table["duration"].max())
    assert simulator.domain["duration"] == (0.0, longest)
    shorter = training_data(data)
    shorter = shorter.part(torch.nonzero(shorter.x[:, -1] < 0.5).flatten())
    simulator.known = domain_of(simulator, shorter, None)
    assert simulator.domain["duration"] == (0.0, 2.0)
    assert simulator.supported(np.array([[0.2, 0.3, 0.05], [0.2, 0.3, 2.0]])).all()
    assert make_controller("plan", simulator).durations == (0.5, 2.0)
    compared = compare(simulator, data, other)
    assert compared.window == 1.0
    errors = compared.errors()
    # In windows of 1 s, with distances of 20 cm and turns of 60 degrees.
    assert errors["dx"]["mean_absolute_error"] < 1.0
    assert errors["dtheta"]["mean_absolute_error"] < 3.0
    # The errors of poses that it was not given add up.
    moved = predict(simulator, other)
    assert moved[:, 2].sum() == pytest.approx(other.output_array()[:, 2].sum(), abs=0.5)


@pytest.mark.slow
def test_what_the_poses_errors_hide_in_a_row_is_learned_from_windows():
    """On a straight line the robot loses 30 %: 2 cm of a row, whose poses are off by 4 mm each."""
    given = {"model": drive_model(0.1, (0.15, 0.25)), "slower": 0.3, "blur": 0.004}
    data = dataset_of(joystick(np.random.default_rng(0), 200.0, **given))
    other = dataset_of(joystick(np.random.default_rng(1), 60.0, **{**given, "blur": 0.0}))
    errors = []
    for without in ((), ("process",)):
        simulator = learn(training_data(data), 0, members=1, noise=False, without=without)
        errors.append(compare(simulator, data, other).errors()["dx"]["mean_absolute_error"])
    assert errors[0] < 0.65 * errors[1]


def ship(seconds, lag, held, dt=0.05, push=0.0):
    """Return the log of a ship that answers within seconds and drifts with these lags, s.

    The first is that of what a turn costs it ahead. Its commands are held for some steps, from one
    to another number of them. ``push`` is the size of a current that turns it (rad/s), and that
    changes within 10 s.
    """
    rng, steps = np.random.default_rng(4), 25
    count, h = round(seconds / dt), dt / steps
    commands = rng.uniform((0.2, -1.0), (1.0, 1.0), (count, 2))
    commands = np.repeat(commands, rng.integers(*held, count), axis=0)[:count]
    pushes, current = np.random.default_rng(5).normal(0, push * np.sqrt(dt / 5.0), count), 0.0
    speed, late, pose, poses = np.zeros(2), np.zeros(2), np.zeros(3), []
    for command, more in zip(commands, pushes, strict=True):
        poses.append(pose)
        current += more - current * dt / 10.0
        for _ in range(steps):
            speed = speed + (command - speed) * h / np.array([1.5, 0.8])
            steady = np.array([-0.3 * speed[1], -0.5 * speed[0]]) * speed[1]
            late = late + (steady - late) * np.minimum(h / np.maximum(lag, 1e-9), 1.0)
            twist = np.array([0.8 * speed[0] + late[0], late[1], 0.6 * speed[1] + current])
            pose = se2.compose(pose, se2.exp(h * twist))
    poses = np.array(poses) + rng.normal(0, (0.002, 0.002, 0.002), (count, 3))
    seen = np.ones(count, bool)
    return Log("ship", dt * np.arange(count), commands, seen, dt * np.arange(count), poses)


@pytest.mark.slow
@pytest.mark.parametrize("lag", [(0.0, 0.0), (1.2, 1.2), (2.2, 0.8), (1.2, 0.0)])
@pytest.mark.parametrize(("seconds", "held"), [(90.0, (3, 15)), (300.0, (12, 60))])
def test_a_ships_drift_is_learned(seconds, held, lag):
    data = dataset_of(ship(seconds, lag, held))
    assert data.meta["windows"] == (held[0] < 10)
    simulator = learn(training_data(data), 0, members=1, noise=False)
    assert simulator.drive.drift.tolist() == pytest.approx(lag, rel=0.25)
    assert ("drift_x" in simulator.state_names) == any(lag)
    if lag[1]:
        plain = learn(training_data(data), 0, members=1, noise=False, without=("drift",))
        off, more = (compare(one, data, data).errors() for one in (simulator, plain))
        # That it stood first, what no row tells, is a part of the error ahead.
        for name, less in (("dx", 0.8), ("dy", 0.2)):
            assert off[name]["mean_absolute_error"] < less * more[name]["mean_absolute_error"]


@pytest.mark.slow
def test_a_current_is_not_a_floor_but_lasts_from_one_held_command_to_the_next(monkeypatch):
    data = dataset_of(ship(400.0, (0.0, 0.0), (12, 25), push=0.1))
    assert not data.meta["windows"]
    simulator = learn(training_data(data), 0, members=3)
    assert simulator.floor is None
    assert simulator.excess.lasts[2] >= 3.2
    assert simulator.excess.believed(0.4)[2, 2] >= 0.7
    monkeypatch.setattr(combined.CombinedTrainer, "_glides", False)
    taken = learn(training_data(data), 0, members=3)
    assert taken.floor is not None
    assert taken.excess is None


@pytest.mark.slow
def test_intervals_of_windows_hold_for_drives_of_the_simulator_itself():
    data = dataset_of(joystick(np.random.default_rng(2), 40.0, drive_model(0.1, (0.15, 0.25))))
    simulator = learn(training_data(data), 0, members=3)
    inputs, drives = data.input_array(), 30
    columns = [data.inputs.index(name) for name in ("v", "w", "duration")]
    commands = torch.from_numpy(inputs[:, columns])
    generator = torch.Generator().manual_seed(5)
    state, moved = simulator.start(torch.zeros(drives, 3), generator), []
    for command in commands:
        now = simulator.step(state, command.repeat(drives, 1), generator)
        moved.append(se2.between(state[:, :3].numpy(), now[:, :3].numpy()))
        state = now
    held = []
    for own in np.stack(moved, axis=1):
        table = data.table.copy()
        table[["dx", "dy", "dtheta"]] = own
        driven = replace(data, table=table)
        compared = compare(simulator, driven, driven)
        held.append(compared.central)
    # The first window is the motion from its first row's beginning to its last one's end.
    pose, lasted = np.zeros(3), 0.0
    for each, lasts in zip(own, inputs[:, -1], strict=True):
        if lasted + lasts / 2.0 > 1.0:
            break
        pose, lasted = se2.compose(pose, each), lasted + lasts
    assert compared.actual[0] == pytest.approx(pose)
    ranks = np.concatenate(held)
    for level in (0.5, 0.8, 0.95):
        assert (ranks <= level).mean(0) == pytest.approx(np.full(3, level), abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(("seconds", "farther"), [(10.0, (2.5, 5.5)), (80.0, (1.1, 1.7))])
def test_members_differ_more_where_a_log_is_short(monkeypatch, seconds, farther):
    """Usually 1 + 20/n times, n: blocks of 2 s."""
    log = joystick(np.random.default_rng(2), seconds, drive_model(0.1, (0.15, 0.25)))
    data, apart = dataset_of(log, windows=True), []
    for blocks in (combined.FEW_BLOCKS, 0.0):
        monkeypatch.setattr(combined, "FEW_BLOCKS", blocks)
        simulator = learn(training_data(data), 0)
        starts = simulator.start_as(torch.zeros(8, 3), torch.arange(8))
        ends = simulator.step(starts, torch.tensor([[1.0, 0.5, 1.0]]).repeat(8, 1))
        apart.append(ends[:, :3].std(0))
    ratio = apart[0] / apart[1]
    assert (farther[0] < ratio).all()
    assert (ratio < farther[1]).all()


def test_windows_of_the_ideal_robot_stand_beside_those_of_the_simulator():
    data = dataset_of(joystick(np.random.default_rng(2), 20.0, drive_model(0.1, (0.15, 0.25))))
    settings = {"generations": 1, "population": 20, "tournament": 4}
    simulator = learn(training_data(data), 0, trainer="ga", **settings)
    compared = compare(simulator, data, data)
    assert compared.central is None
    assert compared.coverage() is None
    _, ideal = compared.baseline
    assert ideal.shape == compared.actual.shape == compared.predicted.shape
    # A second of the fitted unicycle, not a tenth: its distances are the robot's.
    assert np.abs(ideal[:, 0]).mean() == pytest.approx(
        np.abs(compared.actual[:, 0]).mean(), rel=0.3
    )
