"""Findings about virtual robots: correct ones, and ones with a single fault."""

import json

import pytest
from processes import neurosim

from neurosim.base.commands import Commands, Number
from neurosim.lab import VirtualKheperaRig, VirtualLinesRig, VirtualRig
from neurosim.lab.lines.bodies import TwoWheels
from neurosim.lab.lines.firmware import LinesFirmware
from neurosim.robots.base import Geometry
from neurosim.robots.check import check


def checked(rig, ask=None):
    with rig, rig.robot as robot:
        return {one.what: one for one in check(robot, ask)}


def lines(ask=None, **options):
    return checked(VirtualLinesRig(1, camera=False, **options), ask)


def wrong(result):
    return {what: one.sentence for what, one in result.items() if one.verdict == "wrong"}


def test_a_robot_that_is_as_it_says():
    result = lines()
    assert not wrong(result)
    assert {one.verdict for one in result.values()} == {"good"}
    # 115,200 baud carry an answer of 50 bytes in 4 ms.
    assert 3 < result["latency"].measured["latency_ms"] < 15
    assert result["command left"].measured["speed_m_s"] == pytest.approx(0.15, rel=0.05)
    # It takes whole percents, and turns from 4 % on.
    assert result["dead band left"].measured["least_percent"] == pytest.approx(5)
    assert 7 < result["battery"].measured["battery_v"] < 9
    json.dumps([one.describe() for one in result.values()])


def test_a_khepera_has_nothing_that_stops_it():
    with VirtualKheperaRig(1, start=(-0.1, 0.1, 0.0)) as rig:
        report = checked(rig)
    assert set(wrong(report)) == {"self-stopping"}
    assert "when the computer fails" in report["self-stopping"].sentence
    assert report["battery"].verdict == "unknown"


def test_where_nothing_counts_a_person_is_asked():
    silent = lines(kind="omni")
    assert {silent[f"command {name}"].verdict for name in ("vx", "vy", "omega")} == {"unknown"}
    asked = []
    result = lines(lambda question: asked.append(question) or "left, counter" not in question,
                  kind="omni")  # fmt: skip
    assert "Did it drive forward?" in asked
    assert "Did it drive to its left?" in asked
    assert set(wrong(result)) == {"command omega"}
    assert "change the sign" in result["command omega"].sentence
    with VirtualRig(1, camera=False) as rig:
        assert checked(rig)["command left"].verdict == "unknown"


class CountingCar:
    """A car that follows at once, ``factor`` times as fast, and counts 1000 pulses a metre."""

    commands = Commands(
        (Number("speed", "m/s", -0.4, 0.4), Number("steer", "rad", -0.5, 0.5, speed=False)),
        "car",
        {"wheelbase": 0.16},
    )
    pulses_per_metre, geometry = 1000.0, Geometry(0.1, 0.12)

    def __init__(self, factor):
        self.clock, self.factor, self.time, self.pulses, self.speed = self, factor, 0.0, 0.0, 0.0

    def now(self):
        return self.time

    def sleep_until(self, time):
        self.pulses += 1000 * self.factor * self.speed * max(time - self.time, 0.0)
        self.time = max(time, self.time)

    def drive(self, command):
        self.speed = command[0]

    def stop(self):
        self.speed = 0.0

    def read_counts(self):
        return round(self.pulses), round(self.pulses)

    def set_counts(self, left, right):
        self.pulses = left


@pytest.mark.parametrize(
    ("factor", "verdict", "says"),
    [
        (1.0, "good", "drive forward, at 0.120 m/s; commanded were 0.120"),
        (-1.0, "wrong", "does the opposite: change the sign"),
        (0.5, "wrong", "at 0.060 m/s, not at the commanded 0.120"),
    ],
)
def test_counters_tell_what_a_cars_speed_does(factor, verdict, says):
    (result,) = (one for one in check(CountingCar(factor)) if one.what == "command speed")
    assert result.verdict == verdict
    assert says in result.sentence


def body(monkeypatch, change):
    """Change the commands before the two wheels carry them out."""
    move = TwoWheels.move
    monkeypatch.setattr(TwoWheels, "move", lambda self, command: move(self, change(*command)))


@pytest.mark.parametrize(
    ("change", "what", "says"),
    [
        (lambda left, right: (right, left), "command left", "exchange the motors' plugs"),
        (lambda left, right: (-left, right), "command left", "left wheel turns backwards"),
        (lambda left, right: (left, 0.6 * right), "command right", "correct the full speed"),
        (lambda left, right: (left * (left >= 25), right), "dead band left", "from 30 % on"),
        (lambda left, right: (0, 0), "self-stopping", "did not move it"),
    ],
)
def test_wheels_that_are_wrong_in_one_way(monkeypatch, change, what, says):
    body(monkeypatch, change)
    assert says in wrong(lines())[what]


def test_a_robot_that_does_not_stop_by_itself_is_found(monkeypatch):
    monkeypatch.setattr(LinesFirmware, "end", lambda self: setattr(self, "ends", float("inf")))
    assert "continues to drive after the end of its command" in wrong(lines())["self-stopping"]


def test_a_slow_line_is_found():
    result = lines(baud=2400)
    assert "too slow for closed-loop controllers" in wrong(result)["latency"]
    assert result["latency"].measured["latency_ms"] > 100


@pytest.mark.slow
def test_from_the_command_line(tmp_path):
    run = ["check-robot", "--robot"]
    done = neurosim(*run, "virtual-car", "--json", cwd=tmp_path)
    content = json.loads(done.stdout)
    assert content["robot"]["name"] == "car"
    assert content["wrong"] == 0
    done = neurosim(*run, "virtual-khepera", cwd=tmp_path, check=False)
    assert done.returncode == 1
    assert "WRONG  self-stopping: nothing stops it" in done.stdout
