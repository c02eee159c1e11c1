"""Mistakes of users: one clear sentence on stderr, exit code 1, and nothing half-written."""

import json
import os
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from khepera_data import made_up
from patience import PATIENCE, wait_until
from processes import neurosim, started

from neurosim.base.files import locked, write_csv, write_json
from neurosim.cli.main import cli, main, run_plugin
from neurosim.lab import VirtualRig
from neurosim.robots.registry import ROBOTS
from neurosim.simulators.tables.samples import Samples
from neurosim.simulators.tables.sensor_table import OBJECTS
from tracking.datasets.dataset import Dataset

ROOT = Path(__file__).resolve().parents[2]

posix = pytest.mark.skipif(os.name == "nt", reason="Windows has no such device files")


@pytest.fixture
def copy(pipeline, tmp_path):
    """Copy parts of the finished pipeline into the folder of the test."""

    def make(name: str):
        target = tmp_path / name
        if (pipeline / name).is_dir():
            shutil.copytree(pipeline / name, target)
        else:
            shutil.copyfile(pipeline / name, target)
        return target

    return make


def edit(path, old, new, count=1):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, count))


# Robots


def test_a_name_that_is_misspelt_is_answered_with_all_names(refused):
    message = refused("record", "r", "--robot", "NXT")
    assert "there is no robot 'NXT'; choose from virtual, virtual-khepera, " in message
    assert " nxt, khepera, " in message
    message = refused("evolve", "s", "-o", "p", "--reality", "robo", "--robot-generations", "2")
    assert "there is no reality 'robo'; choose from " in message
    assert "virtual-walker" in message
    assert " khepera, " in message


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--draws", "9"], "no effect without --robust: --draws"),
        (["--robust-generations", "9"], "no effect without --robust: --robust-generations"),
        (
            ["--optimiser", "cma", "--eta", "3", "--population", "9"],
            "no effect with --optimiser cma: --population, --eta",
        ),
    ],
)
def test_options_of_evolve_without_effect_are_refused(refused, words, says):
    assert says in refused("evolve", "simulator", "-o", "p", *words)


def test_a_missing_controller_is_named_before_a_missing_calibration(refused):
    assert "nothing: no such controller" in refused("run", "nothing", "-o", "trial")


def test_no_brick_is_found(refused, monkeypatch):
    import usb.core

    monkeypatch.setattr(usb.core, "find", lambda **_: iter(()))
    message = refused("record", "r", "--robot", "nxt", "--camera", "none")
    assert "brick" in message
    assert "--host" in message or "Bluetooth" in message


@posix
def test_a_device_file_that_is_no_brick(refused):
    message = refused(
        "record", "r", "--robot", "nxt", "--filename", "/dev/null", "--camera", "none"
    )
    assert "/dev/null" in message


def test_a_robot_that_no_driver_knows(refused):
    message = refused("record", "r", "--robot", "roomba", "--camera", "none")
    assert "'roomba'" in message
    assert "nxt" in message


@posix
def test_a_camera_that_is_not_there(refused):
    from neurosim.lab import Pacer

    with VirtualRig(0, camera=False, device="pty", real_time=True) as rig, Pacer(rig.lab):
        words = ["--robot", "nxt", "--filename", rig.address["filename"]]
        assert "nowhere.mp4" in refused("record", "r", *words, "--camera", "nowhere.mp4")


@pytest.mark.slow
def test_a_brick_that_stops_answering(tmp_path, monkeypatch, capsys):
    from neurosim.lab.nxt import rig as rig_module

    class Dying(VirtualRig):
        def __init__(self, *args, **options):
            super().__init__(*args, **options)
            self.radio.silent_at = 5.0
            handle = self.radio._unheard

            def unheard():
                silent, brick = handle(), self.robot._brick
                if brick is not None:  # nobody waits a minute for a reply that never comes
                    brick._sock._deadline = 0.3 if silent else 5.0
                return silent

            self.radio._unheard = unheard

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("neurosim.trials.rig.VirtualRig", Dying)
    assert rig_module.VirtualRig is not Dying
    monkeypatch.setattr(sys, "argv", ["neurosim", "record", "r", "--commands", "16"])
    with pytest.raises(SystemExit) as stop:
        main()
    message = capsys.readouterr().err
    assert stop.value.code == 1
    assert "stopped answering" in message
    assert "Traceback" not in message
    # The recording is kept, and is continued.
    from tracking.datasets.recordings import Recording

    assert len(Recording(tmp_path / "r").commands())
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    words = ["record", "r", "--resume", "--json"]
    monkeypatch.setattr(sys, "argv", ["neurosim", *words])
    main()
    resumed = json.loads(capsys.readouterr().out)
    assert (resumed["sessions"], resumed["commands"]) == (2, 16)


