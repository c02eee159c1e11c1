"""Drives of the virtual NXT's wheels alone."""

import numpy as np

from neurosim.lab.nxt.physics import REGULATED, S, U, advance, begin_command


def displacements(state, commands, p, field):
    """Drive a sequence of regulated commands without a brick or a camera.

    Args:
        state: float64 [S.SIZE], changed in place.
        commands: float64 [N, 3]: left and right power (%), duration (s).
        p: coefficients.
        field: slip field.

    Returns:
        float64 [N + 1, 3]: the pose at the start and after every command.
    """
    inputs = np.zeros(6)
    inputs[U.MODE : U.MODE + 2] = REGULATED
    inputs[U.LIMIT : U.LIMIT + 2] = np.nan
    poses = np.empty((len(commands) + 1, 3))
    poses[0] = state[S.X : S.X + 3]
    until = state[S.TIME]
    for i in range(len(commands)):
        advance(state, inputs, p, field, until)
        for wheel in range(2):
            inputs[U.POWER + wheel] = commands[i, wheel]
            begin_command(state, wheel, p)
        until += commands[i, 2]
        advance(state, inputs, p, field, until)
        poses[i + 1] = state[S.X : S.X + 3]
    return poses
