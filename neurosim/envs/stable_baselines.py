"""Gymnasium's vector environments for Stable-Baselines3."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from neurosim.base.errors import UserError


class StableBaselinesEnvs(VecEnv):
    """A vector environment that begins the next trial in the last step of the previous one.

    The end of a trial is described in its ``info``: ``terminal_observation``,
    ``TimeLimit.truncated``, and the environment's own keys, such as ``is_success``.
    """

    def __init__(self, envs: VectorEnv[Any, Any, Any]):
        """Take environments, wrapped or not.

        Raises:
            UserError: if they begin the next trial at another time.
        """
        if envs.metadata.get("autoreset_mode") is not AutoresetMode.SAME_STEP:
            raise UserError(
                "Stable-Baselines3 expects that a trial begins in the step in which another ended: "
                'make the environments with autoreset_mode="SameStep"'
            )
        self.envs = envs
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> NDArray:
        """Begin all trials; return the observations."""
        seeds: Any = self._seeds  # one for each environment
        seen, _ = self.envs.reset(seed=seeds)
        self._reset_seeds()
        self._reset_options()
        return seen

    def step_async(self, actions: NDArray) -> None:
        """Take actions [num_envs, C] for the next step."""
        self._actions = actions

    def step_wait(self) -> tuple[NDArray, NDArray, NDArray, list[dict[str, Any]]]:
        """Advance by a step; return observations, rewards, whether trials ended, and infos."""
        seen, rewards, terminated, truncated, info = self.envs.step(self._actions)
        ended = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        final = info.get("final_info", {})
        names = [name for name in final if not name.startswith("_")]
        for row in np.flatnonzero(ended):
            infos[row] = {name: final[name][row] for name in names}
            infos[row]["terminal_observation"] = info["final_obs"][row]
            infos[row]["TimeLimit.truncated"] = bool(truncated[row] and not terminated[row])
        return seen, rewards.astype(np.float32), ended, infos

    def close(self) -> None:
        """Close the environments."""
        self.envs.close()

    def get_images(self) -> Sequence[NDArray | None]:
        """Return a picture of each trial."""
        pictures: Any = self.envs.render()
        return list(pictures)

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute, which all environments share."""
        return [getattr(self.envs, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Raise an error: the environments are one object.

        Raises:
            UserError: always.
        """
        raise UserError(f"{attr_name} cannot be changed: make new environments")

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Raise an error: the environments are one object without separate methods.

        Raises:
            UserError: always.
        """
        raise UserError(f"{method_name} cannot be called: these environments are stepped together")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Return whether each environment is wrapped: always False."""
        return [False for _ in self._get_indices(indices)]
