"""Simulators behind one protocol: state and command in, state out, for a whole batch.

Names are imported when they are used, because PyTorch takes seconds to import, and the virtual lab
needs a module of this package without it.
"""

from typing import TYPE_CHECKING

from neurosim.base.lazy import names_of

if TYPE_CHECKING:
    from neurosim.simulators.base import Simulator
    from neurosim.simulators.motion.network import MotionNetwork
    from neurosim.simulators.registry import read_simulator
    from neurosim.simulators.tables.simulator import TableSimulator

__all__ = ["MotionNetwork", "Simulator", "TableSimulator", "read_simulator"]

__getattr__ = names_of(
    __name__,
    {
        "MotionNetwork": "neurosim.simulators.motion.network",
        "Simulator": "neurosim.simulators.base",
        "TableSimulator": "neurosim.simulators.tables.simulator",
        "read_simulator": "neurosim.simulators.registry",
    },
)
