"""The table simulator: a robot that samples its own sensors and motors, and moves in an arena.

Lund and Miglino 1996: the sensors' readings in front of a wall and of an obstacle, and the motion
by the motors, are looked up in tables that the robot filled itself. Obstacles may be sampled in
several sizes: one of another size looks like the one of the nearest size. Sensors of ambient light
have a table of their readings in front of a light.

Readings. Each obstacle, and all walls together, add the table's reading above ambient. It is
interpolated at the distance from the robot's rim to the nearest point of a surface and the bearing
of that point; the sum is clipped to 0..1, because a sensor saturates. Samples are of an endless
wall: several walls count as one endless wall at the distance at which it reflects as much light as
they do (Lambert's law). Nearer than the first sampled distance the first counts; beyond the last a
reading fades to ambient over half of the sampled reach. Objects behind a wall are not seen. Lights
add up in the same way; obstacles hide them, too. The whole robot is in the shade if its middle is.

Collisions. The robot is a disc. If a motion ends in a wall or an obstacle, the disc is moved
straight out of it, so that it slides along. If it does not fit there, as in a narrow gap, it keeps
its position. Its heading follows the motors.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neurosim.base import files, formats
from neurosim.base.errors import FileError, UserError
from neurosim.base.place import Place, paper_arena
from neurosim.base.se2 import tensors as se2
from neurosim.simulators.base import FORMAT, VERSION, Simulator
from neurosim.simulators.tables.kernels import (
    FAINT,
    LANES,
    NEAREST,
    PASSES,
    SLACK,
    Lookup,
    TableArrays,
    substeps,
)
from neurosim.simulators.tables.motor_table import MotorTable
from neurosim.simulators.tables.places import ManyArenas
from neurosim.simulators.tables.reaction import Reaction
from neurosim.simulators.tables.sensor_table import LIGHT, SensorTable, is_kind

#: Oldest version that can be read: earlier tables had an arena.
_OLDEST = 8
#: Senses, and the names of their readings.
SENSES = {"proximity": "sensor", "light": "light"}
#: Difference of radius above which an obstacle counts as another size than the sampled ones, m.
SAME_SIZE = 0.0005
#: Noise on every sensor and displacement: none; uniform; normal, as wide as the samples' own.
NOISES = ("none", "uniform", "samples")
#: Radius of a Khepera, m.
RADIUS = 0.0275
#: Reading above ambient that counts as zero: half a percent of the range.
FAINTEST = 0.005
#: Duration of a step for which uniform noise is a fraction of the range, s.
STEP = 0.1


@dataclass(frozen=True, eq=False)
class TableSimulator(Simulator):
    """A simulator of a robot in an arena, from tables.

    Attributes:
        sensors: readings of walls and obstacles.
        motors: motion by the motors.
        place: the place around the robot.
        radius: of the robot, m.
        reaction: delays of the robot.
        noise: one of :data:`NOISES`, drawn only from a given generator.
        noise_level: half width of uniform noise: a fraction of 1 for every sensor, and of the
            largest displacement in 100 ms forward, sideways and in heading. Over other durations
            a displacement's noise grows with the square root.
        meta: other parts of simulator.json.
        lights: readings of a light by sensors of ambient light; None: it has no such sensors.
        senses: those of :data:`SENSES` that are read, if they have a table.
    """

    kind = "tables"
    state_names = ("x", "y", "theta", "left", "right", "left_goal", "right_goal")
    command_names = ("left", "right", "duration")

    sensors: SensorTable
    motors: MotorTable = field(default_factory=MotorTable.ideal)
    place: Place = field(default_factory=paper_arena)
    radius: float = RADIUS
    noise: str = "uniform"
    noise_level: float = 0.05
    reaction: Reaction = field(default_factory=Reaction)
    meta: Mapping[str, Any] = field(default_factory=dict)
    device: str | torch.device = "cpu"
    lights: SensorTable | None = None
    senses: tuple[str, ...] = tuple(SENSES)

    def __post_init__(self) -> None:
        if self.noise not in NOISES:
            raise UserError(f"noise is one of {', '.join(NOISES)}, not {self.noise!r}")
        if not self._tables:
            raise UserError(
                f"these tables have no readings of {' or '.join(self.senses)}: sample a light, too "
                "(neurosim sample --light), and build them again"
            )
        if self.place.start is not None:
            self.place.check_start(self.place.start, self.radius)
        repeats = self.sensors.spread is not None or self.motors.spread is not None
        if self.noise == "samples" and not repeats:
            raise UserError(
                "noise from the samples needs repeated samples; sample every object (and motor "
                "setting) twice or more, or use uniform noise"
            )

    def changed(self, **changes: Any) -> TableSimulator:
        """Return this simulator with another place, noise or other attributes."""
        return replace(self, **changes)

    @property
    def has_noise(self) -> bool:  # type: ignore[override]
        """Whether there is noise on sensors and motors."""
        return self.noise != "none"

    @property
    def _tables(self) -> dict[str, SensorTable]:
        """The tables of the senses that are read."""
        every = {"proximity": self.sensors, "light": self.lights}
        return {
            sense: table
            for sense, table in every.items()
            if table is not None and sense in self.senses
        }

    @cached_property
    def reading_names(self) -> tuple[str, ...]:  # type: ignore[override]
        """Names of the sensors: of proximity, then of ambient light."""
        return tuple(
            f"{SENSES[sense]}_{index}"
            for sense, table in self._tables.items()
            for index in range(table.mean.shape[-1])
        )

    @property
    def noise_width(self) -> int:  # type: ignore[override]
        """Number of random numbers of a step: one for each sensor, and three for the motion."""
        return len(self.reading_names) + 3

    @property
    def domain(self) -> dict[str, tuple[float, float]]:
        """The range of the motors' sampled speeds (%)."""
        levels = float(self.motors.levels[0]), float(self.motors.levels[-1])
        return {"left": levels, "right": levels}

    @property
    def bearings(self) -> np.ndarray:
        """Directions of the sensors, [S] rad to the left."""
        return np.concatenate([table.bearings() for table in self._tables.values()])

    @property
    def notes(self) -> tuple[str, ...]:  # type: ignore[override]
        """Sentences on obstacles of the place without a sampled size."""
        radii = self.sensors.radii[1:]
        sizes = sorted({radius for _, _, radius in self.place.obstacles})
        notes = []
        for radius in sizes:
            nearest = radii[np.abs(radii - radius).argmin()]
            if abs(nearest - radius) > SAME_SIZE:
                notes.append(
                    f"obstacles of {1000 * radius:g} mm radius were not sampled: they look like "
                    f"those of {1000 * nearest:g} mm"
                )
        return tuple(notes)

    def outline(self) -> list[dict[str, Any]]:
        """Return the place's walls and obstacles."""
        return self.place.shapes()

    def conditions(self) -> dict[str, Any]:
        """Return noise and place."""
        return {
            "noise": {"kind": self.noise, "level": self.noise_level},
            "place": self.place.to_json(),
        }

    def free_poses(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return random poses [count, 3] at which the robot touches nothing."""
        return self.place.free_poses(count, self.radius, rng)

    def elsewhere(self, count: int, seed: int) -> Simulator:
        """Return this simulator in ``count`` other arenas, random from a seed."""
        return ManyArenas(self, count, seed)

    def touching(self, poses: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Return whether a robot at poses [..., 3] touches a wall or an obstacle, [...].

        With a margin (m), also whether it is this near.
        """
        return self.place.clearance(poses[..., :2]) < self.radius + SLACK + margin

    @property
    def noise_kind(self) -> str:  # type: ignore[override]
        return "uniform" if self.noise == "uniform" else "normal"

    def start(self, pose: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Return the states [B, 7] of robots that stand at ``pose`` [B, 3] (m, m, rad)."""
        pose = pose.to(self._tensors["twist"])
        return torch.cat([pose, pose.new_zeros(len(pose), 4)], dim=1)

    def step(
        self,
        state: Tensor,
        command: Tensor,
        generator: torch.Generator | None = None,
        z: Tensor | None = None,
    ) -> Tensor:
        """Return the states [B, 7] after ``command`` [B, 3] (%, %, s); see the module.

        Noise is drawn only from a given generator, or computed from the last three of the numbers
        ``z`` [B, noise_width].
        """
        t, a = self._tensors, self.arrays
        command = command.to(t["twist"])
        duration = command[:, 2:]
        goal = command[:, :2]
        if a.resolution > 0:
            goal = a.resolution * (goal / a.resolution).round()
        pose, speeds, last_goal = state[:, :3], state[:, 3:5], state[:, 5:7]
        noise = torch.zeros_like(pose)
        if self.noise != "none" and (generator is not None or z is not None):
            z = z[:, -3:].to(pose) if z is not None else self._numbers(pose, generator)
            if self.noise == "uniform":
                noise = duration.sqrt() * t["twist_noise"] * z
            else:
                noise = duration.sqrt() * self._motion(t["twist_spread"], goal) * z
        parts = substeps(command[:, 2:].cpu().numpy(), a.fastest, a.radius, a.longest)
        parts = torch.as_tensor(parts, device=pose.device)
        length = duration / parts
        for part in range(int(parts.max())):
            waiting = torch.minimum((a.delay - part * length).clamp(min=0.0), length)
            before, reached = self._advanced(speeds, last_goal, waiting)
            after, reached = self._advanced(reached, goal, length - waiting)
            moved = se2.exp(_joined(before, after) + noise / parts)
            here = part < parts
            pose = torch.where(here, self._collided(pose, se2.compose(pose, moved)), pose)
            speeds = torch.where(here, reached, speeds)
        return torch.cat([pose, speeds, goal], dim=1)

    def sense(
        self,
        state: Tensor,
        generator: torch.Generator | None = None,
        z: Tensor | None = None,
    ) -> Tensor:
        """Return the readings [B, S] in 0..1 of robots in ``state`` [B, 7], or at poses [B, 3].

        Noise is drawn only from a given generator, or computed from the first S of the numbers
        ``z`` [B, noise_width].
        """
        means, variances = [], []
        for sense in self._tables:
            seen = self._seen if sense == "proximity" else self._seen_lights
            mean, variance = self._looked_up(sense, *seen(state))
            means.append(mean)
            variances.append(variance)
        reading = torch.cat(means, dim=1)
        if self.noise != "none" and (generator is not None or z is not None):
            z = z[:, :-3].to(reading) if z is not None else self._numbers(reading, generator)
            if self.noise == "uniform":
                reading = reading + self.noise_level * z
            else:
                reading = reading + torch.cat(variances, dim=1).sqrt() * z
        return reading.clamp(0.0, 1.0)

    def _looked_up(
        self, sense: str, distance: Tensor, bearing: Tensor, kind: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return means and variances of readings [B, S] of objects [B, K or 1, S or 1]."""
        table = self._lookups[sense]
        sensor = torch.arange(table["ambient"].shape[-1], device=distance.device)
        weights, rows, columns = self._place(sense, distance, bearing)
        excess, variance = (
            sum(  # type: ignore[union-attr]
                weights[i, j] * table[name][kind.unsqueeze(-1), rows[i], columns[j], sensor]
                for i in range(2)
                for j in range(2)
            ).sum(1)
            for name in ("excess", "variance")
        )
        return table["ambient"] + excess, table["ambient_variance"] + variance

    def standing(self, poses: np.ndarray, member: np.ndarray | None = None) -> np.ndarray:
        return np.concatenate([poses, np.zeros((len(poses), 4))], axis=1)

    def compiled(self) -> TableArrays:
        return self.arrays

    @cached_property
    def _fastest(self) -> float:
        """The highest speed, m/s."""
        return float(np.linalg.norm(self.motors.twist[..., :2], axis=-1).max())

    @cached_property
    def arrays(self) -> TableArrays:
        """The numbers for :mod:`neurosim.simulators.tables.kernels`."""
        motors = self.motors
        twist_spread = np.zeros_like(motors.twist) if motors.spread is None else motors.spread
        largest = np.abs(motors.twist).max(axis=(0, 1)) * STEP
        cylinders, radii = self.place.cylinders, self.sensors.radii[1:]
        kinds = 1 + np.abs(cylinders[:, 2:] - radii).argmin(axis=1)
        bearings = self.sensors.bearings()
        near, light = self.sensors, self.lights
        return TableArrays(
            near=_lookup(near, "proximity" in self.senses),
            light=_lookup(light or near, light is not None and "light" in self.senses),
            twist=np.ascontiguousarray(motors.twist),
            twist_spread=np.ascontiguousarray(twist_spread),
            lowest=float(motors.levels[0]),
            level_pitch=float(np.diff(motors.levels).mean()),
            resolution=float(motors.resolution),
            delay=float(self.reaction.delay),
            lag=np.array(self.reaction.lag, float),
            radius=float(self.radius),
            fastest=self._fastest,
            longest=math.inf if self.reaction == Reaction() else STEP,
            looks=_filled(np.nan_to_num([np.cos(bearings), np.sin(bearings)])),
            walls=_directed(self.place.surfaces),
            screens=_directed(self.place.screens),
            obstacles=np.column_stack([cylinders, kinds]),
            lights=np.array(self.place.lights, float).reshape(-1, 2),
            noise=NOISES.index(self.noise),
            sensor_noise=float(self.noise_level),
            twist_noise=self.noise_level * largest / math.sqrt(STEP),
        )

    @cached_property
    def _tensors(self) -> dict[str, Tensor]:
        arrays = self.arrays._asdict()
        arrays["looks"] = arrays["looks"][..., : self.sensors.mean.shape[-1]]
        return self._as_tensors(arrays)

    @cached_property
    def _lookups(self) -> dict[str, dict[str, Tensor]]:
        """The numbers of the senses that are read, for their sensors only."""
        lookups = {}
        for sense, table in self._tables.items():
            arrays = (self.arrays.near if sense == "proximity" else self.arrays.light)._asdict()
            for name in ("excess", "variance", "ambient", "ambient_variance"):
                arrays[name] = arrays[name][..., : table.mean.shape[-1]]
            lookups[sense] = self._as_tensors(arrays)
        return lookups

    def _as_tensors(self, arrays: Mapping[str, Any]) -> dict[str, Tensor]:
        return {
            name: torch.from_numpy(value).to(self.device, torch.float64)
            for name, value in arrays.items()
            if isinstance(value, np.ndarray)
        }

    def _numbers(self, like: Tensor, generator: torch.Generator | None) -> Tensor:
        """Draw random numbers for noise, in a given shape."""
        options: dict[str, Any] = {"dtype": like.dtype, "device": like.device}
        if self.noise == "uniform":
            return 2.0 * torch.rand(like.shape, generator=generator, **options) - 1.0
        return torch.randn(like.shape, generator=generator, **options)

    def _objects(self, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return vectors to nearest points [B, K, 2], distances [B, K] from rim and kinds [K].

        For an obstacle the vector is to its centre.
        """
        walls, obstacles = self._tensors["walls"], self._tensors["obstacles"]
        centre = state[:, None, :2]
        off = centre - walls[:, :2]
        fraction = torch.minimum((off * walls[:, 2:4]).sum(-1).clamp(min=0.0), walls[:, 4])
        to_walls = walls[:, :2] + fraction.unsqueeze(-1) * walls[:, 2:4] - centre
        to = torch.cat([to_walls, obstacles[:, :2] - centre], dim=1)
        size = torch.cat([torch.zeros_like(walls[:, 0]), obstacles[:, 2]])
        kind = torch.cat([torch.zeros_like(walls[:, 0]), obstacles[:, 3]]).long()
        return to, to.norm(dim=-1) - self.radius - size, kind

    def _place(
        self, sense: str, distance: Tensor, bearing: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return bilinear weights [2, 2, ...], rows [2, ...] and columns [2, ...] in a table."""
        a = self.arrays.near if sense == "proximity" else self.arrays.light
        distances, angles = a.excess.shape[1], a.excess.shape[2] - 1
        row = (distance - a.first) / a.pitch
        fade = (1.0 - (row - (distances - 1)) * a.pitch / a.fade).clamp(0.0, 1.0)
        row = row.clamp(0.0, distances - 1.0)
        turn = -bearing / (2.0 * torch.pi)
        column = (turn - turn.floor()) * angles
        r = row.long().clamp(max=distances - 2)
        c = column.long().clamp(max=angles - 1)
        u, v = row - r, column - c
        weights = torch.stack(
            [torch.stack([(1 - u) * (1 - v), (1 - u) * v]), torch.stack([u * (1 - v), u * v])]
        )
        return weights * fade, torch.stack([r, r + 1]), torch.stack([c, c + 1])

    def _seen(self, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return distance and bearing of the objects for each sensor, [B, 1 + N, S], and kinds.

        The first object is all walls, the others are obstacles; unseen ones are infinitely far. See
        the kernels ``_sense`` and ``_add_walls``.
        """
        t, reaches = self._tensors, self._lookups["proximity"]["reach"]
        sensors, walls = t["looks"].T, t["walls"].unsqueeze(1)
        to, distance, kind = self._objects(state)
        bearing = torch.atan2(to[..., 1], to[..., 0]) - state[:, 2:3]
        distance = torch.where(self._hidden(state, to), torch.inf, distance)
        distance = torch.where(distance < reaches[kind], distance, torch.inf)
        others = (
            each[:, len(walls) :, None].expand(-1, -1, len(sensors)) for each in (distance, bearing)
        )
        to, bearing, distance = (each[:, : len(walls)] for each in (to, bearing, distance))
        # The visible walls, and whether there is a single one without an end within reach.
        middle = state[:, None, :2] - t["walls"][:, :2]
        along = (middle * t["walls"][:, 2:4]).sum(-1)
        before = middle[..., 1] * t["walls"][:, 2] - middle[..., 0] * t["walls"][:, 3]
        reach = float(reaches[0])
        visible = torch.isfinite(distance) & (before > 0.0)
        ends = (along <= reach + self.radius) | (along >= t["walls"][:, 4] - reach - self.radius)
        alone = (visible.sum(1) == 1) & ~(visible & ends).any(1)
        # The light that each reflects to each sensor, [B, W, S].
        cos, sin = state[:, 2].cos(), state[:, 2].sin()
        turn = torch.stack([torch.stack([cos, sin], -1), torch.stack([-sin, cos], -1)], -1)
        looks = (turn @ sensors.T).mT.unsqueeze(1)
        off = walls[..., :2] - (state[:, None, None, :2] + self.radius * looks)
        height = off[..., 0] * walls[..., 3] - off[..., 1] * walls[..., 2]
        begin = (off * walls[..., 2:4]).sum(-1)
        ahead = looks[..., 0] * walls[..., 3] - looks[..., 1] * walls[..., 2]
        aside = (looks * walls[..., 2:4]).sum(-1)
        light = _light(begin, begin + walls[..., 4], height.clamp(min=NEAREST), ahead, aside)
        light = torch.where((height < -NEAREST) | ~visible.unsqueeze(-1), 0.0, light)
        # An endless wall, perpendicular at the brightest point.
        to = to.unsqueeze(2)
        away = to.norm(dim=-1)
        ahead = (looks * to).sum(-1) / away
        aside = (looks[..., 1] * to[..., 0] - looks[..., 0] * to[..., 1]) / away
        height = (away - self.radius * ahead).clamp(min=NEAREST)
        endless = _light(-1e3 * height, 1e3 * height, height, ahead, aside)
        most = light.argmax(dim=1, keepdim=True)
        height, endless = height.gather(1, most), endless.gather(1, most)
        total = light.sum(1, keepdim=True)
        further = torch.where(total > FAINT * endless, (endless / total).sqrt() - 1.0, torch.inf)
        best = torch.where(alone[:, None, None], visible.int().argmax(1)[:, None, None], most)
        best = best.expand(-1, -1, len(sensors))
        near, at = (
            each.unsqueeze(-1).expand(light.shape).gather(1, best) for each in (distance, bearing)
        )
        near = torch.where(alone[:, None, None], near, near + height * further)
        near = torch.where(visible.any(1)[:, None, None], near, torch.inf)
        first, second = others
        kind = torch.cat([kind[:1], kind[len(walls) :]])
        return torch.cat([near, first], 1), torch.cat([at, second], 1), kind

    def _seen_lights(self, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return distance and bearing of the lights, [B, M, 1], and their kind [M].

        A hidden light is infinitely far. See the kernel ``_sense_light``.
        """
        lights, obstacles = self._tensors["lights"], self._tensors["obstacles"]
        to = lights - state[:, None, :2]
        off = (obstacles[:, :2] - state[:, None, :2]).unsqueeze(1)
        square = to.square().sum(-1, keepdim=True).clamp(min=NEAREST**2)
        part = ((off * to.unsqueeze(2)).sum(-1) / square).clamp(0.0, 1.0)
        gap = (off - part.unsqueeze(-1) * to.unsqueeze(2)).norm(dim=-1)
        hidden = self._hidden(state, to) | (gap < obstacles[:, 2]).any(-1)
        distance = to.norm(dim=-1) - self.radius
        hidden |= distance >= self._lookups["light"]["reach"]
        bearing = torch.atan2(to[..., 1], to[..., 0]) - state[:, 2:3]
        distance = torch.where(hidden, torch.inf, distance)
        kind = torch.zeros(len(lights), dtype=torch.long, device=to.device)
        return distance.unsqueeze(-1), bearing.unsqueeze(-1), kind

    def _hidden(self, state: Tensor, to: Tensor) -> Tensor:
        """Return whether the nearest point of each object is hidden, [B, K]."""
        hidden = torch.zeros(to.shape[:2], dtype=torch.bool, device=to.device)
        for x, y, ux, uy, length in self._tensors["screens"]:
            off = state[:, None, :2] - torch.stack([x, y])
            here = off[..., 0] * uy - off[..., 1] * ux
            change = to[..., 0] * uy - to[..., 1] * ux
            there = here + change
            part = torch.where(change == 0.0, 0.0, -here / change)
            met = off + part.unsqueeze(-1) * to
            along = met[..., 0] * ux + met[..., 1] * uy
            hidden |= (here * there < 0) & (there.abs() >= 1e-9) & (along >= 0) & (along <= length)
        return hidden

    def _collided(self, before: Tensor, after: Tensor) -> Tensor:
        """Return the poses [B, 3] after a motion from one pose to another, with collisions."""
        xy, fits = after[:, :2], torch.zeros(len(after), 1, dtype=torch.bool, device=after.device)
        for _ in range(PASSES):
            if fits.all():
                break
            moved, free = xy, torch.ones_like(fits)
            for place in range(len(self.arrays.walls) + len(self.arrays.obstacles)):
                to, distance, _ = self._objects(moved)
                to, deep = to[:, place], -distance[:, place : place + 1]
                norm = to.norm(dim=-1, keepdim=True)
                moved = moved - torch.where((deep > 0) & (norm > 0), deep / norm, 0.0) * to
                free &= deep < SLACK
            xy, fits = torch.where(fits, xy, moved), fits | free
        return torch.cat([torch.where(fits, xy, before[:, :2]), after[:, 2:]], dim=1)

    def _advanced(self, speeds: Tensor, goal: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
        """Return the log of the displacement [B, 3] in a time [B, 1] (s), and speeds [B, 2]."""
        lag = self._tensors["lag"]
        end = torch.where(time > 0.0, torch.exp(-time / lag), 1.0)
        mean = torch.where(time > 0.0, lag * (1.0 - end) / time, 1.0)
        motion = self._motion(self._tensors["twist"], goal + mean * (speeds - goal)) * time
        return motion, goal + end * (speeds - goal)

    def _motion(self, table: Tensor, speeds: Tensor) -> Tensor:
        """Return a motor table's values [B, 3] at the wheels' speeds [B, 2] (%), interpolated."""
        a = self.arrays
        place = ((speeds - a.lowest) / a.level_pitch).clamp(0.0, len(table) - 1.0)
        below = place.long().clamp(max=len(table) - 2)
        (i, j), (u, v) = below.unbind(1), (place - below).unsqueeze(-1).unbind(1)
        return (1 - u) * ((1 - v) * table[i, j] + v * table[i, j + 1]) + u * (
            (1 - v) * table[i + 1, j] + v * table[i + 1, j + 1]
        )

    def write(self, folder: str | Path) -> None:
        """Write simulator.json and tables.safetensors into an existing folder."""
        folder = Path(folder)
        tensors = {
            "motor_levels": self.motors.levels,
            "motor_twist": self.motors.twist,
            "motor_spread": self.motors.spread,
        }
        described = {}
        for name, table in (("sensor", self.sensors), ("light", self.lights)):
            if table is not None:
                tensors |= {f"{name}_mean": table.mean, f"{name}_spread": table.spread}
                described[f"{name}s"] = {
                    "objects": list(table.kinds),
                    "first_distance": table.first_distance,
                    "distance_step": table.distance_step,
                    "repeated": table.spread is not None,
                }
        content = {
            "kind": self.kind,
            **described,
            "motors": {
                "resolution": self.motors.resolution,
                "repeated": self.motors.spread is not None,
            },
            "radius": self.radius,
            "reaction": self.reaction.to_json(),
            "noise": {"kind": self.noise, "level": self.noise_level},
            "place": self.place.to_json(),
            **self.meta,
        }
        given = {name: value for name, value in tensors.items() if value is not None}
        files.write_tensors(folder / "tables.safetensors", given)
        files.write_json(folder / "simulator.json", FORMAT, VERSION, content)

    @classmethod
    def read(cls, folder: str | Path, device: str | torch.device = "cpu") -> TableSimulator:
        """Read and check a table simulator.

        Raises:
            FileError: naming file and field, if something is missing, cut short, of another
                version, of the wrong shape, or not a number.
        """
        path, tables = Path(folder) / "simulator.json", Path(folder) / "tables.safetensors"
        content = files.read_json(path, FORMAT, VERSION, formats.Tables, oldest=_OLDEST)
        motors, noise = content["motors"], content["noise"]
        shapes: dict[str, tuple[int | None, ...]] = {
            "motor_levels": (None,),
            "motor_twist": (None, None, 3),
        }
        if motors.get("repeated"):
            shapes["motor_spread"] = shapes["motor_twist"]
        for name in ("sensor", "light"):
            about = content.get(f"{name}s")
            if about is not None:
                shapes[f"{name}_mean"] = (len(about["objects"]), None, None, None)
                if about.get("repeated"):
                    shapes[f"{name}_spread"] = shapes[f"{name}_mean"]
        # Numbers of another type would compile the loops again.
        arrays = {
            name: np.asarray(tensor, np.float64)
            for name, tensor in files.read_tensors(tables, shapes).items()
        }

        def table(name: str) -> SensorTable | None:
            about = content.get(f"{name}s")
            if about is None:
                return None
            kinds = tuple(about["objects"])
            if (kinds == (LIGHT,)) != (name == "light") or not all(map(is_kind, kinds)):
                raise FileError(path, "are not kinds of objects", field=f"{name}s.objects")
            return SensorTable(
                arrays[f"{name}_mean"],
                arrays.get(f"{name}_spread"),
                about["first_distance"],
                about["distance_step"],
                kinds,
            )

        described = {"format", "version", *formats.Tables.__annotations__}
        try:
            sensors = table("sensor")
            assert sensors is not None
            return cls(
                sensors,
                MotorTable(
                    arrays["motor_levels"],
                    arrays["motor_twist"],
                    arrays.get("motor_spread"),
                    motors["resolution"],
                ),
                Place.from_json(path, content["place"]),
                content["radius"],
                noise["kind"],
                noise["level"],
                Reaction.from_json(content.get("reaction", {})),
                {key: value for key, value in content.items() if key not in described},
                device,
                table("light"),
            )
        except FileError:
            raise
        except (UserError, ValueError) as error:
            raise FileError(path, f"is not a table simulator ({error})") from None


@lru_cache(maxsize=8)  # a simulator in another place has the same tables
def _lookup(table: SensorTable, read: bool) -> Lookup:
    """Return a table's numbers, also of one that is not read."""
    ambient, variance = table.ambient, table.ambient_spread**2
    spread = np.zeros_like(table.mean) if table.spread is None else table.spread
    _, distances, _, sensors = table.mean.shape
    last = table.first_distance + (distances - 1) * table.distance_step
    fade = last / 2.0
    reach = []
    for kind in table.mean:
        # Range of the sensors, from the rim.
        seen = (np.abs(kind - ambient) >= FAINTEST).any(axis=(1, 2))
        rows = len(seen) - int(np.argmax(seen[::-1])) if seen.any() else 0
        whole = rows == len(seen)
        reach.append(last + fade if whole else table.first_distance + rows * table.distance_step)
    return Lookup(
        excess=_closed(table.mean - ambient),
        variance=_closed(np.maximum(spread**2 - variance, 0.0)),
        ambient=_filled(ambient),
        ambient_variance=_filled(variance),
        first=float(table.first_distance),
        pitch=float(table.distance_step),
        fade=fade,
        reach=np.array(reach),
        sensors=sensors if read else 0,
    )


def _joined(first: Tensor, second: Tensor) -> Tensor:
    """Return the twist [B, 3] of one motion and then another.

    It is the Baker-Campbell-Hausdorff series to second order; the error is below 0.1 mm in a step
    of 100 ms.
    """
    (x1, y1, w1), (x2, y2, w2) = first.unbind(-1), second.unbind(-1)
    bracket = torch.stack([w2 * y1 - w1 * y2, w1 * x2 - w2 * x1, torch.zeros_like(w1)], dim=-1)
    return first + second + 0.5 * bracket


def _closed(table: np.ndarray) -> np.ndarray:
    """Return a table [2, D, A, S] with the first angle again after the last, float32, filled."""
    return _filled(np.concatenate([table, table[:, :, :1]], axis=2))


def _light(begin: Tensor, end: Tensor, height: Tensor, ahead: Tensor, aside: Tensor) -> Tensor:
    """Return the light that straight surfaces reflect to sensors, 1/m2; the kernel of this name."""
    behind = -height * ahead / aside
    begin = torch.where(aside > 0.0, torch.maximum(begin, behind), begin)
    end = torch.where(aside < 0.0, torch.minimum(end, behind), end)
    ends = torch.stack([begin, end])
    s, c = ends / torch.hypot(ends, height), height / torch.hypot(ends, height)
    straight, mixed, across = (
        each[1] - each[0]
        for each in (s - 2 * s**3 / 3 + s**5 / 5, -(c**5) / 5, s**3 / 3 - s**5 / 5)
    )
    light = ahead**2 * straight + 2 * ahead * aside * mixed + aside**2 * across
    seen = (begin < end) & ((aside != 0.0) | (ahead > 0.0))
    return torch.where(seen, light.clamp(min=0.0) / height**2, 0.0)


def _directed(walls: np.ndarray) -> np.ndarray:
    """Return walls [W, 4] as [W, 5]: x, y of one end, direction x, y, length."""
    along = walls[:, 2:] - walls[:, :2]
    length = np.linalg.norm(along, axis=1, keepdims=True)
    return np.concatenate([walls[:, :2], along / length, length], axis=1)


def _filled(table: np.ndarray) -> np.ndarray:
    """Return numbers [..., S] as float32, filled with zeros up to :data:`LANES`."""
    missing = max(LANES - table.shape[-1], 0)
    wide = np.pad(table, [(0, 0)] * (table.ndim - 1) + [(0, missing)])
    return np.ascontiguousarray(wide, np.float32)
