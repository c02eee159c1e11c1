"""Recordings in the layout of LeRobot v3.0, read back by pandas, OpenCV and another reader."""

import json
import shutil
import sys

import cv2
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner
from rerun.experimental import LeRobotReader

from neurosim.base.errors import UserError
from neurosim.base.files import write_csv
from neurosim.cli.main import cli
from neurosim.lab import VirtualRig
from tracking.camera.video import Video
from tracking.datasets.lerobot import export_lerobot
from tracking.datasets.recordings import Recording

COUNTERS = ["timestamp", "frame_index", "episode_index", "index", "task_index"]


def neurosim(*words):
    done = CliRunner().invoke(cli, [*map(str, words), "--json"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Two tracked recordings of the virtual lab, of three and four commands."""
    folder = tmp_path_factory.mktemp("recordings")
    with VirtualRig(0, camera_size=(320, 240)) as rig:
        optics = rig.camera.optics
        optics.calibration.write(folder / "c.json")
    for name, commands in (("a", 3), ("b", 4)):
        neurosim(
            "record", folder / name, "--commands", commands, "--camera-size", "320x240",
            "--calibration", folder / "c.json", "--seed", commands,
        )  # fmt: skip
    return [folder / "a", folder / "b"]


@pytest.fixture(scope="module")
def exported(recordings, tmp_path_factory):
    out = tmp_path_factory.mktemp("lerobot") / "out"
    return out, neurosim("export", *recordings, "--to", "lerobot", "-o", out)


@pytest.mark.slow
def test_the_layout_is_that_of_the_format(exported):
    out, warnings = exported
    result = sorted(str(path.relative_to(out)) for path in out.rglob("*") if path.is_file())
    camera = "videos/observation.images.camera/chunk-000"
    assert result == sorted([
        "data/chunk-000/file-000.parquet", "data/chunk-000/file-001.parquet",
        f"{camera}/file-000.mp4", f"{camera}/file-001.mp4", "meta/info.json", "meta/stats.json",
        "meta/tasks.parquet", "meta/episodes/chunk-000/file-000.parquet",
    ])  # fmt: skip
    info = json.loads((out / "meta" / "info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert (info["total_episodes"], info["total_tasks"], info["splits"]) == (2, 1, {"train": "0:2"})
    assert (info["fps"], info["total_frames"]) == (warnings["fps"], warnings["frames"])
    assert info["data_path"].format(chunk_index=0, file_index=1) == result[1]
    features = info["features"]
    assert list(features) == [
        "action", "observation.state", "observation.quality", "observation.images.camera",
        *COUNTERS,
    ]  # fmt: skip
    assert features["action"]["names"] == ["left", "right"]
    assert features["observation.images.camera"]["shape"] == [240, 320, 3]
    stats = json.loads((out / "meta" / "stats.json").read_text())
    assert stats.keys() == features.keys()
    for name, feature in features.items():
        shape = (3, 1, 1) if feature["dtype"] == "video" else tuple(feature["shape"])
        for stat in ("min", "max", "mean", "std"):
            assert np.shape(stats[name][stat]) == shape, (name, stat)
        assert np.shape(stats[name]["count"]) == (1,)


@pytest.mark.slow
def test_columns_have_the_types_and_shapes_of_their_features(exported):
    out, _ = exported
    info = json.loads((out / "meta" / "info.json").read_text())
    schema = pq.read_schema(out / "data/chunk-000/file-000.parquet")
    stored = {name: one for name, one in info["features"].items() if one["dtype"] != "video"}
    assert schema.names == list(stored)
    for name, feature in stored.items():
        kind = schema.field(name).type
        if feature["shape"] != [1]:
            assert kind.list_size == feature["shape"][0]
            kind = kind.value_type
        assert str(kind) == {"float32": "float", "int64": "int64"}[feature["dtype"]]


@pytest.mark.slow
def test_episodes_say_where_their_rows_and_frames_are(exported):
    out, _ = exported
    info = json.loads((out / "meta" / "info.json").read_text())
    episodes = pd.read_parquet(out / "meta" / "episodes")
    tasks = pd.read_parquet(out / "meta" / "tasks.parquet")
    assert tasks.index.name == "task"
    assert tasks.to_dict() == {"task_index": {"random commands": 0}}
    begin = 0
    for number, episode in enumerate(episodes.to_dict("records")):
        where = {name: episode[f"data/{name}"] for name in ("chunk_index", "file_index")}
        table = pd.read_parquet(out / info["data_path"].format(**where))
        assert list(episode["tasks"]) == ["random commands"]
        assert (episode["dataset_from_index"], episode["length"]) == (begin, len(table))
        begin += len(table)
        assert episode["dataset_to_index"] == begin
        assert list(table["index"]) == list(range(begin - len(table), begin))
        assert list(table["frame_index"]) == list(range(len(table)))
        assert set(table["episode_index"]) == {number}
        # LeRobot takes timestamps that are off by less than 0.1 ms.
        assert np.abs(table["timestamp"] - table["frame_index"] / info["fps"]).max() < 1e-4
        key = "videos/observation.images.camera"
        where = {name: episode[f"{key}/{name}"] for name in ("chunk_index", "file_index")}
        path = out / info["video_path"].format(video_key="observation.images.camera", **where)
        with Video(path) as video:
            assert sum(1 for _ in video) == len(table)
            assert video.fps == info["fps"]
        assert episode[f"{key}/to_timestamp"] == pytest.approx(len(table) / info["fps"])
        for stat in ("min", "max", "mean", "std"):
            numbers = np.stack(table["action"].to_numpy())
            assert list(episode[f"stats/action/{stat}"]) == pytest.approx(
                getattr(numbers.astype(float), stat)(axis=0).tolist()
            )


@pytest.mark.slow
def test_actions_poses_and_pictures_are_the_recordings(recordings, exported):
    out, warnings = exported
    recording = Recording(recordings[1])
    table = pd.read_parquet(out / "data/chunk-000/file-001.parquet")
    lines = [line for line in recording.commands().itertuples() if line.is_motor]
    sent = [line.numbers for line in lines if line.kind == "command"]
    actions = np.stack(table["action"].to_numpy())
    changes = actions[np.append(True, np.any(np.diff(actions, axis=0) != 0, axis=1))]
    driven = [row for row in changes.tolist() if any(row)]
    assert driven == [pytest.approx(numbers, abs=1e-4) for numbers in sent]
    assert list(actions[-1]) == [0, 0]
    poses = recording.poses()
    begun = max(lines[0].time, poses.time[0])
    state = np.stack(table["observation.state"].to_numpy())
    for frame in range(0, len(table), 7):
        near = np.argmin(abs(poses.time - begun - frame / warnings["fps"]))
        assert np.abs(state[frame] - poses.pose[near])[:2].max() < 0.03
    # The picture is that of the recording, encoded again.
    path = out / "videos/observation.images.camera/chunk-000/file-001.mp4"
    with Video(recording.video(1)) as old, Video(path) as new:
        old_frames = [frame for _, _, frame in old]
        new_frames = [frame for _, _, frame in new]
    where = int(poses.frame[np.searchsorted(poses.time, begun + 20 / warnings["fps"], "right") - 1])
    differences = [np.abs(new_frames[20].astype(int) - one).mean() for one in old_frames]
    assert differences[where] < 4
    assert abs(int(np.argmin(differences)) - where) <= 1


@pytest.mark.slow
def test_another_reader_takes_it(exported):
    reader = LeRobotReader(exported[0])
    assert (reader.version, reader.episodes()) == ("v3", [0, 1])
    chunks = list(reader.stream(1))
    assert {"/action", "/observation.state"} <= {chunk.entity_path for chunk in chunks}


@pytest.mark.slow
def test_readings_and_rates(recordings, tmp_path):
    shutil.copytree(recordings[0], tmp_path / "a")
    recording = Recording(tmp_path / "a")
    times = [line.time for line in recording.commands().itertuples() if line.is_motor]
    rows = {"session": [1, 1], "command": [0, 1], "time": times[:2]}
    rows |= {"x": [0, 0], "y": [0, 0], "theta": [0, 0], "light": [0.25, 0.75]}
    write_csv(tmp_path / "a" / "observations.csv", rows)
    warnings = export_lerobot([tmp_path / "a"], tmp_path / "out", fps=5)
    assert (warnings["fps"], warnings["episodes"]) == (5, 1)
    assert "observation.sensors" in warnings["features"]
    table = pd.read_parquet(tmp_path / "out" / "data")
    # A feature of one number is stored as this number, as in LeRobot.
    assert table["observation.sensors"].iloc[[0, -1]].tolist() == [0.25, 0.75]
    capture = cv2.VideoCapture(str(next((tmp_path / "out").rglob("*.mp4"))))
    assert capture.get(cv2.CAP_PROP_FPS) == 5
    with pytest.raises(UserError, match="has other sensors than the first"):
        export_lerobot([tmp_path / "a", recordings[1]], tmp_path / "both")
    assert not (tmp_path / "both").exists()


@pytest.mark.slow
def test_what_cannot_be_exported(recordings, tmp_path, monkeypatch):
    def export(*words):
        return CliRunner().invoke(cli, ["export", *map(str, words)], catch_exceptions=False)

    out = ["--to", "lerobot", "-o", tmp_path / "x"]
    for words, says in (
        ([recordings[0], *out, "--fps", 2.5], "--fps is a whole number, not 2.5"),
        ([recordings[0], "--to", "onnx", "-o", tmp_path / "x", "--fps", 2], "leave it out"),
        ([*recordings, "--to", "torch", "-o", tmp_path / "x"], "takes one simulator"),
        ([recordings[0], "--to", "lerobot", "-o", recordings[1]], "is not empty"),
        ([tmp_path, *out], "recording.json"),
    ):
        with pytest.raises(UserError, match=says):
            export(*words)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(UserError, match=r"pip install 'neurosim\[lerobot\]'"):
        export(recordings[0], *out)
    assert not (tmp_path / "x").exists()
