"""Trials of walking robots in MuJoCo, many at once, second by second, with early ends.

``mujoco.rollout`` distributes the trials to the cores. A trial that has ended, by a fall or at the
goal, costs nothing from the next second on.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base.compiled import njit
from neurosim.robots.quadruped import FOOT
from neurosim.simulators.legged.build import SERVO, Build, LeggedBuild, mujoco

#: Number of frames that are computed at once.
_CHUNK = 125


class Physics:
    """Runs walking robots of one build; keeps threads and memory for it."""

    def __init__(self, model: Any, threads: int | None = None, make: type[LeggedBuild] = Build):
        """Prepare.

        Args:
            model: an ``MjModel``; other models must have the same joints and bodies.
            threads: by default one for each core.
            make: the class of the robot's build.
        """
        from mujoco import rollout

        self._mujoco = mujoco()
        # A numerical blow-up counts as a fall, without a MUJOCO_LOG.TXT in the working folder.
        self._mujoco.set_mju_user_warning(lambda message: None)
        self._model, self._make = model, make
        self._threads = threads or len(os.sched_getaffinity(0))
        self._data = [self._mujoco.MjData(model) for _ in range(self._threads)]
        self._pool = rollout.Rollout(nthread=self._threads if self._threads > 1 else 0)
        self._joints = [model.joint(name).qposadr[0] for name in make.joints]
        self._full = self._mujoco.mjtState.mjSTATE_FULLPHYSICS
        self._physical = self._mujoco.mj_stateSize(model, self._full)
        #: Numbers of a state: MuJoCo's, and the goals of servos with a lag or a limit of speed.
        self.size = self._physical + (len(self._joints) if _servo(model) else 0)
        self._standing = self._stand(model)

    def _stand(self, model: Any) -> NDArray[np.float64]:
        """Return the state of a robot that stands at the origin, on the floor."""
        data, make = self._data[0], self._make
        self._mujoco.mj_resetData(model, data)
        data.qpos[self._joints] = make.standing()
        if make.settles:
            data.qpos[2], data.ctrl[:] = make.drop, make.standing()
            data.act[:] = make.standing()  # positions of servos with limited speed
            for _ in range(round(make.settles / model.opt.timestep)):
                self._mujoco.mj_step(model, data)
            data.time, data.qvel[:] = 0.0, 0.0
        else:
            self._put_down(model, data)
        state = np.empty(self._physical)
        self._mujoco.mj_getState(model, data, state, self._full)
        return np.concatenate([state, make.standing()[: self.size - self._physical]])

    def _put_down(self, model: Any, data: Any) -> None:
        """Move a robot up or down until its feet touch the floor."""
        data.qpos[2] = 1.0
        self._mujoco.mj_forward(model, data)
        lowest = np.inf
        for geom in range(model.ngeom):
            if (model.geom(geom).name or "").endswith("_lower"):
                half = data.geom_xmat[geom].reshape(3, 3)[2, 2] * model.geom_size[geom, 1]
                lowest = min(lowest, data.geom_xpos[geom, 2] - abs(half) - FOOT)
        data.qpos[2] = 1.0 - lowest

    def standing(self, poses: NDArray[np.float64], model: Any = None) -> NDArray[np.float64]:
        """Return the states [B, size] of robots that stand at poses [B, 3] (m, m, rad).

        Args:
            poses: poses of the robots.
            model: of all; by default the one of the constructor.
        """
        same = model is None or model is self._model or not self._make.settles
        states = np.tile(self._standing if same else self._stand(model), (len(poses), 1))
        states[:, 1:3] = poses[:, :2]
        states[:, 4], states[:, 5:7] = np.cos(0.5 * poses[:, 2]), 0.0
        states[:, 7] = np.sin(0.5 * poses[:, 2])
        return states

    def frames(
        self, models: Any, states: NDArray[np.float64], commands: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the states [B, T, size] after each of T frames; NaN after a numerical blow-up.

        Args:
            models: one for all or one for each.
            states: [B, size].
            commands: [B, T, joints] angles, rad.
        """
        several = list(models) if isinstance(models, Sequence) else [models]
        frame = self._make.frame
        steps = round(frame / several[0].opt.timestep)
        whole = np.asarray(np.isfinite(states).all(axis=1))
        begun = np.where(whole[:, None], states, self._standing)
        begun, before = np.split(begun, [self._physical], axis=1)
        commands = np.ascontiguousarray(commands, np.float64)
        if servos := [_servo(model) for model in several if _servo(model)]:
            lag, speed = np.broadcast_to(np.array(servos).T, (2, len(states)))
            fraction = -np.expm1(-frame / np.maximum(lag, 1e-9))
            most = np.where(speed > 0.0, speed, np.inf) * frame
            commands = followed(commands, before, fraction, most)
        control = np.repeat(commands, steps, axis=1)
        given = several if isinstance(models, Sequence) else models
        frames, _ = self._pool.rollout(given, self._data, np.ascontiguousarray(begun), control)
        frames = frames[:, steps - 1 :: steps]
        # After a numerical blow-up MuJoCo stops, and so does its clock.
        due = begun[:, :1] + frame * np.arange(1, frames.shape[1] + 1)
        frames[(np.abs(frames[..., 0] - due) > 1e-6) | ~whole[:, None]] = np.nan
        return np.concatenate([frames, commands], axis=2) if servos else frames

    def walk(
        self,
        models: Any,
        starts: NDArray[np.float64],
        commands: NDArray[np.float64],
        reach: float | None = None,
    ) -> NDArray[np.float64]:
        """Return the poses [B, T + 1, 3] of robots; NaN from a fall on.

        Args:
            models: one for all or one for each.
            starts: [B, 3] first poses (m, m, rad).
            commands: [B, T, joints] angles, rad.
            reach: a trial ends when the robot is this far from its start, m; from then on it
                stands.
        """
        rows, frames = commands.shape[:2]
        poses = np.full((rows, frames + 1, 3), np.nan)
        poses[:, 0] = starts
        single = None if isinstance(models, Sequence) else models
        states, going = self.standing(starts, single), np.arange(rows)
        for first in range(0, frames, _CHUNK):
            part = slice(first, min(first + _CHUNK, frames))
            chosen = [models[int(row)] for row in going] if isinstance(models, Sequence) else models
            walked = self.frames(chosen, states[going], commands[going, part])
            seen = poses_of(walked, poses[going, first], self._make)
            states[going] = walked[:, -1]
            poses[going, first + 1 : part.stop + 1] = seen
            over = np.isnan(seen[:, -1, 0])
            if reach is not None:
                over |= arrived(seen, starts[going], reach).any(axis=1)
            going = going[~over]
            if not len(going):
                break
        if reach is None:
            return poses
        there = arrived(poses, starts, reach)
        last = np.where(there.any(axis=1), there.argmax(axis=1), frames)
        kept = np.minimum(np.arange(frames + 1), last[:, None])
        return np.take_along_axis(poses, kept[..., None], axis=1)

    def __getstate__(self) -> None:
        raise TypeError("threads cannot be copied")


