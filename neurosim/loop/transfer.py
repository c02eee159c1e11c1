"""Generations in reality after those in a simulator: Lund and Miglino 1996.

The optimiser goes on where it was in the simulator, and reality tries what it asks for, one
individual after the other. Every trial is in the journal before it is used: to resume is to ask,
and to read what is known.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from neurosim.evolution.climb import Climb
from neurosim.evolution.space import Optimiser
from neurosim.loop.evaluate import Evaluator
from neurosim.loop.journal import Journal

#: So many of the last population's best are tried again, and so often each: what was best in its
#: own trial may have been lucky.
AGAIN, TRIALS_AGAIN = 5, 4


class Transfer(Climb):
    """The generations in reality of one run.

    Attributes:
        chosen: [G] the individual that was best in new trials; None before these.
        again: its fitness in them, [T].
    """

    def __init__(self, optimiser: Optimiser, journal: Journal, evaluator: Evaluator):
        """Go on after a stage in the simulator.

        Args:
            optimiser: of that stage.
            journal: of the trials.
            evaluator: the simulator, where the optimiser wants to know more than the fitness.
        """
        super().__init__(optimiser, self._tried, self._simulated)
        self._journal, self._evaluator = journal, evaluator
        self.chosen: NDArray[np.float64] | None = None
        self.again = np.empty(0)

    def _tried(self, genes: NDArray[np.float64]) -> NDArray[np.float64]:
        return self._journal.evaluate(genes, f"generation {self.done + 1}")

    def _simulated(self, genes: NDArray[np.float64]) -> Mapping[str, NDArray]:
        if not self.hints:
            return {}
        return self._evaluator.merit(genes, self._evaluator.expectation(), hints=self.hints)[1]

    def candidates(self) -> NDArray[np.float64]:
        """Return the best of the last generation [C, G], or the one chosen of them."""
        if self.chosen is not None:
            return self.chosen[None]
        return self.asked[-1][np.argsort(-self.fitness[-1], kind="stable")[:AGAIN]]

    def choose(self) -> None:
        """Try the best of the last generation again, and keep the one that is best."""
        candidates = self.candidates()
        again = self._journal.fitness(candidates, "tried again", 1 + TRIALS_AGAIN)[:, 1:]
        best = int(again.mean(axis=1).argmax())
        self.chosen, self.again = candidates[best], again[best]
