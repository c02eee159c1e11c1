"""How readings of several objects at once combine: tests an assumption of the table simulator.

Tables are made of the readings of robots of the virtual lab before one wall and one round obstacle,
without noise. At random places in the paper's arena, and in random arenas near boards that stand
inside, its walls and obstacles together give readings that the lab knows (light reflected by all
of them, through the sensors' circuits); the tables give every object's alone. Compared are

  - their sum above ambient, of each wall its visible part: TableSimulator.sense;
  - the brightest alone;
  - the nearest object alone.

    python benchmarks/several_objects.py           seconds
"""

from __future__ import annotations

import argparse
import json
from typing import Any

import numpy as np
import torch

from neurosim.base.place import Place, paper_arena
from neurosim.lab import KheperaParams, sampling_places
from neurosim.lab.khepera import physics
from neurosim.lab.khepera.params import WHITE
from neurosim.simulators import TableSimulator
from neurosim.simulators.tables.places import random_arena
from neurosim.simulators.tables.samples import Samples
from neurosim.simulators.tables.sensor_table import SensorTable
from neurosim.simulators.tables.simulator import RADIUS

FIRST, STEP, DISTANCES, ANGLES = 0.005, 0.002, 20, 180
#: The distance at which an object has no effect, m.
FAR = np.array([1e3, 1e3, 0.0, 0.0, 0.0])
#: Two objects are near when their surfaces are within this distance of the rim, m.
NEAR = 0.035


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--robots", type=int, nargs="+", default=[11, 12, 13, 14, 15])
    parser.add_argument("--poses", type=int, default=2000)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if options.quick:
        options.robots, options.poses = options.robots[:1], 300
    rng = np.random.default_rng(0)
    random = [random_arena(rng, inner=2) for _ in range(30)]
    places = {
        "the paper's arena": [paper_arena()],
        "within 35 mm of boards": [arena for arena in random if arena.walls],
    }
    rows = [row for place, arenas in places.items() for row in compare(place, arenas, options)]
    if options.json:
        print(json.dumps({"rows": rows}))
        return
    for row in rows:
        print(
            f"{row['place']:22} {row['readings']:10} rms {row['everywhere']:.4f}, "
            f"with two objects within {1000 * NEAR:.0f} mm {row['two_near']:.4f} "
            f"({100 * row['fraction_two_near']:.0f} % of {row['poses']} poses)"
        )


def compare(place: str, arenas: list[Place], options: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the error of each rule at random poses in arenas; in random arenas, near boards."""
    off, two = [], []
    for robot in options.robots:
        params, rng = KheperaParams.sampled(robot), np.random.default_rng(robot)
        sensors = tables(params)
        for arena in arenas:
            # Nearer than the first distance the tables repeat themselves.
            poses = arena.free_poses(options.poses // len(arenas), RADIUS + FIRST, rng)
            if arena.walls:
                poses = poses[to_walls(arena, poses)[len(arena.outline) :].min(axis=0) < NEAR]
            truth = readings(params, arena, poses)
            distances, near = combined(sensors, arena, poses)
            off.append({name: value - truth for name, value in distances.items()})
            two.append(near)
    both = np.concatenate(two)
    rows = []
    for name in off[0]:
        error = np.concatenate([each[name] for each in off])
        rows.append({"place": place, "readings": name, "poses": len(both)})
        rows[-1] |= {"fraction_two_near": float(both.mean())}
        rows[-1] |= {"everywhere": rms(error), "two_near": rms(error[both])}
    return rows


def readings(params: KheperaParams, arena: Place, poses: np.ndarray) -> np.ndarray:
    """Return the readings of a robot without noise at poses [N, 3], [N, 8] of 0..1."""
    rng = np.random.default_rng(0)
    walls, cylinders = arena.surfaces, arena.cylinders
    circuit = params.angle, params.reach, params.threshold, params.offset
    result = [
        physics.proximity(np.array(pose), *circuit, (0.0, 0.0), 0.0, walls, cylinders, WHITE, rng)
        for pose in poses
    ]
    return np.array(result) / 1023


def tables(params: KheperaParams) -> SensorTable:
    """Return the exact samples that a robot would take of one wall and one obstacle."""
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
    sensors: SensorTable, arena: Place, poses: np.ndarray
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return readings [N, 8] at poses by each rule, and where two objects are near [N]."""
    state, whole = torch.from_numpy(poses), TableSimulator(sensors, place=arena)
    walls, obstacles = whole.arrays.walls, whole.arrays.obstacles
    things = [(walls[w : w + 1], obstacles[:0]) for w in range(len(walls))]
    things += [(walls[:1] + FAR, obstacles[o : o + 1]) for o in range(len(obstacles))]
    alone = []
    for wall, obstacle in things:
        only = TableSimulator(sensors, place=arena)
        # This object alone is in view, and nothing is in front of it.
        vars(only)["arrays"] = whole.arrays._replace(
            walls=wall, obstacles=obstacle, screens=walls[:0]
        )
        alone.append(only)
    seen = np.stack([only.sense(state).numpy() for only in alone])
    gaps = np.concatenate([to_walls(arena, poses), to_obstacles(arena, poses)])
    nearest = gaps.argmin(axis=0)
    distances = {
        "the sum": whole.sense(state).numpy(),
        "brightest": seen.max(axis=0),
        "nearest": seen[nearest, np.arange(len(poses))],
    }
    first, count = len(arena.outline), len(walls)
    boards = gaps[first:count].reshape(-1, 4, len(poses)).min(axis=1)
    objects = np.concatenate([gaps[:first], boards, gaps[count:]])
    return distances, (objects < NEAR).sum(axis=0) >= 2


def to_walls(arena: Place, poses: np.ndarray) -> np.ndarray:
    """Return the distance (m) from the rim to every wall, [W, N]."""
    ends = arena.surfaces[:, None]
    along = ends[..., 2:] - ends[..., :2]
    fraction = ((poses[:, :2] - ends[..., :2]) * along).sum(-1) / (along**2).sum(-1)
    point = ends[..., :2] + np.clip(fraction, 0.0, 1.0)[..., None] * along
    return np.linalg.norm(poses[:, :2] - point, axis=-1) - RADIUS


def to_obstacles(arena: Place, poses: np.ndarray) -> np.ndarray:
    """Return the distance (m) from the rim to every obstacle, [K, N]."""
    centre = arena.cylinders[:, None]
    return np.linalg.norm(poses[:, :2] - centre[..., :2], axis=-1) - RADIUS - centre[..., 2]


def rms(error: np.ndarray) -> float:
    return float(np.sqrt((error**2).mean()))


if __name__ == "__main__":
    main()
