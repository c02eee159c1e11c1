"""Reading video frame by frame, decoded ahead in a separate thread."""

from __future__ import annotations

import os
import queue
import shlex
import threading
from collections.abc import Iterator
from pathlib import Path

# A cut-off file is normal and reported here; FFmpeg's own messages would hide the report.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

import cv2
import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import FileError
from neurosim.base.files import check_name

#: First bytes of files with sound only, and their formats.
_SOUND = {
    b"ID3": "MP3", b"\xff\xfb": "MP3", b"\xff\xf1": "AAC", b"\xff\xf9": "AAC", b"fLaC": "FLAC",
    b"OggS": "Ogg", b"FORM": "AIFF",
}  # fmt: skip
#: Codecs that OpenCV names and cannot decode everywhere.
_CODECS = {"AV01": "AV1", "AV1 ": "AV1"}
#: Advice on a format that every OpenCV decodes.
_CONVERT = "convert it to H.264, with ffmpeg -i {} -c:v libx264 -crf 18 {}"
#: Number and time of missing frames from which a video counts as cut short, because containers
#: count and round differently.
_LEAST_MISSING = 3

#: Codec and pixels of Motion JPEG with full resolution of colour, as recordings have it: FFmpeg
#: takes twice as long as OpenCV's JPEG decoder. With less resolution of colour it is faster.
_FULL_COLOUR = cv2.VideoWriter.fourcc(*"MJPG"), cv2.VideoWriter.fourcc(*"444P")
#: Of a capture: to read frames without decoding them.
_UNDECODED = (cv2.CAP_PROP_FORMAT, -1)
#: Frames decoded ahead: enough to bridge a full search, little enough to hold in memory.
AHEAD = 16


class Video:
    """A video file, as an iterator of (index, time, frame).

    ``time`` is in seconds on the camera's clock: the given times, if any, else the container's
    presentation times, else the index over the frame rate. ``frame`` is BGR
    [H, W, 3] uint8 and belongs to the receiver. Iteration ends where the file ends, also where
    it was cut off; with given times, at the latest after the last of them.

    Use it as a context manager.

    Attributes:
        size: width and height in pixels.
        first: the first frame, BGR [H, W, 3] uint8.
        fps: the frame rate the container claims.
        frames: the number of frames that the container claims; 0 if unknown.
        missing: number of missing frames, known after all were read.
    """

    def __init__(self, path: str | Path, times: NDArray | None = None):
        """Open a video.

        Args:
            path: the file.
            times: camera time [N] in seconds of every frame, if known better than by the file.

        Raises:
            FileError: if there is no such file, it is not a video, or it has no frame.
        """
        self.path = Path(path)
        if not self.path.is_file():
            raise FileError(self.path, "no such video")
        # OpenCV's own log is silenced while it opens the file; what fails is said below.
        level = cv2.utils.logging.getLogLevel()
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        try:
            self._capture = cv2.VideoCapture(check_name(self.path))
        finally:
            cv2.utils.logging.setLogLevel(level)
        if not self._capture.isOpened():
            raise FileError(self.path, _what_instead(self.path))
        good, self.first = self._capture.read()
        code = int(self._capture.get(cv2.CAP_PROP_FOURCC))
        if not good:
            self._capture.release()
            raise FileError(self.path, _undecodable(self.path, code))
        #: Gives the frames one after the other; those of recordings undecoded.
        self._reader = self._capture
        pixels = int(self._capture.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT))
        if (code, pixels) == _FULL_COLOUR:
            reader = cv2.VideoCapture(check_name(self.path), cv2.CAP_FFMPEG, _UNDECODED)
            good, data = reader.read()
            frame = _decoded(data) if good else None
            if frame is not None and frame.shape == self.first.shape:
                self._reader, self.first = reader, frame
        self.size = (self.first.shape[1], self.first.shape[0])
        self.fps = self._claimed(cv2.CAP_PROP_FPS) or 30.0
        self.frames = int(self._claimed(cv2.CAP_PROP_FRAME_COUNT))
        self.missing = 0
        self._times = None if times is None else np.asarray(times, float)
        self._queue: queue.Queue = queue.Queue(maxsize=AHEAD)
        self._stopped = threading.Event()
        self._thread: threading.Thread | None = None

    def __iter__(self) -> Iterator[tuple[int, float, NDArray]]:
        if self._thread is not None:
            raise RuntimeError("a Video is read once; open it again")
        self._thread = threading.Thread(target=self._decode, name="video decoder", daemon=True)
        self._thread.start()
        while (item := self._queue.get()) is not None:
            if isinstance(item, BaseException):
                raise item
            yield item

    def at(self, index: int) -> NDArray | None:
        """Return one frame, BGR [H, W, 3] uint8, before the video is read; None without it."""
        if index == 0:
            return self.first
        self._capture.set(cv2.CAP_PROP_POS_FRAMES, index)
        good, frame = self._capture.read()
        return frame if good else None

    def close(self) -> None:
        """Stop decoding and close the file."""
        self._stopped.set()
        if self._thread is not None:
            # The decoder may be waiting for room in the queue.
            while self._thread.is_alive():
                try:
                    self._queue.get(timeout=0.05)
                except queue.Empty:
                    continue
            self._thread.join()
        self._reader.release()
        self._capture.release()

    def __enter__(self) -> Video:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _claimed(self, what: int) -> float:
        value = self._capture.get(what)
        return value if np.isfinite(value) and 0 < value < 1e9 else 0.0

    def _decode(self) -> None:
        last: BaseException | None = None
        try:
            index, frame, time = 0, self.first, -np.inf
            while frame is not None and not self._stopped.is_set():
                if self._times is not None and index >= len(self._times):
                    break
                time = self._time(index, time)
                self._queue.put((index, time, frame))
                index += 1
                frame = self._read(index)
                if frame is None:
                    self.missing = self._missing(index, time)
                    break
        except Exception as error:
            last = error
        self._queue.put(last)

    def _read(self, index: int) -> NDArray | None:
        """Return the next frame, which has this index; None after the last."""
        good, frame = self._reader.read()
        if not good or self._reader is self._capture:
            return frame if good else None
        picture = _decoded(frame)
        # FFmpeg repairs frames that are damaged or cut off.
        return self.at(index) if picture is None else picture

    def _time(self, index: int, before: float) -> float:
        if self._times is not None:
            return float(self._times[index])
        stamp = self._reader.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
        if index == 0:
            return stamp if np.isfinite(stamp) and stamp >= 0 else 0.0
        # Some containers have no times, or restart them: then the frame rate is used.
        return stamp if np.isfinite(stamp) and stamp > before else before + 1.0 / self.fps

    def _missing(self, count: int, last: float) -> int:
        """Return the number of frames missing after the first ``count``, up to the last time."""
        if self._times is not None:
            return 0
        missing = self.frames - count
        # If a container has only its length in time, the count is a guess.
        late = self.frames - 1 - last * self.fps
        return missing if min(missing, round(late)) >= _LEAST_MISSING else 0


