"""Back to reality: controller and simulator are adapted to each other (Zagal et al. 2004)."""

from neurosim.back_to_reality.alternate import Alternation, Found
from neurosim.back_to_reality.reality import REALITIES, Reality, Trials, make_reality
from neurosim.back_to_reality.settings import BackToRealitySettings, settings_named
from neurosim.back_to_reality.simulated import Simulated
from neurosim.base.trajectory import Tracked

__all__ = [
    "Alternation",
    "BackToRealitySettings",
    "Found",
    "REALITIES",
    "Reality",
    "Simulated",
    "Tracked",
    "Trials",
    "make_reality",
    "settings_named",
]
