"""Draw the README's picture from a demo: python docs/pictures.py DEMO docs/course.png."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from neurosim.reports.course import Paths, Scene, draw_course
from neurosim.tasks.registry import make_task
from tracking.camera.camera_model import CameraModel
from tracking.datasets.recordings import Recording


def main(demo: Path, out: Path) -> None:
    drives = {"in open loop": "trial", "replanned after every command": "replanned"}
    trials = {
        path: json.loads((demo / path / "trial.json").read_text()) for path in drives.values()
    }
    figure, (left, *courses) = plt.subplots(
        1, 3, figsize=(17, 4.4), width_ratios=(1, 1.12, 1.12), layout="constrained"
    )
    left.imshow(frame_with_trail(demo / "trial", trials["trial"])[..., ::-1])
    left.axis("off")
    left.set_title("what the roof camera sees, and the track found in it", fontsize=10)
    for axes, (how, path) in zip(courses, drives.items(), strict=True):
        trial, board = trials[path], Recording(demo / path).meta["board"]
        predicted, actual = trial["predicted"], trial["actual"]
        draw_course(
            axes,
            Scene.of(make_task(trial["task"]), board=board),
            Paths(predicted["poses"], True, predicted["rest"], actual["poses"], actual["path"]),
        )
        axes.set_title(f"the plan {how}", fontsize=10, loc="left")
    figure.savefig(out, dpi=110)


def frame_with_trail(path: Path, trial: dict):
    recording = Recording(path)
    camera = CameraModel.read(path / "calibration.json")
    capture = cv2.VideoCapture(str(recording.video(1)))
    poses = recording.poses()
    number = int(0.72 * len(poses.time))
    capture.set(cv2.CAP_PROP_POS_FRAMES, number)
    frame = capture.read()[1]
    height = recording.meta["markers"]["height"]
    points = [[x, y, height] for _, x, y, _ in trial["actual"]["path"]]
    until = poses.time[number]
    seen = [p for p, row in zip(points, trial["actual"]["path"], strict=True) if row[0] <= until]
    pixels = (camera.to_pixels(seen) * 16).round().astype(int)
    cv2.polylines(frame, [pixels.reshape(-1, 1, 2)], False, (0, 140, 255), 2, cv2.LINE_AA, 4)
    return frame


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
