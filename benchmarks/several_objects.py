"""How readings of several objects at once combine: what the simulator of tables assumes.

Tables are made of what robots of the virtual lab read before one wall and one round obstacle,
without noise. At random places in the paper's arena, where tables say something, its walls and
obstacles together give readings that the lab knows (light reflected by all of them, through the
sensors' circuits); the tables give every object's alone. Compared are

  - their sum above ambient, with what the simulator does in corners: TableSimulator.sense;
  - the brightest alone;
  - the nearest object alone.

    python benchmarks/several_objects.py           seconds
"""

from __future__ import annotations

import argparse
import json

import numpy as np
import torch

from neurosim.lab import KheperaParams, LabArena, sampling_places
from neurosim.lab.khepera import physics
from neurosim.simulators import TableSimulator
from neurosim.simulators.tables.arena import Arena, paper_arena
from neurosim.simulators.tables.samples import Samples
from neurosim.simulators.tables.sensor_table import SensorTable
from neurosim.simulators.tables.simulator import RADIUS

FIRST, STEP, DISTANCES, ANGLES = 0.005, 0.002, 20, 180
#: Far from everything, m.
FAR = 20.0
#: Two objects are near when their surfaces are so near the rim, m.
NEAR = 0.035


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--robots", type=int, nargs="+", default=[1, 2, 3, 4, 5])
    parser.add_argument("--poses", type=int, default=2000)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if options.quick:
        options.robots, options.poses = options.robots[:1], 300
    arena, off, two = paper_arena(), [], []
    for robot in options.robots:
        # Nearer than the first distance the tables repeat themselves.
        poses = arena.free_poses(options.poses, RADIUS + FIRST, np.random.default_rng(robot))
        params = KheperaParams.drawn(robot)
        truth = readings(params, LabArena.of(arena), poses)
        ways, near = combined(tables(params), arena, poses)
        off.append({name: found - truth for name, found in ways.items()})
        two.append(near)
    two = np.concatenate(two)
    rows = []
    for name in off[0]:
        error = np.concatenate([each[name] for each in off])
        rows.append({"readings": name, "everywhere": rms(error), "two_near": rms(error[two])})
    if options.json:
        print(json.dumps({"poses": len(two), "share_two_near": float(two.mean()), "rows": rows}))
        return
    print(f"{len(two)} poses, at {100 * two.mean():.0f} % two objects within {1000 * NEAR:.0f} mm")
    for row in rows:
        print(f"  {row['readings']:10} rms {row['everywhere']:.4f}, there {row['two_near']:.4f}")


def readings(params: KheperaParams, arena: LabArena, poses: np.ndarray) -> np.ndarray:
    """Return what a robot without noise reads at poses [N, 3], [N, 8] of 0..1."""
    rng = np.random.default_rng(0)
    walls, cylinders = arena.wall_rows, arena.cylinder_rows
    circuit = params.angle, params.reach, params.threshold, params.offset
    found = [
        physics.proximity(
            np.array(pose), *circuit, (0.0, 0.0), 0.0, walls, cylinders, arena.albedo, rng
        )
        for pose in poses
    ]
    return np.array(found) / 1023


def tables(params: KheperaParams) -> SensorTable:
    """Return what a robot would sample of one wall and one obstacle, exactly."""
    lab, places = sampling_places()
    samples = {}
    for name in ("wall", "cylinder"):
        _, y, heading = places[name]
        poses = [
            (-RADIUS - FIRST - STEP * distance, y, heading + 2.0 * np.pi * angle / ANGLES)
            for distance in range(DISTANCES)
            for angle in range(ANGLES)
        ]
        seen = readings(params, lab, np.array(poses)).reshape(DISTANCES, ANGLES, 8)
        samples[name] = [Samples(seen, FIRST, STEP)]
    return SensorTable.from_samples(samples)


def combined(
    sensors: SensorTable, arena: Arena, poses: np.ndarray
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return readings [N, 8] at poses by each way, and where two objects are near [N]."""
    state = torch.from_numpy(poses)
    empty = Arena.rectangle(FAR, FAR).outline
    alone = [Arena(empty, inner=(tuple(wall),)) for wall in arena.walls]
    alone += [Arena(empty, obstacles=(tuple(obstacle),)) for obstacle in arena.cylinders]
    seen = np.stack([TableSimulator(sensors, arena=one).sense(state).numpy() for one in alone])
    gaps = np.concatenate([to_walls(arena, poses), to_obstacles(arena, poses)])
    nearest = gaps.argmin(axis=0)
    ways = {
        "the sum": TableSimulator(sensors, arena=arena).sense(state).numpy(),
        "brightest": seen.max(axis=0),
        "nearest": seen[nearest, np.arange(len(poses))],
    }
    return ways, (gaps < NEAR).sum(axis=0) >= 2


def to_walls(arena: Arena, poses: np.ndarray) -> np.ndarray:
    """Return the distance (m) from the rim to every wall, [W, N]."""
    ends = arena.walls[:, None]
    along = ends[..., 2:] - ends[..., :2]
    share = ((poses[:, :2] - ends[..., :2]) * along).sum(-1) / (along**2).sum(-1)
    point = ends[..., :2] + np.clip(share, 0.0, 1.0)[..., None] * along
    return np.linalg.norm(poses[:, :2] - point, axis=-1) - RADIUS


def to_obstacles(arena: Arena, poses: np.ndarray) -> np.ndarray:
    """Return the distance (m) from the rim to every obstacle, [K, N]."""
    centre = arena.cylinders[:, None]
    return np.linalg.norm(poses[:, :2] - centre[..., :2], axis=-1) - RADIUS - centre[..., 2]


def rms(error: np.ndarray) -> float:
    return float(np.sqrt((error**2).mean()))


if __name__ == "__main__":
    main()
