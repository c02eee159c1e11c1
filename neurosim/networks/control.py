"""Networks as controllers, laid out for compiled rollouts: what every step computes.

A layer's genes are rows of weights, one row a unit, the bias last. Hidden units are tanh; outputs
are tanh times a scale. In a recurrent network the hidden units also see what they were in the step
before: with state y and input x, in every step

    y <- y + alpha (W (x, tanh(y), 1) - y)

alpha = 1 is Elman's network (Elman 1990, Cognitive Science 14); with an alpha of its own for
every unit, 1 / (1 + exp(gene)), it is a continuous-time recurrent network (Beer 1995, Adaptive
Behavior 3) stepped by Euler's method, alpha being the step over the unit's time constant.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

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
