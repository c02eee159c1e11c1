"""Simulators behind one protocol: state and command in, state out, for a whole batch."""

from neurosim.simulators.base import Simulator
from neurosim.simulators.motion.network import MotionNetwork
from neurosim.simulators.registry import read_simulator
from neurosim.simulators.tables.simulator import TableSimulator

__all__ = ["MotionNetwork", "Simulator", "TableSimulator", "read_simulator"]
