from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neurosim.base.errors import UserError
from tracking.clock.sync import ClockFit, fit_clock, pulses

#: Two flashes of different length; edges at different phases of a frame of 30 a second.
PATTERN = ((1.0, 1.608), (2.016, 2.324))


def again(pattern, later):
    return [(on + later, off + later) for on, off in pattern]


def film(lamp, seconds, *, offset=-12.5, drift=0.0, fps=30.0, exposure=1.0, seed=0, full=1.0):
    """Camera times and lamp brightness; the lamp's light is gathered in fine steps."""
    rng = np.random.default_rng(seed)
    robot = rng.uniform(0, 1 / fps) + np.arange(int(seconds * fps)) / fps
    moments = robot[:, None] + np.linspace(-0.5, 0.5, 201) * exposure / fps
    lit = np.zeros_like(moments, bool)
    for on, off in lamp:
        lit |= (moments >= on) & (moments < off)
    wander = np.cumsum(rng.normal(0, 0.02, len(robot)))
    brightness = 20 + 20 * np.minimum(full * lit.mean(1), 1) + wander
    brightness += rng.normal(0, 0.5, len(robot))
    return (robot - offset) / (1 + drift), brightness, robot


@settings(max_examples=20, deadline=None)
@given(
    st.floats(-100, 100), st.floats(-2e-4, 2e-4), st.integers(0, 10**6), st.sampled_from([1.0, 0.4])
)
def test_offset_and_drift_to_5_ms(offset, drift, seed, exposure):
    lamp = [*PATTERN, *again(PATTERN, 90)]
    times, brightness, robot = film(
        lamp, 95, offset=offset, drift=drift, exposure=exposure, seed=seed
    )
    brightness[np.random.default_rng(seed).random(len(times)) < 0.01] = np.nan
    fit = fit_clock(times, brightness, lamp)
    assert np.abs(fit.to_robot(times) - robot).max() < 0.005
    assert len(fit.flashes) == 2
    np.testing.assert_allclose(fit.to_robot(fit.flashes), (1.0, 91.0), atol=1e-9)
    assert fit.residual < 0.02


def test_one_flash_gives_no_drift():
    times, brightness, robot = film(PATTERN, 60, drift=2e-5)
    fit = fit_clock(times, brightness, list(PATTERN))
    assert fit.drift == 0
    assert np.abs(fit.to_robot(times[:150]) - robot[:150]).max() < 0.005


def test_a_lamp_that_saturates_the_picture():
    times, brightness, robot = film(PATTERN, 20, full=2.0)
    fit = fit_clock(times, brightness, list(PATTERN))
    assert np.abs(fit.to_robot(times) - robot).max() < 0.009


def test_the_end_was_not_filmed():
    lamp = [*PATTERN, *again(PATTERN, 300)]
    times, brightness, robot = film(lamp, 60)
    fit = fit_clock(times, brightness, lamp)
    assert fit.drift == 0
    assert len(fit.flashes) == 1
    assert np.abs(fit.to_robot(times) - robot).max() < 0.005


def test_other_bright_moments_are_not_the_flash():
    times, brightness, robot = film(PATTERN, 60)
    for begin, end in ((10, 11.2), (30, 30.3), (45, 52)):
        brightness[(robot > begin) & (robot < end)] += 15
    fit = fit_clock(times, brightness, list(PATTERN))
    assert np.abs(fit.to_robot(times) - robot).max() < 0.005


def test_no_flash():
    times, brightness, _ = film([], 60)
    with pytest.raises(UserError, match="no flash found"):
        fit_clock(times, brightness, list(PATTERN))
    with pytest.raises(UserError, match="no flash found"):
        fit_clock(times, np.full(len(times), np.nan), list(PATTERN))
    with pytest.raises(UserError, match="never switched on"):
        fit_clock(times, brightness, [])


def test_two_places_that_fit():
    times, brightness, _ = film([(10.0, 10.5), (40.0, 40.5)], 60)
    with pytest.raises(UserError, match="ambiguous"):
        fit_clock(times, brightness, [(1.0, 1.5)])


def test_to_robot_by_hand():
    fit = ClockFit(offset=-2.0, drift=0.001, residual=0.0, flashes=())
    np.testing.assert_allclose(fit.to_robot([0.0, 1000.0]), [-2.0, 999.0])


@dataclass
class Line:
    kind: str
    time: float


def test_pulses_of_a_log():
    kinds = ["lamp-off", "lamp-on", "lamp-off", "command", "lamp-on", "lamp-on", "lamp-off"]
    lines = [Line(kind, float(i)) for i, kind in enumerate([*kinds, "lamp-on"])]
    assert pulses(lines) == [(1.0, 2.0), (4.0, 6.0)]
