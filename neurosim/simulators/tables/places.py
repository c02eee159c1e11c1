"""Many arenas instead of one, because a controller that evolves in one arena fits only that one.

Arenas are drawn at random: rectangles, slanted quadrilaterals and L-shapes of 0.4 to 0.9 m, with
round obstacles and walls inside, wherever a robot can pass between. They are on one floor,
:data:`PITCH` apart along x, so that a pose determines the robot's arena.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurosim.base.errors import UserError
from neurosim.base.place import Place
from neurosim.base.trajectory import Draws, Episode, Trajectory
from neurosim.simulators.base import Rollouts, Simulator
from neurosim.simulators.engine import ThreadSafe

#: Distance from the middle of one arena to that of the next, m.
PITCH = 100.0
#: Sides of an arena, m, and radius of its obstacles, that of the sampled one.
SIDES, OBSTACLE = (0.4, 0.9), 0.0275
#: Largest number of obstacles and of inner walls; lengths of the latter, m.
MOST, LENGTHS = (4, 2), (0.05, 0.2)
#: Radius of the robot for these sizes, m, which grow with it; and width of a passage beyond the
#: robot's, m.
_RADIUS, _SPARE = 0.0275, 0.03
#: Number of attempts to place an object.
_TRIES = 50


def random_arena(
    rng: np.random.Generator, radius: float = _RADIUS, *, inner: int = MOST[1]
) -> Place:
    """Return a random arena in which a robot of ``radius`` (m) can pass everywhere.

    Args:
        rng: source of the draws.
        radius: of the robot, m.
        inner: largest number of inner walls.

    Raises:
        UserError: if the radius is out of range.
    """
    if not 0.001 <= radius <= 10:
        raise UserError(f"a robot's radius lies from 1 mm to 10 m, not {radius:g} m")
    scale = radius / _RADIUS
    room = 2.0 * radius + scale * _SPARE
    outline = _outline(rng, scale)
    arena = Place(outline)
    for _ in range(rng.integers(MOST[0] + 1)):
        place = _free(rng, arena, room + OBSTACLE, lambda at: at[:, None])
        if place is not None:
            obstacle = (float(place[0, 0]), float(place[0, 1]), OBSTACLE)
            arena = Place(outline, arena.walls, (*arena.obstacles, obstacle))
    for _ in range(rng.integers(inner + 1)):
        turn, length = rng.uniform(0.0, 2.0 * math.pi), scale * rng.uniform(*LENGTHS)
        along = np.linspace(0.0, length, 21)[:, None] * (math.cos(turn), math.sin(turn))
        line = _free(rng, arena, room, lambda at, along=along: at[:, None] + along)  # type: ignore[misc]
        if line is not None:
            (x1, y1), (x2, y2) = line[[0, -1]].tolist()
            arena = Place(outline, (*arena.walls, (x1, y1, x2, y2)), arena.obstacles)
    return arena


def _outline(rng: np.random.Generator, scale: float) -> tuple[Any, ...]:
    width, height = scale * rng.uniform(*SIDES, 2)
    x, y = width / 2, height / 2
    corners = np.array([(-x, -y), (x, -y), (x, y), (-x, y)])
    shape = rng.integers(3)
    if shape == 1:
        corners *= rng.uniform(0.75, 1.0, (4, 1))
    elif shape == 2:
        a, b = x - rng.uniform(0.25, 0.6) * width, y - rng.uniform(0.25, 0.6) * height
        corners = np.array([(-x, -y), (x, -y), (x, b), (a, b), (a, y), (-x, y)])
    turn = rng.uniform(-math.pi, math.pi)
    cos, sin = math.cos(turn), math.sin(turn)
    corners = corners @ np.array([(cos, sin), (-sin, cos)])
    return tuple(tuple(corner) for corner in corners.tolist())


def _free(
    rng: np.random.Generator,
    arena: Place,
    room: float,
    points: Callable[[NDArray[np.float64]], NDArray[np.float64]],
) -> NDArray[np.float64] | None:
    """Return points [N, 2] of an object with some room around it, m; None if there is no room.

    ``points`` gives those [K, N, 2] of objects at K positions [K, 2].
    """
    x1, y1, x2, y2 = arena.bounds
    shapes = points(rng.uniform((x1, y1), (x2, y2), (_TRIES, 2)))
    free = np.flatnonzero((arena.clearance(shapes) > room).all(axis=1))
    return shapes[free[0]] if len(free) else None


class ManyArenas(Simulator):
    """A table simulator in many arenas; a trial stays in the arena of its start.

    Attributes:
        own: the simulator, in its own arena.
        places: copies of it in the other arenas.
    """

    kind = "tables"

    def __init__(self, own: Any, count: int, seed: int):
        """Draw ``count`` arenas from a seed; ``own`` is a table simulator."""
        rng = np.random.default_rng([seed, count])
        self.own = own
        self.state_names, self.command_names = own.state_names, own.command_names
        self.has_noise = own.has_noise
        self.noise_width, self.noise_kind = own.noise_width, own.noise_kind
        self.reading_names, self.radius = own.reading_names, own.radius
        self.places = [own.changed(place=random_arena(rng, own.radius)) for _ in range(count)]

    @property
    def bearings(self) -> NDArray[np.float64]:
        """Directions of the sensors, [S] rad to the left."""
        bearings: NDArray[np.float64] = self.own.bearings
        return bearings

    @property
    def domain(self) -> Mapping[str, tuple[float, float]]:
        domain: Mapping[str, tuple[float, float]] = self.own.domain
        return domain

    def free_poses(self, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
        """Return random poses [count, 3] in random arenas, at which the robot touches nothing."""
        chosen = rng.integers(len(self.places), size=count)
        poses = np.concatenate([self.places[place].free_poses(1, rng) for place in chosen])
        return _moved(poses, chosen)

    def touching(self, poses: NDArray[np.float64], margin: float = 0.0) -> NDArray[np.bool_]:
        """Return whether a robot at poses [..., 3] touches something, or is so near (m), [...]."""
        where, touching = _place_of(poses), np.zeros(poses.shape[:-1], np.bool_)
        for place in np.unique(where):
            here = where == place
            touching[here] = self.places[place].touching(_moved(poses[here], -place), margin)
        return touching

    def start(self, pose: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return self.own.start(pose, generator)

    def step(
        self,
        state: Tensor,
        command: Tensor,
        generator: torch.Generator | None = None,
        z: Tensor | None = None,
    ) -> Tensor:
        moved = torch.empty_like(state)
        for here, local, place in self._split(state):
            given = None if z is None else z[here]
            after = self.places[place].step(local, command[here], generator, given)
            after[:, 0] += PITCH * place
            moved[here] = after
        return moved

    def sense(
        self, state: Tensor, generator: torch.Generator | None = None, z: Tensor | None = None
    ) -> Tensor:
        readings = torch.empty(len(state), len(self.reading_names), dtype=torch.float64)
        for here, local, place in self._split(state):
            given = None if z is None else z[here]
            readings[here] = self.places[place].sense(local, generator, given).to(readings)
        return readings

    def rollouts(self, controller: Any, episode: Episode) -> Rollouts | None:
        """Return compiled rollouts, if the tables have them."""
        if self.own.rollouts(controller, episode) is None:
            return None
        return _Rollouts(self, controller, episode)

    def _split(self, state: Tensor) -> list[tuple[Tensor, Tensor, int]]:
        """Give, for each arena, its rows, their states in the arena's frame, and the arena."""
        where = torch.from_numpy(_place_of(state[:, :3].numpy()))
        parts = []
        for place in where.unique().tolist():
            here = where == place
            local = state[here].clone()
            local[:, 0] -= PITCH * place
            parts.append((here, local, place))
        return parts


