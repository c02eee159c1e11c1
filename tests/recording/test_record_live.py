"""Recording with live tracking, in the lab; the lab's true poses serve the comparison only."""

import itertools
import os
import shutil
import signal
from dataclasses import replace
from urllib.request import urlopen

import numpy as np
import pytest
from patience import PATIENCE, wait_until
from processes import ended_by, started
from slow_camera import delay

from neurosim.base.errors import FileError, UserError
from neurosim.lab import VirtualRig, read_truth
from neurosim.recording.commands import Command, FixedCommands, RandomCommands
from neurosim.recording.record import Guard, RecordSettings, Rig, record
from neurosim.robots.nxt.driver import NXT
from tracking.camera.camera_model import CameraModel
from tracking.datasets.recordings import Recording
from tracking.sightings import seen_live
from tracking.track import track

SIZE = (320, 240)
#: Half a board: the guard has its work without long drives.
BOARD = {"length": 1.4, "width": 1.1}


def calibrate(rig, path):
    optics = rig.camera.optics
    optics.calibration.write(path)


def make(folder, source, count, *, sensors=False, prepare=None, **options):
    """Record in the lab; return the recording, the messages, and the truth."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    messages = []
    settings = options.pop("settings", {"board": BOARD})
    with VirtualRig(2, noise_seed=options.pop("seed", 5), camera_size=SIZE) as rig:
        calibration = folder.parent / "calibration.json"
        calibrate(rig, calibration)
        robot = rig.robot
        if not sensors:
            robot = NXT(
                clock=rig.lab.clock, lamp="A", light_left=None, light_right=None, deadline=60.0,
                **rig.address,
            )  # fmt: skip
        if prepare is not None:
            prepare(rig)
        made = record(
            folder,
            replace(Rig.of_lab(rig), robot=robot),
            source,
            RecordSettings(count, **settings),
            calibration=calibration,
            say=messages.append,
            **options,
        )
    return made, messages, read_truth(folder)


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """A robot without light sensors, on a small board."""
    folder = tmp_path_factory.mktemp("live") / "recording"
    return make(folder, RandomCommands(seed=3), 16)


def test_a_robot_without_light_sensors_stays_on_the_board(kept):
    recording, message, truth = kept
    kinds = [line.kind for line in recording.commands().itertuples()]
    assert kinds.count("cut") >= 2
    half = np.array([BOARD["length"], BOARD["width"]]) / 2
    assert (np.abs(truth.poses[:, :2]) < half - Guard().margin + 0.02).all()
    assert recording.meta["complete"] is True
    assert message == []
    turns = {np.sign(line.right) for line in recording.commands().itertuples()
             if line.kind == "manoeuvre" and line.left == -line.right != 0}  # fmt: skip
    assert turns == {-1.0, 1.0}


@pytest.mark.slow
def test_light_sensors_that_see_no_line_do_not_let_it_leave(tmp_path):
    # The line that the lab's sensors could see lies well outside of this board's edge.
    recording, _, truth = make(tmp_path / "r", RandomCommands(seed=3), 10, sensors=True)
    assert recording.meta["robot"]["ports"]["light_left"] is not None
    assert [line.kind for line in recording.commands().itertuples()].count("cut") >= 1
    half = np.array([BOARD["length"], BOARD["width"]]) / 2
    assert (np.abs(truth.poses[:, :2]) < half - Guard().margin + 0.02).all()
    assert recording.is_tracked


def test_the_poses_are_there_and_are_what_a_second_pass_gives(kept, tmp_path):
    recording, _, truth = kept
    live = recording.poses()
    assert (live.quality > 0).mean() > 0.99
    copy = tmp_path / "again"
    shutil.copytree(recording.path, copy)
    track(copy)
    again = Recording(copy).poses()
    assert np.array_equal(live.frame, again.frame)
    assert np.abs(live.time - again.time).max() < 1e-3
    both = (live.quality > 0) & (again.quality > 0)
    # They differ by the compression of the second, at 1 cm a pixel.
    off = (live.pose - again.pose)[both]
    assert np.sqrt((off[:, :2] ** 2).mean()) < 4e-4
    true = truth.pose_at(live.time[both])
    assert np.sqrt(((live.pose[both] - true)[:, :2] ** 2).mean()) < 4e-3


@pytest.mark.slow
def test_the_same_seed_gives_the_same_files(kept, tmp_path):
    first, _, _ = kept
    second, _, _ = make(tmp_path / "recording", RandomCommands(seed=3), 16)
    for name in ("commands.csv", "frames.csv", "sightings.csv", "poses.csv", "tracking.json"):
        assert (first.path / name).read_bytes() == (second.path / name).read_bytes(), name


@pytest.mark.slow
def test_frames_that_were_passed_over_are_looked_at_in_the_video(kept, tmp_path):
    recording, _, _ = kept
    camera = CameraModel.read(recording.path / "calibration.json")
    whole = seen_live(recording, 1, camera)
    copy = tmp_path / "gaps"
    shutil.copytree(recording.path, copy)
    lines = (copy / "sightings.csv").read_text().splitlines(keepends=True)
    missing = [*range(60), *range(200, 230), 301, len(lines) - 2]
    kept_lines = [line for number, line in enumerate(lines, start=-1) if number not in missing]
    (copy / "sightings.csv").write_text("".join(kept_lines))
    filled = seen_live(Recording(copy), 1, camera)
    assert np.array_equal(filled.frame, whole.frame)
    rest = np.setdiff1d(whole.frame, missing)
    np.testing.assert_array_equal(filled.front[rest], whole.front[rest])
    assert (filled.quality[missing] > 0).all()
    assert np.abs(filled.front[missing] - whole.front[missing]).max() < 0.5


def test_sightings_of_a_killed_session_are_kept_without_its_video(kept, tmp_path):
    recording, _, _ = kept
    camera = CameraModel.read(recording.path / "calibration.json")
    copy = tmp_path / "killed"
    shutil.copytree(recording.path, copy)
    (copy / "video-001.avi").write_bytes(b"")
    with pytest.raises(FileError, match="cannot be opened as a video"):
        seen_live(Recording(copy), 1, camera)
    lines = (copy / "commands.csv").read_text().splitlines(keepends=True)
    (copy / "commands.csv").write_text("".join(line for line in lines if ",end," not in line))
    sightings, whole = (seen_live(one, 1, camera) for one in (Recording(copy), recording))
    np.testing.assert_array_equal(sightings.front, whole.front)
    assert sightings.markers == {"front": {"colour": "pink"}, "rear": {"colour": "blue"}}


def test_a_camera_that_does_not_wait_is_never_slowed_and_misses_nothing_in_the_end(tmp_path):
    def impatient(rig):
        rig.camera.waits = False

    source = FixedCommands([Command((20, 25), 1.0)] * 4)
    made, _, _ = make(
        tmp_path / "r", source, 4, prepare=impatient, settings={"guard": Guard("ignore")}
    )
    poses = made.poses()
    assert len(poses.frame) == len(made.frame_times(1))
    assert (poses.quality > 0).mean() > 0.95


def taken_away(begin, end):
    """Return a function that makes a hand cover the lab's robot from ``begin`` to ``end`` (s)."""

    def prepare(rig):
        render = rig.camera.render
        rig.camera.render = lambda poses, lamp=0.0: render(
            None if begin < rig.lab.time < end else poses, lamp
        )

    return prepare


