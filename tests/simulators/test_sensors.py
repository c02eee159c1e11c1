"""Sensors of a motion network: by hand, compiled and stepped, in files, and errors."""

import json

import numpy as np
import pytest
import torch
from closed_loops import KINDS, assert_alike, assert_reused, both, families
from motion_networks import random_motion_network
from safetensors.numpy import load_file, save_file

from neurosim.base.errors import FileError, UserError
from neurosim.base.trajectory import Episode
from neurosim.controllers import Plan
from neurosim.loop.stepped import SteppedRollouts
from neurosim.simulators import read_simulator
from neurosim.simulators.export import export
from neurosim.simulators.motion.files import write_motion
from neurosim.simulators.motion.noise import DRAWS
from neurosim.simulators.motion.sensors import TENSORS, Sensors
from neurosim.simulators.sampling import PLACING, Stepper
from neurosim.testing import check_simulator

STARTS = np.random.default_rng(3).normal(0, 0.4, (6, 3))


def sensors(maps=2):
    """Three sensors above two random maps of 1 m by 0.8 m."""
    generator = torch.Generator().manual_seed(0)
    return Sensors(
        ("line_left", "line_right", "nose"),
        torch.tensor([[0.07, 0.02], [0.07, -0.02], [0.1, 0.0]]),
        torch.tensor([0, 0, maps - 1]),
        torch.tensor([[0.01, 0.002], [0.01, 0.002], [0.0, 0.01]]),
        torch.rand(maps, 9, 11, generator=generator, dtype=torch.float64),
        torch.tensor([-0.5, -0.4]),
        0.1,
    )


def simulator(**form):
    result = random_motion_network(**form)
    result.sensors = sensors()
    return result


def test_readings_by_hand():
    one = Sensors(
        ("a",),
        torch.tensor([[0.1, 0.2]]),
        torch.tensor([0]),
        torch.tensor([[0.03, 0.04]]),
        torch.tensor([[[0.0, 0.2, 0.4], [0.4, 0.6, 0.8]]]),
        torch.tensor([1.0, 2.0]),
        0.5,
    )
    # Facing up, a sensor that is ahead and to the left is above and at -x.
    pose = torch.tensor([[1.45, 2.15, np.pi / 2]]).double()  # looks at (1.25, 2.25)
    assert one.read(pose).tolist() == [[pytest.approx(0.3)]]
    spread = np.hypot(0.03, 0.04 * np.hypot(0.2 / 0.5, 0.4 / 0.5))
    noisy = one.read(pose, torch.tensor([[0.5]]).double())
    assert noisy.item() == pytest.approx(0.3 + 0.5 * spread)
    far = torch.tensor([[9.0, 9.0, 0.0], [-9.0, -9.0, 0.0]]).double()
    assert one.read(far).tolist() == [[pytest.approx(0.8)], [0.0]]
    assert one.read(pose, torch.tensor([[-50.0]]).double()).item() == 0.0


@pytest.mark.parametrize("noise", [False, True])
@pytest.mark.parametrize("rest", [0.0, 0.5])
@pytest.mark.parametrize("kind", KINDS)
def test_networks_drive_by_readings_as_stepped(kind, rest, noise):
    sim = simulator(noise=noise)
    family = families(("nose", "line_left", "line_right", "cos_heading"), scale=40.0)[kind]
    episode = Episode(0.4, 15, rest)
    draws = sim.rollouts(family, episode).draw(STARTS, 3, PLACING)
    assert draws.noise.shape == (6, 15 + (rest > 0), DRAWS + 3)
    result, expected = both(sim, family, episode, draws)
    assert_alike(result, expected, 1e-9, 1e-6, 1e-6)
    assert result.readings.shape == (4, 6, 15 + (rest > 0), 3)
    assert result.readings.std() > 0.05
    assert_reused(sim, family, episode, draws)


def test_readings_that_nobody_needs_are_not_kept_and_change_nothing():
    plain, sensing = random_motion_network(), simulator()
    family, episode = families(("x", "time"), scale=40.0)["elman"], Episode(0.4, 10)
    draws = plain.rollouts(family, episode).draw(STARTS, 3)
    more = sensing.rollouts(family, episode).draw(STARTS, 3)
    more = type(more)(more.starts, draws.member, np.pad(draws.noise, ((0, 0), (0, 0), (0, 3))))
    genes = np.random.default_rng(0).normal(size=(3, family.genes))
    rolled_out = sensing.rollouts(family, episode).run(genes, more)
    assert rolled_out.readings is None
    assert np.array_equal(rolled_out.poses, plain.rollouts(family, episode).run(genes, draws).poses)


