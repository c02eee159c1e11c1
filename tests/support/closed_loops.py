"""Networks of every kind, and their compiled and stepped rollouts."""

import numpy as np

from neurosim.base.trajectory import Draws
from neurosim.controllers import Network, Recurrent
from neurosim.loop.stepped import SteppedRollouts

POSES_GOALS_TIME = (
    *("x", "y", "cos_heading", "sin_heading"),
    *("goal_x", "goal_y", "goal_cos", "goal_sin", "time"),
    *("goal_distance", "goal_bearing", "goal_approach"),
)


def families(inputs, **options):
    """Return a network of every kind, by name."""
    return {
        "linear": Network(inputs, **options),
        "hidden": Network(inputs, (5,), **options),
        "two hidden": Network(inputs, (4, 6), **options),
        "elman": Recurrent(inputs, 5, **options),
        "ctrnn": Recurrent(inputs, 5, "ctrnn", **options),
    }


KINDS = tuple(families(("x",)))


def genes_of(family, count=4, seed=0):
    """Return random individuals [count, genes]."""
    return np.random.default_rng(seed).normal(0.0, 0.7, (count, family.genes))


def both(simulator, family, episode, draws, genes=None):
    """Return the compiled trajectories and the stepped ones."""
    genes = genes_of(family) if genes is None else genes
    compiled = simulator.rollouts(family, episode)
    assert compiled is not None
    stepped = SteppedRollouts(simulator, family, episode)
    return compiled.run(genes, draws), stepped.run(genes, draws)


def assert_alike(result, expected, metres, percent, readings=1e-5):
    """Compare a trajectory with another one, within tolerances."""
    assert result.poses.shape == expected.poses.shape
    assert np.abs(result.poses - expected.poses).max() < metres
    assert result.commands.shape == expected.commands.shape
    assert np.abs(result.commands - expected.commands).max() < percent
    assert np.array_equal(*np.broadcast_arrays(result.durations, expected.durations))
    assert (result.active is None) == (expected.active is None)
    if result.active is not None:
        assert np.array_equal(result.active, expected.active)
    assert (result.readings is None) == (expected.readings is None)
    if result.readings is not None:
        assert result.readings.shape == expected.readings.shape
        assert np.abs(result.readings - expected.readings).max() < readings


def assert_reused(simulator, family, episode, draws):
    """Compare runs that reuse memory with a run in new memory."""
    rollouts, genes = simulator.rollouts(family, episode), genes_of(family, 5)
    kept = rollouts.run(genes, draws)
    rollouts.run(genes_of(family, 6, seed=1), draws, reuse=True)
    for few in (genes, genes[:3]):
        again = rollouts.run(few, draws, reuse=True)
        for name in ("poses", "commands", "readings"):
            first, then = getattr(kept, name), getattr(again, name)
            assert first is then is None or np.array_equal(first[: len(few)], then)
    assert rollouts.run(genes, draws, reuse=True).poses.base is again.poses.base


def repeated(draws, place):
    """Return the draws of one sample, twice."""
    parts = {name: getattr(draws, name) for name in ("starts", "member", "noise", "seeds")}
    return Draws(**{n: None if v is None else v[[place, place]] for n, v in parts.items()})
