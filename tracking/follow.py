"""Tracks one video from its first frame to its last: the markers' places in each frame."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim.base.errors import UserError
from neurosim.base.files import atomic_path
from neurosim.base.progress import Progress
from tracking.camera.video import Video
from tracking.identity import doubtful
from tracking.markers.colours import Colour
from tracking.markers.pair import LOST, Geometry, Sighting
from tracking.markers.palette import unless_still
from tracking.markers.pointing import colour_at
from tracking.markers.sought import Sought, drawing_colours, tracker_of
from tracking.markers.tag_tracker import TagTracker
from tracking.markers.tracker import Tracker
from tracking.overlay import Overlay, check_overlay


@dataclass(frozen=True)
class Track:
    """The robot in one video, one row for each frame; pixels, seconds of the camera's clock.

    Attributes:
        frame: [N] index within the video.
        time: [N] camera time.
        front, rear: [N, 2] pixels of the markers' centres, or of the middles of a tag's front and
            rear edge; NaN where the pair was not found.
        quality: [N] 0 not found, up to 1.
        lamp: [N] brightness where the lamp is, 0..255, NaN where the pair was not found.
        size: width and height of the video in pixels.
        markers: as in tracking.json. ``front`` and ``rear`` as measured: name, rgb of the rim, hue,
            chroma, confidence, and the reason if it is low; or
            ``tag``: its dictionary and id, and the ids of others that were seen.
        undecided: number of frames in which several pairs could have been the lost one; all were
            refused.
        missing: number of frames that are missing at the video's end, because it was cut short.
    """

    frame: NDArray
    time: NDArray
    front: NDArray
    rear: NDArray
    quality: NDArray
    lamp: NDArray
    size: tuple[int, int]
    markers: dict[str, dict[str, Any]]
    undecided: int = 0
    missing: int = 0

    @property
    def in_view(self) -> NDArray:
        """[N] whether the pair was found."""
        return self.quality > 0

    @cached_property
    def doubtful(self) -> NDArray:
        """[N] whether the pair may be another than that of the first frames.

        A tag cannot be another.
        """
        if "tag" in self.markers:
            return np.zeros(len(self.time), bool)
        return doubtful(self.time, self.front, self.rear)


def follow(
    path: str | Path,
    what: Sought | None,
    *,
    geometry: Geometry | None = None,
    times: NDArray | None = None,
    overlay: str | Path | None = None,
    expected_size: tuple[int, int] | None = None,
    clicks: ArrayLike | None = None,
) -> Track:
    """Follow two coloured markers, or a tag, through a video.

    Args:
        path: the video; one that was cut off is read as far as it goes.
        what: the colours or tag to look for; None with clicks.
        geometry: the known geometry of the pair.
        times: camera time [N] of the frames in seconds; without, the container's.
        overlay: write a video with the markers drawn over it here.
        expected_size: the calibration's image size in pixels.
        clicks: pixels [2, 2] of the front and the rear marker in the first frame; their colours
            are then taken from there.

    Raises:
        UserError: if the video cannot be read, has another size than expected, or shows no
            such pair, or tag, in any frame.
    """
    path = Path(path)
    rows: list[tuple] = []
    with ExitStack() as stack:
        video = stack.enter_context(Video(path, times))
        if clicks is not None:
            front, rear = (colour_at(video.first, click).colour for click in np.asarray(clicks))
            what = front, rear
        if isinstance(what, tuple) and what[0].name == what[1].name:
            raise UserError(f"both markers are {what[0].name}: front and rear need two colours")
        tracker = tracker_of(what, geometry, None if clicks is None else np.asarray(clicks, float))
        if expected_size is not None and video.size != tuple(expected_size):
            raise UserError(
                f"{path} has {video.size[0]} x {video.size[1]} pixels, the calibration was made "
                f"at {expected_size[0]} x {expected_size[1]}; calibrate at the video's size"
            )
        drawing = None
        if overlay is not None:
            check_overlay(overlay, path)
            partial = stack.enter_context(atomic_path(overlay))
            drawing = stack.enter_context(
                Overlay(partial, video.size, video.fps, drawing_colours(what))
            )
        progress = stack.enter_context(
            Progress(f"tracking {path.name}", video.frames or None, "frames")
        )
        for index, time, frame in video:
            sighting = tracker.update(frame, time)
            if clicks is not None and tracker.seen_colours is None:
                raise UserError(
                    f"{path}: no pair of markers is at the clicks in the first frame; click on "
                    "the front marker and on the rear marker of one robot"
                )
            rows.append((index, time, *_row(sighting)))
            if drawing is not None:
                drawing.write(frame, time, sighting)
            progress.advance()
    table = np.array(rows, float)
    if isinstance(tracker, TagTracker):
        if not tracker.ever_seen:
            raise UserError(_no_tag(path, tracker, geometry))
        markers = {"tag": {**tracker.tag.as_dict(), "others": sorted(tracker.others)}}
    else:
        markers = _colours(path, tracker, table, geometry, by_hand=clicks is not None)
    return Track(
        table[:, 0].astype(int),
        table[:, 1],
        table[:, 2:4],
        table[:, 4:6],
        table[:, 6],
        table[:, 7],
        video.size,
        markers,
        tracker.undecided,
        video.missing,
    )


def _row(sighting: Sighting) -> tuple[float, ...]:
    return (*sighting.front, *sighting.rear, sighting.quality, sighting.lamp)


def _colours(
    path: Path, tracker: Tracker, table: NDArray, geometry: Geometry | None, *, by_hand: bool
) -> dict[str, dict[str, Any]]:
    """Return the colours as tracked; rows before the pair are taken out of the table."""
    table[: tracker.begun, 2:] = _row(LOST)
    colours = tracker.seen_colours
    if colours is None or not table[:, 6].any():
        raise UserError(_not_found(path, tracker.colours, tracker.seen, geometry is not None))
    if not by_hand:
        colours = unless_still(colours, table[:, 2:4], table[:, 4:6])
    return {
        which: colour.as_dict() for which, colour in zip(("front", "rear"), colours, strict=True)
    }


def _no_tag(path: Path, tracker: TagTracker, geometry: Geometry | None) -> str:
    others = ", ".join(map(str, sorted(tracker.others)))
    sized = geometry is not None and geometry.separation is not None
    return (
        f"{path}: {tracker.tag} was not found in any frame; "
        + (f"of its dictionary {others} are in view: name one with --tag, or " if others else "")
        + "check that it is flat, whole and in view"
        + (", and that its size is as given" if sized else "")
    )


def _not_found(
    path: Path, colours: tuple[Colour, ...], seen: tuple[bool, bool], known: bool
) -> str:
    missing = [c.name for c, there in zip(colours, seen, strict=True) if not there]
    if missing:
        return (
            f"{path}: nothing {' and nothing '.join(missing)} was found in any frame; "
            "name the markers' colours, such as --colours pink,blue"
        )
    return (
        f"{path}: no {colours[0].name} and {colours[1].name} marker were found together in any "
        "frame; are these the markers' colours"
        + (", and are their distance and size as given?" if known else "?")
    )
