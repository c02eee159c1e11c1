"""Back to reality: controller and simulator are adapted to each other (Zagal et al. 2004)."""

from neurosim.back_to_reality.alternate import Adaptation, Alternation
from neurosim.back_to_reality.settings import BackToRealitySettings, settings_named
from neurosim.back_to_reality.simulated import Simulated
from neurosim.base.trajectory import Tracked
from neurosim.loop.journal import Journal, Reality

__all__ = [
    "Alternation",
    "BackToRealitySettings",
    "Adaptation",
    "Journal",
    "Reality",
    "Simulated",
    "Tracked",
    "settings_named",
]
