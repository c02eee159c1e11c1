"""A policy is trained by back-propagation through a simulator, to drive to points on the board.

python examples/backpropagation.py SIMULATOR (one that was learned from a recording)
"""

import sys

import torch

import neurosim as ns

STEPS, SECONDS = 12, 0.25  # a command every quarter of a second
simulator = ns.load(sys.argv[1])
torch.manual_seed(0)
torch.set_default_dtype(torch.float64)
policy = torch.nn.Sequential(torch.nn.Linear(2, 16), torch.nn.Tanh(), torch.nn.Linear(16, 2))


def distances(goals):
    """Return the robots' final distances from their goals [B, 2] (m), [B] m."""
    state = simulator.start(torch.zeros(len(goals), 3))
    for _ in range(STEPS):
        x, y, theta = state[:, :3].unbind(1)
        away, cos, sin = goals - torch.stack([x, y], 1), theta.cos(), theta.sin()
        ahead, left = cos * away[:, 0] + sin * away[:, 1], cos * away[:, 1] - sin * away[:, 0]
        speeds = 50.0 * torch.tanh(policy(5.0 * torch.stack([ahead, left], 1)))
        lasting = torch.full_like(speeds[:, :1], SECONDS)
        state = simulator.step(state, torch.cat([speeds, lasting], 1))
    return (goals - state[:, :2]).square().sum(1).add(1e-9).sqrt()


optimiser = torch.optim.Adam(policy.parameters(), lr=0.02)
for number in range(41):
    goals = torch.rand(32, 2) * 0.4 + torch.tensor([0.1, -0.2])
    loss = distances(goals).mean()
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    if number % 20 == 0:
        print(f"after {number} steps: {100 * loss.item():.1f} cm from the goal", flush=True)
