"""Stable-Baselines3's PPO learns a policy that drives to a place."""

import gymnasium
import numpy as np
from gymnasium.wrappers.vector import RescaleAction
from stable_baselines3 import PPO

from neurosim.envs import sb3

made = {"simulator": "simulator", "num_envs": 60, "autoreset_mode": "SameStep", "seconds": 6.0}
envs = sb3(RescaleAction(gymnasium.make_vec("neurosim/GoTo-v0", **made), -1.0, 1.0))
learner = PPO("MlpPolicy", envs, n_steps=60, batch_size=600, learning_rate=1e-3, seed=1)
learner.learn(300_000)
seen, done = envs.reset(), []
while len(done) < 200:
    seen, _, ended, infos = envs.step(learner.predict(seen, deterministic=True)[0])
    done += [infos[row]["is_success"] for row in ended.nonzero()[0]]
print(f"success {np.mean(done):.2f}")
