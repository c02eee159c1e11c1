"""Recordings as a dataset of LeRobot, format v3.0: Parquet, MP4 and JSON.

There is one episode for each session, from its first command until the motors stopped, at a
constant frame rate. Each episode has its own data and video files.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import FileError, UserError
from neurosim.base.files import check_new_folder, new_folder, sha256
from tracking.camera.video import Video
from tracking.datasets.recordings import Recording

#: Version of the format, and its files.
VERSION = "v3.0"
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
CAMERA = "observation.images.camera"
#: Files in a folder of the format, at most; pictures of a video of which statistics are made.
CHUNK, LOOKS = 1000, 50
#: H.264 for training: every second frame can be decoded by itself, and no frame needs a later one.
_ENCODED = {"crf": "23", "g": "2", "bf": "0"}
#: Time for which the robot still moves after a stop, s.
AFTER = 0.5


@dataclass(frozen=True)
class _Episode:
    """One session: N frames.

    Attributes:
        columns: feature -> [N, D] float32.
        frames: [N] the number of each frame in the video, or None.
        video: the file, or None.
        task: in words.
    """

    columns: dict[str, NDArray[np.float32]]
    frames: NDArray[np.int64] | None
    video: Path | None
    task: str


def export_lerobot(
    folders: Sequence[str | Path], out: str | Path, fps: int | None = None
) -> dict[str, Any]:
    """Write recordings as a dataset in the layout of LeRobot, v3.0.

    ``action`` are the numbers of the command, ``observation.state`` is the tracked pose (x and y
    in m, theta in rad, not wrapped; interpolated where the robot was not seen),
    ``observation.quality`` is 0 where it was not seen, and ``observation.sensors`` are the readings
    that were kept. The camera's pictures are ``observation.images.camera``.

    Args:
        folders: recordings of the same robot and camera, tracked.
        out: the new folder.
        fps: frames a second; by default the camera's.

    Returns:
        ``episodes``, ``frames``, ``fps`` and the names of the ``features``.

    Raises:
        UserError: if pyarrow or av is missing, a recording is not tracked, recordings differ in
            their commands, sensors or pictures, or ``out`` exists.
    """
    try:
        import av  # noqa: F401  (for the videos, below)
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise UserError(
            "exporting to LeRobot needs the packages pyarrow and av: pip install "
            "'neurosim[lerobot]'"
        ) from None
    check_new_folder(out)
    recordings = [Recording(folder) for folder in folders]
    fps = fps or _fps(recordings[0])
    names = {"action": list(recordings[0].takes.names), "observation.state": ["x", "y", "theta"]}
    looks = recordings[0].observations()
    if looks is not None and looks.names:
        names["observation.sensors"] = list(looks.names)
    names["observation.quality"] = ["quality"]
    episodes = [
        _episode(recording, session, fps, names)
        for recording in recordings
        for session in range(1, recording.sessions + 1)
    ]
    episodes = [one for one in episodes if one is not None]
    if not episodes:
        raise UserError(f"{recordings[0].path}: no command was sent, so there is no episode")
    filmed = episodes[0].video is not None
    if any((one.video is not None) != filmed for one in episodes):
        raise UserError("some of the recordings have a video and some have none: export them apart")
    tasks = list(dict.fromkeys(one.task for one in episodes))
    with new_folder(out) as folder:
        rows, begin, size = [], 0, None
        for number, episode in enumerate(episodes):
            count = len(episode.columns["action"])
            chunk = {"chunk_index": number // CHUNK, "file_index": number % CHUNK}
            index = np.arange(count)
            columns = dict(episode.columns)
            stats = {name: _stats(values) for name, values in columns.items()}
            table = {name: _array(pa, values) for name, values in columns.items()}
            counters = {
                "timestamp": (index / fps).astype(np.float32),
                "frame_index": index,
                "episode_index": np.full(count, number),
                "index": begin + index,
                "task_index": np.full(count, tasks.index(episode.task)),
            }
            table |= {name: pa.array(values) for name, values in counters.items()}
            stats |= {name: _stats(values[:, None]) for name, values in counters.items()}
            _write(pq, pa.table(table), folder / DATA.format(**chunk))
            row: dict[str, Any] = {
                "episode_index": number,
                "tasks": [episode.task],
                "length": count,
                "dataset_from_index": begin,
                "dataset_to_index": begin + count,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
                **{f"data/{name}": value for name, value in chunk.items()},
            }
            if episode.video is not None and episode.frames is not None:
                path = folder / VIDEO.format(video_key=CAMERA, **chunk)
                film_size, stats[CAMERA] = _film(episode.video, episode.frames, path, fps)
                if size not in (None, film_size):
                    raise UserError("the videos are of different sizes: export them apart")
                size = film_size
                row |= {f"videos/{CAMERA}/{name}": value for name, value in chunk.items()}
                row |= {f"videos/{CAMERA}/from_timestamp": 0.0}
                row |= {f"videos/{CAMERA}/to_timestamp": count / fps}
            row |= {
                f"stats/{name}/{stat}": value
                for name, each in stats.items()
                for stat, value in each.items()
            }
            rows.append(row)
            begin += count
        _write(pq, pa.Table.from_pylist(rows), folder / EPISODES)
        features = _features(names, size, fps)
        task_rows = {"task_index": list(range(len(tasks))), "task": tasks}
        import pandas as pd

        frame = pd.DataFrame(task_rows).set_index("task")
        _write(pq, pa.Table.from_pandas(frame), folder / "meta" / "tasks.parquet")
        _json(folder / "meta" / "stats.json", _together(rows, features))
        _json(
            folder / "meta" / "info.json",
            {
                "codebase_version": VERSION,
                "robot_type": recordings[0].meta["robot"].get("kind"),
                "total_episodes": len(rows),
                "total_frames": begin,
                "total_tasks": len(tasks),
                "chunks_size": CHUNK,
                "data_files_size_in_mb": 100,
                "video_files_size_in_mb": 200,
                "fps": fps,
                "splits": {"train": f"0:{len(rows)}"},
                "data_path": DATA,
                "video_path": VIDEO if filmed else None,
                "features": features,
                "neurosim": {
                    "units": {one.name: one.unit for one in recordings[0].takes.numbers},
                    "sources": [
                        {"path": str(one.path), "sha256": sha256(one.path / "commands.csv")}
                        for one in recordings
                    ],
                },
            },
        )
    return {"episodes": len(rows), "frames": begin, "fps": fps, "features": list(features)}


def _fps(recording: Recording) -> int:
    """Return the frame rate of a recording, a whole number for the format."""
    given = recording.meta.get("camera", {}).get("fps")
    if isinstance(given, int | float) and given >= 1:
        return round(given)
    times = recording.poses().time
    steps = np.diff(times)
    return max(round(1 / float(np.median(steps[steps > 0]))), 1) if len(times) > 2 else 10


def _episode(
    recording: Recording, session: int, fps: int, names: Mapping[str, list[str]]
) -> _Episode | None:
    """Return a session; None if it has no command."""
    if list(recording.takes.names) != names["action"]:
        raise UserError(f"{recording.path} has other commands than the first recording")
    table = recording.commands()
    table = table[(table["session"] == session) & table["is_motor"]]
    poses = recording.poses().of_session(session).certain()
    seen = np.isfinite(poses.pose).all(axis=1)
    if table.empty or not seen.any():
        return None
    begun = max(float(table["time"].iloc[0]), float(poses.time[0]))
    ended = min(float(table["time"].iloc[-1]) + AFTER, float(poses.time[-1]))
    count = math.floor((ended - begun) * fps + 1e-9) + 1
    if count < 1:
        return None
    times = begun + np.arange(count) / fps
    numbers = np.array(table["numbers"].tolist(), np.float32).reshape(-1, len(names["action"]))
    sent = np.clip(np.searchsorted(table["time"], times, side="right") - 1, 0, None)
    where = np.clip(np.searchsorted(poses.time, times, side="right") - 1, 0, None)
    state = [np.interp(times, poses.time[seen], column) for column in poses.pose[seen].T]
    columns = {
        "action": numbers[sent],
        "observation.state": np.column_stack(state).astype(np.float32),
        "observation.quality": poses.quality[where, None].astype(np.float32),
    }
    if "observation.sensors" in names:
        columns["observation.sensors"] = _sensors(recording, session, times, names)
    video = recording.video(session)
    frames = None if video is None else poses.frame[where].astype(np.int64)
    columns = {name: columns[name] for name in names}
    return _Episode(columns, frames, video, _task(recording))


def _sensors(
    recording: Recording, session: int, times: NDArray, names: Mapping[str, list[str]]
) -> NDArray[np.float32]:
    looks = recording.observations()
    if looks is None or list(looks.names) != names["observation.sensors"]:
        raise UserError(f"{recording.path} has other sensors than the first recording")
    looks = looks.of_session(session)
    if not len(looks.time):
        raise UserError(f"{recording.path}: no reading was kept in session {session}")
    place = np.clip(np.searchsorted(looks.time, times, side="right") - 1, 0, None)
    return looks.readings[place].astype(np.float32)


def _task(recording: Recording) -> str:
    """Describe the robot's task in words."""
    path = recording.path / "trial.json"
    if path.exists():
        content = json.loads(path.read_text(encoding="utf-8"))
        return str(content["task"]["name"]).replace("-", " ")
    kind = recording.meta.get("settings", {}).get("source", {}).get("kind") or "given"
    return f"{kind} commands"


