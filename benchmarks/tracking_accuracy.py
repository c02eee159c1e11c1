"""How exactly and how steadily the robot is tracked, against rendered truth.

    python benchmarks/tracking_accuracy.py                       about half an hour on one core
    python benchmarks/tracking_accuracy.py --sizes 1280x720      about 8 minutes
    python benchmarks/tracking_accuracy.py --quick               one minute, 640x480
    python benchmarks/tracking_accuracy.py --recording FOLDER    a tracked recording of the lab

Clips of the robot on the paper's board, which fills the picture, are rendered with known poses:
clean, under a moving lamp, with a drifting white balance, blurred, compressed, noisy, among other
things of the same colours, with markers covered, out of the picture, through a tilted and bent
camera (benchmarks/tracking_scenes.py). Markers stand 10 cm above the board and are 6 cm wide.

  - position, heading: RMSE of the pose of the middle of the axle, over the frames in which both
    markers are whole in view (99 % of each);
  - worst: the largest of those errors of position;
  - tracked: fraction of those frames that have a pose;
  - false: poses where less than a tenth of a marker is in view, and poses more than 1 cm or 5
    degrees off; swapped: of these, those with front and back exchanged.

For comparison, on the same paths and in otherwise the same pictures, a robot carries one tag with a
side of 6 cm (``--side``), a 4 x 4 ArUco marker (``--tag``). "tag" is the tracker of
``--markers aruco``, "OpenCV" is OpenCV's detector alone, with its corners refined.
With ``--recording`` the poses of a recording made in the virtual lab are compared with the truth in
its folder, calibration included. A constant offset and a lag of the clock (the radio's
delay, which displacements between two stops do not see) are separated from the scatter.

Both get the true camera; the errors of a calibration are not in these figures. Only the clips
that say so are compressed, with OpenCV's MPEG-4 encoder.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from tracking_scenes import ARUCO, FPS, MARKERS, SCENARIOS, TAG_PLACE, Clip, Frame

from neurosim.lab.nxt.world import read_truth
from tracking.camera.camera_model import CameraModel
from tracking.datasets.recordings import Recording
from tracking.markers.colours import parse_colour
from tracking.markers.pair import Geometry
from tracking.markers.tag_tracker import TagTracker
from tracking.markers.tags import KINDS, Tag
from tracking.markers.tracker import Tracker
from tracking.poses import marker_geometry, marker_poses

#: A pose further off than this (m, rad) is a false one.
FALSE = (0.01, math.radians(5.0))


class Colours:
    """The tracker of two colours, frame by frame, as ``neurosim track`` runs it."""

    name = "colours"

    def __init__(self, camera: CameraModel, markers: dict | None = None):
        self._camera, self._markers = camera, markers or MARKERS
        self._tracker = self._look_for(marker_geometry(self._markers, camera))

    def _look_for(self, geometry: Geometry) -> Tracker | TagTracker:
        front, rear = (parse_colour(MARKERS[m]["colour"]) for m in ("front", "rear"))
        return Tracker(front, rear, geometry)

    def __call__(self, picture: np.ndarray, time: float) -> np.ndarray | None:
        """Return the pose [3] in the next picture."""
        seen = self._tracker.update(picture, time)
        if not seen.in_view:
            return None
        return marker_poses(seen.front[None], seen.rear[None], self._markers, self._camera)[0]


class OneTag(Colours):
    """The tracker of one tag."""

    name = "tag"

    def __init__(self, camera: CameraModel, tag: Tag, side: float):
        self._tag = tag
        x, y = TAG_PLACE
        ends = {"front": {"x": x + side / 2, "y": y}, "rear": {"x": x - side / 2, "y": y}}
        super().__init__(camera, {**ends, "height": MARKERS["height"]})

    def _look_for(self, geometry: Geometry) -> Tracker | TagTracker:
        return TagTracker(self._tag, geometry)


class OpenCV:
    """OpenCV's detector of tags, with its corners refined to fractions of a pixel."""

    name = "OpenCV"

    def __init__(self, camera: CameraModel, tag: Tag, side: float):
        self._camera, self._tag = camera, tag
        settings = cv2.aruco.DetectorParameters()
        settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        self._detector = cv2.aruco.ArucoDetector(tag.words, settings)

    def __call__(self, picture: np.ndarray, time: float) -> np.ndarray | None:
        """Return the pose [3] in the next picture."""
        corners, ids, _ = self._detector.detectMarkers(picture)
        for corner, number in zip(corners, [] if ids is None else ids.ravel(), strict=True):
            if number == self._tag.number:
                points = self._camera.to_board(corner[0], MARKERS["height"])
                break
        else:
            return None
        # Corners: left ahead, right ahead, right behind, left behind.
        ahead = points[0] + points[1] - points[2] - points[3]
        theta = math.atan2(ahead[1], ahead[0])
        cos, sin = math.cos(theta), math.sin(theta)
        middle = points.mean(axis=0)
        x, y = TAG_PLACE
        return np.array([middle[0] - cos * x + sin * y, middle[1] - sin * x - cos * y, theta])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--sizes", default="640x480,1280x720,1920x1080")
    parser.add_argument("--scenarios", default=",".join(s.name for s in SCENARIOS))
    parser.add_argument("--clips", type=int, default=3, help="of every scenario")
    parser.add_argument("--seconds", type=float, default=5.2, help="of a clip")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tag", default="aruco", help="kind of tag; none leaves tags out")
    parser.add_argument("--side", type=float, default=0.06, help="of the tag, in m")
    parser.add_argument("--quick", action="store_true", help="one clip of each, 640x480")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--renders", type=Path, help="keep the clips here, to run again quickly")
    parser.add_argument("--recording", type=Path, help="compare this recording's poses instead")
    options = parser.parse_args()
    if options.recording is not None:
        commanded = rate_recording(options.recording)
        shown = ", ".join(f"{name} {value:.3f}" for name, value in commanded.items())
        print(json.dumps(commanded) if options.json else shown)
        return
    if options.quick:
        options.sizes, options.clips = "640x480", 1
    chosen = options.scenarios.split(",")
    name = KINDS.get(options.tag, options.tag)
    known = None if name == "none" else Tag(name, ARUCO.number)
    rows = []
    if not options.json:
        print(_line("", "", "position", "worst", "heading", "tracked", "false", "swapped"))
    for size in options.sizes.split(","):
        width, height = (int(side) for side in size.split("x"))
        for scenario in (s for s in SCENARIOS if s.name in chosen):
            for method in (Colours, OneTag, OpenCV) if known else (Colours,):
                seen, bits = [], 0.0
                carried = () if method is Colours else (known, options.side)
                for seed in range(options.seed, options.seed + options.clips):
                    clip = Clip(scenario, (width, height), seed, options.seconds, *carried)
                    estimate = method(clip.camera, *carried)
                    frames, bits = frames_of(clip, seed, options.renders)
                    seen += [(frame, estimate(frame.picture, frame.time)) for frame in frames]
                row = {"size": size, "scenario": scenario.name, "method": method.name}
                row |= rate(seen) | ({"bit_rate": bits} if bits else {})
                rows.append(row)
                if not options.json:
                    print(_line(
                        f"{size} {scenario.name}", row["method"],
                        f"{row['position_mm']:.2f} mm", f"{row['worst_mm']:.1f} mm",
                        f"{row['heading_deg']:.2f} deg", f"{100 * row['tracked']:.1f} %",
                        row["false"], row["swapped"],
                    ), flush=True)  # fmt: skip
    if options.json:
        print(json.dumps({"frames_a_second": FPS, "rows": rows}))


