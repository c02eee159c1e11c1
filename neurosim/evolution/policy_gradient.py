"""L2, learning in reality: the policy gradient of Kohl and Stone 2004, as Zagal et al. use it.

Section 5.1.3 of Zagal, Ruiz-del-Solar and Vallejos 2004; Kohl and Stone, Policy gradient
reinforcement learning for fast quadrupedal locomotion, ICRA 2004. Around a policy p, m random ones
are tried; each of their parameters is p's plus e, plus 0, or minus e. A parameter's part of the
gradient is 0 where the policies that left it alone score best on average, else the mean score of
those with plus e less that of those with minus e. p moves along the gradient by a fixed step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from neurosim.base.declared import Checked


@dataclass(frozen=True)
class PolicySettings(Checked):
    """Settings of the policy gradient.

    Attributes:
        policies: Variations of the policy that a step tries.
        epsilon: Variation of a parameter, as a fraction of its range.
        step: Length of a step, as a fraction of the parameters' ranges.
    """

    policies: Annotated[int, Meta(ge=2, le=1000000)] = 13
    epsilon: Annotated[float, Meta(ge=1e-06, le=1)] = 0.04
    step: Annotated[float, Meta(ge=1e-06, le=1)] = 0.12


def gradient(signs: NDArray[np.int64], scores: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the direction [G] of the step, of length 1, or zeros.

    Args:
        signs: [m, G] difference of each policy in each parameter: 1, 0 or -1.
        scores: [m] of the policies.

    A parameter that no policy raised, or that none lowered, gets 0. If every policy changed a
    parameter, the case without change is left out.
    """
    slope = np.zeros(signs.shape[1])
    for place, column in enumerate(signs.T):
        plus, zero, minus = (scores[column == sign] for sign in (1, 0, -1))
        if not len(plus) or not len(minus):
            continue
        if len(zero) and zero.mean() > max(plus.mean(), minus.mean()):
            continue
        slope[place] = plus.mean() - minus.mean()
    length = np.linalg.norm(slope)
    return slope / length if length > 0.0 else slope


class PolicyGradient:
    """Ask and tell; it maximises.

    Attributes:
        point: [G] the policy, fractions in 0..1.
    """

    def __init__(self, start: NDArray[np.float64], settings: PolicySettings, seed: Any):
        """Start at a policy [G], fractions in 0..1."""
        self.point = np.asarray(start, np.float64)
        self._settings = settings
        self._rng = np.random.default_rng(seed)
        self._signs = np.empty((0, len(self.point)), np.int64)

    def ask(self) -> NDArray[np.float64]:
        """Return the policies to try, [m, G]."""
        shape = self._settings.policies, len(self.point)
        self._signs = self._rng.integers(-1, 2, shape)
        return np.clip(self.point + self._settings.epsilon * self._signs, 0.0, 1.0)

    def tell(self, scores: NDArray[np.float64]) -> None:
        """Take their scores [m], and make a step."""
        change = self._settings.step * gradient(self._signs, scores)
        self.point = np.clip(self.point + change, 0.0, 1.0)
