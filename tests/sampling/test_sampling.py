"""A virtual Khepera samples itself: compared with the lab's objects, which it cannot see."""

import json
import math
from dataclasses import replace

import click
import numpy as np
import pytest
from click.testing import CliRunner
from patience import PATIENCE

from neurosim.base import files
from neurosim.base.errors import FileError, RobotError, UserError
from neurosim.base.place import Place
from neurosim.cli.main import cli
from neurosim.lab import KheperaParams, VirtualKheperaRig, VirtualThymioRig, sampling_places
from neurosim.lab.khepera import physics
from neurosim.lab.khepera.params import WHEEL_BASE, WHITE
from neurosim.robots.khepera.dialects import DIALECTS, dialect_named
from neurosim.robots.khepera.driver import Khepera
from neurosim.robots.thymio.driver import BODY, NEAR, Thymio
from neurosim.sampling import (
    FORMAT,
    VERSION,
    SampleSettings,
    build_tables,
    full_turn,
    read_turns,
    sample,
)
from neurosim.sampling.resampling import write_samples
from neurosim.sampling.turns import PIVOTS
from neurosim.simulators.tables.motor_table import MotorTable
from neurosim.simulators.tables.reaction import Reaction
from neurosim.simulators.tables.samples import Samples

#: With a faster line the robot would only read and write more values.
BAUD = 9600
ROOMY = Place.rectangle(2.0, 1.5, ((0.3, 0.2, 0.0275),))
SETTINGS = SampleSettings(angles=36, distances=2, step=0.01, grid=3, held_out=4, duration=0.5)


class Interrupted(Exception):
    pass


def sampled(
    out, settings=SETTINGS, *,
    resume=False, stop_at=None, noise_seed=0, params=None, baud=BAUD, which=1,
):  # fmt: skip
    """Sample a robot; with ``stop_at`` the person leaves at that request."""
    arena, poses = sampling_places()
    asked = []
    with (
        VirtualKheperaRig(
            which,
            noise_seed=noise_seed,
            place=arena,
            start=poses["open"],
            baud=baud,
            params=params,
        ) as rig,
        rig.robot as robot,
    ):

        def place(where):
            asked.append(where)
            if where == stop_at:
                raise Interrupted
            rig.lab.place(*poses[where])

        lab = rig.describe()
        result = sample(out, robot, settings, place, resume=resume, progress=False, lab=lab)
        return result, asked, rig.lab.body.params, arena