def frames_of(clip: Clip, seed: int, renders: Path | None) -> tuple[Iterable[Frame], float]:
    """Return a clip's frames, compressed if the scenario says so, and the bit rate if it does."""
    frames: Iterable[Frame] = clip
    if renders is not None:
        renders.mkdir(parents=True, exist_ok=True)
        width, height = clip.size
        what = f"{clip.scenario.name}-{width}x{height}-{seed}-{clip.frames}-{clip.carried}"
        frames = _kept(clip, renders / f"{what}.npz")
    return _compressed(frames, clip.size) if clip.scenario.compressed else (frames, 0.0)


def _kept(clip: Clip, path: Path) -> Iterator[Frame]:
    if not path.exists():
        frames = list(clip)
        columns = {k: np.array([getattr(f, k) for f in frames]) for k in Frame.__annotations__}
        np.savez(path, **columns)
    with np.load(path) as kept:
        columns = {k: kept[k] for k in Frame.__annotations__}
    for i in range(len(columns["time"])):
        yield Frame(*(columns[k][i] for k in Frame.__annotations__))


def _compressed(frames: Iterable[Frame], size: tuple[int, int]) -> tuple[list[Frame], float]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "clip.mp4"
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), FPS, size)
        kept = []
        for frame in frames:
            writer.write(frame.picture)
            kept.append(frame)
        writer.release()
        bits = 8.0 * path.stat().st_size / (len(kept) / FPS)
        capture = cv2.VideoCapture(str(path))
        kept = [replace(frame, picture=capture.read()[1]) for frame in kept]
        capture.release()
    return kept, bits


