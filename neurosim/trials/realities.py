"""Realities by name: robots of the lab, real ones by their drivers, and a person who types."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any

from neurosim.base.errors import UserError
from neurosim.base.registry import Registry
from neurosim.loop.journal import Reality
from neurosim.robots.registry import ROBOTS
from neurosim.simulators.base import Simulator
from neurosim.trials.filmed import on_robot

#: Functions by name that take a controller and options as keywords, and the task, the simulator,
#: the camera and its calibration if they have parameters of these names; they return a reality, or
#: a context that gives one.
REALITIES = Registry(
    "reality",
    "neurosim.realities",
    {
        "virtual-walker": "neurosim.lab.walker:VirtualWalker",
        "virtual-nxt": "neurosim.trials.filmed:VirtualNxt",
        "virtual-khepera": "neurosim.trials.floor:virtual_khepera",
        "virtual-thymio": "neurosim.trials.floor:virtual_thymio",
        "by-hand": "neurosim.trials.by_hand:ByHand",
    },
)


class _Named:
    """Realities, and drivers of robots."""

    def names(self) -> list[str]:
        """Return all names."""
        return [*REALITIES.names(), *ROBOTS.names()]

    def get(self, name: str) -> Callable[..., Any]:
        """Return the callable whose keywords are the options.

        Raises:
            UserError: if the name is unknown.
        """
        if name in ROBOTS.names() and name not in REALITIES.names():
            return ROBOTS.get(name)
        return REALITIES.get(name, ROBOTS.names())


#: The choices of ``--reality``.
NAMED = _Named()


def make_reality(
    name: str,
    controller: Any,
    task: Any = None,
    simulator: Simulator | None = None,
    *,
    camera: str | None = None,
    calibration: str | Path | None = None,
    **options: Any,
) -> Any:
    """Return a reality, or a context that gives one.

    Args:
        name: of the reality, or of a robot's driver.
        controller: the controller of the genes.
        task: the task.
        simulator: the simulator that is compared with it.
        camera, calibration: of a robot that is named by its driver, or of a reality that takes
            them.
        options: of the reality.

    Raises:
        UserError: if the name is unknown, the options are wrong, or the registered object is not a
            reality.
    """
    given = {"controller": controller, "task": task, "simulator": simulator}
    if name in ROBOTS.names() and name not in REALITIES.names():
        robot = ROBOTS.make(name, options)
        return on_robot(robot, **given, camera=camera, calibration=calibration)
    maker = REALITIES.get(name)
    takes = inspect.signature(maker).parameters if callable(maker) else {}
    for option, value in (("camera", camera), ("calibration", calibration)):
        if value is not None and option not in takes:
            raise UserError(f"the reality {name} needs no {option}: leave it out")
        given[option] = value
    given = {key: value for key, value in given.items() if key == "controller" or key in takes}
    reality = REALITIES.make(name, {**given, **options})
    if not isinstance(reality, Reality | AbstractContextManager):
        raise UserError(f"the reality {name!r} has no trial()")
    return reality


@contextmanager
def open_reality(name: str, *given: Any, **options: Any) -> Iterator[Reality]:
    """Open a reality, and close it if necessary; see :func:`make_reality`."""
    made = make_reality(name, *given, **options)
    with made if isinstance(made, AbstractContextManager) else nullcontext(made) as reality:
        yield reality
