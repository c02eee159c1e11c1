"""evosax evolves a network that drives to two places in turn."""

import jax
from evosax.algorithms import CMA_ES

import neurosim as ns

simulator = ns.load("simulator")
task = ns.make_task("go-to", goals=[[0.5, 0.3, 0], [0.0, 0.5, 0]], seconds=20.0)
network = ns.make_controller("network", simulator, task)
fitness = ns.evaluate(simulator, task, network, samples=24)

key, mean = jax.random.key(1), jax.numpy.zeros(network.genes)
search = CMA_ES(population_size=40, solution=mean)
state = search.init(key, mean, search.default_params)
for draw in jax.random.split(key, 60):
    genes, state = search.ask(draw, state, search.default_params)
    state, _ = search.tell(draw, genes, -fitness(genes), state, search.default_params)
success = ns.evaluate(simulator, task, network, samples=200, seed=1, objective="probability")
print(f"success {success(search.get_mean(state)):.2f}")
