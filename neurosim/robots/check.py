"""Tries a robot before a recording: its answering time, whether it stops, its directions.

The check uses only the abilities of the driver, so that it works with any driver. The robot drives
slowly for short times: give it free space.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np

from neurosim.base import se2
from neurosim.base.commands import Number
from neurosim.robots.base import Battery, Counters, Robot, SelfStopping, Sensors

#: Number of questions whose answers are timed.
QUESTIONS = 40
#: Length of a closed-loop step, with a reading of the sensors and a command, s.
STEP = 0.1
#: Time after which a stopped robot is at rest, s.
COASTS = 1.0
#: Speed of the check, as a fraction of the limits.
GENTLE = 0.3
#: Fractions of a limit at which a wheel is tried for its dead band.
LEVELS = (0.01, 0.02, 0.03, 0.05, 0.08, 0.12, 0.2, 0.3)

Verdict = Literal["good", "wrong", "unknown"]


@dataclass(frozen=True)
class Finding:
    """The result of one check.

    Attributes:
        what: subject of the check, in a word or two.
        verdict: good, wrong, or unknown if it cannot be measured.
        sentence: one sentence; for wrong or unknown also with advice.
        measured: numbers, by name, with the unit in the name.
    """

    what: str
    verdict: Verdict
    sentence: str
    measured: dict[str, Any] = field(default_factory=dict)

    def describe(self) -> dict[str, Any]:
        """Return the result for JSON."""
        return asdict(self)


def check(robot: Robot, ask: Callable[[str], bool] | None = None) -> list[Finding]:
    """Check a robot.

    Args:
        robot: connected, standing free.
        ask: asks a person a yes-no question, for robots without wheel counters; None: nobody is
            there.

    Raises:
        LinkLost: if it stops answering.
    """
    tried = _Tried(robot, ask)
    try:
        findings = [tried.latency(), tried.order(), tried.self_stopping()]
        findings += tried.numbers()
        findings += tried.dead_bands()
        findings.append(tried.battery())
    finally:
        robot.stop()
    return findings


class _Tried:
    def __init__(self, robot: Robot, ask: Callable[[str], bool] | None):
        self._robot, self._ask, self._clock = robot, ask, robot.clock
        self._takes = robot.commands
        self._counter = robot if isinstance(robot, Counters) else None

    def latency(self) -> Finding:
        """Time the robot's shortest questions."""
        question: Callable[[], Any] = self._robot.stop
        if isinstance(self._robot, Sensors) and self._robot.sensor_names:
            question = self._robot.read_sensors
        elif self._counter is not None:
            question = self._counter.read_counts
        times = []
        for _ in range(QUESTIONS):
            asked = self._clock.now()
            question()
            times.append(self._clock.now() - asked)
        usual, late = float(np.median(times)), float(np.quantile(times, 0.95))
        measured = {"latency_ms": 1000 * usual, "latency_95_ms": 1000 * late,
                    "rate_hz": 1 / max(usual, 1e-6)}  # fmt: skip
        sentence = (
            f"it answers after {1000 * usual:.0f} ms, 95 % of the time within {1000 * late:.0f} ms"
        )
        if 2 * late > STEP:
            sentence += (
                f": enough for plans, too slow for closed-loop controllers with steps of {STEP:g} "
                "s; for these use a cable in place of a radio, raise --baud on a serial line, or "
                "give the task longer steps"
            )
            return Finding("latency", "wrong", sentence, measured)
        return Finding("latency", "good", sentence, measured)

    def order(self) -> Finding:
        """Check that the last of many commands holds: the robot must stand."""
        for _ in range(5):
            self._robot.drive(self._gentle())
            self._robot.drive(self._takes.rest())
        return self._stands(
            "order",
            "the last of ten commands, a stop, holds",
            "it continues to drive after commands that end in a stop: some commands are lost, or "
            "their order changes",
        )

    def self_stopping(self) -> Finding:
        """Check whether the robot stops without the computer."""
        if not isinstance(self._robot, SelfStopping):
            return Finding(
                "self-stopping", "wrong",
                "nothing stops it when the computer fails or the line is cut: stay near, with a "
                "hand at its switch; a driver with drive_for would help",
            )  # fmt: skip
        before = self._counts()
        self._robot.drive_for(self._gentle(), 0.3)
        self._wait(0.3 + 2.0)
        moved = self._counts() != before
        finding = self._stands(
            "self-stopping", "it stops by itself after its command, with nothing sent",
            "it continues to drive after the end of its command, although its driver is "
            "SelfStopping",
        )  # fmt: skip
        if self._counter is not None and not moved:
            return Finding(
                "self-stopping", "wrong",
                "a command of 0.3 s did not move it: are its motors on, and its wheels free?",
            )  # fmt: skip
        return finding

    def numbers(self) -> list[Finding]:
        """Check direction and speed of each number of a command."""
        findings = []
        for place, one in enumerate(self._takes.numbers):
            if not one.speed:
                continue
            command = [0.0] * len(self._takes.numbers)
            command[place] = GENTLE * one.high
            if self._counter is not None and self._takes.body == "wheels":
                findings.append(self._wheel(place, command))
            elif self._counter is not None and (
                self._takes.body == "car" or one.name in ("v", "vx", "w", "omega")
            ):
                findings.append(self._velocity(one, command))
            else:
                findings.append(self._seen(one.name, command))
        return findings

    def _wheel(self, place: int, command: list[float]) -> Finding:
        assert self._counter is not None
        name = self._takes.names[place]
        speeds = self._speeds(command)
        speed, other = speeds[place], speeds[1 - place]
        measured = {"speed_m_s": speed, "other_wheel_m_s": other}
        full = self._takes.measures.get("full", 0.0)
        what = f"command {name}"
        if abs(other) > 2 * abs(speed):
            return Finding(what, "wrong", f"{name} turns the other wheel: exchange the motors' "
                           "plugs or ports", measured)  # fmt: skip
        if speed <= 0:
            does = "turns backwards" if speed < 0 else "does not turn"
            return Finding(what, "wrong", f"its {name} wheel {does} on a positive command, by its "
                           "counter: exchange the wires of the motor or of its encoder",
                           measured)  # fmt: skip
        if full and not 0.8 < speed / (GENTLE * full) < 1.2:
            return Finding(
                what, "wrong",
                f"its {name} wheel turns at {speed:.3f} m/s where {GENTLE * full:.3f} m/s were "
                "commanded: correct the full speed or the pulses per metre that it says",
                measured,
            )  # fmt: skip
        return Finding(what, "good", f"its {name} wheel drives forward at {speed:.3f} m/s at "
                       f"{100 * GENTLE:.0f} %", measured)  # fmt: skip

    def _velocity(self, one: Number, command: list[float]) -> Finding:
        """Check a base's own velocity by counters of virtual wheels."""
        assert self._counter is not None
        twist = se2.of_wheels(*self._speeds(command), self._counter.geometry.wheel_base)
        part = 0 if one.unit == "m/s" else 2
        does, direction = (("drive", "forward"), ("", ""), ("turn", "to the left"))[part]
        reached, wanted = float(twist[part]), GENTLE * one.high
        measured = {f"reached_{one.unit.replace('/', '_')}": reached}
        what, given = f"command {one.name}", f"a positive {one.name}"
        if abs(reached) < 0.1 * wanted:
            return Finding(what, "wrong", f"{given} does not make it {does}: are its motors on, "
                           "and does another node command it?", measured)  # fmt: skip
        if reached < 0:
            return Finding(what, "wrong", f"{given} should make it {does} {direction}; by its "
                           "counters it does the opposite: change the sign in its program",
                           measured)  # fmt: skip
        if not 0.8 < reached / wanted < 1.2:
            return Finding(
                what, "wrong",
                f"{given} makes it {does} at {reached:.3f} {one.unit}, not at the commanded "
                f"{wanted:.3f}: lower the driver's limit, or correct the robot's measures",
                measured,
            )  # fmt: skip
        return Finding(what, "good", f"{given} makes it {does} {direction}, at {reached:.3f} "
                       f"{one.unit}; commanded were {wanted:.3f}", measured)  # fmt: skip

    def _speeds(self, command: list[float]) -> list[float]:
        """Return both wheels' speeds at a command, by their counters, m/s."""
        assert self._counter is not None
        self._robot.drive(command)
        self._wait(0.5)  # longer than its lag
        begin, first = self._clock.now(), self._counts()
        self._wait(1.0)
        seconds, last = self._clock.now() - begin, self._counts()
        self._robot.stop()
        self._wait(COASTS)
        return [(b - a) / self._counter.pulses_per_metre / seconds
                for a, b in zip(first, last, strict=True)]  # fmt: skip

    def _seen(self, name: str, command: list[float]) -> Finding:
        if self._ask is None:
            return Finding(
                f"command {name}", "unknown",
                f"nothing counts what a positive {name} does: watch it, and say --ask to be asked",
            )  # fmt: skip
        self._robot.drive(command)
        self._wait(1.0)
        self._robot.stop()
        part = int(np.abs(self._takes.twist(command)).argmax()) if self._takes.body else 0
        direction = ("forward", "to its left", "to the left, counter-clockwise")[part]
        motion = "turn" if part == 2 else "drive"
        if self._ask(f"Did it {motion} {direction}?"):
            return Finding(
                f"command {name}", "good", f"a positive {name} makes it {motion} {direction}"
            )
        return Finding(
            f"command {name}", "wrong",
            f"a positive {name} should make it {motion} {direction}: "
            "change the sign in its program",
        )  # fmt: skip

    def dead_bands(self) -> list[Finding]:
        """Find the smallest command that turns each wheel, by its counter."""
        if self._counter is None or self._takes.body != "wheels":
            return []
        findings = []
        for place, one in enumerate(self._takes.numbers):
            least = math.nan
            for level in LEVELS:
                command = [0.0, 0.0]
                command[place] = level * one.high
                before = self._counts()[place]
                self._robot.drive(command)
                self._wait(0.5)
                moved = abs(self._counts()[place] - before) > 2
                self._robot.stop()
                self._wait(0.3)
                if moved:
                    least = level
                    break
            measured = {"least_percent": 100 * least}
            what = f"dead band {one.name}"
            if math.isnan(least):
                sentence = (
                    f"{100 * LEVELS[-1]:.0f} % do not turn it: are its motors on, and charged?"
                )
                findings.append(Finding(what, "wrong", sentence, {}))
            elif least > 0.2:
                sentence = (f"it turns from {100 * least:.0f} % on: record with speeds well above, "
                            "or regulate the speed in its program")  # fmt: skip
                findings.append(Finding(what, "wrong", sentence, measured))
            else:
                sentence = f"it turns from {100 * least:.0f} % on, or below"
                findings.append(Finding(what, "good", sentence, measured))
        return findings

    def battery(self) -> Finding:
        """Read the battery."""
        if not isinstance(self._robot, Battery):
            return Finding("battery", "unknown", "it does not say how full its battery is: charge "
                           "it before a long recording")  # fmt: skip
        volts = self._robot.battery()
        if not volts > 0:
            return Finding("battery", "unknown", "its battery's voltage is not known: charge it")
        return Finding("battery", "good", f"its battery has {volts:.2f} V", {"battery_v": volts})

    def _stands(self, what: str, good: str, wrong: str) -> Finding:
        """Check by the counters, or by asking a person, whether the robot stands now."""
        self._wait(COASTS)
        if self._counter is None:
            if self._ask is None:
                return Finding(what, "unknown", "nothing counts its wheels: watch whether it "
                               "stands now, and say --ask to be asked")  # fmt: skip
            stands = self._ask("Does it stand still now?")
        else:
            before = self._counts()
            self._wait(0.5)
            stands = self._counts() == before
        return Finding(what, "good" if stands else "wrong", good if stands else wrong)

    def _counts(self) -> tuple[int, ...]:
        return () if self._counter is None else tuple(self._counter.read_counts())

    def _gentle(self) -> tuple[float, ...]:
        numbers = self._takes.numbers
        return tuple(GENTLE * one.high if one.speed else 0.0 for one in numbers)

    def _wait(self, seconds: float) -> None:
        self._clock.sleep_until(self._clock.now() + seconds)
