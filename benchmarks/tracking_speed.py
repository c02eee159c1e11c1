"""How fast video is tracked, compared with decoding it, the usual recipe, and ArUco.

    python benchmarks/tracking_speed.py             about 4 minutes
    python benchmarks/tracking_speed.py --quick     one minute, 1280x720, 2 rounds

Milliseconds a frame and ratios, the medians of rounds in which these take turns on one file:

  - decoding: every frame through ``VideoCapture.read`` and nothing else;
  - ours: the whole of ``neurosim track`` on the file, calibrated, from opening it to poses.csv;
  - tag: the same of a robot with an ArUco marker, which is tracked as ``--markers aruco`` does;
  - usual: decoding, then the usual recipe on the full frame: HSV, two thresholds, opening,
    connected components with their centroids;
  - ArUco: decoding, then OpenCV's detector with refined corners, on the clip with that marker.

The robot of tracking_accuracy.py drives through every clip: 150 frames, forwards, backwards and
forwards again. Other work on the machine spoils these figures.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from tracking_scenes import ARUCO, FPS, MARKERS, SCENARIOS, Clip

from tracking.markers.sought import Sought
from tracking.markers.tags import Tag
from tracking.track import track_video

COLOURS = ("pink", "blue")
METHODS = ("decoding", "ours", "tag", "usual", "ArUco")
CODECS = {"mp4v": ".mp4", "MJPG": ".avi"}
#: HSV ranges of pink and blue, as one tunes them by hand.
RANGES = (((150, 60, 50), (178, 255, 255)), ((100, 60, 40), (128, 255, 255)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--sizes", default="1280x720,1920x1080")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if options.quick:
        options.sizes, options.rounds = "1280x720", 2
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for text in options.sizes.split(","):
            width, height = (int(side) for side in text.split("x"))
            clips = [make(Path(folder), (width, height), tag) for tag in (None, ARUCO)]
            camera = clips[0][1]
            for codec in CODECS:
                pair, aruco = (files[codec] for files, _ in clips)
                methods: dict[str, Callable[[], int]] = {
                    "decoding": lambda path=pair: decode(path, lambda frame: None),
                    "ours": lambda path=pair, model=camera: ours(
                        path, COLOURS, model, Path(folder)
                    ),
                    "tag": lambda path=aruco, model=camera: ours(path, ARUCO, model, Path(folder)),
                    "usual": lambda path=pair: decode(path, usual),
                    "ArUco": lambda path=aruco: decode(path, aruco_detector()),
                }
                rows.append({"size": text, "codec": codec, **timed(methods, options.rounds)})
    if options.json:
        machine = {"cores": os.cpu_count(), "opencv": cv2.__version__}
        print(json.dumps({"machine": machine, "rows": rows}))
        return
    print(" " * 18 + "".join(f"{name:>10}" for name in METHODS) + "  ms a frame")
    for row in rows:
        cells = "".join(f"{row[name]:10.2f}" for name in METHODS)
        print(
            f"{row['size'] + ' ' + row['codec']:18}{cells}  "
            f"ours / decoding {row['ours'] / row['decoding']:.2f}, "
            f"ours / usual {row['ours'] / row['usual']:.2f}"
        )


def make(folder: Path, size: tuple[int, int], tag: Tag | None) -> tuple[dict, object]:
    """Render a clip and write it with every codec; return the files and the camera."""
    clip = Clip(SCENARIOS[0], size, 1, 5.0, tag)
    frames = [frame.picture for frame in clip]
    files = {}
    for codec, suffix in CODECS.items():
        path = folder / f"{size[0]}-{clip.carried}-{codec}{suffix}"
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), FPS, size)
        for picture in (*frames, *frames[::-1], *frames):
            writer.write(picture)
        writer.release()
        files[codec] = path
    return files, clip.camera


def decode(path: Path, look: Callable[[np.ndarray], object]) -> int:
    """Read every frame and look at it; return how many there are."""
    capture, count = cv2.VideoCapture(str(path)), 0
    while True:
        good, frame = capture.read()
        if not good:
            capture.release()
            return count
        look(frame)
        count += 1


def ours(path: Path, what: Sought | tuple[str, str], camera: object, folder: Path) -> int:
    """Track the file as ``neurosim track VIDEO --calibration FILE -o FOLDER`` does."""
    with tempfile.TemporaryDirectory(dir=folder) as out:
        result = track_video(
            path, what, Path(out) / "poses", calibration=camera, height=MARKERS["height"]
        )
    if result["in_view"] < 0.99:
        raise SystemExit(f"the robot was found in {100 * result['in_view']:.1f} % of {path.name}")
    return result["frames"]


def usual(frame: np.ndarray) -> list[np.ndarray]:
    """Return the centre of the largest patch of each colour."""
    hsv = cv2.cvtColor(frame, cv2.COLOR_BGR2HSV)
    centres = []
    for low, high in RANGES:
        mask = cv2.inRange(hsv, low, high)
        mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        _, _, stats, places = cv2.connectedComponentsWithStats(mask)
        if len(stats) > 1:
            centres.append(places[1 + stats[1:, cv2.CC_STAT_AREA].argmax()])
    return centres


def aruco_detector() -> Callable[[np.ndarray], object]:
    """Return OpenCV's detector with refined corners."""
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return cv2.aruco.ArucoDetector(ARUCO.words, settings).detectMarkers


def timed(methods: dict[str, Callable[[], int]], rounds: int) -> dict[str, float]:
    """Return milliseconds a frame of every method, the medians of rounds in turn."""
    seconds: dict[str, list[float]] = {name: [] for name in methods}
    for turn in range(rounds + 1):
        for name, method in methods.items():
            begun = time.perf_counter()
            frames = method()
            # The first round reads the file, compiles and warms up.
            if turn:
                seconds[name].append(1e3 * (time.perf_counter() - begun) / frames)
    return {name: statistics.median(values) for name, values in seconds.items()}


if __name__ == "__main__":
    main()