def test_a_real_robots_option_without_a_real_robot(refused):
    message = refused("record", "r", "--host", "00:16:53:01:02:03", "--commands", 1)
    assert "--robot virtual has no option --host: leave it out, or choose --robot nxt" in message
    assert "--camera" in refused("record", "r", "--camera", "0")


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ("--robot khepera", "--robot khepera needs --port"),
        ("--robot khepera --port /dev/no-such-port", "there is no such port"),
        pytest.param("--robot khepera --port /dev/null", "it is not a serial port", marks=posix),
        ("--robot khepera --port socket://127.0.0.1:1", "nothing listens there"),
        ("--robot khepera --port x --invert", "khepera has no option --invert"),
        ("--robot khepera --port x --host 00", "choose --robot nxt"),
        ("--robot nxt --baud 9600", "choose --robot virtual-khepera or khepera"),
        ("--port x", "choose --robot khepera"),
    ],
)
def test_a_khepera_that_is_not_reached(refused, options, why):
    assert why in refused("record", "new", *options.split(), "--camera", "none")


@pytest.mark.parametrize(
    ("options", "names"),
    [
        (["--lab-seed", "1"], "virtual_lab.robot_seed"),
        (["--camera-size", "320x240"], "pictures of 640x480"),
        (["--fps", "30"], "camera.fps"),
        (["--lamp", "color:3"], "robot.ports.lamp"),
        (["--seed", "9"], "settings.source.seed"),
    ],
)
def test_a_recording_resumed_as_another(refused, copy, options, names):
    edit(copy("recording") / "recording.json", '"complete": true', '"complete": false')
    words = ["record", "recording", "--commands", "60", "--fps", "20", "--seed", "4", "--resume"]
    assert names in refused(*words, *options)


def test_a_calibration_is_looked_at_before_anything_moves(refused, copy, tmp_path):
    copy("controller")
    (tmp_path / "bad.json").write_text("{}")
    for name in ("bad.json", "none.json"):
        assert name in refused("record", "r", "--calibration", name)
        assert name in refused("run", "controller", "-o", "t", "--calibration", name)
    copy("calibration.json")
    words = ["record", "r", "--calibration", "calibration.json", "--camera-size", "320x240"]
    assert "640x480" in refused(*words)
    copy("photographs")
    monkey = json.loads((tmp_path / "calibration.json").read_text())
    monkey["rotation"] = monkey["translation"] = monkey["homography"] = None
    (tmp_path / "lens.json").write_text(json.dumps(monkey))
    message = refused("run", "controller", "-o", "t", "--calibration", "lens.json")
    assert "lens.json" in message


def test_a_plan_is_planned_again_in_a_simulator_only(refused, copy, tmp_path):
    copy("controller")
    copy("calibration.json")
    words = ["run", "controller", "-o", "t", "--calibration", "calibration.json"]
    # The simulator is not where it was, or was changed since.
    file = tmp_path / "controller" / "controller.json"
    plan = json.loads(file.read_text())
    plan["simulator"]["path"] = "elsewhere"
    file.write_text(json.dumps(plan))
    assert "name one with --simulator" in refused(*words, "--replan")
    plan["task"] = {"name": "go-to", "settings": {}}
    file.write_text(json.dumps(plan))
    assert "(--no-replan)" in refused(*words)
    assert "need --replan" in refused(*words, "--no-replan", "--think", "0.2")
    copy("simulator")
    for option, value in (("--replan-generations", "0"), ("--push", "3")):
        finished = CliRunner().invoke(cli, [*words, "--simulator", "simulator", option, value])
        assert finished.exit_code == 2
        assert f"Invalid value for '{option}'" in finished.output