@pytest.mark.parametrize("nominal", [8333.0, 8000.0])
@pytest.mark.slow
def test_counters_of_another_number_of_pulses_are_refused(tmp_path, nominal):
    """The robot's are 10,000 a metre; it is taken for one of fewer, 12 or 12.5 to their 10."""
    arena, poses = sampling_places()
    placed = []
    with VirtualKheperaRig(1, place=arena, start=poses["open"], baud=BAUD) as rig:
        clock, timeout = rig.lab.clock, PATIENCE
        robot = Khepera(rig.address, pulses_per_metre=nominal, clock=clock, timeout=timeout)

        def place(where):
            placed.append(where)
            rig.lab.place(*poses[where])

        with robot, pytest.raises(UserError, match=r"the pulses per metre or.*--pulses-per-metre"):
            sample(tmp_path / "out", robot, SETTINGS, place, progress=False)
    assert placed == ["wall"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    out = tmp_path_factory.mktemp("sampling") / "out"
    return out, *sampled(out)


@pytest.mark.slow
def test_samples_are_what_the_sensors_see_there(whole):
    out, result, asked, params, arena = whole
    assert asked == ["wall", "cylinder", "open"]
    assert result["samples"] == ["wall.sample", "cylinder.sample"]
    rng = np.random.default_rng(0)
    for name, y in (("wall", 0.0), ("cylinder", 3.0)):
        computed = Samples.read(out / f"{name}.sample")
        assert computed.activations.shape == (2, 36, 8)
        truth = np.empty_like(computed.activations)
        for distance, away in enumerate((0.005, 0.015)):
            for angle in range(36):
                pose = np.array([-0.0275 - away, y, math.radians(10 * angle)])
                truth[distance, angle] = physics.proximity(
                    pose, params.angle, params.reach, params.threshold, params.offset,
                    (0.0, 0.0), 0.0, arena.surfaces, arena.cylinders, WHITE, rng,
                ) / 1023  # fmt: skip
        off = np.abs(computed.activations - truth)
        assert np.median(off) < 0.01
        assert off.mean() < 0.03
        assert truth.std() > 0.2


@pytest.mark.slow
def test_the_wheel_base_is_measured(whole):
    _, result, _, params, _ = whole
    # The counters of a turn: the measured distance over the wheels' nominal distance.
    seen = WHEEL_BASE / np.mean(params.wheel)
    assert result["wheel_base"] == pytest.approx(seen, rel=0.008)


@pytest.mark.slow
def test_the_sizes_of_the_wheels_are_measured(whole):
    _, result, _, params, _ = whole
    assert result["wheel_sizes"] == pytest.approx(params.wheel / params.wheel.mean(), abs=0.003)


@pytest.mark.slow
def test_motors(whole):
    out, result, _, _, _ = whole
    motors = MotorTable.read_csv(out / "motors.csv")
    assert motors.levels.tolist() == [-100, 0, 100]
    forward = motors.twist[2, 2]
    assert 0.06 < forward[0] < 0.1
    assert motors.twist[0, 2, 2] > 2.0  # left backward, right forward: to the left
    assert np.abs(motors.twist[1, 1]).max() == 0
    cost = result["interpolation"]
    assert cost["settings"] == 4
    assert 0 < cost["forward"]["median"] <= cost["forward"]["max"] < 0.02
    assert json.loads((out / "sampling.json").read_text())["result"] == result


@pytest.mark.slow
def test_how_late_the_robot_is(whole):
    _, result, _, params, _ = whole
    computed = Reaction.from_json(result["reaction"])
    assert computed.lag == pytest.approx(params.lag, abs=0.004)
    # A reading is 43 bytes at most; a command 8 or 10, less the 2 that ask for counters.
    byte = 11 / BAUD
    assert 20 * byte < computed.hold < 45 * byte
    assert computed.answer == pytest.approx(7 * byte + dialect_named("khepera").scan / 2, abs=0.003)


@pytest.mark.slow
def test_distances_hold_though_wheels_are_unequal(tmp_path):
    """Turning there and back at two speeds must not count as backing off."""
    settings = SampleSettings(angles=36, distances=5, step=0.008, grid=3, held_out=0, duration=0.5)
    uneven = replace(KheperaParams.sampled(1), dead_band=np.array([0.0, 0.002]), slip=0.0)
    sampled(tmp_path / "out", settings, params=uneven)
    result = read_turns(tmp_path / "out")
    arena, _ = sampling_places()
    rng = np.random.default_rng(0)
    samples = Samples.read(tmp_path / "out" / "wall.sample")
    assert len(result) == 10 + len(PIVOTS)
    for distance in range(5):
        pose = np.array([-0.0275 - 0.005 - 0.008 * distance, 0.0, 0.0])
        truth = physics.proximity(
            pose, uneven.angle, uneven.reach, uneven.threshold, uneven.offset, (0.0, 0.0), 0.0,
            arena.surfaces, arena.cylinders, WHITE, rng,
        ) / 1023  # fmt: skip
        assert samples.activations[distance, 0] == pytest.approx(truth, abs=0.08)


@pytest.mark.slow
def test_interrupted_sampling_goes_on(tmp_path, whole):
    out = tmp_path / "out"
    with pytest.raises(Interrupted):
        sampled(out, stop_at="cylinder")
    before = (out / "sensors.csv").read_bytes()
    # A kill in the middle of a turn and of a line: both are passed over.
    torn = b"cylinder,1,0,9,0,1.0,0.1,0,0,0,0" + b",0.5" * 8 + b"\ncylinder,1,0,9,0,1.1,0"
    (out / "sensors.csv").write_bytes(before + torn)
    with pytest.raises(FileError, match="other settings"):
        sampled(out, SampleSettings(angles=20), resume=True)
    with pytest.raises(FileError, match="was begun with baud = 9600, not 38400"):
        sampled(out, resume=True, baud=38400)
    with pytest.raises(FileError, match="was begun with robot_seed = 1, not 2"):
        sampled(out, resume=True, which=2)
    with pytest.raises(UserError, match="not empty"):
        sampled(out)
    with files.locked(out, "used"), pytest.raises(UserError, match="is being sampled into by"):
        sampled(out, resume=True)
    result, asked, _, _ = sampled(out, resume=True)
    assert asked == ["cylinder", "open"]
    assert (out / "sensors.csv").read_bytes().startswith(before)
    assert Samples.read(out / "cylinder.sample").activations.shape == (2, 36, 8)
    assert result["wheel_base"] == pytest.approx(whole[1]["wheel_base"], rel=0.01)
    again, asked, _, _ = sampled(out, resume=True)
    assert asked == []
    assert again == result


@pytest.mark.slow
def test_a_thymio_samples_itself_too(tmp_path):
    """Seven sensors, of which five look ahead and two behind, on a body three times as large."""
    out, radius = tmp_path / "out", BODY.radius
    settings = SampleSettings(angles=36, distances=2, grid=3, held_out=0, duration=0.5)
    place, _ = sampling_places()
    with VirtualThymioRig(2, camera=False, around=place, start=(-2.0, 1.5, 0.0)) as rig:

        def put(where):
            rig.lab.place(*sampling_places(radius=radius)[1][where])

        with rig.robot as robot:
            result = sample(out, robot, settings, put, progress=False, lab=rig.describe())
        body = rig.lab.body
        body._noise = type("Silent", (), {"standard_normal": staticmethod(np.zeros)})
        for name, y in (("wall", 0.0), ("cylinder", 3.0)):
            computed = Samples.read(out / f"{name}.sample")
            assert computed.activations.shape == (2, 36, 7)
            assert (computed.first_distance, computed.distance_step) == (0.005, 0.135)
            truth = np.empty_like(computed.activations)
            for distance, away in enumerate((0.005, 0.14)):
                for angle in range(36):
                    body.place(-radius - away, y, math.radians(10 * angle))
                    truth[distance, angle] = np.array(body.proximity()) / NEAR
            off = np.abs(computed.activations - truth)
            assert np.median(off) < 0.005
            assert off.mean() < 0.03
            assert truth[0, 0, 2] > 0.8 > truth[0, 18, 5] > 0.5 > 0.01 > truth[0, 18, 2]
    wheels = body.wheels
    # The counters of a turn: the measured distance over the wheels' nominal distance.
    assert result["wheel_base"] == pytest.approx(BODY.wheel_base / wheels.mean(), rel=0.05)
    # They differ from their mean by 3 %; the slip of a turn changes by 0.8 % from turn to turn.
    assert result["wheel_sizes"] == pytest.approx(wheels / wheels.mean(), abs=0.012)
    computed = Reaction.from_json(result["reaction"])
    assert 0.05 < computed.answer < 0.08  # half a scan, plus the line's delay
    # A folder of tables knows the robot's size, and that its speeds are whole ones of 500.
    paths = [out / "wall.sample", out / "cylinder.sample"]
    simulator = build_tables(paths, out / "motors.csv", place=ROOMY)
    assert (simulator.radius, simulator.meta["body"]["radius"]) == (radius, "sampled")
    assert simulator.motors.resolution == 0.2
    assert simulator.reading_names == tuple(f"sensor_{number}" for number in range(7))
    looks = np.degrees(simulator.bearings)
    assert looks[:5] == pytest.approx([40, 20, 0, -20, -40], abs=6)
    assert np.abs(looks[5:]) == pytest.approx(180, abs=15)


def test_full_turn_is_where_the_sensors_repeat():
    turned = np.linspace(0, 900, 400)
    angle = 2 * np.pi * turned / 790
    where = np.zeros_like(turned)
    counts = np.column_stack([-turned, turned])
    rows = np.column_stack([counts, where, where, np.exp(3 * np.cos(angle - 0.4)), np.cos(angle)])
    assert full_turn({("wall", 1, 0): rows}) == pytest.approx(790, rel=1e-3)


class _Plain:
    """A robot of nominal size, and its readings: sensor s looks at 45 s degrees."""

    pulses_per_metre, full = 10_000.0, 1665.0
    geometry = type("Geometry", (), {"radius": 0.0275})

    @staticmethod
    def reads(distance, angle):
        off = angle[:, None] - 2 * np.pi * np.arange(8) / 8
        return np.exp(3 * (np.cos(off) - 1)) * (0.9 - 12 * np.asarray(distance)[:, None])

    @classmethod
    def turns(cls, facing, slips, settings):
        """Turn there and back at every distance, at first too far to the left by this (rad)."""
        results = {}
        distance = (
            np.concatenate([np.linspace(0, 7 / 6, 600), np.linspace(7 / 6, 0, 600)]) * cls.full
        )
        for name, off in facing.items():
            slipped = 0.0
            for k in range(settings.distances):
                away = settings.first + settings.step * k
                truth = away + slipped + slips * np.linspace(0, 1, len(distance))
                seen = cls.reads(truth, 2 * np.pi * distance / cls.full + off)
                where = np.full_like(distance, -away), np.zeros_like(distance)
                results[name, 1, k] = np.column_stack([-distance, distance, *where, seen])
                slipped += slips
        return results

    @classmethod
    def samples(cls, out, facing, slips, settings):
        turns = cls.turns(facing, slips, settings)
        paths = write_samples(out, settings, turns, cls(), cls.full, (1.0, 1.0))
        return [Samples.read(path).activations for path in paths]


def test_what_wheels_slip_in_a_turn_is_seen(tmp_path):
    settings = SampleSettings(angles=36, distances=12, first=0.005, step=0.003)
    angles = np.tile(np.radians(10 * np.arange(36)), 12)
    away = np.repeat(0.005 + 0.003 * np.arange(12), 36)
    truth = _Plain.reads(away, angles).reshape(12, 36, 8)
    wall, _ = _Plain.samples(tmp_path, {"wall": 0.0, "cylinder": 0.0}, 0.0005, settings)
    # Without correction, 5 mm of slip would have added up there: 0.06.
    assert np.abs(wall[:10] - truth[:10]).max() < 0.025


def test_samples_are_readings_beside_a_steep_edge(tmp_path):
    """A straight line through such readings would leave their range."""
    settings = SampleSettings(angles=180, distances=2, first=0.005, step=0.01)
    turns = _Plain.turns({"wall": 0.0, "cylinder": 0.01}, 0.0, settings)
    for rows in turns.values():
        rows[:, 4:] = rows[:, 4:] > 0.3
    for path in write_samples(tmp_path, settings, turns, _Plain(), _Plain.full, (1.0, 1.0)):
        result = Samples.read(path).activations
        assert (result.min(), result.max()) == (0, 1)


def test_wall_and_obstacle_agree_in_where_sensors_look(tmp_path):
    settings = SampleSettings(angles=90, distances=2, step=0.002)
    facing = {"wall": 0.03, "cylinder": -0.01}
    wall, cylinder = _Plain.samples(tmp_path, facing, 0.0, settings)
    assert wall == pytest.approx(cylinder, abs=2e-3)
    angles = np.radians(4 * np.arange(90))
    truth = _Plain.reads(np.full(90, 0.005), angles + 0.01)
    assert wall[0] == pytest.approx(truth, abs=4e-3)


def test_a_robot_that_is_held_is_reported(tmp_path):
    class Held(Khepera):
        stopped = 0

        class Clock:
            time = 0.0

            def now(self):
                self.time += 0.02
                return self.time

        def describe(self):
            return {}

        def set_counts(self, left, right):
            pass

        set_speeds = set_counts

        def read_counts(self):
            return 0, 0

        def stop(self):
            self.stopped += 1

    robot = Held("port", clock=Held.Clock())
    with pytest.raises(RobotError, match="wheels do not turn"):
        sample(tmp_path / "out", robot, SETTINGS, lambda where: None, progress=False)
    assert robot.stopped


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--grid", "4"], "a grid of 4 does not fall on the robot's 21 whole speeds"),
        (["--robot", "khepera"], "--robot khepera needs --port: serial port, such as /dev/tty"),
        (["--port", "COM3"], "--port: leave it out, or choose --robot khepera"),
        (["--dialect", "epuck"], "--dialect: leave it out, or choose --robot khepera"),
        (["--robot", "virtual"], "this robot cannot sample itself: it needs a ring"),
    ],
)
def test_refusals(tmp_path, words, message):
    out = tmp_path / "out"
    with pytest.raises(UserError, match=message):
        CliRunner().invoke(cli, ["sample", str(out), *words], catch_exceptions=False)
    assert not out.exists()


