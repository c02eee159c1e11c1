"""pycma evolves a network that drives to two places in turn."""

import cma

import neurosim as ns

simulator = ns.load("simulator")
task = ns.make_task("go-to", goals=[[0.5, 0.3, 0], [0.0, 0.5, 0]], seconds=20.0)
network = ns.make_controller("network", simulator, task)
fitness = ns.evaluate(simulator, task, network, samples=24)

options = {"seed": 1, "popsize": 40, "maxiter": 60}
search = cma.CMAEvolutionStrategy(network.genes * [0.0], 0.5, options)
while not search.stop():
    genes = search.ask()
    search.tell(genes, -fitness(genes))

success = ns.evaluate(simulator, task, network, samples=200, seed=1, objective="probability")
print(f"success {success(search.result.xfavorite):.2f}")