def arrived(
    poses: NDArray[np.float64], starts: NDArray[np.float64], reach: float
) -> NDArray[np.bool_]:
    """Return whether poses [B, T, 3] are at least ``reach`` (m) from starts [B, 3], [B, T]."""
    away = np.linalg.norm(poses[..., :2] - starts[:, None, :2], axis=-1)
    return np.asarray(np.nan_to_num(away, nan=0.0) >= reach)


def _servo(model: Any) -> tuple[float, float] | None:
    """Return a model's lag (s) and speed (rad/s, 0: no limit) of servos; None: they are ideal."""
    if not any(model.numeric(n).name == SERVO for n in range(model.nnumeric)):
        return None
    lag, speed = model.numeric(SERVO).data
    return float(lag), float(speed)


@njit
def followed(
    commands: NDArray[np.float64],
    before: NDArray[np.float64],
    fraction: NDArray[np.float64],
    most: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the goals of servos with a lag and a limit of speed, [B, T, joints] rad.

    Args:
        commands: [B, T, joints] rad, one a frame.
        before: [B, joints] goals before, rad.
        fraction: of the remaining angle, in a frame, [B].
        most: largest change in a frame, [B] rad.
    """
    goals = np.empty_like(commands)
    for row in range(commands.shape[0]):
        for joint in range(commands.shape[2]):
            now = before[row, joint]
            for frame in range(commands.shape[1]):
                change = fraction[row] * (commands[row, frame, joint] - now)
                now += min(max(change, -most[row]), most[row])
                goals[row, frame, joint] = now
    return goals


def poses_of(
    states: NDArray[np.float64], before: NDArray[np.float64], make: type[LeggedBuild] = Build
) -> NDArray[np.float64]:
    """Return the poses [B, T, 3] of states [B, T, size]; NaN from a fall on.

    Args:
        states: frame by frame.
        before: [B, 3] the poses before them; a NaN stays one.
        make: the class of the robot's build.
    """
    x, y, height, w, i, j, k = np.moveaxis(states[..., 1:8], -1, 0)
    heading = np.arctan2(2.0 * (w * k + i * j), 1.0 - 2.0 * (j * j + k * k))
    upright = 1.0 - 2.0 * (i * i + j * j)
    with np.errstate(invalid="ignore"):
        lost = ~np.isfinite(states).all(-1) | ~(upright > make.fallen)
        lost |= ~(height < make.highest)
    lost = np.logical_or.accumulate(lost | np.isnan(before[:, None, 0]), axis=1)
    turned = np.unwrap(np.concatenate([before[:, None, 2], heading], axis=1), axis=1)[:, 1:]
    return np.where(lost[..., None], np.nan, np.stack([x, y, turned], axis=-1))
