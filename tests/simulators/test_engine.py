"""A user's own simulator in the compiled loop: equal to its steps, cached, never stale."""

import subprocess
import sys

import numpy as np
import pytest

import neurosim as ns
from neurosim import testing
from neurosim.base import threads
from neurosim.simulators import engine

OWN = """
from typing import NamedTuple

import numpy as np
import torch
from numba import njit

import neurosim as ns


class Slider(NamedTuple):
    gain: float


@njit
def step(model, states, command, z, work):
    for r in range(len(states)):
        states[r, 0] += model.gain * command[0] * command[2] * FACTOR
        if len(z) > 0:
            states[r, 1] += 0.01 * z[r, 0]


@njit
def sense(model, state, z, work, out):
    out[0] = min(max(state[0], 0.0), 1.0)


ns.compiled(Slider, step, sense)


class Own(ns.Simulator):
    kind = "own"
    state_names = ("x", "y", "theta")
    command_names = ("left", "right", "duration")
    reading_names = ("front",)
    has_noise, noise_width = True, 1
    domain = {"left": (-50.0, 50.0), "right": (-50.0, 50.0), "duration": (0.0, 2.0)}

    def start(self, pose, generator=None):
        return pose

    def step(self, state, command, generator=None, z=None):
        if generator is not None:
            z = torch.randn(len(state), 1, generator=generator, dtype=torch.float64)
        moved = 0.01 * command[:, 0] * command[:, 2] * FACTOR
        aside = torch.zeros_like(moved) if z is None else 0.01 * z[:, 0]
        return torch.stack([state[:, 0] + moved, state[:, 1] + aside, state[:, 2]], 1)

    def sense(self, state, generator=None, z=None):
        return state[:, :1].clamp(0.0, 1.0)

    def compiled(self):
        return Slider(0.01)
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """Return a function that writes the module with a factor and returns its simulator."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def written(factor):
        (tmp_path / "own_slider.py").write_text(OWN.replace("FACTOR", factor))
        sys.modules.pop("own_slider", None)
        import own_slider

        return own_slider.Own()

    return written


@pytest.mark.slow
def test_a_simulator_of_ones_own_is_what_its_steps_say(own):
    testing.check_simulator(own("2.0"))


@pytest.mark.slow
def test_cores_share_trials_out_and_find_the_same(own, monkeypatch):
    simulator, fractions = own("2.0"), []
    functions = engine.functions_of(simulator.compiled())

    def drive(*given):
        fractions.append((*given[5:7], given[7].pool.own))
        functions.drive(*given)

    drive.overloads = {"compiled": True}
    own_functions = {type(simulator.compiled()): functions._replace(drive=drive)}
    monkeypatch.setattr(engine, "_FUNCTIONS", own_functions)

    def driven(cores):
        fractions.clear()
        monkeypatch.setattr(threads.numba, "get_num_threads", lambda: cores)
        return ns.rollout(simulator, [[20.0, 20.0, 1.0]] * 3, samples=301).poses

    alone = driven(1)
    assert sorted(fractions) == [(0, 1, 0)]
    assert np.array_equal(driven(3), alone)
    assert sorted(fractions) == [(0, 3, 0), (0, 3, 1), (0, 3, 2)]


@pytest.mark.slow
def test_what_is_compiled_is_kept_and_never_stale(own, tmp_path):
    own("3.0")
    program = """
import numpy as np, own_slider, neurosim as ns
from neurosim.simulators import engine
plan = ns.make_controller("plan", slots=2)
print(ns.rollout(own_slider.Own(), np.array([[50.0, 0.0, 1.0]])).poses[-1, 0])
loop = engine.functions_of(own_slider.Own().compiled()).drive
print(sum(loop.stats.cache_hits.values()))
"""

    def ran():
        done = subprocess.run(
            [sys.executable, "-c", program],
            env={**__import__("os").environ, "PYTHONPATH": f"{tmp_path}:{':'.join(sys.path)}"},
            capture_output=True,
            text=True,
            check=True,
        )
        x, hits = done.stdout.split()
        return float(x), int(hits)

    assert ran()[0] == pytest.approx(1.5)
    assert ran() == (pytest.approx(1.5), 1)
    (tmp_path / "own_slider.py").write_text(OWN.replace("FACTOR", "4.0"))
    assert ran()[0] == pytest.approx(2.0)


def test_a_model_without_functions_is_refused():
    class Empty(ns.Simulator):
        state_names, command_names = ("x", "y", "theta"), ("left", "right", "duration")

        def start(self, pose, generator=None):
            return pose

        def compiled(self):
            return np.zeros(3)

    with pytest.raises(TypeError, match="ndarray has no compiled functions"):
        Empty().stepper()


def test_a_simulator_that_draws_its_noise_itself_is_stepped_with_it(own):
    simulator = own("2.0")
    simulator.noise_width = 0
    plan = ns.make_controller("plan", slots=2)
    assert simulator.rollouts(plan, ns.Episode()) is None
    ends = ns.rollout(simulator, [[20.0, 20.0, 1.0]], samples=20).poses[:, -1, 1]
    assert 0.003 < ends.std() < 0.03