class _Rollouts(ThreadSafe):
    """Rollouts in many arenas: those of the tables, arena by arena."""

    def __init__(self, simulator: ManyArenas, controller: Any, episode: Episode):
        self._simulator, self._controller, self._episode = simulator, controller, episode
        self._own: Any = simulator.own.rollouts(controller, episode)
        self._of: dict[int, Any] = {}

    def draw(
        self,
        starts: NDArray[np.float64],
        rng: np.random.Generator | int,
        placing: tuple[float, float] | None = None,
    ) -> Draws:
        """Draw samples, as in one arena."""
        return self._own.draw(starts, rng, placing)

    def run(self, genes: NDArray[np.float64], draws: Draws, *, reuse: bool = False) -> Trajectory:
        where = _place_of(draws.starts)
        parts = []
        for place in np.unique(where).tolist():
            if place not in self._of:
                local = self._simulator.places[place]
                self._of[place] = local.rollouts(self._controller, self._episode)
            here = np.flatnonzero(where == place)
            noise = None if draws.noise is None else draws.noise[here]
            some = Draws(_moved(draws.starts[here], -place), noise=noise)
            driven = self._of[place].run(genes, some)
            parts.append((here, driven, _moved(driven.poses, place)))
        order = np.argsort(np.concatenate([here for here, _, _ in parts]), kind="stable")

        def joined(name: str) -> Any:
            each = [getattr(driven, name) for _, driven, _ in parts]
            return np.concatenate(each, axis=1)[:, order] if np.ndim(each[0]) > 1 else each[0]

        poses = np.concatenate([moved for _, _, moved in parts], axis=1)[:, order]
        names = ("commands", "durations", "readings", "active", "segment")
        return Trajectory(poses, *(joined(name) for name in names))


def _place_of(poses: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the index of the arena of poses [..., 3], [...]."""
    return np.rint(poses[..., 0] / PITCH).astype(np.int64)


def _moved(poses: NDArray[np.float64], places: NDArray[np.int64] | int) -> NDArray[np.float64]:
    """Return poses [..., 3] moved by a number of arenas."""
    moved = np.array(poses, np.float64)
    moved[..., 0] += PITCH * np.asarray(places)
    return moved
