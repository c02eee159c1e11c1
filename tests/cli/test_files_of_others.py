"""Artefacts from somebody else that were made to do harm."""

import ast
import json
import os
import re
import socket
import sys
from pathlib import Path

import pytest

import neurosim
from neurosim.base.checkpoint import Checkpoint
from neurosim.base.errors import FileError, UserError
from neurosim.base.files import JsonLines, LineLog, check_no_links, locked, open_own, write_json
from neurosim.cli.main import main
from neurosim.recording.commands import RandomCommands
from neurosim.recording.record import _wanted
from neurosim.recording.settings import RecordSettings
from neurosim.robots.khepera.driver import Khepera
from tracking.camera.cameras import VideoSink
from tracking.datasets.recordings import Recording

links = pytest.mark.skipif(os.name == "nt", reason="links need a right on Windows")


@pytest.fixture
def precious(tmp_path):
    path = tmp_path / "precious.txt"
    path.write_text("mine\n")
    return path


@pytest.fixture
def listener():
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setblocking(False)
        yield server


def recording(folder, options):
    """Make an unfinished recording of a Khepera, such as somebody else could send."""
    about = _wanted(Khepera("x"), None, RandomCommands(), RecordSettings(3))
    return Recording.create(folder, {**about, "options": {"commands": 3, **options}})


def made(command, folder, options):
    """Make the folder that a command resumes, with these options; return the command's words."""
    if command == "record":
        recording(folder / "r", options)
        return ["record", "r", "--resume"]
    if command == "record --guided":
        (folder / "r").mkdir()
        recording(folder / "r" / "round-01", options)
        return ["record", "r", "--resume"]
    if command == "sample":
        content = {"settings": {}, "seed": 0, "robot": {}, "options": options}
        write_json(folder / "s" / "sampling.json", "neurosim-sampling", 2, content)
        return ["sample", "s", "--resume"]
    Checkpoint(folder / "c", "evolution").begin({}, {"real_generations": 1, **options})
    return ["evolve", "sim", "-o", "c", "--resume"]


@pytest.mark.parametrize("command", ["record", "record --guided", "sample", "evolve"])
def test_a_file_does_not_choose_what_is_driven(refused, precious, listener, tmp_path, command):
    port = listener.getsockname()[1]
    for url in (f"spy://loop://?file={precious}", f"socket://127.0.0.1:{port}"):
        folder = tmp_path / url.partition(":")[0]
        folder.mkdir()
        option = "reality" if command == "evolve" else "robot"
        words = made(command, folder, {option: "khepera", "port": url, "camera": "none"})
        os.chdir(folder)
        message = refused(*words)
        assert f"started with --{option} khepera: give it and its options again" in message
        # The robot is named again, and its port is not.
        assert f"--{option} khepera needs --port" in refused(*words, f"--{option}", "khepera")
    assert precious.read_text() == "mine\n"
    with pytest.raises(BlockingIOError):
        listener.accept()


def test_a_file_does_not_choose_the_camera(refused, tmp_path, listener):
    url = f"http://127.0.0.1:{listener.getsockname()[1]}/x.avi"
    made("record", tmp_path, {"robot": "virtual", "camera": url})
    made("sample", tmp_path, {"robot": "virtual-khepera", "camera": url, "calibration": "c.json"})
    # Neither is opened: recording uses the virtual lab's own camera, and sampling uses none.
    assert "was recorded with another robot.kind" in refused("record", "r", "--resume")
    refused("sample", "s", "--resume")
    with pytest.raises(BlockingIOError):
        listener.accept()


def test_a_robot_of_the_lab_is_the_one_it_was_begun_with(refused, tmp_path):
    made("record", tmp_path, {"robot": "virtual-khepera", "lab_seed": 3})
    # The recording is not of a virtual Khepera, whose markers are others than an NXT's.
    assert "markers.front.x (0.07, now 0.014)" in refused("record", "r", "--resume")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"durations": [0.5, {"a": 1}]}, "'--durations': .*expected LOW..HIGH, such as 0.5..3"),
        ({"durations": 7}, "'--durations': .*expected LOW..HIGH, such as 0.5..3"),
        ({"max_speed": {}}, "the options of the first start cannot be read"),
        ({"commands": [1]}, "the options of the first start cannot be read"),
    ],
)
def test_options_of_another_shape(monkeypatch, capsys, tmp_path, options, says):
    monkeypatch.chdir(tmp_path)
    words = made("record", tmp_path, {"robot": "virtual", **options})
    monkeypatch.setattr(sys, "argv", ["neurosim", *words])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code in (1, 2)
    assert re.search(says, capsys.readouterr().err)