STEADY = FixedCommands([Command((15, 18), 1.0)] * 8)


@pytest.mark.slow
def test_a_robot_that_is_lost_is_told_of_at_once_and_without_sensors_stopped(tmp_path):
    away = taken_away(6.0, 12.0)
    recording, message, truth = make(tmp_path / "r", STEADY, 8, prepare=away, settings={})
    assert message[0].startswith("the robot is lost from sight")
    assert "the robot is not seen, and cannot drive unseen" in message[1]
    assert message[2].startswith("the robot is seen again, after 6.")
    assert len(message) == 3
    cut = [line for line in recording.commands().itertuples() if line.kind == "cut"]
    assert len(cut) == 1
    assert 6.9 < cut[0].time < 7.2
    still = (truth.times > cut[0].time + 0.4) & (truth.times < 12.0)
    assert np.ptp(truth.poses[still, :2], axis=0).max() < 1e-3
    # In the end all commands were sent, the interrupted one twice.
    sent = [line.command for line in recording.commands().itertuples() if line.kind == "command"]
    assert sorted(set(sent)) == list(range(8))
    assert len(sent) == 9


@pytest.mark.slow
def test_with_light_sensors_it_drives_on(tmp_path):
    recording, message, _ = make(
        tmp_path / "r", STEADY, 4, sensors=True, prepare=taken_away(5.0, 7.0)
    )
    assert [line.kind for line in recording.commands().itertuples() if line.is_motor] == [
        "command"
    ] * 4 + ["stop"]
    # It drove on unseen for more than 2 s, and the stretch seen then is too short to identify it.
    lost, again, warning = message
    assert "lost from sight" in lost
    assert "seen again" in again
    poses = recording.poses()
    away = (poses.time > 5.1) & (poses.time < 6.9)
    assert (poses.quality[away] == 0).all()
    assert np.isnan(poses.pose[away]).all()
    assert poses.doubtful.tolist() == ((poses.time > 6.9) & (poses.quality > 0)).tolist()
    assert warning.startswith(f"{poses.doubtful.sum()} poses may be of another pair")


