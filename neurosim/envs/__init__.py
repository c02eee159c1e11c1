"""Gymnasium environments: every task in every simulator, one robot or many at once.

An import of this package registers them, and so does its name:
``gymnasium.make("neurosim.envs:neurosim/GoTo-v0", simulator="folder")``. A task of your own is
``neurosim/Task-v0`` with ``task=``.
"""

from __future__ import annotations

from typing import Any

from neurosim.base.errors import UserError

try:
    import gymnasium
except ImportError:  # pragma: no cover
    raise UserError(
        "environments need Gymnasium, which is not installed; pip install 'neurosim[gym]'"
    ) from None

from neurosim.envs.single import TaskEnv
from neurosim.envs.vector import TaskVectorEnv
from neurosim.tasks.registry import TASKS

__all__ = ["TaskEnv", "TaskVectorEnv", "environment_id", "make_env", "sb3"]


def make_env(
    simulator: Any, task: Any = "nine-rectangles", *, robot: str | None = None, **others: Any
) -> gymnasium.Env[Any, Any]:
    """Return a task in a simulator, or, with the simulator's spaces, on a robot.

    Args:
        simulator, task: as :class:`TaskEnv` takes them.
        robot: None, or a name for ``--robot``: virtual, virtual-khepera, or a real robot's.
        others: arguments of :class:`TaskEnv`, or of :class:`neurosim.envs.robot.RobotEnv`.

    Raises:
        UserError: if they do not fit each other.
    """
    if robot is None:
        return TaskEnv(simulator, task, **others)
    from neurosim.envs.robot import RobotEnv

    return RobotEnv(simulator, task, robot=robot, **others)


def sb3(envs: gymnasium.vector.VectorEnv[Any, Any, Any]) -> Any:
    """Return a vector environment as a ``VecEnv`` of Stable-Baselines3.

    Args:
        envs: made with ``autoreset_mode="SameStep"``, wrapped or not.

    Raises:
        UserError: if they have another mode, or Stable-Baselines3 is not installed.
    """
    try:
        import stable_baselines3  # noqa: F401
    except ImportError:
        raise UserError(
            "Stable-Baselines3 is not installed; pip install stable-baselines3"
        ) from None
    from neurosim.envs.stable_baselines import StableBaselinesEnvs

    return StableBaselinesEnvs(envs)


def environment_id(task: str) -> str:
    """Return a task's name in Gymnasium: neurosim/GoTo-v0 for ``go-to``."""
    return f"neurosim/{''.join(part.capitalize() for part in task.split('-'))}-v0"


def _register(name: str, **settings: Any) -> None:
    gymnasium.register(
        name,
        entry_point="neurosim.envs:make_env",
        vector_entry_point="neurosim.envs.vector:TaskVectorEnv",
        kwargs=settings,
    )


_register("neurosim/Task-v0")
for _task in TASKS.names():
    if environment_id(_task) not in gymnasium.registry:
        _register(environment_id(_task), task=_task)
