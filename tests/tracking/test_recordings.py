import numpy as np
import pytest

from neurosim.base.errors import FileError, UserError
from tracking.datasets.recordings import Poses, Recording

HEADER = "session,command,kind,time,left,right,duration\n"


@pytest.fixture
def recording(tmp_path):
    made = Recording.create(tmp_path / "r", {"robot": {"kind": "fake"}})
    made.begin_session(video="video-001.avi")
    return made


def write_commands(recording, text):
    (recording.path / "commands.csv").write_text(HEADER + text)


def test_a_recording_without_commands_can_be_read(recording):
    assert recording.commands().empty


def test_a_recording_is_read_as_it_was_written(recording):
    with recording.command_log() as log:
        log.append(1, None, "lamp-on", 0.1, None, None, None)
        log.append(1, 0, "command", 1.5, 20, -30, 2.0)
        log.append(1, None, "stop", 3.5, 0, 0, None)
    again = Recording(recording.path)
    lamp, command, stop = again.commands().itertuples()
    assert (lamp.kind, lamp.is_motor, lamp.time) == ("lamp-on", False, 0.1)
    assert (command.command, command.left, command.right, command.duration) == (0, 20, -30, 2)
    assert command.is_motor
    assert stop.is_motor
    assert again.video(1) == recording.path / "video-001.avi"
    assert again.sessions == 1


def test_a_line_that_a_kill_tore_is_passed_over(recording):
    write_commands(recording, "1,0,command,1.5,20,-30,2.0\n1,1,command,3.5,2")
    assert [line.command for line in recording.commands().itertuples()] == [0]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("1,0,command,x,1,1,1\n", "line 2, field 'time': expected a finite number, found 'x'"),
        ("1,0,command,nan,1,1,1\n", "line 2, field 'time'"),
        ("1,0,jump,1,1,1,1\n", "line 2, field 'kind'"),
        ("1,0,command,1,,1,1\n", "line 2: a motor command needs both speeds"),
        ("1,,command,1,1,1,1\n", "line 2: a command needs a number and a duration"),
        ("1,0,command,1,1,1,0\n", "line 2: a command needs a number and a duration"),
        ("1,0,command,2,1,1,1\n1,1,command,1,1,1,1\n", "line 3, field 'time': the clock goes back"),
        ("2,0,command,2,1,1,1\n1,1,command,3,1,1,1\n", "line 3, field 'session'"),
    ],
)
def test_a_command_log_that_is_wrong_is_refused_with_its_line(recording, text, says):
    write_commands(recording, text)
    with pytest.raises(FileError) as error:
        recording.commands()
    assert says in str(error.value)


def test_each_session_has_clocks_of_its_own(recording):
    write_commands(recording, "1,0,command,90,1,1,1\n2,1,command,1,1,1,1\n")
    assert [line.session for line in recording.commands().itertuples()] == [1, 2]


def test_a_camera_clock_that_goes_backwards_is_refused(recording):
    (recording.path / "frames.csv").write_text("session,frame,time\n1,0,0.1\n1,1,0.05\n")
    with pytest.raises(FileError, match=r"line 3, field 'time'.*backwards"):
        recording.frame_times(1)
    assert recording.frame_times(2) is None


def test_poses_are_read_as_they_were_written(recording):
    pose = np.array([[0.1, -0.2, 7.0], [np.nan] * 3])
    recording.write_poses(
        Poses(
            np.array([1, 1]),
            np.array([0, 1]),
            np.array([0.5, 0.6]),
            pose,
            np.array([0.9, 0.0]),
            np.array([True, False]),
        )
    )
    again = recording.poses()
    assert again.doubtful.tolist() == [True, False]
    assert np.isnan(again.certain().pose).all()
    assert again.certain().quality.tolist() == [0.0, 0.0]
    np.testing.assert_array_equal(again.pose, pose)
    np.testing.assert_array_equal(again.quality, [0.9, 0.0])
    assert len(again.of_session(2).time) == 0


def test_a_recording_that_was_not_tracked_says_what_to_do(recording):
    with pytest.raises(FileError, match="run neurosim track on it first"):
        recording.poses()


def test_nothing_is_recorded_over(recording, tmp_path):
    with pytest.raises(UserError, match="not empty"):
        Recording.create(recording.path, {})
    with pytest.raises(FileError, match="no such recording"):
        Recording(tmp_path / "other")
    with pytest.raises(FileError, match="is a CSV file; neurosim dataset --from csv reads it"):
        Recording(tmp_path / "log.csv")


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"front": {"colour": "pink", "x": "a", "y": 0}}, r"markers\.front\.x"),
        ({"rear": {"colour": "blue", "x": 0, "y": None}}, r"markers\.rear\.y"),
        ({"height": "high"}, r"markers\.height"),
        ({"lamp": {"x": 1}}, r"markers\.lamp"),
    ],
)
def test_measures_of_markers_are_lengths(recording, tmp_path, change, field):
    meta = {**recording.meta, "markers": {**recording.meta["markers"], **change}}
    with pytest.raises(FileError, match=field):
        Recording.create(tmp_path / "other", {"markers": meta["markers"]})


def test_markers_must_have_colours_and_places(tmp_path):
    with pytest.raises(FileError, match=r"markers\.rear"):
        Recording.create(tmp_path / "r", {"markers": {"front": {"colour": "pink", "x": 0, "y": 0}}})