@pytest.mark.slow
def test_a_robot_that_stays_away_ends_the_session_which_resumes(tmp_path):
    folder = tmp_path / "r"
    with pytest.raises(UserError, match=r"not seen for 60 s.*--resume"):
        make(folder, STEADY, 8, prepare=taken_away(6.0, np.inf))
    broken = Recording(folder)
    assert broken.meta["complete"] is False
    assert not broken.is_tracked
    assert broken.commands()["kind"].iloc[-1] == "stop"
    recording, _, _ = make(folder, STEADY, 8, resume=True, seed=6)
    assert recording.meta["complete"] is True
    poses = recording.poses()
    assert set(poses.session) == {1, 2}
    assert len(poses.of_session(1).frame) == len(recording.frame_times(1))


@pytest.mark.slow
def test_a_robot_that_was_never_in_sight_does_not_drive(tmp_path):
    with pytest.raises(UserError, match="neurosim watch"):
        make(tmp_path / "r", STEADY, 8, prepare=taken_away(0.0, np.inf))
    assert not any(
        line.kind == "command" for line in Recording(tmp_path / "r").commands().itertuples()
    )


def test_poses_that_cannot_be_finished_leave_a_whole_recording(tmp_path):
    def dark(rig):
        render = rig.camera.render
        rig.camera.render = lambda poses, lamp=0.0: render(poses, 0.0)

    recording, message, _ = make(tmp_path / "r", STEADY, 2, prepare=dark)
    assert recording.meta["complete"] is True
    assert not recording.is_tracked
    assert len(message) == 1
    assert "the recording is complete, but its poses are not" in message[0]
    assert "neurosim track" in message[0]


def test_what_was_seen_live_and_is_doubted_is_looked_at_again_in_the_video(tmp_path, monkeypatch):
    def doubted(recording, session, model):
        seen = seen_live(recording, session, model)
        grey = {which: one | {"reason": "it is grey"} for which, one in seen.markers.items()}
        return replace(seen, markers=grey)

    monkeypatch.setattr("neurosim.recording.record.seen_live", doubted)
    recording, message, _ = make(tmp_path / "r", STEADY, 2)
    assert message == []
    assert recording.is_tracked
    assert not recording.poses().doubtful.any()


def test_one_that_was_killed_before_its_poses_gets_them_when_it_is_resumed(tmp_path, monkeypatch):
    def killed(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("neurosim.recording.record._write_poses", killed)
        make(tmp_path / "r", STEADY, 2)
    broken = Recording(tmp_path / "r")
    assert broken.meta["complete"] is True
    assert not broken.is_tracked
    recording, message, _ = make(tmp_path / "r", STEADY, 2, resume=True)
    assert recording.is_tracked
    assert recording.sessions == 1
    assert message == []
    with pytest.raises(UserError, match="nothing to resume"):
        make(tmp_path / "r", STEADY, 2, resume=True)


def test_a_camera_that_stops_ends_the_session_at_once(tmp_path):
    def dying(rig):
        look = rig.camera.look
        rig.camera.looked_after = True

        def until(*what):
            if rig.lab.time < 5.0:
                look(*what)
            else:
                rig.camera.stop()
                rig.camera.failed = True

        rig.camera.look = until

    with pytest.raises(UserError, match=r"the camera stopped.*--resume"):
        make(tmp_path / "r", STEADY, 8, sensors=True, prepare=dying)
    sent = [
        line for line in Recording(tmp_path / "r").commands().itertuples() if line.kind == "command"
    ]
    assert 1 <= len(sent) <= 3


LONG = ("--calibration", "c.json", "--camera-size", "320x240", "--commands", "100000")


@pytest.mark.slow
def test_the_page_shows_a_recording_and_sets_nothing(kept, tmp_path):
    shutil.copyfile(kept[0].path / "calibration.json", tmp_path / "c.json")
    child = started("record", "r", "--watch", *LONG, cwd=tmp_path)
    try:
        line = child.stderr.readline()
        assert line.startswith("Watch at http://127.0.0.1:")
        url = line.split()[-1]

        def seen():
            with urlopen(f"{url}picture?after=0", timeout=PATIENCE) as reply:
                state = reply.headers["Neurosim-State"]
            return '"in_view":true' in state and state

        state = wait_until(seen, "a picture with the robot in it")
        assert '"settable":false' in state
        assert '"pose":{' in state
    finally:
        child.kill()
        child.communicate()


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="there is no such signal")
def test_a_kill_leaves_a_recording_that_can_be_tracked(kept, tmp_path):
    shutil.copyfile(kept[0].path / "calibration.json", tmp_path / "c.json")
    words = ["record", "r", *LONG]
    killed = ended_by("SIGKILL", words, log="r/sightings.csv", count=400, cwd=tmp_path)
    assert killed.returncode == -signal.SIGKILL
    recording = Recording(tmp_path / "r")
    assert not recording.is_tracked
    summary = track(recording.path)
    assert summary["frames"] >= 300
    times = recording.poses().time
    assert all(b > a for a, b in itertools.pairwise(times))


