"""Workers that judge the parts of a population: this process, or those of a Ray cluster.

A population is cut into the same parts for all workers, and a part depends only on its genes and
the samples. So the result is the same for any number of workers, and a
part whose worker was lost is judged again by another.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from copy import copy
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from neurosim.base.cluster import Name, ray_cluster
from neurosim.base.errors import UserError
from neurosim.base.registry import PLUGIN
from neurosim.base.threads import one_thread

#: (evaluator, parts of a population, draws, settings of the judgement) -> the merit of each part,
#: in order; see :meth:`neurosim.loop.evaluate.Evaluator.merit_of`.
Workers = Callable[[Any, Iterable[NDArray], Any, tuple[Any, ...]], Iterator[Any]]


def workers_named(name: Name) -> Workers | None:
    """Return workers; None: this process.

    Args:
        name: local, this process; or ray, a Ray cluster: the one of ``RAY_ADDRESS``, one that runs
            on this computer, or a new one.

    Raises:
        UserError: if the name is unknown, or Ray is not installed or cannot be reached.
    """
    if name == "local":
        return None
    if name == "ray":
        return Ray()
    raise UserError(f"there are no workers {name!r}; choose local or ray")


class Ray:
    """Workers of a Ray cluster, each a process on one core."""

    def __init__(self) -> None:
        """Connect to a cluster, or start one on this computer.

        Raises:
            UserError: if Ray is not installed or its cluster cannot be reached.
        """
        self._ray = ray = ray_cluster()
        self._judge = ray.remote(max_retries=-1)(_judge)

    def __call__(
        self, evaluator: Any, parts: Iterable[NDArray], draws: Any, how: tuple[Any, ...]
    ) -> Iterator[Any]:
        """Judge parts on all workers; send only as many as keep them busy."""
        ray = self._ray
        for name, module in list(sys.modules.items()):
            if name.startswith(PLUGIN):  # a worker could not import it
                ray.cloudpickle.register_pickle_by_value(module)
        alone = copy(evaluator)
        alone.workers = None
        # As bytes: shared arrays of Ray are read-only.
        job = ray.put(ray.cloudpickle.dumps((alone, draws, how)))
        most = 2 * max(int(ray.cluster_resources().get("CPU", 1)), 1)
        waiting: deque[Any] = deque()
        for part in parts:
            if len(waiting) >= most:
                yield self._result(waiting.popleft())
            waiting.append(self._judge.remote(job, part))
        while waiting:
            yield self._result(waiting.popleft())

    def _result(self, reference: Any) -> Any:
        try:
            return self._ray.get(reference)
        except self._ray.exceptions.RayTaskError as error:
            raise error.cause from None


def _judge(job: bytes, genes: NDArray[np.float64]) -> Any:
    """Judge one part in a worker."""
    import ray

    evaluator, draws, how = ray.cloudpickle.loads(job)
    numba.set_num_threads(1)
    with one_thread():
        return evaluator.merit_of(np.array(genes), draws, *how)