def test_markers_that_the_virtual_robot_does_not_carry(refused):
    assert "pink and blue" in refused("record", "r", "--markers", "green,orange")
    assert "mauve" in refused("record", "r", "--markers", "mauve,blue")


@pytest.mark.slow
@posix
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_closed_terminal_stops_the_motors(tmp_path, name):
    """A robot that runs in real time in this process, recorded by another process."""
    import signal

    from neurosim.lab import Pacer

    with VirtualRig(0, camera=False, device="pty", real_time=True) as rig, Pacer(rig.lab):
        words = ["record", "r", "--robot", "nxt", "--filename", rig.address["filename"]]
        words += ["--camera", "none", "--stopped", "0", "--durations", "2..3", "--commands", "20"]
        child = started(*words, cwd=tmp_path)
        log = tmp_path / "r" / "commands.csv"
        wait_until(lambda: log.exists() and ",command," in log.read_text(), "a command")
        wait_until(lambda: turned(rig) != (0, 0), "the robot's first turn of a wheel")
        child.send_signal(getattr(signal, name))
        _, stderr = child.communicate(timeout=PATIENCE)
        assert child.returncode == 128 + getattr(signal, name)
        assert "interrupted" in stderr
        assert "Traceback" not in stderr
        # In the lab's time, which is late on a busy computer.
        now = rig.lab.clock.now()
        rig.lab.clock.sleep_until(now + 0.7)
        at_rest = turned(rig)
        rig.lab.clock.sleep_until(now + 1.0)
        assert turned(rig) == at_rest


def turned(rig):
    """Return how far the motors have turned, degrees."""
    with rig.lab.lock:
        return tuple(rig.lab.body.output(port).rotation_count for port in (1, 2))


PLUGIN = """
import neurosim
from neurosim.base.errors import RobotError

class Other:
    \"\"\"A robot of somebody's own.

    Args:
        channel: radio channel. Any.
        gain: of its radio.
    \"\"\"

    def __init__(self, channel: str, gain: float = 1.5):
        self.where = f"{channel} at {gain:g}"

    def connect(self):
        raise RobotError(f"nothing on channel {self.where}")

    def close(self):
        pass

neurosim.register("robot", "other", Other)
"""


def test_a_robot_of_a_plug_in_has_options_of_its_own(refused, tmp_path, monkeypatch):
    monkeypatch.setattr(ROBOTS, "_registered", dict(ROBOTS._registered))
    (tmp_path / "mine.py").write_text(PLUGIN)
    words = ["--plugin", "mine.py", "record", "r", "--robot", "other", "--camera", "none"]
    assert "--robot other needs --channel: radio channel" in refused(*words)
    assert "nothing on channel 7 at 1.5" in refused(*words, "--channel", "7")
    assert "nothing on channel 7 at 2" in refused(*words, "--channel", "7", "--gain", "2")
    assert "choose --robot nxt" in refused(*words, "--channel", "7", "--host", "00:16")
    shown = CliRunner().invoke(cli, [*words, "--help"]).stdout
    assert "--gain FLOAT    Of its radio.  [default: 1.5]" in shown


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (None, "p.py: no such file; --plugin takes a Python file"),
        ("x = 1\ny = = 2\n", "p.py, line 2: does not run: invalid syntax"),
        ("x = 1\n\nx / 0\n", "p.py, line 3: does not run: ZeroDivisionError: division by zero"),
        ("import nothing_like_it\n", "p.py, line 1: does not run: ModuleNotFoundError: No module"),
        (
            "import neurosim as ns\nns.register('task', 'go-to', 1)\n",
            "p.py, line 2: the name 'go-to' is taken by neurosim's own task",
        ),
    ],
)
def test_a_plug_in_that_does_not_run(refused, tmp_path, text, says):
    if text is not None:
        (tmp_path / "p.py").write_text(text)
    assert says in refused("--plugin", "p.py", "dataset", "r", "-o", "d")


def test_a_plug_in_is_named_like_a_module_of_python_and_imports_what_is_beside_it(
    tmp_path, monkeypatch
):
    (tmp_path / "random.py").write_text("import beside_it\nimport json\nbeside_it.seen.append(1)\n")
    (tmp_path / "beside_it.py").write_text("seen = []\n")
    monkeypatch.setattr(sys, "path", [*sys.path])
    run_plugin(tmp_path / "random.py")
    import random

    assert random.random() < 1
    assert sys.modules["beside_it"].seen == [1]