def _stats(values: NDArray) -> dict[str, list]:
    """Return the format's statistics of a feature [N, D]."""
    values = values.astype(np.float64)
    kept = {name: getattr(values, name)(axis=0).tolist() for name in ("min", "max", "mean", "std")}
    return {**kept, "count": [len(values)]}


def _together(rows: list[dict[str, Any]], features: Mapping[str, Any]) -> dict[str, Any]:
    """Return the statistics over all episodes."""
    combined = {}
    for name in features:
        each = {
            stat: np.array([row[f"stats/{name}/{stat}"] for row in rows], float)
            for stat in ("min", "max", "mean", "std", "count")
        }
        weights = each["count"] / each["count"].sum()
        weights = weights.reshape(-1, *[1] * (each["mean"].ndim - 1))
        mean = (weights * each["mean"]).sum(axis=0)
        variance = (weights * (each["std"] ** 2 + (each["mean"] - mean) ** 2)).sum(axis=0)
        combined[name] = {
            "min": each["min"].min(axis=0).tolist(),
            "max": each["max"].max(axis=0).tolist(),
            "mean": mean.tolist(),
            "std": np.sqrt(variance).tolist(),
            "count": [int(each["count"].sum())],
        }
    return combined


def _film(
    video: Path, frames: NDArray[np.int64], out: Path, fps: int
) -> tuple[tuple[int, int], dict[str, list]]:
    """Write the frames of these numbers; return their size, and statistics of the colours."""
    import av

    out.parent.mkdir(parents=True, exist_ok=True)
    looks = set(np.linspace(0, len(frames) - 1, LOOKS).astype(int).tolist())
    colours: list[NDArray] = []
    written = 0
    with Video(video) as film, av.open(str(out), "w") as container:
        width, height = size = film.size[0] // 2 * 2, film.size[1] // 2 * 2  # even sizes for H.264
        stream = container.add_stream("libx264", rate=fps, options=_ENCODED)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for number, _, picture in film:
            picture = np.ascontiguousarray(picture[:height, :width, ::-1])
            while written < len(frames) and frames[written] <= number:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
                if written in looks:
                    colours.append(picture[::8, ::8].reshape(-1, 3) / 255)
                written += 1
            if written == len(frames):
                break
        container.mux(stream.encode())
    if written < len(frames):
        raise FileError(video, f"ends before frame {frames[written]}, which poses.csv has")
    stats = _stats(np.concatenate(colours))
    shaped = {name: [[[value]] for value in values] for name, values in stats.items()}
    return size, {**shaped, "count": [len(colours)]}


def _features(
    names: Mapping[str, list[str]], size: tuple[int, int] | None, fps: int
) -> dict[str, Any]:
    features: dict[str, Any] = {
        name: {"dtype": "float32", "shape": [len(parts)], "names": parts, "fps": fps}
        for name, parts in names.items()
    }
    if size is not None:
        width, height = size
        features[CAMERA] = {
            "dtype": "video",
            "shape": [height, width, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": height,
                "video.width": width,
                "video.codec": "h264",
                "video.pix_fmt": "yuv420p",
                "video.is_depth_map": False,
                "video.fps": fps,
                "video.channels": 3,
                "has_audio": False,
            },
        }
    for name in ("timestamp", "frame_index", "episode_index", "index", "task_index"):
        kind = "float32" if name == "timestamp" else "int64"
        features[name] = {"dtype": kind, "shape": [1], "names": None, "fps": fps}
    return features


def _array(pa: Any, values: NDArray[np.float32]) -> Any:
    """Return a column: numbers for one value, else lists."""
    if values.shape[1] == 1:
        return pa.array(values[:, 0])
    return pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1])


def _write(pq: Any, table: Any, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path)


def _json(path: Path, content: Mapping[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=4, allow_nan=False) + "\n", encoding="utf-8")
