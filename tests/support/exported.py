"""Random plans, driven in a simulator and in its exported step."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import torch

from neurosim.simulators import MotionNetwork


def given(simulator, commands, seed=3):
    """Return states at the start, every member in turn, and noise [B, T, Z] or None."""
    count = len(commands)
    pose = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed)).double()
    member = torch.arange(count) % (simulator.members + 1) - 1
    state = simulator.start(pose, member=member if simulator.members > 1 else None)
    if not simulator.noise_width:
        return state, None
    seeds = np.arange(count, dtype=np.uint64) + np.uint64(1000 * seed)
    noise = torch.from_numpy(simulator.noise_of(seeds, commands.shape[1])).double()
    return state, noise * (torch.arange(count) % 2)[:, None, None]


def ours(simulator):
    """Return its step, as :func:`drive` takes it."""
    return lambda state, command, noise: simulator.step(state, command, z=noise)


def random_plans(simulator: MotionNetwork, count, steps=8, seed=0, like=0.3):
    """Return commands [count, steps, C] of float32 numbers, many of them round.

    Args:
        simulator: the commands are in its domain.
        count: plans.
        steps: commands in each.
        seed: of all numbers.
        like: number of plans in whole tenths of the largest command, whose speeds and directions
            often equal those of the previous command, or their opposites.
    """
    generator = torch.Generator().manual_seed(seed)
    ends = torch.tensor(list(simulator.domain.values()), dtype=torch.float64)
    low = torch.where(torch.tensor([n == "duration" for n in simulator.command_names]), 0.1, 0.0)
    low = torch.maximum(ends[:, 0], torch.where(low > 0, low, ends[:, 0]))
    shape = (count, steps, len(ends))
    random = torch.rand(shape, generator=generator, dtype=torch.float64)
    whole = torch.rand(shape[:2], generator=generator) < like
    random = torch.where(whole[..., None], (10.0 * random).round().clamp(min=1.0) / 10.0, random)
    return (low + random * (ends[:, 1] - low)).float().double()


def drive(step, state, commands, noise=None, parts=1):
    """Return poses [B, T, 3] after each of the commands [B, T, C], cut into this many steps.

    Args:
        step: (state, command, noise) -> state.
        state: at the start, [B, S]; its type is that of everything.
        commands: the last column is the duration where there are parts.
        noise: [B, T, Z], or None.
        parts: steps of a command.
    """
    poses = []
    for number in range(commands.shape[1]):
        command = commands[:, number].clone()
        if parts > 1:
            command[:, -1] /= parts
        z = None if noise is None else noise[:, number].to(state)
        for _ in range(parts):
            state = step(state, command.to(state), z)
        poses.append(state[:, :3])
    return torch.stack(poses, 1).double()


def printed_by_page(folder: Path):
    """Run the Python code of an export's page without neurosim; return the poses [T, 3]."""
    _, block = (folder / "README.md").read_text(encoding="utf-8").split("```python\n")
    program = block.split("```")[0] + "\nimport sys\nassert 'neurosim' not in sys.modules\n"
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=folder, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    rows = [line.strip("[]").replace(",", " ").split() for line in done.stdout.splitlines()]
    return torch.tensor([[float(each) for each in row] for row in rows], dtype=torch.float64)
