"""How long one generation of the paper's training takes, in neurosim and in other libraries.

    python benchmarks/ga_training.py [DATASET] [--repeats 15] [--json] [--whole]

One whole generation (tournament selection, crossover, mutation, fitness of everybody) of one
output's network at the setting of Pretorius et al. 2009, Table 1: 250 chromosomes, 10 product and
10 summation units over 5 inputs, 5,000 rows. All work on the same rows and compute the same mean
squared error, which is checked first. Ours evolves three outputs at once, as training does; its
time is divided by three. Generations of each are measured in turn, and medians printed.

The floor is the unavoidable part: 250 x 10 x 5,000 exponentials and the small matrix products
that feed and follow them, in cache-sized blocks, in single precision; the faster of PyTorch and
a compiled loop with the exponential of our own kernel, which is vector instructions.

``--whole`` runs the paper's 3 x 15,000 generations on DATASET and prints minutes and test error.
Peers: pip install evotorch deap pygad (extra ``bench``). Those not installed are left out.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import random
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
import torch

from neurosim.base.threads import one_thread
from neurosim.evolution import GeneticAlgorithm
from neurosim.networks import PopulationError, ProductSummationNetwork
from neurosim.networks._kernels import _exp2
from neurosim.training.base import TrainingData
from neurosim.training.trainers.ga import GaSettings, GaTrainer

POPULATION, ROWS, OUTPUTS = 250, 5_000, 3
NETWORK = ProductSummationNetwork(5, 10, 10)
SETTINGS = GaSettings()
Generation = Callable[[], object]


def rows(dataset: Path | None) -> tuple[torch.Tensor, torch.Tensor]:
    """Return scaled inputs [N, 5] and targets [3, N], N = 5,000."""
    if dataset is None:
        rng = np.random.default_rng(0)
        x = rng.uniform(-1, 1, (ROWS, 5))
        x[:, 4] = rng.uniform(1 / 6, 1, ROWS)
        x[rng.random(ROWS) < 0.2, 2:4] = 0.0
        return torch.tensor(x), torch.tensor(rng.standard_normal((OUTPUTS, ROWS)))
    from tracking.datasets.dataset import Dataset

    read = Dataset.read(dataset)
    places = np.arange(ROWS) % len(read)
    data = TrainingData(
        read.meta["inputs"],
        torch.tensor(read.input_array()[places]),
        torch.tensor(read.output_array()[places]),
    )
    return data.scaled_inputs, (data.y / data.y.square().mean(0).sqrt()).T.contiguous()


def ours(x: torch.Tensor, targets: torch.Tensor, device: str = "cpu") -> Generation:
    error = PopulationError(NETWORK, x.to(device), targets.to(device))
    generator = torch.Generator(device).manual_seed(0)
    first = torch.rand(OUTPUTS, POPULATION, NETWORK.genes, generator=generator, device=device)
    ga = GeneticAlgorithm(first - 0.5, SETTINGS, generator)

    def generation() -> float:
        with one_thread(device):
            ga.tell(1.0 / error(ga.ask()))
        return ga.best_fitness[0].item()

    return generation


def straightforward(genes: torch.Tensor, x: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return the mean squared error [P] of networks, as it is usually written in PyTorch."""
    return (NETWORK.forward(genes, x) - target).square().mean(-1)


def evotorch(x: torch.Tensor, targets: torch.Tensor) -> Generation:
    from evotorch import Problem
    from evotorch.algorithms import GeneticAlgorithm as EvoGA
    from evotorch.logging import Logger  # noqa: F401 - fails early where it is half installed
    from evotorch.operators import GaussianMutation, SimulatedBinaryCrossOver

    x, target = x.float(), targets[0].float()
    problem = Problem(
        "min",
        lambda genes: straightforward(genes, x, target),
        solution_length=NETWORK.genes,
        initial_bounds=(-0.5, 0.5),
        dtype=torch.float32,
        vectorized=True,
        seed=0,
    )
    searcher = EvoGA(
        problem,
        popsize=POPULATION,
        elitist=False,
        operators=[
            SimulatedBinaryCrossOver(
                problem, tournament_size=SETTINGS.tournament, eta=SETTINGS.eta, cross_over_rate=0.8
            ),
            GaussianMutation(
                problem, stdev=SETTINGS.mutation_scale, mutation_probability=SETTINGS.mutation
            ),
        ],
    )
    return searcher.step