def test_a_recording_that_does_not_say_whether_it_is_complete_is_not(tmp_path):
    folder = recording(tmp_path / "r", {}).path
    path = folder / "recording.json"
    content = json.loads(path.read_text())
    content.pop("complete", None)
    path.write_text(json.dumps(content))
    assert Recording(folder).meta["complete"] is False


@pytest.mark.parametrize("port", ["spy://loop://", " SPY:///dev/ttyUSB0", "spy://x?file=y"])
def test_a_spy_is_refused(refused, precious, port):
    if "file" in port:
        port = f"spy://loop://?file={precious}"
    words = ["record", "new", "--robot", "khepera", "--camera", "none", "--port", port]
    assert "it overwrites a file" in refused(*words)
    assert precious.read_text() == "mine\n"


@pytest.mark.parametrize(
    "name", ["../../precious.txt", "/etc/passwd", "..", "", "a/b.avi", "C:x.avi", "a\\b", 7, []]
)
def test_a_video_stands_in_its_recording(tmp_path, name):
    made = recording(tmp_path / "r", {})
    made.meta["videos"] = [name]
    made.save_meta()
    with pytest.raises(FileError, match=r"json, field 'videos.*': expected (the name|text)"):
        Recording(tmp_path / "r")


@links
@pytest.mark.parametrize("command", ["record", "record --guided", "sample"])
def test_what_is_gone_on_with_holds_no_links(refused, precious, tmp_path, command):
    words = made(command, tmp_path, {"robot": "virtual"})
    folder = tmp_path / words[1]
    if command == "sample":
        about = json.loads((folder / "sampling.json").read_text())
        settings = {"angles": 180, "distances": 20, "first": 0.005, "step": 0.002, "repeats": 1}
        about |= {"settings": {**settings, "grid": 0, "held_out": 12, "duration": 1.0}}
        (folder / "sampling.json").write_text(json.dumps({**about, "options": {}}))
    name = "sensors.csv" if command == "sample" else "commands.csv"
    inner = folder / "round-01" if command == "record --guided" else folder
    (inner / name).unlink(missing_ok=True)
    (inner / name).symlink_to(precious)
    if command == "record --guided":
        words += ["--guided", "--commands", "60", "--round", "20", "--calibration", "c.json"]
    message = refused(*words)
    assert f"{name} is a link to {precious}" in message
    assert precious.read_text() == "mine\n"


def _as_link(path, target):
    path.symlink_to(target)


def _as_hard_link(path, target):
    path.hardlink_to(target)


def _as_pipe(path, target):
    os.mkfifo(path)


def _open_lines(path):
    LineLog(path, ("time",)).append(1.0)


def _open_objects(path):
    JsonLines(path, "neurosim-trials", 1, {}).append({})


@links
@pytest.mark.parametrize("put", [_as_link, _as_hard_link, _as_pipe, lambda path, _: path.mkdir()])
def test_a_lock_is_a_plain_file_or_refused(precious, tmp_path, put):
    put(tmp_path / ".lock", precious)
    with pytest.raises(UserError, match=r"\.lock is a "), locked(tmp_path, "recorded into"):
        pass
    assert precious.read_text() == "mine\n"
    assert (tmp_path / ".lock").exists()


@links
@pytest.mark.parametrize("put", [_as_link, _as_hard_link, _as_pipe])
@pytest.mark.parametrize(
    "write", [open_own, lambda path: open_own(path, "wb"), _open_lines, _open_objects]
)
def test_what_grows_in_place_does_not_lead_elsewhere(precious, tmp_path, put, write):
    precious.write_text("")  # so that its content is valid
    put(tmp_path / "log", precious)
    with pytest.raises(UserError, match="log"):
        write(tmp_path / "log")
    assert precious.read_text() == ""


@links
def test_a_new_video_does_not_lead_elsewhere(precious, tmp_path):
    (tmp_path / "video-001.avi").symlink_to(precious)
    with pytest.raises(UserError, match=r"video-001\.avi is a link to"):
        VideoSink(tmp_path / "video-001.avi", None, 1, (64, 48), 30.0)
    assert precious.read_text() == "mine\n"