def rate_recording(folder: Path) -> dict[str, float]:
    """Compare a recording's poses with the lab's truth: scatter (RMS) about a constant offset."""
    poses, misses, lags = Recording(folder).poses(), [], []
    for session in np.unique(poses.session):
        own = (poses.session == session) & (poses.quality > 0)
        truth, times, seen = read_truth(folder, int(session)), poses.time[own], poses.pose[own]
        step = 0.005
        speed = (truth.pose_at(times + step) - truth.pose_at(times - step))[:, :2] / (2 * step)
        off = (seen - truth.pose_at(times))[:, :2]
        lag = float(((off - off.mean(axis=0)) * speed).sum() / max((speed**2).sum(), 1e-12))
        miss = seen - truth.pose_at(times + lag)
        miss[:, 2] = (miss[:, 2] + math.pi) % (2 * math.pi) - math.pi
        misses.append(miss)
        lags.append(lag)
    miss = np.concatenate(misses)
    x, y, theta = miss.std(axis=0)
    return {
        "tracked": len(miss) / len(poses.time),
        "position_mm": 1e3 * math.hypot(x, y),
        "heading_deg": math.degrees(theta),
        "offset_mm": 1e3 * float(np.hypot(*miss.mean(axis=0)[:2])),
        "offset_deg": math.degrees(miss.mean(axis=0)[2]),
        "lag_ms": 1e3 * float(np.mean(lags)),
    }


def rate(seen: list[tuple[Frame, np.ndarray | None]]) -> dict:
    """Compare poses with the truth."""
    off, angle, visible = [], [], []
    for frame, pose in seen:
        miss = np.full(3, np.nan) if pose is None else pose - frame.pose
        off.append(math.hypot(miss[0], miss[1]))
        angle.append(abs((miss[2] + math.pi) % (2 * math.pi) - math.pi))
        visible.append(frame.visible.min())
    off, angle, visible = np.array(off), np.array(angle), np.array(visible)
    result, whole = np.isfinite(off), visible > 0.99
    good = result & whole
    wrong = result & ((visible < 0.1) | (off > FALSE[0]) | (angle > FALSE[1]))
    rms = [float(np.sqrt(np.mean(np.square(e[good])))) if good.any() else math.nan
           for e in (off, angle)]  # fmt: skip
    return {
        "frames": len(seen),
        "whole": int(whole.sum()),
        "position_mm": 1e3 * rms[0],
        "worst_mm": 1e3 * float(off[good].max(initial=0.0)),
        "heading_deg": math.degrees(rms[1]),
        "tracked": float(result[whole].mean()) if whole.any() else math.nan,
        "false": int(wrong.sum()),
        "swapped": int((result & (angle > math.pi / 2)).sum()),
    }


def _line(what: str, who: str, *cells: object) -> str:
    return f"{what:24}{who:8}" + "".join(f"{cell:>11}" for cell in cells)


if __name__ == "__main__":
    main()