class NumpyNetwork:
    """The mean squared error of one chromosome, as it is usually written in NumPy."""

    def __init__(self, x: np.ndarray, target: np.ndarray):
        self.x, self.target = x, target
        self.log = np.log(np.maximum(np.abs(x), NETWORK.floor))
        self.negative = (x < 0).astype(float)

    def __call__(self, genes: np.ndarray) -> float:
        """Return the error of one chromosome [131]."""
        w, a, v, b, c, bias = np.split(genes, np.cumsum([50, 10, 50, 10, 10]))
        w, v = w.reshape(10, 5), v.reshape(10, 5)
        products = np.exp(np.clip(self.log @ w.T, -20, 20)) * np.cos(np.pi * self.negative @ w.T)
        output = products @ a + (self.x @ v.T + b) @ c + bias
        return float(np.mean((output - self.target) ** 2))


def deap(x: torch.Tensor, targets: torch.Tensor) -> Generation:
    from deap import algorithms, base, creator, tools

    error = NumpyNetwork(x.numpy(), targets[0].numpy())
    creator.create("Fitness", base.Fitness, weights=(-1.0,))
    creator.create("Individual", np.ndarray, fitness=creator.Fitness)
    random.seed(0)
    rng = np.random.default_rng(0)
    toolbox = base.Toolbox()
    toolbox.register("evaluate", lambda genes: (error(genes),))
    toolbox.register("select", tools.selTournament, tournsize=SETTINGS.tournament)
    toolbox.register("mate", tools.cxSimulatedBinary, eta=SETTINGS.eta)
    toolbox.register(
        "mutate", tools.mutGaussian, mu=0, sigma=SETTINGS.mutation_scale, indpb=SETTINGS.mutation
    )
    population = [
        creator.Individual(rng.uniform(-0.5, 0.5, NETWORK.genes)) for _ in range(POPULATION)
    ]
    for individual in population:
        individual.fitness.values = toolbox.evaluate(individual)

    def generation() -> None:
        chosen = toolbox.select(population, len(population))
        # Everybody is evaluated, as by the others: mutation changes nearly all.
        children = algorithms.varAnd(chosen, toolbox, SETTINGS.crossover, 1.0)
        for child in children:
            child.fitness.values = toolbox.evaluate(child)
        population[:] = children

    return generation


def pygad(x: torch.Tensor, targets: torch.Tensor) -> Callable[[int], float]:
    """Return a function that runs a number of generations; PyGAD has no single step."""
    import pygad

    error = NumpyNetwork(x.numpy(), targets[0].numpy())

    def run(generations: int) -> float:
        ga = pygad.GA(
            num_generations=generations,
            num_parents_mating=POPULATION,
            sol_per_pop=POPULATION,
            num_genes=NETWORK.genes,
            init_range_low=-0.5,
            init_range_high=0.5,
            fitness_func=lambda ga, genes, place: 1.0 / error(genes),
            parent_selection_type="tournament",
            K_tournament=SETTINGS.tournament,
            keep_elitism=1,
            crossover_type="sbx",
            crossover_probability=SETTINGS.crossover,
            mutation_type="random",
            mutation_probability=SETTINGS.mutation,
            random_seed=0,
            suppress_warnings=True,
        )
        began = time.perf_counter()
        ga.run()
        return time.perf_counter() - began

    return run


def floor_torch(x: torch.Tensor) -> Generation:
    log = x.abs().clamp(min=NETWORK.floor).log().float().T.contiguous()
    exponents = torch.rand(POPULATION * 10, 5) - 0.5
    weights = torch.rand(POPULATION, 1, 10)
    block = 40  # rows: 250 x 10 x 40 numbers are 400 kB
    out = torch.empty(POPULATION * 10, block)

    def generation() -> None:
        for start in range(0, ROWS, block):
            torch.matmul(exponents, log[:, start : start + block], out=out)
            torch.matmul(weights, out.exp_().view(POPULATION, 10, block))

    return generation


@numba.njit(fastmath=True)
def _floor_unit(out, weight, w, log, start, rows):
    a, b, c = (
        log[0, start : start + rows],
        log[1, start : start + rows],
        log[2, start : start + rows],
    )
    d, e = log[3, start : start + rows], log[4, start : start + rows]
    w0, w1, w2, w3, w4 = w[0], w[1], w[2], w[3], w[4]
    for j in range(rows):
        out[j] += weight * _exp2(w0 * a[j] + w1 * b[j] + w2 * c[j] + w3 * d[j] + w4 * e[j])


@numba.njit(parallel=True, fastmath=True)
def _floor(exponents, weights, log, sums):
    for n in numba.prange(len(exponents)):
        out = np.zeros(256, np.float32)
        for start in range(0, log.shape[1], 256):
            rows = min(256, log.shape[1] - start)
            for k in range(exponents.shape[1]):
                _floor_unit(out, weights[n, k], exponents[n, k], log, start, rows)
        sums[n] = out[0]  # read, so that none of it is optimised away


