"""EvoTorch evolves a policy that drives to a place; the trials of a generation are one batch."""

import gymnasium
import numpy as np
import torch
from evotorch.algorithms import SNES
from evotorch.neuroevolution import VecGymNE
from gymnasium.wrappers.vector import RescaleAction

NAME = "neurosim.envs:neurosim/GoTo-v0"
make = lambda n: RescaleAction(gymnasium.make_vec(NAME, num_envs=n, simulator="simulator"), -1, 1)
problem = VecGymNE(lambda num_envs: make(num_envs), "Linear(obs_length, act_length)", seed=1)
search = SNES(problem, popsize=100, stdev_init=1.0)
search.run(40)
policy, envs, done = problem.to_policy(search.status["center"]), make(100), np.zeros(100, bool)
seen, _ = envs.reset(seed=1)
for _ in range(150):  # a trial
    seen, *_, info = envs.step(policy(torch.as_tensor(seen)).clamp(-1, 1).numpy())
    done |= info.get("is_success", done)
print(f"success {done.mean():.2f}")