@pytest.mark.parametrize("seconds", ["nan", "inf", "-1", "0"])
def test_a_time_that_is_none(monkeypatch, capsys, seconds):
    monkeypatch.setattr(sys, "argv", ["neurosim", "watch", "--camera", "lab", "--seconds", seconds])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 2
    assert "--seconds" in capsys.readouterr().err


# Recordings and videos


def test_a_recording_that_another_process_makes(refused, tmp_path):
    (tmp_path / "recording").mkdir()
    with locked(tmp_path / "recording", "recorded into"):
        for words in (["track", "recording"], ["dataset", "recording", "-o", "new"]):
            assert f"recording is being recorded into by process {os.getpid()}" in refused(*words)


def test_a_folder_that_is_not_empty(refused, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "precious").write_text("x")
    assert "mine is not empty" in refused("record", "mine", "--commands", 5)
    assert "no recording or video file" in refused("track", "nothing")


def make_video(path, frames):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, (640, 480))
    for frame in frames:
        writer.write(frame)
    writer.release()


def test_a_video_without_markers(refused, copy):
    video = copy("recording") / "video-001.avi"
    make_video(video, [np.full((480, 640, 3), 90, np.uint8)] * 60)
    message = refused("track", "recording")
    assert "video-001.avi" in message
    assert "pink" in message


def test_a_video_without_a_flash(refused, copy):
    recording = copy("recording")
    capture = cv2.VideoCapture(str(recording / "video-001.avi"))
    frames = [capture.read()[1] for _ in range(400)]
    make_video(recording / "video-001.avi", frames[120:])
    (recording / "frames.csv").unlink()
    message = refused("track", "recording")
    assert "flash" in message


def test_a_video_of_zero_frames(refused, copy):
    video = copy("recording") / "video-001.avi"
    make_video(video, [])
    assert "video-001.avi" in refused("track", "recording")
    video.write_bytes(b"")
    assert "video-001.avi" in refused("track", "recording")
    video.unlink()
    assert "video-001.avi" in refused("track", "recording")


def test_a_video_that_was_cut_short(refused, copy, monkeypatch, capsys):
    video = copy("recording") / "video-001.avi"
    whole = video.read_bytes()
    video.write_bytes(whole[: len(whole) // 2])
    message = refused("track", "recording")
    assert "video-001.avi ends after" in message
    assert "--partial" in message
    # The part that exists can be used.
    monkeypatch.setattr(sys, "argv", ["neurosim", "track", "recording", "--partial", "--json"])
    main()
    capsys.readouterr()
    monkeypatch.setattr(sys, "argv", ["neurosim", "dataset", "recording", "-o", "d", "--json"])
    main()
    made = json.loads(capsys.readouterr().out)
    assert 15 < made["rows"] < 50
    assert made["left_out"]["incomplete"] > 5


@pytest.mark.parametrize("rows", [0, 200])
def test_frame_times_that_were_cut_short(refused, copy, rows):
    path = copy("recording") / "frames.csv"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[: 1 + rows]))
    message = refused("track", "recording")
    assert (
        f"frames.csv: has {rows} rows of session 1, but video-001.avi has {len(lines) - 1}"
        in message
    )


def test_a_clock_that_goes_backwards(refused, copy):
    path = copy("recording") / "commands.csv"
    lines = path.read_text().splitlines()
    lines[20], lines[21] = lines[21], lines[20]
    path.write_text("\n".join(lines) + "\n")
    for words in (("track", "recording"), ("dataset", "recording", "-o", "d")):
        message = refused(*words)
        assert "line 22" in message
        assert "backwards" in message


@pytest.mark.parametrize(
    ("name", "old", "new", "says"),
    [
        ("poses.csv", "theta", "angle", "field 'theta': this column is missing"),
        ("poses.csv", "\n1,3,", "\n1,three,", "line 5, field 'frame': expected a whole number"),
        ("commands.csv", "lamp-on,", "lamp-on,nan", "line 2, field 'time': expected a finite"),
    ],
)
def test_a_table_that_is_wrong_somewhere(refused, copy, name, old, new, says):
    edit(copy("recording") / name, old, new)
    message = refused("dataset", "recording", "-o", "d")
    assert name in message
    assert says in message