def floor_numba(x: torch.Tensor) -> Generation:
    log = x.abs().clamp(min=NETWORK.floor).log2().float().T.contiguous().numpy()
    rng = np.random.default_rng(0)
    exponents = (rng.random((POPULATION, 10, 5)) - 0.5).astype(np.float32)
    weights = rng.random((POPULATION, 10)).astype(np.float32)
    sums = np.zeros(POPULATION, np.float32)
    return lambda: _floor(exponents, weights, log, sums)


def check(x: torch.Tensor, targets: torch.Tensor) -> None:
    """Check that all compute the same."""
    genes = torch.rand(OUTPUTS, 4, NETWORK.genes, dtype=torch.float64) - 0.5
    fast = PopulationError(NETWORK, x, targets)(genes)[0]
    plain = straightforward(genes[0], x, targets[0])
    one = NumpyNetwork(x.numpy(), targets[0].numpy())
    assert torch.allclose(fast, plain, rtol=1e-4)
    assert np.allclose([one(g.numpy()) for g in genes[0]], plain.numpy())


def measure(x: torch.Tensor, targets: torch.Tensor, repeats: int, device: str) -> dict[str, float]:
    """Return the median seconds of one output's generation, by name."""
    check(x, targets)
    makers: dict[str, Callable[[], Generation]] = {
        "neurosim": lambda: ours(x, targets, device),
        "EvoTorch": lambda: evotorch(x, targets),
        "DEAP": lambda: deap(x, targets),
        "floor (PyTorch)": lambda: floor_torch(x),
        "floor (compiled)": lambda: floor_numba(x),
    }
    runs: dict[str, Generation] = {}
    for name, make in makers.items():
        try:
            runs[name] = make()
            runs[name]()  # compiles, warms up
        except ImportError as error:
            print(f"{name} is left out: {error}", file=sys.stderr)
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(repeats):
        for name, run in runs.items():
            # The faster ones several times, so that a clock's tick and a hiccup weigh less.
            times = 1 if name in ("EvoTorch", "DEAP") else 5
            began = time.perf_counter()
            for _ in range(times):
                run()
                if device != "cpu" and name == "neurosim":
                    torch.cuda.synchronize()
            seconds[name].append((time.perf_counter() - began) / times)
    medians = {name: statistics.median(values) for name, values in seconds.items()}
    medians["neurosim"] /= OUTPUTS
    try:
        run = pygad(x, targets)
        medians["PyGAD"] = run(max(2, repeats // 2)) / max(2, repeats // 2)
    except ImportError as error:
        print(f"PyGAD is left out: {error}", file=sys.stderr)
    return medians


def whole(dataset: Path, generations: int, device: str) -> dict[str, object]:
    """Run the paper's training; return minutes and errors on the last fifth."""
    from neurosim.training.evaluate import compare
    from neurosim.training.train import training_data
    from tracking.datasets.dataset import Dataset

    earlier, later = Dataset.read(dataset).split(0.2)
    trainer = GaTrainer(training_data(earlier), SETTINGS, 0, device)
    began = time.perf_counter()
    for number in range(generations):
        trainer.advance()
        if number % 1000 == 999:
            seconds = time.perf_counter() - began
            print(f"{number + 1} generations, {seconds:.0f} s", file=sys.stderr, flush=True)
    minutes = (time.perf_counter() - began) / 60
    return {
        "generations": generations,
        "rows": len(earlier),
        "minutes": minutes,
        "errors": compare(trainer.result(), earlier, later).errors(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", type=Path, nargs="?", help="its rows, else random ones")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--device", default="cpu", help="for ours")
    parser.add_argument("--whole", action="store_true", help="the paper's whole training")
    parser.add_argument("--generations", type=int, default=15_000, help="of --whole")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if options.whole:
        if options.dataset is None:
            parser.error("--whole needs a dataset")
        result = whole(options.dataset, options.generations, options.device)
        if options.json:
            print(json.dumps(result))
            return
        print(f"3 x {result['generations']} generations: {result['minutes']:.1f} minutes")
        for name, error in result["errors"].items():
            mean, mse = error["mean_absolute_error"], error["mse"]
            print(f"{name:7s} mean absolute error {mean:.2f} {error['unit']}, MSE {mse:.2f}")
        return
    with contextlib.redirect_stdout(sys.stderr):  # where peers' own messages go
        medians = measure(*rows(options.dataset), options.repeats, options.device)
    floor = min(value for name, value in medians.items() if name.startswith("floor"))
    if options.json:
        print(json.dumps({"seconds": medians, "floor": floor}))
        return
    print(f"{'':18s}{'x ours':>9s}{'x floor':>9s}{'ms':>9s}")
    for name, value in sorted(medians.items(), key=lambda item: item[1]):
        ours_, over = value / medians["neurosim"], value / floor
        print(f"{name:18s}{ours_:9.1f}{over:9.1f}{1e3 * value:9.1f}")


if __name__ == "__main__":
    main()
