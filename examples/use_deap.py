"""DEAP's CMA-ES evolves a network that drives to two places in turn."""

import numpy as np
from deap import base, cma, creator

import neurosim as ns

np.random.seed(1)  # noqa: NPY002 (DEAP draws from it)
simulator = ns.load("simulator")
task = ns.make_task("go-to", goals=[[0.5, 0.3, 0], [0.0, 0.5, 0]], seconds=20.0)
network = ns.make_controller("network", simulator, task)
fitness = ns.evaluate(simulator, task, network, samples=24)
creator.create("Fitness", base.Fitness, weights=(1.0,))
creator.create("Individual", list, fitness=creator.Fitness)
search = cma.Strategy([0.0] * network.genes, 1.0, lambda_=40)
for _ in range(80):
    population = search.generate(creator.Individual)
    for individual, value in zip(population, fitness(population), strict=True):
        individual.fitness.values = (value,)
    search.update(population)
success = ns.evaluate(simulator, task, network, samples=200, seed=1, objective="probability")
print(f"success {success(search.centroid):.2f}")
