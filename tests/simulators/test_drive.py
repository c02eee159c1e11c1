"""The drive model: how speeds approach their targets, and how a command may be cut."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from given_plans import GivenPlans, expected, sampled_poses
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_networks import (
    LONGEST,
    NAMES,
    drive_model,
    kernel_units,
    normal,
    random_motion_network,
)
from numba import njit
from safetensors.numpy import load_file, save_file

from neurosim.base.errors import FileError
from neurosim.base.se2 import tensors as se2
from neurosim.base.trajectory import Draws, Episode
from neurosim.controllers import Network
from neurosim.simulators import MotionNetwork, read_simulator
from neurosim.simulators.motion import kernels
from neurosim.simulators.motion.drive import ALIKE, MOVING, DriveModel, Underway, motion_features
from neurosim.simulators.motion.files import KERNEL, write_motion
from neurosim.simulators.motion.kernel_units import KernelUnits
from neurosim.simulators.motion.network import can_drive, chain
from neurosim.simulators.motion.noise import CommandFeatures

MEMBERS = torch.tensor([-1, 0, 1, 2])
POSES = 0.5 * normal(7, 4, 3)


def double(values):
    return torch.tensor(values, dtype=torch.float64)


def alike(
    lag=0.2,
    slowing=1.0,
    braking=1.0,
    rate=100.0,
    stick=0.0,
    curve=(0.0,) * 6,
    delay=0.0,
    kinematics=None,
    drag=0.0,
    drift=(0.0, 0.0),
):
    """Return a drive model of two actuators that are alike, of a differential drive."""
    if kinematics is None:
        kinematics = [[0.15, 0.0, -1.0], [0.15, 0.0, 1.0], *[[0.0] * 3] * 3]
    laws = [double([value, value]) for value in (lag, slowing, braking, rate, stick)]
    rest = double([curve, curve]), double([delay]), double(kinematics)
    return DriveModel(*laws, *rest, drag=double([drag, drag]), drift=double(drift))


def pairs(low, high):
    return st.tuples(st.floats(low, high), st.floats(low, high)).map(double)


def speeds():
    """Return two fractions of full speed, none so small that no dead band would hold it."""
    return st.tuples(*[st.integers(-500, 500)] * 2).map(lambda pair: double(pair) / 500)


@st.composite
def drive_models(draw):
    """Return a drive model of two actuators."""
    return drive_model(
        draw(st.integers(0, 99)),
        lag=draw(pairs(0.03, 0.5)),
        slowing=draw(pairs(0.4, 2.0)),
        braking=draw(pairs(0.3, 2.0)),
        rate=draw(pairs(0.5, 20.0)),
        stick=draw(pairs(0.0, 0.05)),
        drag=draw(st.just(double([0.0, 0.0])) | pairs(0.0, 3.0)),
        delay=double([draw(st.floats(0.0, 0.15))]),
    )


def integrated(drive, commands, dt=5e-4):
    """Return the speeds [T + 1, B, C] at equal times of actuators that stand at first.

    The law, integrated by the midpoint method in steps of ``dt`` s: each command begins to act a
    delay after it was given, and acts for as long.

    Args:
        drive: the drive model.
        commands: goals and duration, [B, K, C + 1], durations and delay multiples of ``dt``.
    """
    names = "lag", "slowing", "braking", "rate", "stick", "drag"
    laws = np.stack([getattr(drive, name).numpy() for name in names], 1)
    commands = np.asarray(commands)
    steps = round(commands[..., -1].sum(1).max() / dt)
    return np.stack([_integrated(laws, float(drive.delay), one, dt, steps) for one in commands], 1)


@njit
def _integrated(laws, delay, commands, dt, steps):
    out = np.zeros((steps + 1, len(laws)))
    for c in range(len(laws)):
        lag, slowing, braking, rate, stick, drag = laws[c]
        speed = push = goal = held = 0.0
        acts, begins = 0, delay
        for n in range(steps):
            while acts < len(commands) and begins < (n + 0.5) * dt:
                goal, held = commands[acts, c], 0.0
                begins += commands[acts, -1]
                acts += 1
                push = 0.0 if speed * goal < 0.0 else push
                # Friction holds a wheel that already moves the same way for less time, in
                # proportion to its speed.
                if goal != 0.0 and (speed * goal < 0.0 or abs(speed) < abs(goal)):
                    along = speed * np.sign(goal) / MOVING
                    held = min(max(1.0 - along, 0.0), 1.0) * stick - push
            step = dt
            if held > 1e-12 and speed * goal >= 0.0:
                waits = min(held / abs(goal), dt)
                push, held, step = push + waits * abs(goal), held - waits * abs(goal), dt - waits
            at = speed
            for half in (0.5, 1.0):
                own = lag * slowing if abs(goal) < abs(at) - ALIKE else lag
                own = lag * braking if goal == 0.0 else own
                faster = abs(goal) + abs(at)
                if at * goal < 0.0:
                    faster = faster / 2.0 if abs(at) > abs(goal) else abs(goal)
                change = (goal - at) * (1.0 + drag * faster) / own
                at = speed + half * step * min(max(change, -rate), rate)
            # When its speed crosses zero it is held.
            speed = 0.0 if speed * goal < 0.0 and at * goal > 0.0 and held > 0.0 else at
            if goal == 0.0 or abs(speed) >= MOVING:
                push = 0.0
            out[n + 1, c] = speed
    return out


def integrated_pose(drive, speeds, dt=5e-4):
    """Return the displacement [3] of a robot whose actuators have speeds [T + 1, C]."""
    middle = torch.from_numpy(0.5 * (speeds[1:] + speeds[:-1]))
    span = torch.full((len(middle),), dt, dtype=torch.float64)
    vx, vy, turn = (motion_features(middle * dt, span, drive.turning) @ drive.twists).numpy().T
    heading = np.cumsum(turn) - 0.5 * turn
    cos, sin = np.cos(heading), np.sin(heading)
    return np.array([(cos * vx - sin * vy).sum(), (sin * vx + cos * vy).sum(), turn.sum()])


def reached(drive, before, target, time):
    """Return the speeds [B, C] after a command that acts at once."""
    return replace(drive, delay=double([0.0])).reached(drive.begun(before), target, time)[0]


def test_an_exponential_worked_by_hand():
    before, target = double([[0.0, 0.8]]), double([[0.5, 0.2]])
    drive = alike(lag=0.2, slowing=0.5, delay=0.1)
    left, missed, settling, _ = drive.approach(before, target, double([0.4]))
    # Two time constants; four where it slows down.
    up, down = math.exp(-2.0), math.exp(-4.0)
    assert left[0].tolist() == pytest.approx([0.5 * up, -0.6 * down])
    distance = [0.5 * 0.2 * (1 - up), -0.6 * 0.1 * (1 - down)]
    assert missed[0].tolist() == pytest.approx(distance)
    assert settling[0].tolist() == pytest.approx([0.5, 0.25])
    # 0.4 s after a delay of 0.1 s, within which nothing happens.
    speed = drive.reached(drive.begun(before), target, double([0.5])).speed
    assert speed[0, 0] == pytest.approx(0.5 - 0.5 * up)
    speed = drive.reached(drive.begun(before), target, double([0.07])).speed
    assert torch.equal(speed, before)
    # But the previous command continues to act.
    under = drive.begun(before, double([[1.0, 0.0]]))
    speed = drive.reached(under, target, double([0.07])).speed
    assert speed[0].tolist() == pytest.approx([1 - math.exp(-0.35), 0.8 * math.exp(-0.35)])


def test_a_reversal_to_a_lower_speed_worked_by_hand():
    # From -0.8 to 0.4 the lag is 0.1 s until -0.4, where two thirds of the difference are left,
    # and 0.2 s from then on.
    drive, before, target = alike(lag=0.2, slowing=0.5), double([[-0.8, 0.0]]), double([[0.4, 0.0]])
    until = 0.1 * math.log(1.5)
    left, missed, settling, _ = drive.approach(before, target, double([until + 0.2]))
    assert left[0, 0].item() == pytest.approx(0.8 / math.e)
    assert missed[0, 0].item() == pytest.approx(0.1 * 0.4 + 0.2 * 0.8 * (1 - 1 / math.e))
    assert settling[0, 0].item() == pytest.approx(0.5)


def test_commands_that_change_faster_than_the_delay_reach_the_motors():
    drive = alike(lag=0.1, delay=0.3)
    under, goals = drive.begun(double([[0.0, 0.0]])), double([[0.5, 0.5]])
    under = under._replace(goals=under.goals.expand(1, 15, 2), acts=torch.zeros(1, 15).double())
    time = double([0.05])
    for k in range(40):
        target = goals * (1.0 + 0.005 * (-1.0) ** k)
        under = drive.after(under, target, time, drive.reached(under, target, time))
    # 1.7 s after the first one acts it drives at their mean, apart from the effect of every second
    # one.
    assert under.speed[0].tolist() == pytest.approx([0.5, 0.5], abs=1e-3)
    assert (under.acts[0] > 1e-9).sum() == 5


def test_commands_shorter_than_a_slot_ask_for_their_mean():
    drive = alike(lag=0.1, delay=0.1)
    assert drive.slots == 5
    under = SIMULATOR.drive.begun(double([[0.0, 0.0]]))
    under = under._replace(goals=torch.zeros(1, 5, 2).double(), acts=torch.zeros(1, 5).double())
    for k in range(12):
        target, time = double([[0.4 + 0.2 * (k % 2), 0.5]]), double([0.005])
        under = drive.after(under, target, time, drive.reached(under, target, time))
    assert under.acts[0].tolist() == pytest.approx([-0.06, -0.06, 0.04, 0.06, 0.08])
    assert under.goals[0, 2:].flatten().tolist() == pytest.approx([0.5] * 6)


def test_an_actuator_breaks_loose_though_its_command_changes():
    # 0.05 s at full speed overcome the friction: at 0.5 after five commands of 0.02 s.
    drive, under = alike(lag=0.1, stick=0.05), alike().begun(double([[0.0, 0.0]]))
    speeds = []
    for k in range(8):
        target, time = double([[0.5 + 1e-3 * (-1) ** k, 0.0]]), double([0.02])
        under = drive.after(under, target, time, drive.reached(under, target, time))
        speeds.append(float(under.speed[0, 0]))
    assert speeds[:4] == [0.0] * 4
    assert speeds[-1] == pytest.approx(0.5 * (1 - math.exp(-0.6)), abs=2e-3)


def test_standing_and_braking_worked_by_hand():
    drive = alike(lag=0.2, braking=0.5, stick=0.05)
    # Commanded 0.5 at rest, it stands for another 0.1 s. Commanded to stop, it brakes at lag 0.1 s.
    before, target = double([[0.0, 0.8]]), double([[0.5, 0.0]])
    left, missed, settling, _ = drive.approach(before, target, double([0.3]))
    assert left[0].tolist() == pytest.approx([0.5 * math.exp(-1.0), -0.8 * math.exp(-3.0)])
    distance = [0.05 + 0.1 * (1 - math.exp(-1.0)), -0.08 * (1 - math.exp(-3.0))]
    assert missed[0].tolist() == pytest.approx(distance)
    assert settling[0].tolist() == pytest.approx([0.6, 0.25])
    assert reached(drive, before, target, double([0.06]))[0, 0] == 0.0
    # From -0.5 to 0.5 it stands halfway, after 0.2 ln 2 s, for 0.1 s.
    before, target = double([[-0.5, 0.2]]), double([[0.5, 0.5]])
    until = 0.2 * math.log(2.0)
    times = (until + t for t in (0.0, 0.09, 0.1, 0.2))
    speeds = [reached(drive, before, target, double([time]))[0, 0] for time in times]
    assert speeds == pytest.approx([0.0, 0.0, 0.0, 0.5 * (1 - math.exp(-0.5))], abs=1e-12)
    # An actuator that continues in the same direction does not stand.
    assert reached(drive, before, target, double([0.2]))[0, 1] == pytest.approx(0.5 - 0.3 / math.e)


def test_a_limited_rate_worked_by_hand():
    # From -0.5 to 0.5 at 2 a second: within 0.4 of the end, after 0.3 s, the lag of 0.2 s rules.
    drive, before, target = alike(lag=0.2, rate=2.0), double([[-0.5, 0.5]]), double([[0.5, 0.5]])
    assert reached(drive, before, target, double([0.2]))[0].tolist() == pytest.approx([-0.1, 0.5])
    late = drive.approach(before, target, double([0.5]))
    assert late.left[0].tolist() == pytest.approx([0.4 / math.e, 0.0])
    assert late.missed[0, 0].item() == pytest.approx(0.3 * 0.7 + 0.4 * 0.2 * (1 - 1 / math.e))
    assert late.settling[0].tolist() == pytest.approx([0.3 + 2.5 * 0.2, 0.0])


def test_quadratic_drag_worked_by_hand():
    # With lag 2 s and drag 1.5, 2 ds/dt = F - s - 1.5 s |s|, F being 0.5 (1 + 1.5 * 0.5) at speed
    # 0.5 and 2.5 at full speed. From rest (0.5 - s) / (s + 0.5 + 1 / 1.5) falls with 2.5 / 2 s.
    drive = alike(lag=2.0, drag=1.5)
    assert drive.shaped(double([0.35, 1.0])).tolist() == pytest.approx([0.5, 1.0])
    before, target, ratio = double([[0.0, 1.0]]), double([[0.5, 0.0]]), 0.5 / (0.5 + 1 / 1.5)
    left, missed, _, _ = drive.approach(before, target, double([0.8]))
    later = ratio * math.exp(-1.0)
    speed = (0.5 - later * (0.5 + 1 / 1.5)) / (1.0 + later)
    assert left[0, 0].item() == pytest.approx(0.5 - speed)
    lost = 2.0 / 1.5 * math.log((1.0 + 1.5 * (0.5 + speed)) / (1.0 + 1.5 * 0.5))
    assert missed[0, 0].item() == pytest.approx(lost)
    # It coasts: 1 / s + 1.5 grows with 1 / 2 s.
    coasts = 1.0 / (2.5 * math.exp(0.4) - 1.5)
    assert left[0, 1].item() == pytest.approx(-coasts)
    assert missed[0, 1].item() == pytest.approx(-2.0 / 1.5 * math.log(2.5 / (1.0 + 1.5 * coasts)))


def test_a_static_curve_worked_by_hand():
    drive = alike(curve=(-0.1, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert drive.shaped(double([1.0, -0.5])).tolist() == pytest.approx([0.9, -0.475])
    # Forwards 0.5 (1 + 0.1 + 0.05 + 0.025 + 0.2 + 0.15 + 0.1), backwards with the last three less;
    # beyond full command it grows in proportion.
    drive = alike(curve=(0.2, 0.2, 0.2, 0.2, 0.3, 0.4))
    assert drive.shaped(double([0.5, -0.5])).tolist() == pytest.approx([0.8125, -0.3625])
    assert drive.shaped(double([2.0, -2.0])).tolist() == pytest.approx([5.0, -1.4])


def test_a_drift_worked_by_hand():
    """The square of a turn at once drifts by 0.2 m/s and loses 0.1 m/s, with a lag of 0.5 s."""
    kinematics = [[0.0] * 3, [0.3, 0.0, 0.0], *[[0.0] * 3] * 2, [-0.1, 0.2, 0.0]]
    drive = alike(lag=1e-6, rate=1e6, kinematics=kinematics, drift=(0.5, 0.5))
    still, target = double([[0.0, 0.0]]), double([[0.0, 1.0]])
    reached = drive.reached(drive.begun(still), target, double([1.0]))
    ahead, aside = reached.drift[0].tolist()
    assert aside == pytest.approx(0.2 * (1 - math.exp(-2.0)), rel=1e-2)
    assert ahead == pytest.approx(-0.5 * aside)
    changing, steady = drive.phases(drive.begun(still), target, double([1.0]))
    forward, away, _ = se2.compose(changing, se2.exp(steady))[0].tolist()
    assert away == pytest.approx(0.2 - 0.5 * aside, rel=1e-2)
    # What is no product comes at once.
    assert forward == pytest.approx(0.3 - 0.5 * away, rel=1e-2)
    # It goes on when the command ends.
    under = drive.after(drive.begun(still), target, double([1.0]), reached)
    more = drive.reached(under, still, double([0.5]))
    assert more.drift[0].tolist() == pytest.approx(
        [part * math.exp(-1.0) for part in (ahead, aside)], rel=1e-2
    )


@pytest.mark.parametrize("drift", [(0.05, 0.05), (1.0, 0.4), (0.3, 2.0)])
def test_a_ship_drifts_as_its_law_integrated_in_small_steps(drift):
    rng = np.random.default_rng(3)
    zero = [0.0] * 3
    kinematics = [[0.8, 0.0, 0.0], [0.0, 0.0, 0.6], zero, [0.0, -0.4, 0.0], [-0.2, 0.0, 0.0]]
    drive = alike(lag=0.6, delay=0.12, kinematics=kinematics, drift=drift)
    commands = torch.from_numpy(rng.uniform(-1.0, 1.0, (60, 1, 2)))
    under, pose = drive.begun(double([[0.0, 0.0]])), torch.zeros(1, 3, dtype=torch.float64)
    lasts = double([0.1])
    for target in commands:
        changing, steady = drive.phases(under, target, lasts)
        pose = se2.compose(pose, se2.compose(changing, se2.exp(steady)))
        under = drive.after(under, target, lasts, drive.reached(under, target, lasts))
    h, (x, y, heading), speed, late = 1e-3, np.zeros(3), np.zeros(2), np.zeros(2)
    for k in range(6000):
        waited = k - 120
        goal = commands[waited // 100, 0].numpy() if waited >= 0 else np.zeros(2)
        speed = speed + (goal - speed) * h / 0.6
        steady = np.array([-0.2 * speed[1], -0.4 * speed[0]]) * speed[1]
        late += (steady - late) * h / np.array(drift)
        ahead, aside = 0.8 * speed[0] + late[0], late[1]
        x += h * (ahead * math.cos(heading) - aside * math.sin(heading))
        y += h * (ahead * math.sin(heading) + aside * math.cos(heading))
        heading += h * 0.6 * speed[1]
    assert pose[0].tolist() == pytest.approx([x, y, heading], abs=2e-3)
    assert under.drift[0].tolist() == pytest.approx(late.tolist(), abs=2e-3)


#: Durations of commands, s.
SPANS = {"short": (0.02, 0.1), "mixed": (0.02, 0.6), "long": (0.3, 3.0)}


def commanded(drive, seed, spans, robots=6, seconds=4.0):
    """Return random goals and durations [B, K, C + 1], in all as long as ``seconds`` or more."""
    rng, (low, high) = np.random.default_rng(seed), SPANS[spans]
    shape = robots, math.ceil(2.0 * seconds / (low + high))
    command = rng.uniform(-1.0, 1.0, (*shape, 2)) * (rng.random((*shape, 2)) < 0.85)
    goals = drive.shaped(torch.from_numpy(command)).numpy()
    return np.concatenate([goals, rng.integers(low * 1e3, high * 1e3, (*shape, 1)) * 1e-3], 2)


def standing(drive, robots):
    """Return the pending commands of robots that stand."""
    zero = torch.zeros(robots, 2, dtype=torch.float64)
    slots = torch.zeros(robots, drive.slots, 2, dtype=torch.float64)
    return Underway(zero, zero, slots, slots[..., 0], zero[:, : 2 * drive.drifts])


def late_model(seed, sticky):
    """Return a drive model whose delay is up to 0.5 s, in whole milliseconds."""
    rng = np.random.default_rng(seed)
    limits = {"lag": (0.03, 0.5), "slowing": (0.4, 2.0), "braking": (0.3, 2.0), "rate": (0.5, 20.0)}
    laws = {name: double(rng.uniform(*ends, 2)) for name, ends in limits.items()}
    stick = double(rng.uniform(0.0, 0.05, 2)) * sticky
    delay, drag = double([1e-3 * rng.integers(0, 501)]), double(rng.uniform(0.0, 3.0, 2))
    return drive_model(seed, **laws, stick=stick, delay=delay, drag=drag * rng.integers(2))


@pytest.mark.slow
@pytest.mark.parametrize("sticky", [False, True])
@pytest.mark.parametrize("spans", SPANS)
@settings(max_examples=10, deadline=None)
@given(st.integers(0, 9999))
def test_a_sequence_of_commands_follows_the_law_integrated_in_small_steps(spans, sticky, seed):
    # Friction holds a wheel or not: in a few robots the step of the integration decides this, in
    # rare cases in more of them, which a smaller step shows.
    few = 2 if sticky else 0
    bounds = (0.02, 0.004) if sticky else (0.005, 0.001)
    for dt in (5e-4, 1e-4):
        differ = np.sort(off(seed, spans, sticky, dt))[:, -1 - few]
        if (differ < bounds).all():
            break
    assert (differ < bounds).all(), differ


def off(seed, spans, sticky, dt):
    """Return the largest differences of speeds and distances of robots from an integration."""
    drive = late_model(seed, sticky)
    commands = commanded(drive, seed, spans)
    speeds, under = integrated(drive, commands, dt), standing(drive, len(commands))
    ends, distance, away = np.zeros(len(commands), int), 0.0, []
    for command in torch.from_numpy(commands).unbind(1):
        target, time = command[:, :2], command[:, 2]
        pieces = drive.pieces(under, target, time)
        distance = distance + sum(piece.features for piece in pieces)[:, :2].numpy()
        under = drive.after(under, target, time, drive.reached(under, target, time))
        ends = ends + np.round(time.numpy() / dt).astype(int)
        for b, end in enumerate(ends):
            integral = np.trapezoid(speeds[: end + 1, b], dx=dt, axis=0)
            away.append((under.speed[b].numpy() - speeds[end, b], distance[b] - integral))
    return np.abs(away).max(2).reshape(-1, len(commands), 2).max(0).T


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(st.integers(0, 9999), st.floats(0.1, 0.9), st.booleans())
def test_it_does_not_matter_where_a_sequence_of_commands_is_cut(seed, fraction, sticky):
    drive = late_model(seed, sticky)
    commands = torch.from_numpy(commanded(drive, seed, "mixed", seconds=2.0))
    whole = standing(drive, len(commands))
    # Twice as many may wait: they are kept apart even if they are short.
    goals, acts = (torch.cat([part, part], 1) for part in (whole.goals, whole.acts))
    whole = cut = whole._replace(goals=goals, acts=acts)
    for command in commands.unbind(1):
        target, time = command[:, :2], command[:, 2]
        whole = drive.after(whole, target, time, drive.reached(whole, target, time))
        first = torch.where(time > 0.2, fraction * time, 0.5 * time)
        for part in (first, time - first):
            cut = drive.after(cut, target, part, drive.reached(cut, target, part))
    assert torch.allclose(cut.speed, whole.speed, atol=2e-4)


#: Twists by the two speeds, and by the products of the first with itself, of both, of the second;
#: the error (m, rad) of so few pieces of constant twist, even where both speeds are reversed, which
#: takes such slow actuators a second.
KINEMATICS = {
    "differential drive": ([[0.15, 0.0, -1.0], [0.15, 0.0, 1.0], *[[0.0] * 3] * 3], 0.03, 1e-4),
    "omnidirectional": ([[0.3, 0.0, 0.0], [0.0, 0.3, 0.0], *[[0.0] * 3] * 3], 1e-4, 1e-9),
    # A forward speed and a steering angle: the turn is their product.
    "car": ([[0.3, 0.0, 0.0], [0.0] * 3, [0.0] * 3, [0.0, 0.0, 1.5], [0.0] * 3], 0.1, 0.3),
}


@pytest.mark.slow
@pytest.mark.parametrize(("kinematics", "metres", "radians"), KINEMATICS.values(), ids=KINEMATICS)
@settings(max_examples=15, deadline=None)
@given(
    st.floats(0.03, 0.2),
    st.floats(3.0, 20.0),
    st.floats(0.0, 0.1),
    speeds(),
    speeds(),
    st.floats(0.1, 3.0),
)
def test_phases_are_near_a_fine_integration(
    kinematics, metres, radians, lag, rate, delay, before, target, time
):
    drive = alike(lag, 0.8, 0.8, rate, delay=round(delay, 3), kinematics=kinematics)
    # After 3 s it has reached the previous speed.
    first, time = 3.0, round(time, 3)
    commands = torch.stack(
        [torch.cat([before, double([first])]), torch.cat([target, double([time])])]
    )
    under = drive.begun(before[None], before[None])
    moved, steady = drive.phases(under, target[None], double([time]))
    result = se2.compose(moved, se2.exp(steady))[0].numpy()
    speeds = integrated(drive, commands[None])[:, 0]
    wanted = integrated_pose(drive, speeds[round(first / 5e-4) :])
    assert np.abs(result - wanted)[:2].max() < metres
    assert abs(result - wanted)[2] < radians


def test_the_turn_of_a_car_at_its_speed_is_the_product():
    drive, speeds = alike(kinematics=KINEMATICS["car"][0]), double([[0.8, -0.5]])
    moved, steady = drive.phases(drive.begun(speeds), speeds, double([1.5]))
    arc = se2.exp(1.5 * double([[0.3 * 0.8, 0.0, 1.5 * 0.8 * -0.5]]))
    assert se2.compose(moved, se2.exp(steady))[0].tolist() == pytest.approx(arc[0].tolist())


def test_straight_ahead_the_phases_are_exact():
    drive = alike(0.2, 0.7, 3.0, delay=0.05)
    before, target = double([[-1.0, -1.0]]), double([[1.0, 1.0]])
    moved, steady = drive.phases(drive.begun(before), target, double([0.8]))
    missed = drive.approach(before, target, double([0.75])).missed
    distance = 0.3 * (0.75 - float(missed[0, 0]) - 0.05)
    ahead = se2.compose(moved, se2.exp(steady))[0].tolist()
    assert ahead == pytest.approx([distance, 0.0, 0.0], abs=1e-12)
    # At its speed already, the robot drives an arc, whatever the pieces.
    speeds = double([[0.4, 0.8]])
    moved, steady = drive.phases(drive.begun(speeds), speeds, double([2.0]))
    arc = se2.exp(double([[0.36, 0.0, 0.8]]))
    assert se2.compose(moved, se2.exp(steady))[0].tolist() == pytest.approx(arc[0].tolist())


ARRAYS = random_motion_network(noise=False).compiled()


@njit
def compiled_approach(arrays, c, before, goal, push, time, law):
    """Return the remaining and the missed part of a difference, the settling time, and the push."""
    kernels._law(arrays, c, before, goal, push, law)
    left, missed = kernels._follow(law, time)
    return left, missed, law[10], kernels._come(law, time, left)[1]


@settings(max_examples=40, deadline=None)
@given(drive_models(), speeds(), speeds(), st.floats(1e-4, 3.0), pairs(0.0, 0.03))
@pytest.mark.slow
def test_the_compiled_law_agrees(drive, before, target, time, push):
    target = drive.shaped(target)
    arrays = ARRAYS._replace(**{name: getattr(drive, name).numpy() for name in DriveModel.NAMES})
    each = torch.stack(drive.approach(before[None], target[None], double([time]), push[None]))[:, 0]
    law = np.empty(kernels._LAW)
    for c in range(2):
        given = (float(before[c]), float(target[c]), float(push[c]), time)
        result = compiled_approach(arrays, c, *given, law)
        assert result == pytest.approx(each[:, c].tolist(), abs=1e-13)


@pytest.mark.parametrize("spans", [*SPANS, "very short"])
@pytest.mark.parametrize("delay", [0.0, 0.013, 0.1, 0.5])
def test_compiled_steps_end_in_the_same_states(spans, delay):
    sim = delayed(SIMULATOR, delay)
    rng = np.random.default_rng(4)
    low, high = SPANS.get(spans, (0.001, 0.03))
    random = rng.uniform((-50, -50, low), (50, 50, high), (40, 4, 3))
    random[..., :2] *= rng.random((40, 4, 1)) < 0.8
    state, noise = driven(sim, [])[:, 0], normal(3, 40, 4, 4).float().double()
    stepper = sim.stepper()
    for command, z in zip(random, noise, strict=True):
        result = stepper.step(state.numpy(), command, z.numpy())
        state = sim.step(state, torch.from_numpy(command), z=z)
        np.testing.assert_allclose(result, state, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("period", [0.02, 0.05, 0.12])
@pytest.mark.parametrize("delay", [0.1, 0.5])
def test_a_command_that_comes_and_goes_by_one_percent_is_as_if_it_were_held(period, delay):
    """Such commands come from a controller that makes a small correction at each step."""
    sim, count = delayed(SIMULATOR, delay), round(2.4 / period)
    sim = replaced(sim, genes=torch.zeros_like(sim.genes), kernel_units=None)
    kept = driven(sim, double([[30.0, 20.0, period]] * count))[0]
    wobbling = double([[30.0 * (1.0 + 0.005 * (-1.0) ** k), 20.0, period] for k in range(count)])
    away = (driven(sim, wobbling)[0, -1, :3] - kept[-1, :3]).abs().max()
    assert (kept[-1, :2] - kept[0, :2]).norm() > 0.1
    assert away < 0.01


def test_what_is_no_drive_model_is_refused():
    with pytest.raises(ValueError, match=r"rate must be of shape \(2,\), not \(1,\)"):
        replace(alike(), rate=double([1.0]))
    with pytest.raises(ValueError, match=r"kinematics must be of shape \(5, 3\)"):
        replace(alike(), kinematics=torch.zeros(2, 3))
    wrongs = {
        "lag": 0.0,
        "rate": -1.0,
        "slowing": 0.0,
        "braking": 0.0,
        "delay": -0.1,
        "stick": -0.1,
        "drag": -0.1,
    }
    for wrong in ({name: value} for name, value in wrongs.items()):
        with pytest.raises(ValueError, match="must be above 0, the other times and drag not"):
            alike(**wrong)
    assert can_drive(NAMES)
    assert not can_drive(NAMES, 3)
    assert not can_drive(NAMES[:4])
    assert not can_drive(("prev_left", "left", "right", "duration"))
    assert not can_drive(("duration",))
    sim = random_motion_network(noise=False)
    parts = sim.inputs, sim.network, sim.genes, sim.input_scale, sim.output_scale
    how = {"central": True, "derived": sim.derived}
    with pytest.raises(ValueError, match="needs a drive model"):
        MotionNetwork(*parts, "displacement", **how, drive=sim.drive)
    with pytest.raises(ValueError, match="needs a drive model"):
        MotionNetwork(*parts, "residual-twist", **how)
    with pytest.raises(ValueError, match="needs a duration, and every input's command before"):
        MotionNetwork(*parts, "residual-twist", **how, drive=drive_model(0, 3))
    for units in (kernel_units(0, 4, 5, 4), kernel_units(0, 4, 6, 3)):
        with pytest.raises(ValueError, match="kernel units and networks do not fit"):
            MotionNetwork(*parts, "residual-twist", **how, drive=sim.drive, kernel_units=units)
    with pytest.raises(ValueError, match="do not fit each other"):
        KernelUnits(torch.zeros(4, 5), torch.ones(6), torch.zeros(4, 3, 4))
    with pytest.raises(ValueError, match="must be above 0"):
        KernelUnits(torch.zeros(4, 6), torch.zeros(6), torch.zeros(4, 3, 4))


def test_kernel_units_worked_by_hand():
    units = KernelUnits(double([[0.0, 1.0]]), double([1.0, 0.5]), torch.zeros(1, 3, 1).double())
    # One length away in each of both inputs.
    assert units.units(double([[1.0, 0.5]])).item() == pytest.approx(math.exp(-1.0))
    sim = random_motion_network(units=5, noise=False)
    bare = MotionNetwork(
        *(sim.inputs, sim.network, sim.genes, sim.input_scale, sim.output_scale),
        *(sim.coordinates, None, None, sim.dead_band, True, sim.derived, sim.drive),
    )
    inputs = 20.0 * normal(3, 6, 5).abs()
    x = sim.derived.append(sim.columns, sim.scaled(inputs))
    near = sim.kernel_units.units(x)
    more = torch.einsum("bk,mok->bmo", near, sim.kernel_units.weights)[:, 1:]
    assert torch.allclose(sim.outputs(inputs), bare.outputs(inputs) + more)


@pytest.fixture
def folder(tmp_path):
    write_motion(random_motion_network(), tmp_path)
    return tmp_path


def test_written_and_read_bit_for_bit(folder):
    sim, again = random_motion_network(), read_simulator(folder)
    for name in DriveModel.NAMES:
        assert torch.equal(getattr(again.drive, name), getattr(sim.drive, name))
    for name in KERNEL:
        assert torch.equal(getattr(again.kernel_units, name), getattr(sim.kernel_units, name))
    assert again.state_names == sim.state_names
    assert again.meta == {}
    assert torch.equal(driven(again, cut((0.3,), (0.4, 1.0))), driven(sim, cut((0.3,), (0.4, 1.0))))


@pytest.mark.parametrize("name", ["drive.lag", "drive.kinematics", "kernel.centres"])
@pytest.mark.parametrize("change", ["missing", "of another shape", "not finite"])
def test_wrong_tensors_are_refused(folder, name, change):
    path = folder / "weights.safetensors"
    tensors = load_file(path)
    if change == "missing":
        del tensors[name]
    elif change == "not finite":
        tensors[name].flat[0] = math.nan
    else:
        tensors[name] = tensors[name][:-1].copy()
    save_file(tensors, path)
    with pytest.raises(FileError, match=name.replace(".", r"\.")):
        read_simulator(folder)


@pytest.mark.parametrize("name", ["drive.lag", "drive.rate", "kernel.lengths"])
def test_numbers_that_cannot_be_are_refused(folder, name):
    path = folder / "weights.safetensors"
    tensors = load_file(path)
    tensors[name][0] = -1.0
    save_file(tensors, path)
    with pytest.raises(FileError, match=r"is not a motion network .*above 0"):
        read_simulator(folder)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"kernel_units": -1}, "'kernel_units': expected a whole number from 0 to .*, found -1"),
        ({"kernel_units": True}, "'kernel_units': expected a whole number from 0"),
        ({"kernel_units": 7}, "expected shape"),
    ],
)
def test_a_wrong_description_is_refused(folder, changes, says):
    path = folder / "simulator.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    with pytest.raises(FileError, match=says):
        read_simulator(folder)


#: Two commands in a row: the first drives the robot, the second is looked at in pieces.
FIRST, SECOND = (20.0, -30.0), (35.0, 45.0)
#: Fractions by which something is cut up.
CUTS = st.lists(st.floats(0.02, 1.0), min_size=1, max_size=8)
TIMES = st.floats(0.1, LONGEST)


def cut(first, second):
    """Return rows of both commands, [T, 3], each commanded in steps of these durations."""
    return double([[*FIRST, step] for step in first] + [[*SECOND, step] for step in second])


def fractions_of(cuts, time):
    return [time * c / sum(cuts) for c in cuts]


def noise_of(*counts, seed=5):
    """Return noise numbers [4, T, 4]; they matter where a command begins."""
    noise = 100.0 + normal(seed, 4, sum(counts), 4)
    for n, place in enumerate(np.cumsum([0, *counts[:-1]])):
        noise[:, place] = normal(10 + n, 4, 4)
    return noise


def driven(sim, commands, noise=None, members=MEMBERS):
    """Return the states [B, T + 1, S] of robots that get commands [T, 3]."""
    states = [sim.start(POSES[: len(members)], member=members if sim.members > 1 else None)]
    for k, command in enumerate(commands):
        z = None if noise is None else noise[: len(members), k]
        states.append(sim.step(states[-1], command.expand(len(members), 3), z=z))
    return torch.stack(states, dim=1)


SIMULATOR = random_motion_network()


def replaced(sim, **parts):
    """Return a simulator with other parts."""
    names = (
        *("inputs", "network", "genes", "input_scale", "output_scale", "coordinates", "meta"),
        *("noise", "dead_band", "central", "derived", "drive", "kernel_units"),
    )
    return MotionNetwork(**({name: getattr(sim, name) for name in names} | parts))


def delayed(sim, delay):
    """Return a simulator with another delay (s)."""
    return replaced(sim, drive=replace(sim.drive, delay=double([delay])))


@pytest.mark.slow
@pytest.mark.parametrize("noisy", [False, True])
@settings(max_examples=25, deadline=None)
@given(CUTS, CUTS, TIMES, TIMES)
def test_it_does_not_matter_into_what_a_command_is_cut(noisy, first, second, begin, time):
    counts = len(first), len(second)
    noise = [noise_of(1, 1), noise_of(*counts)] if noisy else [None, None]
    whole = driven(SIMULATOR, cut((begin,), (time,)), noise[0])[:, -1]
    pieces = driven(
        SIMULATOR, cut(fractions_of(first, begin), fractions_of(second, time)), noise[1]
    )[:, -1]
    # The whole state, but for the heading's own 2 pi.
    assert torch.allclose(pieces, whole, rtol=0, atol=1e-10)


def test_one_step_of_3_s_six_of_half_a_second_and_thirty_of_a_tenth():
    ends = [driven(SIMULATOR, cut((1.0,), (3.0 / n,) * n))[:, -1] for n in (1, 6, 30)]
    assert torch.allclose(ends[1], ends[0], rtol=0, atol=1e-12)
    assert torch.allclose(ends[2], ends[0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("noisy", [False, True])
@settings(max_examples=15, deadline=None)
@given(CUTS, CUTS, TIMES, TIMES)
def test_compiled_plans_may_be_cut(noisy, first, second, begin, time):
    ends = []
    for durations in (
        ((begin,), (time,)),
        (fractions_of(first, begin), fractions_of(second, time)),
    ):
        commands = cut(*durations).numpy()[None]
        plans = GivenPlans(commands, np.ones(commands.shape[:2], bool))
        rollouts = SIMULATOR.rollouts(plans, Episode(rest=0.5))
        if noisy:
            noise = noise_of(*map(len, durations), 1)[1:].numpy()
            paths = sampled_poses(
                rollouts, plans, Draws(POSES[1:].numpy(), MEMBERS[1:].numpy(), noise)
            )[0]
        else:
            paths = expected(rollouts, plans, POSES[0].numpy())
        at = np.array([len(durations[0]), commands.shape[1], commands.shape[1] + 1])
        ends.append(paths[:, at])
    np.testing.assert_allclose(ends[1], ends[0], rtol=0, atol=1e-10)


@pytest.mark.parametrize("noisy", [False, True])
def test_a_network_that_holds_its_output_may_be_asked_at_any_interval(noisy):
    family = Network(("x",), outputs=("left", "right"), scale=50.0)
    genes, result = np.array([[0.0, 0.8, 0.0, -0.3], [0.0, 0.2, 0.0, 0.9]]), {}
    for steps in (1, 6, 30):
        rollouts = SIMULATOR.rollouts(family, Episode(3.0 / steps, steps, rest=0.5))
        noise = noise_of(steps, 1).numpy() if noisy else None
        result[steps] = rollouts.run(genes, Draws(POSES.numpy(), MEMBERS.numpy(), noise)).poses
    for steps in (6, 30):
        at = [0, steps, steps + 1]
        np.testing.assert_allclose(result[steps][:, :, at], result[1], rtol=0, atol=1e-10)
    np.testing.assert_allclose(result[30][:, :, :31:5], result[6][:, :, :7], rtol=0, atol=1e-10)


def test_noise_that_is_drawn_holds_until_the_command_ends():
    generator, place = torch.Generator().manual_seed(1), SIMULATOR.state_names.index("noise_0")
    states = [SIMULATOR.start(POSES, generator)]
    for command in cut((0.5, 0.5), (0.5,)):
        states.append(SIMULATOR.step(states[-1], command.expand(4, 3), generator))
    first, again, other = (state[:, place : place + 4] for state in states[1:])
    assert torch.equal(again, first)
    assert (other != first).all()


def test_a_batch_is_its_rows_some_of_which_go_on():
    commands = torch.tensor([FIRST, FIRST, SECOND, (0.0, 0.0)] * 2).double()
    commands = torch.cat([commands, double([[0.4], [2.9]] * 4)], dim=1)
    state = driven(SIMULATOR, cut((0.7,), ()), noise_of(1))[:, -1].repeat(2, 1)
    z = normal(3, 8, 4)
    together = SIMULATOR.step(state, commands, z=z)
    elapsed = together[:, SIMULATOR.state_names.index("elapsed")]
    assert elapsed.tolist() == pytest.approx([1.1, 2.9, 0.4, 2.9] * 2)
    for n in range(8):
        row = slice(n, n + 1)
        alone = SIMULATOR.step(state[row], commands[row], z=z[row])
        assert torch.allclose(alone, together[row], rtol=0, atol=1e-12)


def test_a_robot_that_is_put_elsewhere_goes_on_from_there():
    states = driven(SIMULATOR, cut((1.0,), (0.7, 0.8)), noise_of(1, 2))
    before, after = states[:, -2], states[:, -1]
    moved = before.clone()
    moved[:, :3] = 3.0 * normal(8, 4, 3)
    command = cut((), (0.8,)).expand(4, 3)
    there = SIMULATOR.step(moved, command, z=normal(9, 4, 4))
    relative = se2.between(before[:, :3], after[:, :3])
    assert torch.allclose(se2.between(moved[:, :3], there[:, :3]), relative, rtol=0, atol=1e-12)
    assert torch.allclose(there[:, 3:], after[:, 3:])


def test_a_command_that_lasts_for_longer_than_the_longest_begins_anew():
    elapsed = SIMULATOR.state_names.index("elapsed")
    states = driven(SIMULATOR, cut((0.5,), (2.0, 1.1, 0.5)), noise_of(1, 2, 1))
    # 3.1 s are the longest within a few percent.
    assert states[0, :, elapsed].tolist() == pytest.approx([0.0, 0.5, 2.0, 3.1, 0.5])
    speed = slice(3, 5)
    target = SIMULATOR._speeds(double([SECOND]))
    began = SIMULATOR.state_names.index("began_speed_left")
    reached = states[:, 4, began : began + 2]
    assert torch.equal(reached, states[:, 3, speed])
    assert torch.allclose(reached, target)
    noise = slice(elapsed + 4, elapsed + 8)
    assert torch.equal(states[:, 3, noise], normal(11, 4, 4))
    assert torch.equal(states[:, 4, noise], normal(12, 4, 4))
    # The same as for another robot that reaches this speed on its way to the same target.
    x = torch.cat([reached, target.expand(4, 2), double([[0.5 / LONGEST]] * 4)], dim=1)
    mean = SIMULATOR.displacement_of(torch.cat([x, target.expand(4, 2)], 1), MEMBERS)
    moved = SIMULATOR.disturbed(x, mean, normal(12, 4, 4))
    wanted = se2.compose(states[:, 3, :3], moved)
    assert torch.allclose(states[:, 4, :3], wanted, rtol=0, atol=1e-12)


def test_another_command_begins_with_the_speeds_reached():
    states = driven(SIMULATOR, cut((0.2,), (0.3,)))
    target = SIMULATOR._speeds(double([FIRST]))
    drive, zero = SIMULATOR.drive, torch.zeros(1, 2).double()
    reached = drive.reached(drive.begun(zero), target, double([0.2])).speed
    began = SIMULATOR.state_names.index("began_speed_left")
    assert torch.allclose(states[:, 2, began : began + 2], reached.expand(4, 2))
    assert torch.equal(states[:, 1, 3:5], states[:, 2, began : began + 2])
    assert (reached.abs() < target.abs()).all()


@pytest.mark.parametrize("first", [(0.0, 0.0), (1.0, -2.0)])
def test_to_stop_a_robot_that_stands(first):
    """A command to stand, or within the dead band, from rest: no speeds, noise of its own."""
    state = SIMULATOR.start(POSES, member=MEMBERS)
    assert not state[:, 3:-1].any()
    z = normal(3, 4, 4)
    whole = SIMULATOR.step(state, double([[*first, 1.0]]).expand(4, 3), z=z)
    half = double([[*first, 0.5]]).expand(4, 3)
    halves = SIMULATOR.step(SIMULATOR.step(state, half, z=z), half, z=100.0 * z)
    assert torch.allclose(halves, whole, rtol=0, atol=1e-12)
    assert not whole[:, 3:5].any()
    place = SIMULATOR.state_names.index("noise_0")
    began = SIMULATOR.state_names.index("began_speed_left")
    assert torch.equal(whole[:, place : place + 4], z)
    x = torch.zeros(4, 5).double()
    x[:, 4] = 1.0 / LONGEST
    moved = SIMULATOR.disturbed(x, SIMULATOR.displacement_of(x, MEMBERS), z)
    assert torch.allclose(whole[:, :3], se2.compose(POSES, moved), rtol=0, atol=1e-12)
    after = SIMULATOR.step(whole, double([[20.0, 30.0, 0.5]]).expand(4, 3))
    assert not after[:, began : began + 4].any()


@pytest.mark.parametrize("drives", [False, True])
def test_chained_inputs_are_those_of_steps_from_rest(drives):
    sim = random_motion_network(noise=False, drives=drives)
    random = np.random.default_rng(4).uniform((-50, -50, 0.1), (50, 50, 0.5), (12, 3))
    commands = torch.from_numpy(random)
    before = torch.cat([torch.zeros(1, 2), commands[:-1, :2]])
    inputs = torch.cat([before, commands], dim=1)
    x = sim.chained(inputs)
    poses = driven(sim, commands, members=MEMBERS[:1])[0, :, :3]
    moved = se2.between(poses[:-1], poses[1:])
    result = sim.displacement_of(x)
    # Remainders from before the fifth command back are forgotten.
    assert torch.allclose(result[:5], moved[:5], rtol=0, atol=1e-12)
    assert torch.allclose(result, moved, rtol=0, atol=1e-3)
    # A command that does not follow the row before it begins with the commanded speed.
    inputs[6, :2] = 10.0
    again = sim.chained(inputs)
    assert torch.equal(again[6, :5], sim.scaled(inputs)[6])
    assert torch.equal(again[:6], x[:6])
    assert len(sim.chained(inputs[:0])) == 0


def test_a_slow_body_remembers_many_short_commands():
    slow = alike(lag=9.0, delay=0.12)
    commands = double(np.random.default_rng(5).uniform(0.2, 1.0, (200, 2)))
    time = torch.full((200,), 0.5).double()
    before = torch.cat([commands[:1], commands[:-1]])
    x = torch.cat([before, commands, time[:, None] / LONGEST], 1)
    columns = CommandFeatures.of(("prev_left", "prev_right", "left", "right", "duration"))
    begins = chain(slow, columns, x, torch.arange(200) > 0, LONGEST)[:, :2]
    under = slow.begun(before[:1], before[:1])
    for k in range(200):
        assert begins[k].tolist() == pytest.approx(under.speed[0].tolist(), abs=5e-3)
        reached = slow.reached(under, commands[k : k + 1], time[:1])
        under = slow.after(under, commands[k : k + 1], time[:1], reached)


@pytest.mark.parametrize("members", [1, 3])
def test_the_order_of_inputs_does_not_matter(members):
    sim = random_motion_network(swing=None, units=0, noise=False, members=members)
    order = [4, 2, 0, 3, 1]
    weights = sim.network.split(sim.genes)
    permuted = {n: getattr(weights, n)[..., order] for n in ("exponents", "summation")}
    other = MotionNetwork(
        [sim.inputs[i] for i in order],
        sim.network,
        sim.network.join(weights._replace(**permuted)),
        sim.input_scale[order],
        sim.output_scale,
        "residual-twist",
        dead_band=sim.dead_band[order],
        central=True,
        drive=sim.drive,
    )
    assert other.command_names == ("duration", "left", "right")
    commands = cut((0.4, 0.3), (0.2, 2.0))
    wanted = driven(sim, commands)[..., :3]
    assert torch.allclose(driven(other, commands[:, [2, 0, 1]])[..., :3], wanted, atol=1e-12)


def test_a_simulator_of_an_earlier_version_is_refused(folder):
    path = folder / "simulator.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"version": 3}))
    with pytest.raises(FileError, match="reads versions 13 to 14, found 3"):
        read_simulator(folder)
