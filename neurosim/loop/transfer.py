"""Generations in reality after those in a simulator: Lund and Miglino 1996.

The optimiser continues from its state in the simulator, and reality tries its individuals one after
the other. Every trial is in the journal before it is used. A resumed run asks again, and reads the
known trials.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from neurosim.evolution.climb import Climb
from neurosim.evolution.space import Optimiser
from neurosim.loop.evaluate import Evaluator
from neurosim.loop.journal import Journal

#: Number of the last population's best that are tried again, and how often: the best in a single
#: trial may be due to luck.
AGAIN, TRIALS_AGAIN = 5, 4


class Transfer(Climb):
    """The generations in reality of one run.

    Attributes:
        chosen: [G] the individual that was best in new trials; None before these.
        again: its fitness in them, [T].
    """

    def __init__(self, optimiser: Optimiser, journal: Journal, evaluator: Evaluator):
        """Continue after a stage in the simulator.

        Args:
            optimiser: of that stage.
            journal: of the trials.
            evaluator: the simulator's, if the optimiser needs more than the fitness.
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
        """Return the best of the last generation [C, G], or the chosen one of them."""
        if self.chosen is not None:
            return self.chosen[None]
        return self.asked[-1][np.argsort(-self.fitness[-1], kind="stable")[:AGAIN]]

    def choose(self) -> None:
        """Try the best of the last generation again, and keep the best of these."""
        candidates = self.candidates()
        again = self._journal.fitness(candidates, "tried again", 1 + TRIALS_AGAIN)[:, 1:]
        best = int(again.mean(axis=1).argmax())
        self.chosen, self.again = candidates[best], again[best]
