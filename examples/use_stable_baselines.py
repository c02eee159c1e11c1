"""Stable-Baselines3's PPO learns a policy that drives to a place."""

import gymnasium
import numpy as np
from gymnasium.wrappers.vector import RescaleAction
from stable_baselines3 import PPO

from neurosim.envs import sb3

made = {"num_envs": 60, "autoreset_mode": "SameStep", "seconds": 6.0, "tolerance": 0.1}
envs = gymnasium.make_vec("neurosim/GoTo-v0", simulator="simulator", **made)
envs, less_noise = sb3(RescaleAction(envs, -1.0, 1.0)), {"log_std_init": -1.0}
learner = PPO("MlpPolicy", envs, 1e-3, 60, 600, gamma=0.95, policy_kwargs=less_noise, seed=1)
learner.learn(200_000)
seen, done = envs.reset(), []
while len(done) < 200:
    seen, _, ended, infos = envs.step(learner.predict(seen, deterministic=True)[0])
    done += [infos[row]["is_success"] for row in ended.nonzero()[0]]
print(f"success {np.mean(done):.2f}")
