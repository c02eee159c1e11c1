"""EvoTorch's VecGymNE: the trials of a whole generation are one batch."""

import gymnasium
from evotorch.algorithms import SNES
from evotorch.neuroevolution import VecGymNE
from gymnasium.wrappers.vector import RescaleAction


def make(num_envs):
    name = "neurosim.envs:neurosim/GoTo-v0"
    return RescaleAction(gymnasium.make_vec(name, num_envs=num_envs, simulator="simulator"), -1, 1)


problem, envs = VecGymNE(make, "Linear(obs_length, act_length)"), make(100)
search = SNES(problem, popsize=100, stdev_init=1.0)
search.run(40)
policy, (seen, _) = problem.to_policy(search.status["center"]), envs.reset(seed=1)
for _ in range(150):  # a trial
    seen, *_, info = envs.step(policy(problem.as_tensor(seen)).clamp(-1, 1).detach().numpy())
print(f"success {info['is_success'].mean():.2f}")
