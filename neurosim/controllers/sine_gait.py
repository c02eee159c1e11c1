"""Gaits of five parameters for a quadruped of nine servos: SineModel5 of Yosinski et al. 2011.

All eight servos of the legs follow one sine wave. Multipliers scale it for outer servos, for legs
two and four, and for legs one and four. The waves are added to a crouch, and positions beyond the
servos' limits are cut. For a second at the beginning and two at the end the robot goes from its
crouch to the gait and back, so that it is measured in one and the same pose.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from neurosim.controllers.gait import GaitParameter, Gaits, values_of
from neurosim.robots.quadratot import JOINTS, MIDDLE, READY, angles_of

#: The wave is added to these positions of inner and outer servos.
INNER, OUTER = 800, 40
#: Time from the crouch to the gait, and back, s.
BEGIN, END = 1.0, 2.0


@dataclass(frozen=True)
class SineGait(Gaits):
    """Gaits of one sine wave for the nine servos of a QuadraTot.

    Attributes:
        seconds: Duration of a trial, s, with standing up and crouching again.
    """

    kind: ClassVar[str] = "sine-gait"
    outputs = JOINTS
    genes = 5
    #: In the order of the genes. The names are those of the authors' program: the wave of leg one
    #: is multiplied by mult_lr, that of leg two by mult_fb, and that of leg four by both.
    parameters: ClassVar[tuple[GaitParameter, ...]] = (
        GaitParameter("amp", 0.0, 400.0),
        GaitParameter("tau", 0.5, 8.0, "s"),
        GaitParameter("scale_in_out", -2.0, 2.0),
        GaitParameter("mult_fb", -1.0, 1.0),
        GaitParameter("mult_lr", -1.0, 1.0),
    )

    seconds: Annotated[float, Meta(ge=3, le=3600)] = 12.0

    def positions(
        self, genes: NDArray[np.float64], times: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the servo positions [P, T, 9] of individuals [P, 5], before anything is cut.

        Args:
            genes: in 0..1.
            times: [T] s, since the wave began.
        """
        values = values_of(np.asarray(genes, np.float64), self.parameters)[:, None]
        amplitude, period, outer, front, right = np.moveaxis(values, -1, 0)
        wave = amplitude * np.sin(2.0 * np.pi * np.asarray(times) / period)
        positions = np.full((*wave.shape, len(JOINTS)), float(MIDDLE))
        for leg, multiplier in enumerate((right, front, 1.0, front * right)):
            positions[..., 2 * leg] = INNER + multiplier * wave
            positions[..., 2 * leg + 1] = OUTER + multiplier * outer * wave
        return positions

    def over(self, genes: NDArray[np.float64], times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the commands [P, T, 9] rad of individuals [P, 5] at times [T] s of a trial."""
        times = np.asarray(times, np.float64)
        fraction = np.clip(np.minimum(times / BEGIN, (self.seconds - times) / END), 0.0, 1.0)
        gone = fraction[:, None] * (self.positions(genes, times) - READY)
        return angles_of(READY + gone)

    def settings(self) -> dict[str, Any]:
        return {"seconds": self.seconds}
