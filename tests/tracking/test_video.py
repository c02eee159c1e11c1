"""Files that are not a video, or are incomplete."""

import struct
import wave

import cv2
import numpy as np
import pytest
import tracking_scene as scene
from click.testing import CliRunner

from neurosim.base.errors import FileError, UserError
from neurosim.cli.track import track as command
from tracking.camera.cameras import VideoSink
from tracking.camera.video import Video

SIZE, FRAMES = (160, 120), 60


@pytest.fixture(scope="module")
def frames():
    rng, background = np.random.default_rng(0), scene.background(SIZE)
    made = []
    for i in range(FRAMES):
        image = background.copy()
        scene.robot(image, np.array([50.0 + i, 60.0]), 0.02 * i, body=(48, 18))
        made.append(scene.finish(image, rng))
    return made


def write(path, frames, codec):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 30.0, SIZE)
    for frame in frames:
        writer.write(frame)
    writer.release()
    return path


def boxes(data):
    """The boxes of an MP4 file by their kind."""
    result, place = {}, 0
    while place < len(data):
        length, kind = struct.unpack(">I4s", data[place : place + 8])
        result[kind] = data[place : place + length]
        place += length
    return result


def index_first(data):
    """An MP4 file as phones and web pages store it: the index before the frames."""
    parts = boxes(data)
    index = bytearray(parts[b"moov"])
    table = index.find(b"stco")
    (count,) = struct.unpack(">I", index[table + 8 : table + 12])
    offsets = struct.unpack(f">{count}I", index[table + 12 : table + 12 + 4 * count])
    moved = [offset + len(index) for offset in offsets]
    index[table + 12 : table + 12 + 4 * count] = struct.pack(f">{count}I", *moved)
    rest = b"".join(part for kind, part in parts.items() if kind not in (b"ftyp", b"moov"))
    return parts[b"ftyp"] + bytes(index) + rest


@pytest.mark.parametrize(("name", "codec"), [("a.mp4", "mp4v"), ("a.mkv", "mp4v")])
def test_a_video_that_was_cut_short_is_not_tracked_as_a_shorter_one(tmp_path, frames, name, codec):
    path = write(tmp_path / name, frames, codec)
    data = path.read_bytes()
    data = index_first(data) if path.suffix == ".mp4" else data
    path.write_bytes(data)
    with Video(path) as video:
        assert sum(1 for _ in video) == FRAMES
        assert video.missing == 0
    path.write_bytes(data[: len(data) * 6 // 10])
    with Video(path) as video:
        there = sum(1 for _ in video)
        assert 0 < there < FRAMES - 10
        assert video.missing == FRAMES - there
    done = CliRunner().invoke(command, [str(path), "-o", str(tmp_path / "out")])
    assert isinstance(done.exception, UserError)
    assert f"ends after {there} of {FRAMES} frames" in str(done.exception)
    assert not (tmp_path / "out").exists()
    done = CliRunner().invoke(command, [str(path), "-o", str(tmp_path / "out"), "--partial"])
    assert done.exit_code == 0, done.exception
    assert f"{there} frames" in done.stdout


def test_a_video_that_is_left_early_misses_nothing(tmp_path, frames):
    path = write(tmp_path / "a.avi", frames, "MJPG")
    with Video(path) as video:
        for index, _, _ in video:
            if index == 3:
                break
    assert video.missing == 0


def test_an_mp4_without_its_index(tmp_path, frames):
    path = write(tmp_path / "a.mp4", frames, "mp4v")
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(FileError, match="whose index, at its end, is missing"):
        Video(path)


def test_a_codec_that_cannot_be_decoded_is_named(tmp_path, frames):
    path = write(tmp_path / "my clip.mp4", frames, "mp4v")
    data = path.read_bytes()
    assert data.count(b"mp4v") == 1
    path.write_bytes(data.replace(b"mp4v", b"av01").replace(b"esds", b"free"))
    with pytest.raises(FileError, match="is AV1 video") as raised:
        Video(path)
    assert "ffmpeg -i 'my clip.mp4' -c:v libx264 -crf 18 'my clip-h264.mp4'" in str(raised.value)


@pytest.mark.parametrize(
    ("name", "begin", "kind"),
    [
        ("a.mp3", b"ID3\x04\x00", "MP3"),
        ("a.flac", b"fLaC\x00\x00", "FLAC"),
        ("a.ogg", b"OggS\x00\x02", "Ogg"),
        ("a.m4a", b"\x00\x00\x00\x1cftypM4A \x00\x00\x02\x00", "MPEG-4 audio"),
        ("a.mp4", b"\x00\x00\x00\x1cftypisom" + 20 * b"\x00" + b"hdlrsoun", "MPEG-4 audio"),
        ("a.webm", b"\x1aE\xdf\xa3" + 20 * b"\x00" + b"A_OPUS", "WebM audio"),
    ],
)
def test_sound_alone_is_called_so(tmp_path, name, begin, kind):
    path = tmp_path / name
    path.write_bytes(begin + bytes(3000))
    with pytest.raises(FileError, match="is sound alone") as raised:
        Video(path)
    assert kind in str(raised.value)


def test_a_wav_file(tmp_path):
    with wave.open(str(tmp_path / "a.wav"), "wb") as file:
        file.setparams((1, 2, 8000, 0, "NONE", ""))
        file.writeframes(bytes(4000))
    with pytest.raises(FileError, match=r"is sound alone \(WAV\)"):
        Video(tmp_path / "a.wav")


def chunks(data):
    """Give the places of an AVI's frames in its bytes: first and last."""
    at = data.index(b"movi") + 4
    while data[at : at + 4] == b"00dc":
        (size,) = struct.unpack("<I", data[at + 4 : at + 8])
        yield at + 8, at + 8 + size
        at += 8 + size + size % 2


def test_a_recordings_frames_are_as_ffmpeg_decodes_them_also_where_they_are_cut(tmp_path, frames):
    path = tmp_path / "a.avi"
    sink = VideoSink(path, None, 1, SIZE, 30.0)
    for frame in frames:
        sink.write(0.0, frame)
    assert sink.close() == FRAMES
    data = bytearray(path.read_bytes())
    places = list(chunks(data))
    assert len(places) == FRAMES
    first, last = places[5]
    left = (last - first) // 2 & ~1
    junk = b"JUNK" + struct.pack("<I", last - first - left - 8)  # in place of the lower half
    data[first - 4 : first] = struct.pack("<I", left)
    data[first + left : first + left + 8] = junk
    cut = sum(places[-3]) // 2
    path.write_bytes(data[:cut])
    capture = cv2.VideoCapture(str(path))
    expected = [capture.read()[1] for _ in range(FRAMES)]
    with Video(path) as video:
        seen = list(video)
        assert np.array_equal(video.at(7), expected[7])
    assert len(seen) == sum(frame is not None for frame in expected) == FRAMES - 2
    for (index, time, frame), other in zip(seen, expected, strict=False):
        assert time == pytest.approx(index / 30, abs=1e-3)
        apart = np.abs(frame.astype(int) - other)
        assert apart.max() <= (0 if index in (5, FRAMES - 3) else 5)
