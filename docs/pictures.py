"""Make the README's moving picture of a demo: python docs/pictures.py DEMO docs/drive.webp."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from neurosim.reports.artefacts import Trial
from neurosim.reports.film import Film, filmed_trial, frames
from tracking.camera.camera_model import CameraModel
from tracking.datasets.recordings import Recording

#: Height of the picture, pixels; how much faster than the drive it is; time of its last frame, s.
HEIGHT, SPEED, REST = 330, 3, 2.0
#: Colour of the track in the camera's picture, BGR.
TRACK = (0, 140, 255)


def main(demo: Path, out: Path) -> None:
    folders = [demo / name for name in ("replanned", "simulator", "controller")]
    trial, scene, film = filmed_trial(folders, seed=0, only="name the folder of a demo")
    film = replace(film, names=(), readings=np.empty((0, 0)))  # sensors would hide the board's edge
    pairs = zip(camera_frames(trial, film), frames(scene, film), strict=True)
    pictures = []
    for number, pair in enumerate(pairs):
        if number % 2 == 0 or number == len(film.times) - 1:
            pictures.append(Image.fromarray(np.hstack([*map(scaled, pair)])[..., ::-1]))
    pause = 1000 * 2 * film.times[1] / SPEED
    pauses = [round(pause)] * (len(pictures) - 1) + [round(1000 * REST)]
    pictures[0].save(
        out,
        save_all=True,
        append_images=pictures[1:],
        duration=pauses,
        loop=0,
        quality=55,
        method=6,
    )


def scaled(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a picture with the common height."""
    width = round(picture.shape[1] * HEIGHT / picture.shape[0])
    return cv2.resize(picture, (width, HEIGHT), interpolation=cv2.INTER_AREA)


def camera_frames(trial: Trial, film: Film) -> Iterator[NDArray[np.uint8]]:
    """Give the frames (H, W, 3) of the roof camera, BGR, with the track so far."""
    recording = Recording(trial.path)
    camera = CameraModel.read(trial.path / "calibration.json")
    height = recording.meta["markers"]["height"]
    times = trial.meta["actual"]["path"][0][0] + film.times
    seen = recording.poses().time
    numbers = np.searchsorted(seen, times).clip(max=len(seen) - 1)
    known = np.isfinite(film.robot).all(axis=1)
    pixels = camera.to_pixels([[x, y, height] for x, y, _ in film.robot[known]])
    video, at, frame = cv2.VideoCapture(str(recording.video(1))), -1, np.empty(0, np.uint8)
    for number, until in zip(numbers, known.cumsum(), strict=True):
        while at < number:
            at, frame = at + 1, video.read()[1]
        line = (16 * pixels[:until]).round().astype(np.int32)
        yield cv2.polylines(frame.copy(), [line], False, TRACK, 2, cv2.LINE_AA, 4)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