def _decoded(data: NDArray) -> NDArray | None:
    """Return the picture of JPEG data, as it is stored; None if it is damaged."""
    if not data.size:
        return None
    return cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)


def _what_instead(path: Path) -> str:
    """Describe a file that cannot be opened as a video."""
    with path.open("rb") as file:
        head, rest = file.read(12), file.read(2**20)
    sound = next((kind for begin, kind in _SOUND.items() if head.startswith(begin)), None)
    if head.startswith(b"RIFF") and head[8:] == b"WAVE":
        sound = "WAV"
    elif head[4:] == b"ftypM4A " or (
        head[4:8] == b"ftyp" and b"soun" in rest and b"vide" not in rest
    ):
        sound = "MPEG-4 audio"
    elif head.startswith(b"\x1aE\xdf\xa3") and b"A_" in rest and b"V_" not in rest:
        sound = "Matroska or WebM audio"
    if sound:
        return (
            f"is sound alone ({sound}), with no picture to look at; name a video, such as an .mp4"
        )
    if head[4:8] == b"ftyp":
        return (
            "cannot be opened as a video: it is an MP4 or MOV whose index, at its end, is "
            "missing, so it was cut short; copy it again, or repair it (untrunc does)"
        )
    return (
        "cannot be opened as a video; it may be empty or cut short, or of a kind that OpenCV does "
        f"not read: then {_convert(path)}"
    )


def _undecodable(path: Path, code: int) -> str:
    """Describe a video without a frame that can be decoded."""
    name = code.to_bytes(4, "little").decode("ascii", "replace") if 0 <= code < 2**32 else "?"
    if name in _CODECS:
        return f"is {_CODECS[name]} video, which OpenCV cannot decode here; {_convert(path)}"
    return (
        f"has no frame that can be read (its codec is {name.strip()}); it may be cut short, or "
        f"OpenCV cannot decode it here: then {_convert(path)}"
    )


def _convert(path: Path) -> str:
    other = path.with_name(f"{path.stem}-h264.mp4").name
    return _CONVERT.format(shlex.quote(path.name), shlex.quote(other))
