"""Nevergrad evolves a network that drives to two places in turn."""

import nevergrad as ng

import neurosim as ns

simulator = ns.load("simulator")
task = ns.make_task("go-to", goals=[[0.5, 0.3, 0], [0.0, 0.5, 0]], seconds=20.0)
network = ns.make_controller("network", simulator, task)
fitness = ns.evaluate(simulator, task, network, samples=24)

search = ng.optimizers.TwoPointsDE(ng.p.Array(shape=(network.genes,)), budget=2500)
search.parametrization.random_state.seed(1)
best = search.minimize(lambda genes: -fitness(genes)).value

success = ns.evaluate(simulator, task, network, samples=200, seed=1, objective="probability")
print(f"success {success(best):.2f}")
