"""A robot samples its own sensors and motors: Lund and Miglino 1996, "Model".

In front of an object the robot turns on the spot and writes down what its sensors say, backs off,
and so on (:mod:`.turns`, :mod:`.resampling`); in the open it drives its motor settings
(:mod:`.motors`), and measures how late it answers a command (:mod:`.reaction`). Its position
counters say how far it turned and drove; at the motor settings a camera can say it better
(:mod:`.eye`).

Everything is written down as it is read (``sensors.csv``, ``motors.csv``, ``reaction.csv``); the
``.sample`` files and the reaction in ``sampling.json`` are made of that.
"""

from typing import TYPE_CHECKING

from neurosim.base.lazy import names_of
from neurosim.sampling.eye import Eye
from neurosim.sampling.motors import interpolation_cost
from neurosim.sampling.resampling import full_turn
from neurosim.sampling.sampler import FORMAT, VERSION, sample
from neurosim.sampling.settings import SampleSettings
from neurosim.sampling.turns import read_turns

if TYPE_CHECKING:
    from neurosim.sampling.build import build_tables, sampled_baud, sampled_body, sampled_reaction

__all__ = [
    "Eye",
    "FORMAT",
    "SampleSettings",
    "VERSION",
    "build_tables",
    "full_turn",
    "interpolation_cost",
    "read_turns",
    "sample",
    "sampled_baud",
    "sampled_body",
    "sampled_reaction",
]

#: They build simulators, which needs PyTorch.
_BUILD = ("build_tables", "sampled_baud", "sampled_body", "sampled_reaction")

__getattr__ = names_of(__name__, dict.fromkeys(_BUILD, "neurosim.sampling.build"))