#: Functions that write to a path that they are given, and where they may be called: in a folder or
#: at a path that ``atomic_path`` or ``new_folder`` made, or after ``open_own``.
_WRITERS = {
    "neurosim/base/files.py": {"write_text", "write_bytes", "open"},
    "neurosim/back_to_reality/run.py": {"copyfile"},
    "neurosim/lab/camera/photographs.py": {"imwrite"},
    "neurosim/recording/record.py": {"copyfile"},
    "neurosim/reports/film.py": {"VideoWriter"},
    "neurosim/robots/nxt/link.py": {"open"},  # the line's device file
    "neurosim/simulators/export.py": {"write_bytes", "save"},
    "neurosim/simulators/tables/samples.py": {"write_bytes"},
    "tracking/camera/cameras.py": {"VideoWriter"},
    "tracking/datasets/lerobot.py": {"open", "write_text"},
    "tracking/datasets/recordings.py": {"copyfile"},
    "tracking/overlay.py": {"VideoWriter"},
}
_NAMES = {"write_bytes", "copyfile", "copytree", "imwrite", "VideoWriter", "to_csv"}


def _calls_that_write(path):
    """Give the names of the functions in a source that write to a path that they are given."""
    for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(call, ast.Call):
            continue
        method = isinstance(call.func, ast.Attribute)
        name = call.func.attr if method else getattr(call.func, "id", "")
        owner = getattr(call.func.value, "id", "") if method else ""
        given = [*call.args[:2], *(k.value for k in call.keywords if k.arg == "mode")]
        modes = {v.value for v in given if isinstance(v, ast.Constant) and isinstance(v.value, str)}
        opens = name == "open" and any(re.fullmatch(r"[wax]b?\+?|r\+b?", mode) for mode in modes)
        # A method of a path, not of neurosim.base.files or of a help formatter.
        writes = method and name == "write_text" and owner not in ("files", "formatter")
        others = (name, owner) in {("save", "export"), ("move", "shutil")}
        if name in _NAMES or opens or writes or others:
            yield name


@pytest.mark.slow
def test_every_place_that_opens_for_writing_is_known():
    root = Path(neurosim.__file__).parents[1]
    results = {}
    for path in sorted([*root.glob("neurosim/**/*.py"), *root.glob("tracking/**/*.py")]):
        if names := set(_calls_that_write(path)):
            results[path.relative_to(root).as_posix()] = names
    unknown = {file: names - _WRITERS.get(file, set()) for file, names in results.items()}
    assert {file: names for file, names in unknown.items() if names} == {}


@links
def test_a_folder_of_files_is_no_folder_of_links(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "b").write_text("")
    check_no_links(tmp_path)
    (tmp_path / "a" / "c").symlink_to("nowhere")
    with pytest.raises(UserError, match="c is a link to nowhere"):
        check_no_links(tmp_path)


@pytest.mark.skipif(os.name == "nt", reason="names are Unicode there")
@pytest.mark.parametrize(
    "words",
    [
        ["track", "\udcff.avi", "-o", "t"],
        ["record", "r", "--camera", "\udcff.avi", "--robot", "khepera", "--port", "loop://"],
        ["calibrate", "\udcff.jpg", "--square", "40"],
        ["record", "\udcff", "--commands", "1"],
    ],
)
@pytest.mark.slow
def test_a_name_that_is_not_utf_8(refused, tmp_path, words):
    for name in (b"\xff.avi", b"\xff.jpg"):
        (tmp_path / os.fsdecode(name)).write_bytes(b"x")
    message = refused(*words)
    assert (
        "the name is not UTF-8" in message
        or "not answer as a Khepera" in message
        or "sends back" in message
    )


@links
@pytest.mark.parametrize(
    "words",
    [
        ["dataset", "loop", "-o", "d"],
        ["train", "loop", "-o", "s"],
        ["report", "loop", "-o", "r.html"],
        ["track", "loop"],
        ["evolve", "loop", "-o", "c"],
        ["dataset", "--from", "csv", "loop", "-o", "d"],
        ["build-tables", "loop", "-o", "t"],
    ],
)
def test_a_link_that_leads_to_itself(refused, tmp_path, words):
    (tmp_path / "loop").symlink_to("loop")
    refused(*words)


def test_an_arena_of_too_many_obstacles(refused, tmp_path):
    square = [[-9, -9], [9, -9], [9, 9], [-9, 9]]
    obstacles = [[0.0, 0.0, 0.001]] * 20_000
    content = {"outline": square, "obstacles": obstacles}
    write_json(tmp_path / "arena.json", "neurosim-place", 1, content)
    message = refused("lab", "khepera", "--place", "arena.json", "--seconds", "1")
    assert "field 'obstacles': expected a list of at most 1,000, found" in message
