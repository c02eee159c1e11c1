"""Networks as controllers, in the form for compiled rollouts.

A layer's genes are rows of weights, one row a unit, the bias last. Hidden units are tanh; outputs
are tanh times a scale. In a recurrent network the hidden units also get their values of the
previous step: with state y and input x, in every step

    y <- y + alpha (W (x, tanh(y), 1) - y)

alpha = 1 is Elman's network (Elman 1990, Cognitive Science 14); with an alpha of its own for
every unit, 1 / (1 + exp(gene)), it is a continuous-time recurrent network (Beer 1995, Adaptive
Behavior 3) stepped by Euler's method, alpha being the step over the unit's time constant.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

#: Inputs of a controller in addition to the readings of sensors. The pose is in the board's frame;
#: the next goal is in the robot's: ahead and to the left (m), and the turn to its heading.
POSE_INPUTS = ("x", "y", "cos_heading", "sin_heading")
GOAL_INPUTS = ("goal_x", "goal_y", "goal_cos", "goal_sin")
TIME_INPUTS = ("time",)
#: The next goal in polar coordinates (Aicardi, Casalino, Bicchi, Balestrino 1995, Closed loop
#: steering of unicycle-like vehicles via Lyapunov techniques), folded for robots that drive forward
#: and back alike: the distance (m), negative where the goal is behind; the turn (rad, -pi/2 to
#: pi/2) until the line to the goal is straight ahead or straight behind; and the turn (rad, -pi to
#: pi) from that line to the goal's heading. All three are zero at the goal, and bearing and
#: approach are zero for a robot that only has to drive straight on.
POLAR_INPUTS = ("goal_distance", "goal_bearing", "goal_approach")
#: All inputs about the next goal.
OF_GOALS = (*GOAL_INPUTS, *POLAR_INPUTS)
NOT_READINGS = (*POSE_INPUTS, *GOAL_INPUTS, *TIME_INPUTS, *POLAR_INPUTS)

#: Values of :attr:`NetworkArrays.recurrence`.
FEED_FORWARD, ELMAN, CTRNN = 0, 1, 2


class NetworkArrays(NamedTuple):
    """A family of networks, as numbers; an individual is a row of genes.

    Genes are in the order: for a CTRNN one gene of alpha for every hidden unit; then the layers
    from the inputs on, each row by row. A recurrent network has one hidden layer, whose rows have
    the inputs' weights, then the hidden units', then the bias.
    """

    inputs: int  #: I
    hidden: np.ndarray  #: [L] int64 units of each hidden layer
    scale: np.ndarray  #: [C] float64 of the outputs
    recurrence: int  #: FEED_FORWARD, ELMAN or CTRNN


def input_sources(inputs: Sequence[str], reading_names: Sequence[str]) -> NDArray[np.int64]:
    """Return the source of each input for compiled rollouts, [I].

    It is the index of a sensor, or -1 - the index in :data:`NOT_READINGS`.
    """
    return np.array(
        [
            -1 - NOT_READINGS.index(name)
            if name in NOT_READINGS
            else list(reading_names).index(name)
            for name in inputs
        ],
        np.int64,
    )