class ToTheEdge:
    """Drives to x = 0.3 m, by its pose alone, and keeps its observations."""

    step, steps, rest, start = 0.15, 30, 0.5, (0.0, 0.0, 0.0)
    sensors, reads, needs_pose = (), False, True

    def __init__(self, goal):
        self.goal, self.seen = goal, []

    def begin(self):
        self.seen.clear()

    def react(self, seen):
        self.seen.append(seen)
        speed = float(np.clip(200 * (self.goal - seen.pose[0]), -40, 40))
        return Command((round(speed), round(speed)), self.step)

    def describe(self):
        return {"kind": "test"}


def test_a_controller_that_sees_the_pose_is_driven_by_it(tmp_path):
    source = ToTheEdge(0.3)
    recording, message, truth = make(tmp_path / "r", source, source.steps)
    assert message == []
    assert recording.meta["complete"] is True
    assert recording.meta["deadlines"]["missed"] == 0
    assert recording.is_tracked
    seen = recording.observations()
    # The pose predicted for the time of sending is the robot's pose at that time.
    off = seen.pose[:-2] - truth.pose_at(seen.time[:-2])
    assert np.abs(off[:, :2]).max() < 0.02
    assert truth.poses[-1, 0] == pytest.approx(0.3, abs=0.03)
    assert np.diff(seen.time[:-2]) == pytest.approx(0.15, abs=1e-5)


def test_pictures_that_come_late_are_timed_by_the_flash(tmp_path):
    """A controller sees the robot where the recording's poses have it, with a slow camera, too."""

    def late(rig):
        delay(rig.camera, frames=4)

    source = ToTheEdge(0.3)
    recording, message, _ = make(tmp_path / "r", source, source.steps, prepare=late)
    assert message == []
    seen, poses = recording.observations(), recording.poses()
    # While it drives, at a steady speed or slowing down; 0.13 s are up to 2.5 cm.
    some = (seen.command > 3) & (seen.command < 15)
    there = np.interp(seen.time[some], poses.time, poses.pose[:, 0])
    assert np.ptp(there) > 0.15
    assert np.abs(seen.pose[some, 0] - there).max() < 0.006


@pytest.mark.slow
def test_a_controller_is_kept_on_the_board_and_never_driven_unseen(tmp_path):
    recording, message, truth = make(tmp_path / "edge", ToTheEdge(5.0), 30)
    motor = [line.kind for line in recording.commands().itertuples() if line.is_motor]
    assert motor[-3:] == ["command", "cut", "stop"]
    assert np.abs(truth.poses[:, 0]).max() < BOARD["length"] / 2 - Guard().margin + 0.02
    assert "was stopped at the board's edge" in message[0]

    def covered(rig):
        render = rig.camera.render
        begin = rig.lab.time + 4.0
        rig.camera.render = lambda poses, lamp=0.0: render(
            None if rig.lab.time > begin else poses, lamp
        )

    source = ToTheEdge(0.3)
    recording, message, _ = make(
        tmp_path / "lost", source, source.steps, prepare=covered, sensors=True,
        settings={"board": BOARD, "guard": Guard("ignore")},
    )  # fmt: skip
    motor = [line for line in recording.commands().itertuples() if line.is_motor]
    assert [line.kind for line in motor[-2:]] == ["cut", "stop"]
    assert motor[-2].time == pytest.approx(4.0 + Guard().unseen, abs=0.3)
    assert any("stopped because it was not seen" in words for words in message)
