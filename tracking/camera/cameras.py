"""Cameras that deliver frames, and the video file that keeps them."""

from __future__ import annotations

import queue
import threading
import time as _time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from neurosim.base.errors import UserError
from neurosim.base.files import LineLog, check_name, open_own
from tracking.camera.video import Video

#: Seconds, and frame intervals, without a frame after which a camera has stalled.
STALLED, STALLED_FRAMES = 0.5, 5

#: OpenCV's JPEG encoder takes half as long as FFmpeg's. Colour has full resolution, as markers of
#: a few pixels need it; a frame of the virtual lab, 640 x 480, takes 28 kB.
_JPEG = [
    *(cv2.IMWRITE_JPEG_QUALITY, 75),
    *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
]
_RAW = [cv2.VIDEOWRITER_PROP_RAW_VIDEO, 1]

OnFrame = Callable[[float, np.ndarray], None]


class Camera:
    """A source of frames: camera time in seconds, and the picture, BGR [H, W, 3] uint8.

    A delivered frame belongs to the receiver: the camera does not write to it again.

    Attributes:
        size: width and height of a frame, pixels.
        fps: frames per second.
        waits: whether it makes the next frame only after this one was taken, so that none are
            dropped.
        looked_after: whether it may stop or freeze, unlike the virtual lab's.
        failed: whether it stopped by itself.
        stalled: whether no frame has come for longer than :data:`STALLED`.
    """

    size: tuple[int, int]
    fps: float
    waits: bool = False
    looked_after: bool = True
    failed: bool = False
    stalled: bool = False

    def start(self, on_frame: OnFrame) -> None:
        """Deliver every frame to ``on_frame`` from now on."""
        raise NotImplementedError

    def stop(self) -> None:
        """Deliver no more frames."""
        raise NotImplementedError

    def describe(self) -> dict[str, Any]:
        """Describe this camera for a recording."""
        raise NotImplementedError


class OpenCVCamera(Camera):
    """A webcam, or another source that OpenCV opens, read in a separate thread.

    A frame's time is its arrival on the given clock; the flash later corrects the constant latency.
    Only that thread uses OpenCV's object while it runs, because closing it during a wait for a
    frame crashes it. A URL, such as a phone's, is read from the beginning, because unread frames
    would wait in the network and come late.
    """

    def __init__(
        self,
        source: int | str,
        now: Callable[[], float],
        size: tuple[int, int] | None = None,
        fps: float | None = None,
    ):
        self._source = source
        self._now = now
        self._capture = cv2.VideoCapture(check_name(source) if isinstance(source, str) else source)
        if not self._capture.isOpened():
            what = (
                "start the program that sends it, in the same network"
                if _is_url(source)
                else "plug it in, close other programs that use it"
            )
            raise UserError(
                f"camera {source!r} cannot be opened: {what}, or name another with --camera"
            )
        if size:
            self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
            self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
        if fps:
            self._capture.set(cv2.CAP_PROP_FPS, fps)
        good, frame = self._capture.read()
        if not good:
            self._capture.release()
            raise UserError(f"camera {source!r} opens but delivers no picture")
        self.size = (frame.shape[1], frame.shape[0])
        self.fps = float(self._capture.get(cv2.CAP_PROP_FPS)) or 30.0
        self._running = threading.Event()
        self._thread: threading.Thread | None = None
        self._arrived = 0.0
        self._on_frame: OnFrame | None = None
        if _is_url(source):
            self._begin()

    @property
    def stalled(self) -> bool:
        """Whether no frame has come for too long since it was started."""
        patience = max(STALLED, STALLED_FRAMES / self.fps)
        started = self._running.is_set() and self._on_frame is not None
        return started and _time.monotonic() - self._arrived > patience

    def start(self, on_frame: OnFrame) -> None:
        """Deliver every frame from a thread; ``failed`` is set when the camera stops."""
        self._arrived = _time.monotonic()
        self._on_frame = on_frame
        if self._thread is None:
            self._begin()

    def _begin(self) -> None:
        """Read frames from now on."""
        capture = self._capture

        def read() -> None:
            try:
                while self._running.is_set():
                    good, frame = capture.read()
                    if not self._running.is_set():
                        return
                    if not good:
                        self.failed = True
                        return
                    self._arrived = _time.monotonic()
                    try:
                        if self._on_frame is not None:
                            self._on_frame(self._now(), frame)
                    except UserError:  # the receiver of the frames keeps the error until the end
                        self.failed = True
                        return
            finally:
                capture.release()

        self._running.set()
        self._thread = threading.Thread(target=read, name="camera", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Deliver no more frames and release the camera; a stalled one when it continues."""
        self._running.clear()
        if self._thread is None:
            self._capture.release()
        else:
            self._thread.join(timeout=2.0)

    def describe(self) -> dict[str, Any]:
        """Return source, size and frame rate."""
        return {
            "kind": "opencv",
            "source": str(self._source),
            "size": list(self.size),
            "fps": self.fps,
        }


def _is_url(source: int | str) -> bool:
    return isinstance(source, str) and "://" in source


def open_camera(
    source: str,
    now: Callable[[], float],
    size: tuple[int, int] | None = None,
    fps: float | None = None,
) -> OpenCVCamera:
    """Open a camera.

    Args:
        source: its number, or a file or URL that OpenCV opens.
        now: the clock of frames' times, s.
        size: (width, height) in pixels; by default the camera's own.
        fps: frames per second; by default the camera's own.

    Raises:
        UserError: if it cannot be opened, or delivers no picture.
    """
    return OpenCVCamera(int(source) if source.isdigit() else source, now, size, fps)


class VideoCamera(Camera):
    """A video file as a camera: frames at their own rate, repeated from the beginning at the end.

    Frames have the times of the file, so that time goes back where it begins again.

    Args:
        path: the file.

    Raises:
        FileError: if it is not a readable video.
    """

    def __init__(self, path: str | Path):
        self._path = Path(path)
        with Video(path) as video:
            self.size, self.fps = video.size, video.fps
        self._stopped = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, on_frame: OnFrame) -> None:
        """Deliver every frame from a thread, at the times of the file."""

        def play() -> None:
            try:
                while not self._stopped.is_set():
                    zero = _time.monotonic()
                    with Video(self._path) as video:
                        for _, time, frame in video:
                            if self._stopped.wait(max(0.0, zero + time - _time.monotonic())):
                                return
                            on_frame(time, frame)
            except UserError:
                self.failed = True

        self._thread = threading.Thread(target=play, name="video camera", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Deliver no more frames."""
        self._stopped.set()
        if self._thread is not None:
            self._thread.join(timeout=2.0)

    def describe(self) -> dict[str, Any]:
        """Return file, size and frame rate."""
        return {"kind": "video", "source": str(self._path), "size": [*self.size], "fps": self.fps}


class VideoSink:
    """Encodes frames in a separate thread, and logs each frame's time, if there is a log.

    Motion JPEG in AVI: every frame is independent, the file can be read up to a cut by a kill, and
    it contains only the frames (Matroska adds a random number), so that the virtual lab's file is
    the same for the same seed. It takes more disk space.
    """

    def __init__(
        self, path: str | Path, log: LineLog | None, session: int, size: tuple[int, int], fps: float
    ):
        self._path = Path(path)
        open_own(self._path, "xb").close()
        fourcc, name = cv2.VideoWriter.fourcc(*"MJPG"), check_name(self._path)
        self._writer = cv2.VideoWriter(name, cv2.CAP_FFMPEG, fourcc, fps, size, _RAW)
        #: Whether the writer takes frames that are JPEG already.
        self._takes_jpeg = self._writer.isOpened()
        if not self._takes_jpeg:
            self._writer = cv2.VideoWriter(name, fourcc, fps, size)
        if not self._writer.isOpened():
            self._path.unlink()
            raise UserError(f"{self._path}: OpenCV cannot write this video here")
        self._log = log
        self._session = session
        self._frames = 0
        self._queue: queue.Queue = queue.Queue(maxsize=64)
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._encode, name="video", daemon=True)
        self._thread.start()

    def write(self, time: float, frame: np.ndarray) -> None:
        """Give a frame to the encoder; waits while it is far behind."""
        if self._error is not None:
            raise UserError(f"{self._path}: writing the video failed: {self._error}")
        self._queue.put((time, frame))

    def close(self) -> int:
        """Write the rest, close the file and return the number of frames.

        Raises:
            UserError: if a frame could not be written.
        """
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join()
        self._writer.release()
        if self._error is not None:
            raise UserError(f"{self._path}: writing the video failed: {self._error}")
        return self._frames

    def _encode(self) -> None:
        while (item := self._queue.get()) is not None:
            if self._error is not None:
                continue
            time, frame = item
            try:
                if self._takes_jpeg:
                    frame = cv2.imencode(".jpg", frame, _JPEG)[1].reshape(1, -1)
                self._writer.write(frame)
                if self._log is not None:
                    self._log.append(self._session, self._frames, round(time, 6))
                self._frames += 1
            except Exception as error:
                self._error = error


