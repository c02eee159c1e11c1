"""A robot builds its own simulator: record it, learn it, evolve in it, drive it.

Names for scripts, imported when they are used::

    import neurosim as ns

    simulator = ns.train("data/reference", "simulator")
    task, plan = ns.make_task("nine-rectangles"), ns.make_controller("plan")
    fitness = ns.evaluate(simulator, task, plan)      # genes [P, G] -> fitness [P]
    best = ns.evolve(simulator, task, plan)[0]
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurosim.base.compiled import keep_compiled_later
from neurosim.base.lazy import names_of

__version__ = "0.1.0"

if TYPE_CHECKING:
    from neurosim.base.errors import UserError
    from neurosim.base.trajectory import Episode, Trajectory
    from neurosim.controllers import Controller, Function, SavedController, make_controller
    from neurosim.loop.check import check
    from neurosim.loop.evaluate import evaluate
    from neurosim.loop.evolve import evolve
    from neurosim.loop.shortcuts import load, read_dataset, rollout
    from neurosim.simulators.base import Simulator
    from neurosim.simulators.engine import compiled
    from neurosim.tasks.base import Judgement, Task
    from neurosim.tasks.registry import make_task
    from neurosim.training.train import train
    from tracking.datasets.csv_files import import_csv

_PUBLIC = {
    "load": "neurosim.loop.shortcuts",
    "read_dataset": "neurosim.loop.shortcuts",
    "import_csv": "tracking.datasets.csv_files",
    "rollout": "neurosim.loop.shortcuts",
    "train": "neurosim.training.train",
    "make_task": "neurosim.tasks.registry",
    "make_controller": "neurosim.controllers",
    "evaluate": "neurosim.loop.evaluate",
    "evolve": "neurosim.loop.evolve",
    "check": "neurosim.loop.check",
    "compiled": "neurosim.simulators.engine",
    "Simulator": "neurosim.simulators.base",
    "Controller": "neurosim.controllers",
    "Function": "neurosim.controllers",
    "SavedController": "neurosim.controllers",
    "Task": "neurosim.tasks.base",
    "Judgement": "neurosim.tasks.base",
    "Trajectory": "neurosim.base.trajectory",
    "Episode": "neurosim.base.trajectory",
    "UserError": "neurosim.base.errors",
}

__getattr__ = names_of(__name__, _PUBLIC)

keep_compiled_later(Path(__file__).parent, Path(__file__).parents[1] / "tracking")

#: The registry of each kind of object that has names.
_REGISTRIES = {
    "robot": ("neurosim.robots.registry", "ROBOTS"),
    "simulator": ("neurosim.simulators.registry", "SIMULATORS"),
    "controller": ("neurosim.controllers.registry", "CONTROLLERS"),
    "task": ("neurosim.tasks.registry", "TASKS"),
    "optimiser": ("neurosim.evolution.optimisers", "OPTIMISERS"),
    "trainer": ("neurosim.training.trainers.registry", "TRAINERS"),
    "reality": ("neurosim.trials.realities", "REALITIES"),
}

__all__ = [
    "Controller",
    "Episode",
    "Function",
    "Judgement",
    "SavedController",
    "Simulator",
    "Task",
    "Trajectory",
    "UserError",
    "check",
    "compiled",
    "evaluate",
    "evolve",
    "import_csv",
    "load",
    "make_controller",
    "make_task",
    "read_dataset",
    "register",
    "rollout",
    "train",
]


def register(what: str, name: str, item: Any = None) -> Any:
    """Register an object of your own under a name; it then works wherever such a name is accepted.

    Args:
        what: the kind of object: robot, simulator, controller, task, optimiser, trainer or reality.
        name: the name for ``make_task``, ``--task`` and so on.
        item: the object, such as a subclass of :class:`Task`; without it, a decorator is returned.

    Raises:
        UserError: if neurosim itself uses the name, or there is no such kind of object.

    Example:
        >>> def away(seen):
        ...     return 60 - 80 * seen["sensor_3"], 60 - 80 * seen["sensor_2"]
        >>> vehicle = ns.Function(away, inputs=("sensor_2", "sensor_3"), name="vehicle")
        >>> _ = ns.register("controller", "vehicle", vehicle)
        >>> ns.make_controller("vehicle").inputs
        ('sensor_2', 'sensor_3')
    """
    if what not in _REGISTRIES:
        from neurosim.base.errors import UserError

        raise UserError(f"{what!r} cannot be registered; choose one of: {', '.join(_REGISTRIES)}")
    module, attribute = _REGISTRIES[what]
    return getattr(import_module(module), attribute).register(name, item)


def __dir__() -> list[str]:
    return sorted([*__all__, *(name for name in globals() if name.startswith("__"))])