def test_tasks_that_need_readings_of_plans_get_them():
    sim, plan = simulator(), Plan(slots=3)
    episode = Episode(0.4, 3, 0.5, readings=True)
    genes = np.full((2, plan.genes), 0.6)
    draws = SteppedRollouts(sim, plan, episode).draw(STARTS, 0)
    result, expected = both(sim, plan, episode, draws, genes)
    assert result.readings.shape == (2, 6, 4, 3)
    assert_alike(result, expected, 1e-9, 1e-6, 1e-6)
    assert sim.rollouts(plan, Episode(0.4, 3, 0.5)).run(genes, draws).readings is None


def test_compiled_readings_are_the_simulators_own():
    sim = simulator()
    compiled, plain = sim.stepper(), Stepper(sim)
    state = compiled.start(np.random.default_rng(0).normal(0, 0.4, (30, 3)))
    seeds = np.arange(30, dtype=np.uint64)
    noise = compiled.noise(seeds, np.zeros(30, np.int64))
    assert noise.shape == (30, DRAWS + 3)
    for given in (None, noise):
        np.testing.assert_allclose(
            compiled.sense(state, given), plain.sense(state, given), atol=1e-12
        )
    command = np.tile([30.0, 20.0, 0.3], (30, 1))
    np.testing.assert_allclose(
        compiled.step(state, command, noise), plain.step(state, command, noise), atol=1e-9
    )


def test_noise_is_as_wide_as_it_says():
    sim = simulator()
    state = sim.start(torch.zeros(20_000, 3))
    sampled = sim.sense(state, torch.Generator().manual_seed(1))
    mean = sim.sense(state[:1])
    assert sampled.mean(0) - mean[0] == pytest.approx([0, 0, 0], abs=1e-3)
    again = sim.sensors.read(state[:1, :3], torch.ones(1, 3).double()) - mean
    assert sampled.std(0).tolist() == pytest.approx(again[0].tolist(), rel=0.03)


def test_files_keep_sensors(tmp_path):
    sim = simulator()
    write_motion(sim, tmp_path)
    read = read_simulator(tmp_path)
    assert read.reading_names == ("line_left", "line_right", "nose")
    assert read.sensors.cell == 0.1
    for name in TENSORS:
        assert torch.equal(getattr(read.sensors, name), getattr(sim.sensors, name))
    plain = tmp_path / "plain"
    plain.mkdir()
    write_motion(random_motion_network(), plain)
    assert "sensors" not in json.loads((plain / "simulator.json").read_text())
    assert read_simulator(plain).sensors is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"sensors.place": np.array([0, 0, 2])}, "a map that does not exist"),
        ({"sensors.noise": -np.ones((3, 2))}, "must not be negative"),
        ({"sensors.maps": np.zeros((2, 1, 5))}, "at least 2 by 2"),
        ({"sensors.mount": np.zeros((2, 2))}, "expected shape"),
        ({"sensors.origin": np.array([np.nan, 0])}, "not finite"),
        ({"sensors.maps": None}, "missing"),
    ],
)
def test_damaged_sensors_are_refused(tmp_path, change, words):
    write_motion(simulator(), tmp_path)
    tensors = load_file(tmp_path / "weights.safetensors") | change
    kept = {name: value for name, value in tensors.items() if value is not None}
    save_file(kept, tmp_path / "weights.safetensors")
    with pytest.raises(FileError, match=words):
        read_simulator(tmp_path)


@pytest.mark.parametrize(
    ("message", "words"),
    [
        ({"names": ["a", "a", "b"], "cell": 0.1}, "names that differ"),
        ({"names": ["time", "a", "b"], "cell": 0.1}, "not the name of a sensor"),
        ({"names": ["a", "b", "c"], "cell": 0.0}, "above 0"),
        ({"names": "abc", "cell": 0.1}, "names"),
    ],
)
def test_what_is_said_of_sensors_is_checked(tmp_path, message, words):
    write_motion(simulator(), tmp_path)
    path = tmp_path / "simulator.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"sensors": message}))
    with pytest.raises(FileError, match=words):
        read_simulator(tmp_path)


def test_a_simulator_with_sensors_is_not_exported(tmp_path):
    with pytest.raises(UserError, match=r"has sensors \(line_left, line_right, nose\)"):
        export(simulator(), tmp_path / "out", "torch")
    assert not (tmp_path / "out").exists()


def test_an_adjusted_simulator_keeps_its_sensors():
    sim = simulator()
    values = [one.value for one in sim.parameters]
    assert sim.adjusted(np.array(values)).sensors is sim.sensors


def test_it_is_a_simulator_as_any_other():
    check_simulator(simulator())
