"""Rows of a robot that follows a drive model's laws, plus a wobble and noise."""

import math

import torch

from neurosim.base.se2 import tensors as se2
from neurosim.simulators.motion.drive import CURVES, DriveModel, Underway
from neurosim.training.base import TrainingData, Within

INPUTS = [
    {"name": name, "unit": "%"} for name in ("prev_left", "prev_right", "left", "right", "duration")
]


def drive_data(
    count,
    *,
    seed=0,
    lag=(0.1, 0.12),
    delay=0.0,
    bend=(0.0, 0.0),
    curve=None,
    rate=40.0,
    braking=1.0,
    stick=0.0,
    stops=0.0,
    wobble=0.0,
    noise=0.001,
):
    """Rows of a differential drive of 0.2 m/s and 0.1 m track, with poses within commands.

    ``stops``: the fraction of wheels that are commanded to stand. ``wobble``: rad/s by which it
    turns where its left wheel runs against its right. ``bend``: the fraction of its speed that a
    wheel lacks at full command. ``curve``: speeds by commands, instead of ``bend``.
    """
    g = torch.Generator().manual_seed(seed)
    u = 2.0 * torch.rand(count, 2, generator=g, dtype=torch.float64) - 1.0
    if stops:
        u[torch.rand(count, 2, generator=g) < stops] = 0.0
    u[0] = torch.tensor([1.0, -1.0])  # the scale is the same for all
    time = 0.5 + 2.5 * torch.rand(count, generator=g, dtype=torch.float64)
    time[1] = 3.0
    wheel = torch.tensor([[0.1, 0.0, -2.0], [0.1, 0.0, 2.0]], dtype=torch.float64)
    bent = torch.zeros(2, CURVES).double()
    bent[:, 0] = -torch.tensor(bend)
    kinematics = torch.cat([wheel, torch.zeros(3, 3, dtype=torch.float64)])
    drive = DriveModel(
        torch.tensor(lag), torch.ones(2), torch.full((2,), braking), torch.full((2,), rate),
        torch.full((2,), stick), bent, torch.tensor([delay]), kinematics,
    )  # fmt: skip
    commanded = drive.shaped(u) if curve is None else curve(u)
    under, each = drive.begun(torch.zeros(1, 2, dtype=torch.float64)), []
    for row in range(count):
        each.append(under)
        reached = drive.reached(under, commanded[row : row + 1], time[row : row + 1])
        under = drive.after(under, commanded[row : row + 1], time[row : row + 1], reached)

    def moved(rows, until):
        begun = Underway(*(torch.cat(parts)[rows] for parts in zip(*each, strict=True)))
        changing, twist = drive.phases(begun, commanded[rows], until)
        turn = wobble * torch.sin(2.0 * math.pi * u[rows, 0] * u[rows, 1]) * until
        twist = twist + torch.stack([0 * turn, 0 * turn, turn], 1)
        scatter = torch.randn(len(rows), 3, generator=g, dtype=torch.float64)
        scatter = scatter * torch.tensor([noise, noise, 5 * noise], dtype=torch.float64)
        return se2.compose(changing, se2.exp(twist)) + scatter

    rows = torch.arange(count)
    of = rows.repeat_interleave(4)
    fraction = torch.tensor([0.1, 0.2, 0.4, 0.7], dtype=torch.float64).repeat(count)
    within = Within(of, fraction * time[of], moved(of, fraction * time[of]))
    previous = torch.cat([torch.zeros(1, 2, dtype=torch.float64), u[:-1]])
    x = torch.cat([100 * previous, 100 * u, time[:, None]], 1)
    return TrainingData(INPUTS, x, moved(rows, time), within)
