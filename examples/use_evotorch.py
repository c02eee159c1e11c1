"""EvoTorch evolves a policy that drives to a place."""

import gymnasium
import torch
from evotorch.algorithms import SNES
from evotorch.neuroevolution import GymNE
from gymnasium.wrappers import RescaleAction

NAME = "neurosim.envs:neurosim/GoTo-v0"
make = lambda: RescaleAction(gymnasium.make(NAME, simulator="simulator"), -1, 1)
problem = GymNE(make, "Linear(obs_length, act_length)", seed=1)
search = SNES(problem, popsize=40, stdev_init=1.0)
search.run(25)
policy, env, done = problem.to_policy(search.status["center"]), make(), 0
for trial in range(50):
    (seen, _), over = env.reset(seed=trial), False
    while not over:
        action = policy(torch.as_tensor(seen)).clamp(-1, 1).numpy()
        seen, _, terminated, truncated, info = env.step(action)
        over = terminated or truncated
    done += info["is_success"] / 50
print(f"success {done:.2f}")
