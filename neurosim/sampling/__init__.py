"""A robot samples its own sensors and motors: Lund and Miglino 1996, "Model".

In front of an object the robot turns on the spot and records its sensors' readings, backs off, and
repeats this (:mod:`.turns`, :mod:`.resampling`). On open floor it drives its motor settings
(:mod:`.motors`), and measures its delay after a command (:mod:`.reaction`). Its position counters
measure turns and distances; a camera measures the motor settings more accurately (:mod:`.eye`).

All readings are written at once (``sensors.csv``, ``motors.csv``, ``reaction.csv``); the
``.sample`` files and the reaction in ``sampling.json`` are computed from them.
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
    from neurosim.sampling.build import build_tables, sampled_reaction

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
    "sampled_reaction",
]

#: Names of functions that build simulators, which needs PyTorch.
_BUILD = ("build_tables", "sampled_reaction")

__getattr__ = names_of(__name__, dict.fromkeys(_BUILD, "neurosim.sampling.build"))
