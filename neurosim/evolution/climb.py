"""A running optimiser whose answers are kept, from which alone it can be resumed."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.evolution.space import Optimiser


class Replay:
    """Any optimiser with its answers; a new optimiser with the same answers is equal to it.

    Attributes:
        optimiser: the optimiser.
        hints: names of further arguments of its ``tell``.
        answers: of every generation the fitness, the hints, and a checksum of the population.
    """

    def __init__(self, optimiser: Optimiser):
        self.optimiser, self.hints = optimiser, tuple(getattr(optimiser, "hints", ()))
        self.answers: list[dict[str, NDArray]] = []
        self._asked = np.empty(0)

    @property
    def done(self) -> int:
        """Number of generations so far."""
        return len(self.answers)

    def ask(self) -> NDArray[np.float64]:
        """Return the population [P, G] or [N, P, G] to evaluate."""
        self._asked = np.ascontiguousarray(self.optimiser.ask(), np.float64)
        return self._asked

    def tell(self, fitness: NDArray[np.float64], **hints: NDArray) -> None:
        """Take its fitness [P] or [N, P], and the hints."""
        checksum = np.array(zlib.crc32(self._asked.data))
        self.answers.append({"fitness": fitness, "asked": checksum, **hints})
        self.optimiser.tell(fitness, **hints)

    def state(self) -> dict[str, NDArray]:
        """Return all answers, as arrays."""
        names = self.answers[0] if self.answers else ()
        return {name: np.stack([one[name] for one in self.answers]) for name in names}

    def load(self, state: Mapping[str, NDArray]) -> None:
        """Give a new optimiser the answers from :meth:`state`.

        Raises:
            UserError: if the optimiser asks for other individuals than before.
        """
        for row in range(len(state["fitness"]) if state else 0):
            arguments = {name: values[row] for name, values in state.items()}
            if arguments.pop("asked") != zlib.crc32(self.ask().data):
                raise UserError(
                    "the optimiser asked for other individuals than before the interruption: to "
                    "be resumed, it must take all its random numbers from the seed"
                )
            self.tell(**arguments)


def resumable(optimiser: Optimiser) -> Any:
    """Return the optimiser if it can save its own state, else its replay."""
    return optimiser if hasattr(optimiser, "state") else Replay(optimiser)


class Climb(Replay):
    """A search of one run that keeps all individuals; a :class:`neurosim.base.generations.Stage`.

    Attributes:
        asked: [P, G] of every generation.
        fitness: [P] of every generation.
        ended: never before its last generation.
    """

    ended = False

    def __init__(
        self,
        optimiser: Optimiser,
        evaluate: Callable[[NDArray[np.float64]], NDArray[np.float64]],
        hints: Callable[[NDArray[np.float64]], Mapping[str, NDArray]] | None = None,
    ):
        """Begin.

        Args:
            optimiser: of one run, [P, G] or [1, P, G].
            evaluate: returns the fitness [P] of a population [P, G].
            hints: returns the optimiser's hints about it, [P, ...] by name.

        Raises:
            UserError: if the optimiser needs hints, and there are none.
        """
        super().__init__(optimiser)
        if self.hints and hints is None:
            raise UserError(
                f"this optimiser needs {', '.join(self.hints)} in addition to the fitness; only "
                "the evolution of plans in a simulator has these"
            )
        self._evaluate, self._hints = evaluate, hints
        self.asked: list[NDArray[np.float64]] = []

    def generation(self) -> str:
        """Evaluate a generation; return its best."""
        asked = self.ask()
        genes = asked.reshape(-1, asked.shape[-1])
        fitness, shape = self._evaluate(genes), asked.shape[:-1]
        hints = {} if self._hints is None else self._hints(genes)
        self.tell(fitness.reshape(shape), **{k: v.reshape(*shape, -1) for k, v in hints.items()})
        return f"best {fitness.max():.3g}"

    def tell(self, fitness: NDArray[np.float64], **hints: NDArray) -> None:
        """Take the fitness of the last population, and remember both."""
        self.asked.append(self._asked.reshape(-1, self._asked.shape[-1]).copy())
        super().tell(fitness, **hints)

    @property
    def fitness(self) -> list[NDArray[np.float64]]:
        """The fitness [P] of every generation."""
        return [one["fitness"].reshape(-1) for one in self.answers]

    @property
    def individuals(self) -> int:
        """Number of evaluated individuals so far, including those before an interruption."""
        return sum(map(len, self.asked))

    @property
    def best(self) -> NDArray[np.float64]:
        """The best of each generation, [n, G]."""
        pairs = zip(self.asked, self.fitness, strict=True)
        return np.stack([asked[fitness.argmax()] for asked, fitness in pairs])

    def history(self) -> dict[str, list[float]]:
        """Return best and mean fitness of every generation."""
        return {
            "best": [float(fitness.max()) for fitness in self.fitness],
            "mean": [float(fitness.mean()) for fitness in self.fitness],
        }