def test_speeds_to_drive():
    assert SampleSettings().levels(10).tolist() == list(range(-10, 11))
    for dialect in DIALECTS.values():
        full = dialect.full_speed
        assert SampleSettings(grid=5).levels(full).tolist() == [
            -full,
            -full // 2,
            0,
            full // 2,
            full,
        ]
    with pytest.raises(UserError, match=r"2,001 speeds would be 4,004,001 settings.*choose a grid"):
        SampleSettings().levels(1000)
    with pytest.raises(UserError, match=r"use 2, 3, 4, 5, 6, 7, 9, 10, 11, 13, 16, 17 \.\.\.$"):
        SampleSettings(grid=8).levels(14_400)


def test_resume_takes_the_options_it_was_begun_with(tmp_path, monkeypatch):
    out, seen = tmp_path / "out", []

    def interrupted(out, robot, settings, place, **others):
        about = robot.describe()
        seen.append((settings, others["seed"], about["virtual"], about["baud"]))
        if not others["resume"]:
            files.write_json(out / "sampling.json", FORMAT, VERSION, {"options": others["options"]})
        raise KeyboardInterrupt

    monkeypatch.setattr("neurosim.sampling.sample", interrupted)
    begun = ["--angles", "24", "--grid", "5", "--seed", "3", "--lab-seed", "2", "--baud", "38400"]
    for words in (begun, ["--resume"], ["--resume", "--angles", "30"]):
        with pytest.raises(click.Abort):
            cli.main(["sample", str(out), *words], standalone_mode=False)
    assert seen[0] == seen[1]
    assert (seen[1][0].angles, seen[1][0].grid, *seen[1][1:]) == (24, 5, 3, True, 38400)
    assert (seen[2][0].angles, seen[2][0].grid) == (30, 5)


def test_the_distances_reach_as_far_as_the_sensors_see():
    """By hand: 19 steps from 5 mm to 43 mm of a Khepera, and to 14 cm of a Thymio."""
    khepera, thymio = Khepera("port"), Thymio("port")
    assert SampleSettings().of(khepera).step == 0.002
    assert SampleSettings().of(thymio).step == 0.0071
    assert SampleSettings(step=0.003).of(thymio).step == 0.003
