import numpy as np
import pytest
import torch
from driven_robot import drive_data

from neurosim.base.se2 import tensors as se2
from neurosim.simulators.motion.derived import Derived
from neurosim.simulators.motion.kernel_units import covariance
from neurosim.simulators.motion.noise import CommandFeatures
from neurosim.training.base import TrainingData
from neurosim.training.coverage import central, central_ranks, draw_displacements
from neurosim.training.error_size import row_weights
from neurosim.training.trainers.combined import CombinedSettings, CombinedTrainer
from neurosim.training.trainers.drive_fit import Motion, fit_again, fit_drive
from neurosim.training.trainers.gaussian_process import Process, learn_process
from neurosim.training.trainers.windows import Windows

NAMES = ("prev_left", "prev_right", "left", "right", "duration")
INPUTS = [{"name": name, "unit": "%"} for name in NAMES]


def trained(data, members=1, noise=False, centres=40, **settings):
    settings = CombinedSettings(members=members, noise=noise, centres=centres, **settings)
    return CombinedTrainer(data, settings, 0).result()


def errors(simulator, data):
    result = simulator.displacement_of(simulator.chained(data.x))
    return (result - data.y).abs().mean(0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_the_laws_of_a_robot_that_keeps_them_are_found(seed):
    lag, delay = (0.12, 0.2), 0.06
    data = drive_data(400, seed=seed, lag=lag, delay=delay, bend=(0.1, 0.2), rate=3.0, noise=0.0)
    x = data.scaled_inputs
    columns = CommandFeatures.of(NAMES)
    longest = float(data.input_scale[4])
    drive, *_ = fit_drive(Motion(x, data.y, data.follows, columns, longest, data.within))
    assert drive.lag.tolist() == pytest.approx(lag, rel=0.3)
    assert float(drive.delay) == pytest.approx(delay, abs=0.03)
    full = drive.shaped(torch.ones(2, dtype=torch.float64)) / drive.shaped(torch.full((2,), 0.1))
    # 0.9 and 0.8 of the speed at full command, for 0.99 and 0.98 at a tenth.
    assert (full / 10.0).tolist() == pytest.approx((0.9 / 0.99, 0.8 / 0.98), abs=0.03)
    assert drive.rate.tolist() == pytest.approx([3.0, 3.0], rel=0.15)


@pytest.mark.slow
def test_a_speed_that_falls_again_at_large_commands_is_found():
    def curve(u):
        return torch.sin(2.2 * u.abs()) * u.sign()  # the most at 71 % of the command

    data = drive_data(150, lag=(0.15, 0.15), curve=curve, noise=0.0005)
    rows = data.scaled_inputs, data.y, data.follows
    drive, *_ = fit_drive(
        Motion(*rows, CommandFeatures.of(NAMES), float(data.input_scale[4]), data.within)
    )
    u = torch.linspace(-1.0, 1.0, 21, dtype=torch.float64).unsqueeze(1).repeat(1, 2)
    driven = drive.shaped(u) * drive.kinematics[1, 2] / 2.0
    assert (driven - curve(u)).abs().max() < 0.05
    assert drive.lag.tolist() == pytest.approx([0.15, 0.15], rel=0.1)


@pytest.mark.slow
def test_the_process_grows_where_held_out_rows_ask_for_it():
    settings = {"members": 1, "noise": False, "centres": 20}
    plain = drive_data(300, noise=0.0005)
    rough = drive_data(300, noise=0.0005, wobble=1.0)
    assert trained(plain, **settings).meta["composition"]["kernel_units"] == 20
    grown, small = (trained(rough, **settings, most_centres=most) for most in (1200, 20))
    assert 20 < grown.meta["composition"]["kernel_units"] <= 100
    fresh = drive_data(300, seed=7, noise=0.0, wobble=1.0)
    assert errors(grown, fresh)[2] < 0.9 * errors(small, fresh)[2]


@pytest.mark.slow
def test_it_is_found_how_a_robot_brakes_and_how_long_it_sticks():
    data = drive_data(600, braking=0.4, stick=0.03, stops=0.25, noise=0.0005)
    longest, columns = float(data.input_scale[4]), CommandFeatures.of(NAMES)
    rows = data.scaled_inputs, data.y, data.follows, columns, longest, data.within
    drive, *_ = fit_drive(Motion(*rows))
    assert drive.braking.tolist() == pytest.approx([0.4, 0.4], rel=0.25)
    assert drive.stick.tolist() == pytest.approx([0.03, 0.03], abs=0.006)
    assert drive.slowing.tolist() == pytest.approx([1.0, 1.0], rel=0.25)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.slow
def test_lag_and_delay_together_are_found_to_within_milliseconds(seed):
    lag, delay = torch.tensor([0.1, 0.08]).double(), 0.15
    data = drive_data(800, lag=tuple(lag.tolist()), delay=delay, noise=0.001, seed=seed)
    longest, columns = float(data.input_scale[4]), CommandFeatures.of(NAMES)
    rows = data.scaled_inputs, data.y, data.follows, columns, longest, data.within
    drive, *_ = fit_drive(Motion(*rows))
    assert (drive.lag + drive.delay).tolist() == pytest.approx((lag + delay).tolist(), abs=0.002)


@pytest.mark.parametrize("rows", [20, 30, 60])
@pytest.mark.slow
def test_with_few_rows_it_is_no_worse_than_the_fitted_unicycle(rows):
    data = drive_data(rows, noise=0.003)
    fresh = drive_data(300, seed=9, noise=0.0)
    chord, time = se2.chord(data.y[:, 2]), data.x[:, 4:]
    moved = se2.mid_turn(data.y)
    turn = torch.linalg.lstsq(data.x[:, 2:4] * time, data.y[:, 2]).solution
    ahead = torch.linalg.lstsq(chord[:, None] * data.x[:, 2:4] * time, moved[:, 0]).solution
    distances = fresh.x[:, 2:4] * fresh.x[:, 4:]
    none = torch.zeros(len(fresh.x), dtype=torch.float64)
    unicycle = se2.exp(torch.stack([distances @ ahead, none, distances @ turn], 1))
    own = errors(trained(data), fresh)
    assert (own < (unicycle - fresh.y).abs().mean(0)).all()


@pytest.mark.slow
def test_the_process_learns_what_the_drive_model_cannot_say():
    data = drive_data(500, wobble=0.15)
    fresh = drive_data(300, seed=9, wobble=0.15, noise=0.0)
    plain = errors(trained(data, without=("process",)), fresh)
    assert errors(trained(data), fresh)[2] < 0.6 * plain[2]


@pytest.mark.slow
def test_what_the_process_cannot_better_is_left_to_the_drive_model():
    data = drive_data(200, noise=0.004)
    simulator = trained(data)
    assert simulator.meta["composition"]["process"]["dy"] <= 0.3


@pytest.mark.slow
def test_one_row_in_a_hundred_far_off_changes_nothing_that_matters():
    data, fresh = drive_data(600), drive_data(300, seed=9, noise=0.0)
    y = data.y.clone()
    y[::100, :2] += 0.3
    spoilt = TrainingData(data.inputs, data.x, y, data.within)
    clean, own = (errors(trained(d), fresh) for d in (data, spoilt))
    assert (own < 1.5 * clean + torch.tensor([1e-4, 1e-4, 1e-3])).all()


@pytest.mark.slow
def test_poses_within_commands_make_their_beginnings_known():
    data, fresh = drive_data(300), drive_data(200, seed=9, noise=0.0)
    early = fresh.within.time < 0.3
    row, time, moved = (part[early] for part in fresh.within)

    def early_error(**settings):
        simulator = trained(data, **settings)
        x = simulator.chained(fresh.x)[row]
        x[:, 4] = time / simulator.longest
        return (simulator.displacement_of(x) - moved).abs().mean(0)[[0, 2]]

    assert (early_error() < early_error(whole_commands=True)).all()


@pytest.mark.slow
def test_members_differ_and_their_mean_is_the_central_network():
    data = drive_data(300, wobble=0.15)
    simulator = trained(data, members=6, noise=True)
    x = simulator.chained(data.x)
    mean = simulator.displacement_of(x)
    off = torch.stack([simulator.displacement_of(x, m) - mean for m in range(6)])
    spread, error = off.square().mean().sqrt(), (mean - data.y).square().mean().sqrt()
    assert 0.02 * error < spread < 3.0 * error


@pytest.mark.slow
def test_where_no_row_was_members_differ_most():
    data = drive_data(400, wobble=0.15)
    forwards = (data.x[:, 2:4] >= 0).all(1)
    own = TrainingData(INPUTS, data.x[forwards], data.y[forwards], scale=data.input_scale)
    simulator = trained(own, members=8)

    def spread(rows):
        moved = [simulator.displacement(rows, m)[:, 2] for m in range(8)]
        return torch.stack(moved).std(0).median()

    assert spread(data.x[(data.x[:, 2:4] < 0).all(1)]) > 2 * spread(data.x[forwards])


@pytest.mark.slow
@pytest.mark.parametrize("window", [1, 4])
def test_the_process_is_the_textbook_s_where_all_rows_are_centres(window):
    """Of rows, and of sums over windows of four, three of whose rows are the next one's, too."""
    g = torch.Generator().manual_seed(0)
    x = torch.rand(40, 2, generator=g, dtype=torch.float64)
    y = (3 * x[:, 0]).sin() + 0.1 * torch.randn(40, generator=g, dtype=torch.float64)
    lengths, one = torch.tensor([0.3, 0.5], dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    process = Process(x, lengths, 0.8 * one, 0.01 * one)
    factor = torch.linspace(0.5, 1.5, 40, dtype=torch.float64)
    first = torch.arange(41 - window)
    windows = Windows(first, first + window, 0 * first, torch.ones(len(first)))
    given, units = factor * y, process.units(x)
    columns, seen = windows.sums(factor[:, None] * units), windows.sums(given)
    weight = torch.linspace(0.5, 2.0, len(first), dtype=torch.float64) / window**2
    mean, triangle = process.posterior(columns, seen, weight, 0)
    fresh = torch.rand(7, 2, generator=g, dtype=torch.float64)
    # Rasmussen and Williams 2006, equations 2.25 and 2.26, of linear functions of the values.
    of_rows = torch.zeros(len(first), 40, dtype=torch.float64)
    for number, begin in enumerate(first.tolist()):
        of_rows[number, begin : begin + window] = factor[begin : begin + window]
    shared = of_rows @ (0.8 * covariance(x, x, lengths)) @ of_rows.T + torch.diag(0.01 / weight)
    cross = 0.8 * covariance(fresh, x, lengths) @ of_rows.T
    expected = cross @ torch.linalg.solve(shared, of_rows @ y)
    variance = 0.8 - (cross * torch.linalg.solve(shared, cross.T).T).sum(1)
    torch.testing.assert_close(process.units(fresh) @ mean, expected, rtol=1e-2, atol=2e-3)
    part = torch.linalg.solve_triangular(triangle, process.units(fresh).T, upper=False)
    torch.testing.assert_close(part.square().sum(0), variance, rtol=2e-2, atol=1e-4)


def test_lengths_say_which_inputs_matter():
    g = torch.Generator().manual_seed(1)
    x = 2 * torch.rand(300, 3, generator=g, dtype=torch.float64) - 1
    y = torch.stack([(4 * x[:, 1]).sin(), (3 * x[:, 1]).cos()], 1)
    y = y + 0.02 * torch.randn(300, 2, generator=g, dtype=torch.float64)
    process, _ = learn_process(x, y, torch.ones_like(y), 60, x[:50], torch.arange(300))
    assert process.lengths[1] < 0.3 * min(process.lengths[0], process.lengths[2])
    assert process.noise.sqrt().tolist() == pytest.approx([0.02, 0.02], rel=0.4)


def test_rows_with_larger_errors_weigh_less():
    g = torch.Generator().manual_seed(0)
    x = 2 * torch.rand(2000, 5, generator=g, dtype=torch.float64) - 1
    residual = torch.randn(1, 2000, generator=g, dtype=torch.float64) * x[:, 4] ** 2
    weights = row_weights(x, residual)
    assert weights.square().mean().item() == pytest.approx(1.0)
    long, short = weights[0, x[:, 4].abs() > 0.9].mean(), weights[0, x[:, 4].abs() < 0.3].mean()
    assert short > 1.5 * long


@pytest.mark.slow
@pytest.mark.parametrize("side", [-1.0, 1.0, 0.0])
def test_a_swing_is_found_where_there_is_one(side):
    """A robot whose caster turns it by 0.1 rad for every half turn of the caster."""
    data = drive_data(400)
    columns = CommandFeatures.of(NAMES)
    x, y = data.scaled_inputs, data.y.clone()
    swing = Derived(swing=0.03 * (side or 1.0)).append(columns, x)[:, -1]
    y[:, 2] += 0.1 * abs(side) * swing
    result = trained(TrainingData(data.inputs, data.x, y)).derived
    assert result == Derived(swing=0.03 * side if side else None)


@pytest.mark.slow
def test_members_span_what_another_recording_of_the_same_robot_would_say():
    """Simulators of several recordings differ by as much as the members of one say."""
    fresh = drive_data(100, seed=99, noise=0.0)
    simulators = [
        trained(drive_data(60, seed=s, noise=0.01), members=8, whole_commands=True)
        for s in range(6)
    ]

    def output(simulator, member=-1):
        return simulator.displacement_of(simulator.chained(fresh.x), member)

    means = torch.stack([output(one) for one in simulators])
    of_members = torch.stack(
        [torch.stack([output(one, m) for m in range(8)]).var(0) for one in simulators]
    )
    ratio = (of_members.mean((0, 1)) / means.var(0).mean(0)).sqrt()
    assert ((ratio > 0.6) & (ratio < 2.0))[[0, 2]].all()


@pytest.mark.slow
def test_intervals_hold_when_rows_are_few():
    """A drive model's errors are much smaller on its own 24 rows than on others."""
    fresh = drive_data(300, seed=99, noise=0.01)
    ranks = []
    for seed in range(4):
        data = drive_data(24, seed=seed, noise=0.01)
        simulator = trained(data, members=8, noise=True, whole_commands=True)
        ranks.append(central_ranks(simulator, fresh.x.numpy(), fresh.y.numpy(), draws=100))
    held = (np.stack(ranks) <= 0.8).mean((0, 1))
    assert held == pytest.approx(0.8, abs=0.12)


@pytest.mark.slow
def test_intervals_hold_for_beginnings_of_commands_when_rows_are_few():
    """Whole commands alone do not tell how noise depends on the time: it is the same here."""
    fresh, held = drive_data(300, seed=99, noise=0.01), []
    row, time, moved = (part[fresh.within.time < 0.5] for part in fresh.within)
    for seed in range(3):
        simulator = trained(drive_data(24, seed=seed, noise=0.01), members=8, noise=True)
        inputs = simulator.chained(fresh.x)[row]
        inputs[:, simulator.columns.duration] *= time / fresh.x[row, 4]
        generator = torch.Generator().manual_seed(0)
        sampled = draw_displacements(simulator, inputs, 100, generator)
        held.append(central(sampled.numpy(), moved.numpy()) <= 0.8)
    assert np.mean(held, axis=(0, 1)) == pytest.approx(0.8, abs=0.12)


@pytest.mark.slow
def test_laws_that_are_left_out_do_not_come_back_in_members():
    data = drive_data(60, lag=(0.3, 0.3))
    columns, longest = CommandFeatures.of(NAMES), float(data.input_scale[4])
    motion = Motion(data.scaled_inputs, data.y, data.follows, columns, longest, data.within)
    fit = fit_drive(motion, without=("laws",))
    (again,) = fit_again(fit, torch.linspace(0.5, 1.5, 60, dtype=torch.float64)[None])
    assert torch.equal(again.drive.lag, fit.drive.lag)
    assert not torch.equal(again.drive.kinematics, fit.drive.kinematics)


def test_robots_that_it_cannot_drive_are_refused():
    x = torch.rand(30, 2, dtype=torch.float64)
    data = TrainingData([{"name": "left", "unit": "%"}, {"name": "right", "unit": "%"}], x, x)
    with pytest.raises(ValueError, match="needs a duration"):
        CombinedTrainer(data, CombinedSettings(), 0)


@pytest.mark.slow
@pytest.mark.parametrize(("true", "result"), [(0.0, (0.0, 0.0)), (0.15, (0.05, 0.25))])
def test_a_delay_is_believed_where_the_rows_tell_it_from_a_lag(true, result):
    """From the ends of a hundred commands alone."""
    for seed in (0, 2):
        data = drive_data(100, seed=seed, delay=true, noise=0.003)
        names = tuple(entry["name"] for entry in data.inputs)
        columns, longest = CommandFeatures.of(names), float(data.input_scale[-1])
        drive, *_ = fit_drive(Motion(data.scaled_inputs, data.y, data.follows, columns, longest))
        assert result[0] <= float(drive.delay) <= result[1]