def test_a_recording_that_was_not_tracked(refused, copy):
    (copy("recording") / "poses.csv").unlink()
    assert "neurosim track" in refused("dataset", "recording", "-o", "d")


# Datasets, simulators, controllers


def test_a_dataset_too_small_to_split(refused, copy, tmp_path):
    whole = Dataset.read(copy("dataset"))
    shutil.rmtree(tmp_path / "dataset")
    whole.part(slice(5)).write(tmp_path / "dataset")
    assert "record more commands" in refused("train", "dataset", "-o", "s", "--members", 2)


@pytest.mark.parametrize("word", ["nan", "fast", ""])
def test_a_word_where_a_number_belongs(refused, copy, word):
    path = copy("dataset") / "dataset.csv"
    lines = path.read_text().splitlines()
    fields = lines[7].split(",")
    fields[lines[0].split(",").index("dx")] = word
    lines[7] = ",".join(fields)
    path.write_text("\n".join(lines) + "\n")
    message = refused("train", "dataset", "-o", "s", "--members", 2)
    assert "line 8, field 'dx'" in message


def test_a_simulator_of_another_version_or_cut_in_half(refused, copy):
    simulator = copy("simulator")
    copy("dataset")
    weights = simulator / "weights.safetensors"
    whole = weights.read_bytes()
    weights.write_bytes(whole[: len(whole) // 2])
    assert "cut short" in refused("evaluate", "simulator", "dataset")
    weights.write_bytes(whole)
    text = (simulator / "simulator.json").read_text()
    (simulator / "simulator.json").write_text(text[: len(text) // 2])
    assert "simulator.json, line" in refused("evolve", "simulator", "-o", "c")
    document = json.loads(text)
    document["version"] = 99
    (simulator / "simulator.json").write_text(json.dumps(document))
    assert "found 99" in refused("evolve", "simulator", "-o", "c")


def test_a_controller_that_is_no_controller(refused, copy):
    copy("simulator")
    assert "controller" in refused(
        "run", "simulator", "-o", "t", "--calibration", "calibration.json"
    )


def test_a_report_of_nothing(refused, tmp_path):
    (tmp_path / "photos").mkdir()
    assert "photos" in refused("report", "photos")


def test_points_that_fix_no_board(refused, copy, tmp_path):
    copy("photographs")
    write_csv(
        tmp_path / "points.csv", {"u": [1, 2, 3], "v": [1, 2, 3], "x": [0, 1, 2], "y": [0, 1, 2]}
    )
    message = refused(
        "calibrate", "photographs", "--square", 40, "--points", "points.csv", "-o", "c"
    )
    assert "points" in message
    done = CliRunner().invoke(cli, ["calibrate", "photographs", "--point", "1,2,3"])
    assert (done.exit_code, "'1,2,3': expected U,V,X,Y" in done.stderr) == (2, True)
    assert "--board needs --corners" in refused("calibrate", "photographs", "--board", "1x1")


def test_a_demo_that_is_a_file_or_was_begun_otherwise(refused, tmp_path):
    (tmp_path / "FILE").touch()
    assert "FILE is a file; name a folder" in refused("demo", "FILE")
    write_json(tmp_path / "d" / "demo.json", "neurosim-demo", 3, {"commands": 400, "seed": 0})
    assert "was started with --commands 400, not 60" in refused("demo", "d", "--commands", 60)
    assert "was started with --seed 0, not 1" in refused("demo", "d", "--seed", 1)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "precious").touch()
    assert "mine is not empty" in refused("demo", "mine")
    (tmp_path / "e" / "recording").mkdir(parents=True)
    assert "is not the folder of a demo" in refused("demo", "e")


def test_a_report_of_a_simulator_whose_weights_are_damaged(refused, copy):
    weights = copy("simulator") / "weights.safetensors"
    weights.write_bytes(weights.read_bytes()[:-100])
    assert "weights.safetensors" in refused("report", "simulator")


def test_a_dataset_of_two_robots(refused, copy, tmp_path):
    copy("recording").rename(tmp_path / "a")
    edit(copy("recording") / "recording.json", '"robot_seed": 0', '"robot_seed": 1')
    message = refused("dataset", "a", "recording", "-o", "d")
    assert "a and recording are of different robots (robot of the lab: 0 and 1)" in message
    assert "--mixed" in message


@pytest.mark.parametrize("by", ["cause", "context"])
def test_ctrl_c_within_compiled_code_is_an_interruption_however_often_it_is_wrapped(
    monkeypatch, capsys, by
):
    def wrapped(**_):
        error = KeyboardInterrupt()
        for _ in range(2):
            outer = SystemError("returned a result with an exception set")
            setattr(outer, f"__{by}__", error)
            error = outer
        raise error

    monkeypatch.setattr(cli, "main", wrapped)
    monkeypatch.setattr(sys, "argv", ["neurosim", "evolve", "simulator"])
    with pytest.raises(SystemExit) as stop:
        main()
    message = capsys.readouterr().err
    assert stop.value.code == 130
    assert message.count("\n") == 1
    assert "run the command again with --resume" in message


@pytest.mark.parametrize("begun", ["", "new", "new.checkpoint"])
def test_an_interruption_names_resume_where_something_was_saved(
    begun, monkeypatch, capsys, tmp_path
):
    def interrupted(**_):
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    (tmp_path / begun).mkdir(exist_ok=True)
    monkeypatch.setattr(cli, "main", interrupted)
    for out in (["-o", "new"], ["-onew"], ["--out=new"]):
        monkeypatch.setattr(sys, "argv", ["neurosim", "evolve", "simulator", *out])
        with pytest.raises(SystemExit):
            main()
        assert ("--resume" in capsys.readouterr().err) == bool(begun)


def test_a_system_error_that_is_no_interruption_is_raised(monkeypatch):
    def failing(**_):
        raise SystemError("something else") from ValueError("x")

    monkeypatch.setattr(cli, "main", failing)
    with pytest.raises(SystemError, match="something else"):
        main()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("evolve", "{tables}", "--task", "obstacle-avoidance", "--elites", 500), "elites"),
        (("train", "{dataset}", "--without", "product_units"), "without: expected laws"),
    ],
)
def test_settings_that_cannot_be(refused, tmp_path, words, says):
    from simulators_of_tests import tables

    (tmp_path / "tables").mkdir()
    tables().write(tmp_path / "tables")
    places = {"tables": tmp_path / "tables", "dataset": ROOT / "data" / "reference"}
    words = [str(word).format(**places) for word in words]
    assert says in refused(*words, "-o", tmp_path / "out")


