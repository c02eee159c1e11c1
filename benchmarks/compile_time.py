"""How long compiling takes, function by function, with nothing compiled before.

Seconds of processor time of the trial loop of the motion network and of tables, each with all
functions that it calls, and of the random numbers of noise. The time of a function excludes the
functions that it calls and that are compiled by themselves.

    python benchmarks/compile_time.py
    python benchmarks/compile_time.py --all           all functions, not the ten slowest
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections import Counter
from typing import Any


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--all", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as empty:
        os.environ["NUMBA_CACHE_DIR"] = empty  # before anything is compiled
        for simulator, seconds, functions in compiled():
            print(f"{simulator:<7} {seconds:6.2f} s")
            for name, own in functions.most_common(None if options.all else 10):
                print(f"        {own:6.2f}   {name}")


def compiled() -> list[tuple[str, float, Counter[str]]]:
    """Return the seconds of both simulators, and of their functions."""
    import numpy as np
    from closed_loop import GOALS, INPUTS, motion_network, tables
    from numba.core import event

    from neurosim.base.trajectory import Episode
    from neurosim.controllers import Network

    class Times(event.Listener):
        """Adds up the time of each function."""

        def __init__(self) -> None:
            self.own: Counter[str] = Counter()
            self.open: list[list[float]] = []

        def on_start(self, event: Any) -> None:
            self.open.append([time.process_time(), 0.0])

        def on_end(self, event: Any) -> None:
            began, inner = self.open.pop()
            seconds = time.process_time() - began
            function = event.data["dispatcher"].py_func
            self.own[f"{function.__module__}.{function.__qualname__}"] += seconds - inner
            if self.open:
                self.open[-1][1] += seconds

    results = []
    for simulator in (motion_network(), tables()):
        with event.install_listener("numba:compile", Times()) as times:
            free = simulator.free_poses(1, np.random.default_rng(0))
            starts = np.zeros((1, 3)) if free is None else free
            network = Network(simulator.reading_names or INPUTS, (5,), scale=45.0)
            episode = Episode(0.1, 2, goals=GOALS if free is None else None)
            rollouts = simulator.rollouts(network, episode)
            assert rollouts is not None
            rollouts.run(np.zeros((1, network.genes)), rollouts.draw(starts, 0))
        results.append((simulator.kind, sum(times.own.values()), times.own))
    return results


if __name__ == "__main__":
    main()
