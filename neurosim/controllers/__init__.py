"""Controllers: the next command of a robot, given its observations; and their files."""

from neurosim.controllers.base import Controller
from neurosim.controllers.files import SavedController, read_controller
from neurosim.controllers.function import Function
from neurosim.controllers.network import Network, Recurrent
from neurosim.controllers.plan import Command, FixedPlan, Plan
from neurosim.controllers.registry import CONTROLLERS, make_controller

__all__ = [
    "CONTROLLERS",
    "Command",
    "Controller",
    "FixedPlan",
    "Function",
    "Network",
    "Plan",
    "Recurrent",
    "SavedController",
    "make_controller",
    "read_controller",
]