class Film:
    """A video file of a camera's frames at a steady rate, for players and trackers.

    A webcam's rate varies, and a Motion JPEG file has no times: the rate is measured over the first
    second, and then frames are left out or repeated to keep it.

    Args:
        path: the new ``.avi``.
        size: of the pictures, width and height in pixels.

    Raises:
        UserError: if it exists, or is not an .avi.
    """

    def __init__(self, path: str | Path, size: tuple[int, int]):
        self.path = Path(path)
        if self.path.suffix.lower() != ".avi":
            raise UserError(f"{self.path}: a film is written as Motion JPEG; name an .avi")
        if self.path.exists():
            raise UserError(f"{self.path} exists already; a film is never overwritten")
        self._size = size
        self._first: list[tuple[float, np.ndarray]] = []
        self._sink: VideoSink | None = None
        self._fps, self._frames = 0.0, 0
        self._begun, self._last = 0.0, np.zeros((0, 0, 3), np.uint8)

    def take(self, time: float, frame: np.ndarray) -> None:
        """Take the camera's next frame, time in s."""
        if self._sink is not None:
            self._write(time, frame)
            return
        self._first.append((time, frame))
        if time - self._first[0][0] >= 1.0:
            self._begin()

    def close(self) -> int:
        """Write the rest, close the file and return the number of frames.

        Raises:
            UserError: if a frame could not be written.
        """
        if self._sink is None and self._first:
            self._begin()
        return 0 if self._sink is None else self._sink.close()

    def _begin(self) -> None:
        times = [time for time, _ in self._first]
        span = times[-1] - times[0]
        self._fps = round((len(times) - 1) / span, 2) if span > 0 else 30.0
        self._begun = times[0]
        self._sink = VideoSink(self.path, None, 0, self._size, self._fps)
        for time, frame in self._first:
            self._write(time, frame)
        self._first = []

    def _write(self, time: float, frame: np.ndarray) -> None:
        due = round((time - self._begun) * self._fps)
        while self._frames < due:
            self._sink.write(time, self._last)
            self._frames += 1
        if self._frames == due:
            self._sink.write(time, frame)
            self._frames += 1
        self._last = frame
