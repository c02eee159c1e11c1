"""An ideal robot with two wheels: a simulator that has learned nothing."""

import torch

from neurosim.simulators.base import Simulator


class IdealWheels(Simulator):
    """Follows its motors at once and without slip; 0.5 m/s at full speed, axle track 0.13 m."""

    state_names = ("x", "y", "theta", "prev_left", "prev_right")
    command_names = ("left", "right", "duration")

    def start(self, pose, generator=None):
        return torch.cat([pose, pose.new_zeros(len(pose), 2)], dim=1)

    def step(self, state, command, generator=None):
        left, right, duration = command[:, 0] * 0.005, command[:, 1] * 0.005, command[:, 2]
        forward, turn = (left + right) / 2 * duration, (right - left) / 0.13 * duration
        x, y, theta = state[:, :3].unbind(1)
        chord = forward * torch.sinc(turn / (2 * torch.pi))
        return torch.stack(
            [
                x + chord * torch.cos(theta + turn / 2),
                y + chord * torch.sin(theta + turn / 2),
                theta + turn,
                command[:, 0],
                command[:, 1],
            ],
            dim=1,
        )


class SlippingWheels(IdealWheels):
    """Wheels whose speed is off by a few percent, drawn for every command."""

    has_noise = True

    def step(self, state, command, generator=None):
        if generator is None:
            return super().step(state, command)
        scale = torch.ones_like(command)
        slip = torch.randn(len(command), 2, generator=generator, dtype=command.dtype)
        scale[:, :2] += 0.03 * slip
        return super().step(state, command * scale)
