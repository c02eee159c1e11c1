"""EvoTorch's GymNE: one trial after the other."""

import gymnasium
from evotorch.algorithms import SNES
from evotorch.neuroevolution import GymNE
from gymnasium.wrappers import RescaleAction

name = "neurosim.envs:neurosim/GoTo-v0"
env = RescaleAction(gymnasium.make(name, simulator="simulator", seconds=6.0), -1, 1)
problem = GymNE(lambda: env, "Linear(obs_length, act_length)")
search = SNES(problem, popsize=50, stdev_init=1.0)
search.run(60)
policy, done = problem.to_policy(search.status["center"]), []
while len(done) < 50:
    (seen, _), over = env.reset(seed=len(done)), False
    while not over:
        action = policy(problem.as_tensor(seen)).clamp(-1, 1).detach().numpy()
        seen, _, _, over, info = env.step(action)
    done.append(info["is_success"])
print(f"success {sum(done) / 50:.2f}")
