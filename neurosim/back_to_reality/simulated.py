"""Controllers in a simulator with adjustable parameters, as the searches L1 and L3 use them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.controllers.base import Controller
from neurosim.loop.evaluate import Evaluator, rollouts_of
from neurosim.loop.objectives import mean_fitness
from neurosim.simulators.adjustable import Adjustable, AdjustableSimulator
from neurosim.simulators.base import Simulator
from neurosim.tasks.base import Task


class Simulated:
    """A simulator with parameters, a task and a controller: fractions in, fitness out.

    Genes and parameters are given as fractions 0..1 of their ranges.

    Attributes:
        parameters: of the simulator.
        genes: number of genes of an individual.
        as_is: [K] fractions of the parameters before anything was adjusted.
        steps: number of steps of a trial; there is a pose after each.
        circle: distance from the start at which a trial ends, m; 0: it does not.
        tried: number of simulated trials.
    """

    def __init__(self, simulator: Simulator, task: Task, controller: Controller):
        """Join the three.

        Raises:
            UserError: if they do not fit each other, or the simulator has no parameters.
        """
        if not isinstance(simulator, AdjustableSimulator):
            raise UserError(
                f"a simulator of the kind {simulator.kind} has no parameters that could be "
                "adjusted to reality: it needs parameters and adjusted()"
            )
        self._simulator, self._task, self._controller = simulator, task, controller
        self.parameters: tuple[Adjustable, ...] = tuple(simulator.parameters)
        self.genes, self.circle = controller.genes, task.episode.circle
        self.as_is = np.array([one.fraction(one.value) for one in self.parameters])
        self.tried = 0
        self.steps = self._evaluator(self.as_is).steps  # raises an error if they do not fit

    def real_genes(self, fractions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the genes [..., G] of fractions [..., G] of the controller's range of genes."""
        low, high = self._controller.gene_range
        return low + (high - low) * np.asarray(fractions, np.float64)

    def fractions_of(self, genes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the fractions [..., G] of genes [..., G].

        Raises:
            UserError: if one is not finite or out of the controller's range.
        """
        low, high = self._controller.gene_range
        genes = np.asarray(genes, np.float64)
        if genes.shape[-1:] != (self.genes,):
            raise UserError(f"expected {self.genes} genes, got {genes.shape[-1:]}")
        if not ((genes >= low) & (genes <= high)).all():
            raise UserError(f"a gene lies outside of {low:g} to {high:g}, where the search is")
        return (genes - low) / (high - low)

    def values(self, fractions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return parameters [K] in their units of fractions [K]."""
        return np.array([one.at(s) for one, s in zip(self.parameters, fractions, strict=True)])

    def adjusted(self, fractions: NDArray[np.float64]) -> Any:
        """Return the simulator with other parameters [K]."""
        assert isinstance(self._simulator, AdjustableSimulator)
        return self._simulator.adjusted(self.values(fractions))

    def _evaluator(self, fractions: NDArray[np.float64]) -> Evaluator:
        return Evaluator(self.adjusted(fractions), self._task, self._controller)

    def fitness(
        self, genes: NDArray[np.float64], parameters: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the fitness [P] of individuals [P, G] with one set of parameters [K].

        The motion is the expected one, without noise. A simulation that blows up gets the fitness
        0, or the worst of the others if that is lower.
        """
        evaluator = self._evaluator(parameters)
        self.tried += len(genes)
        with evaluator.threads_for(len(genes)):
            judged, trajectory = evaluator.judge(self.real_genes(genes), evaluator.expectation())
        fitness = mean_fitness(self._task, judged.fitness)
        finite = np.isfinite(fitness)
        if trajectory.poses is not None:
            finite &= np.isfinite(trajectory.poses).all(axis=(1, 2, 3))
        return np.where(finite, fitness, fitness[finite].min(initial=0.0))

    def steps_in(self, seconds: float) -> int:
        """Return the number of steps in a time, at least 1; the commands of a plan are steps."""
        if self._controller.open_loop:
            return 1
        return max(round(seconds / self._task.episode.step), 1)

    def poses(
        self, genes: NDArray[np.float64], parameters: NDArray[np.float64], steps: int | None = None
    ) -> NDArray[np.float64]:
        """Return the expected poses of individuals [P, G], [P, K + 1, 3].

        At the task's first start and after each of K steps, with one set of parameters, without
        noise. K is that of a trial, or fewer: ``steps``.
        """
        evaluator = self._evaluator(parameters)
        if steps is not None and steps < evaluator.episode.steps:
            episode = replace(evaluator.episode, steps=steps)
            evaluator.rollouts = rollouts_of(evaluator.simulator, self._controller, episode)
        self.tried += len(genes)
        with evaluator.threads_for(len(genes)):
            poses = evaluator.run(self.real_genes(genes), evaluator.expectation()).poses
        assert poses is not None
        return np.array(poses[:, 0])

    def over(self, genes: NDArray[np.float64], sets: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the fitness [S, P] of individuals [P, G] with sets of parameters [S, K]."""
        return np.stack([self.fitness(genes, one) for one in sets])

    def expected(
        self, genes: NDArray[np.float64], sets: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the mean fitness [P] of individuals [P, G] over sets of parameters [S, K].

        It is a better prediction than that of the best set alone: whether a gait falls is a matter
        of chance, and the sets say how likely it is.
        """
        mean: NDArray[np.float64] = self.over(genes, sets).mean(axis=0)
        return mean
