"""An optimiser of a user's own: the best so far, and eight changes of it."""

import numpy as np


class HillClimber:
    """Keeps an individual that is better."""

    def __init__(self, space):
        self.space, self.rng = space, np.random.default_rng(space.seed)
        self.best, self.fitness = space.start[0], -np.inf

    def ask(self):
        """Return eight individuals near the best."""
        change = self.space.spread * self.rng.standard_normal((8, self.space.genes))
        self.asked = np.clip(self.best + change, *(self.space.bounds or (-np.inf, np.inf)))
        return self.asked

    def tell(self, fitness):
        """Take their fitness."""
        if fitness.max() > self.fitness:
            self.best, self.fitness = self.asked[fitness.argmax()], fitness.max()