def test_a_demo_goes_on_where_it_stopped(tmp_path):
    """Finished stages are not repeated; an interrupted trial is kept, and driven again."""
    from neurosim.cli.demo import _steps

    for name in ("photographs", "dataset", "simulator", "controller", "trial", "replanned"):
        (tmp_path / name).mkdir()
    (tmp_path / "calibration.json").touch()
    (tmp_path / "trial" / "trial.json").touch()
    (tmp_path / "replanned" / "commands.csv").touch()
    record, evaluate, check, run, report = _steps(tmp_path, 100, 3)
    assert record[:2] == ["record", tmp_path / "recording"]
    assert (evaluate[0], check[0]) == ("evaluate", "plan-check")
    assert run[:3] == ["run", tmp_path / "controller", "--replan"]
    assert (tmp_path / "interrupted-replanned-1" / "commands.csv").exists()
    assert report[4:6] == [tmp_path / "trial", tmp_path / "replanned"]


@pytest.mark.slow
def test_what_numpy_warns_of_does_not_reach_the_terminal(tmp_path):
    table = made_up()
    samples = [tmp_path / f"{name}.sample" for name in OBJECTS]
    for mean, path in zip(table.mean, samples, strict=True):
        Samples(mean, 0.005, 0.005).write(path)
    rows = [f"{left},{right},1e-320,1000,0,1" for left in (-100, 100) for right in (-100, 100)]
    motors = tmp_path / "motors.csv"
    motors.write_text("\n".join(["left,right,duration,dx,dy,dtheta", *rows, ""]))
    words = ["build-tables", *samples, "--motors", motors, "-o", tmp_path / "s"]
    child = neurosim(*words, cwd=tmp_path, check=False)
    assert child.returncode == 1
    stderr = child.stderr.splitlines()
    assert len(stderr) == 1
    assert "the samples at left -100 %, right -100 % give no speed" in stderr[0]
