"""The policy gradient of Kohl and Stone, by hand-worked numbers."""

import numpy as np
import pytest

from neurosim.evolution.policy_gradient import PolicyGradient, PolicySettings, gradient


def test_gradient_by_hand():
    signs = np.array([[1, 1, 1, 0], [0, 0, 1, 1], [-1, -1, 0, 1], [1, -1, 0, -1]])
    scores = np.array([4.0, 1.0, 2.0, 6.0])
    # First parameter: +e (4 + 6) / 2 = 5, 0: 1, -e: 2; 5 - 2 = 3.
    # Second: +e 4, 0: 1, -e (2 + 6) / 2 = 4; 4 - 4 = 0.
    # Third: no policy lowered it: 0. Fourth: +e 1.5, 0: 4, -e 6: 1.5 - 6 = -4.5.
    assert gradient(signs, scores) == pytest.approx(np.array([3, 0, 0, -4.5]) / np.hypot(3, 4.5))


def test_a_parameter_is_left_alone_where_leaving_it_alone_is_best():
    signs = np.array([[1], [0], [-1]])
    assert gradient(signs, np.array([1.0, 2.0, 0.5])).tolist() == [0.0]
    assert gradient(signs, np.array([3.0, 2.0, 0.5])).tolist() == [1.0]


def test_steps_have_the_given_length_and_stay_within_bounds():
    learner = PolicyGradient(np.array([0.5, 0.95]), PolicySettings(13, 0.04, 0.12), 0)
    asked = learner.ask()
    assert asked.shape == (13, 2)
    assert set(np.unique(np.round(asked[:, 0], 9))) == {0.46, 0.5, 0.54}
    learner.tell(asked[:, 0])
    assert learner.point[0] == pytest.approx(0.62, abs=0.03)
    for _ in range(20):
        learner.tell(learner.ask()[:, 1])
    assert learner.point.max() <= 1.0


def test_it_climbs_a_hill():
    top = np.array([0.8, 0.2, 0.5])
    learner = PolicyGradient(np.full(3, 0.5), PolicySettings(policies=15, step=0.05), 1)
    for _ in range(40):
        learner.tell(-np.linalg.norm(learner.ask() - top, axis=1))
    assert np.linalg.norm(learner.point - top) < 0.1
