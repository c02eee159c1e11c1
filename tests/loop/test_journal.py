"""Trials in reality: written down, never repeated, counted; wrong results are errors."""

import json
import signal
import threading
import time

import numpy as np
import pytest
from sliding_block import Push

from neurosim.base.errors import FileError, RobotError, UserError
from neurosim.base.trajectory import Tracked
from neurosim.lab.camera.camera import RoofCamera
from neurosim.lab.nxt.params import CameraParams
from neurosim.loop.journal import Journal, read_trials
from neurosim.tasks.walking import Walking
from neurosim.trials.by_hand import ByHand
from neurosim.trials.realities import REALITIES, make_reality, open_reality
from tracking.camera.cameras import VideoSink

ONE, TWO = np.array([0.25, 0.5]), np.array([0.75, 0.1])


class Counting:
    """Returns the number of earlier trials, and remembers them."""

    def __init__(self):
        self.seen = []

    def trial(self, genes, number):
        self.seen.append((genes.tolist(), number))
        return float(number)

    def describe(self):
        return {"kind": "counting"}


def test_every_trial_is_written_before_it_is_used_and_none_is_made_twice(tmp_path):
    reality, path = Counting(), tmp_path / "trials.jsonl"
    trials = Journal(reality, path, each=3)
    assert trials.evaluate(np.stack([ONE, TWO]), "first") == pytest.approx([1.0, 4.0])
    assert trials.evaluate(ONE[None], "again") == pytest.approx([1.0])
    assert (trials.used, trials.made, trials.evaluations) == (6, 6, 2.0)
    assert trials.evaluate(ONE[None], "confirm", 2) == pytest.approx([(0 + 1 + 2 + 6 + 7 + 8) / 6])
    trials.close()
    rows = read_trials(path)
    assert [row["number"] for row in rows] == list(range(9))
    assert rows[0] == {"number": 0, "genes": [0.25, 0.5], "fitness": 0.0, "why": "first"}
    assert rows[-1]["why"] == "confirm"
    assert len(reality.seen) == 9


def test_an_interrupted_run_goes_on_without_repeating_a_trial(tmp_path):
    path = tmp_path / "trials.jsonl"

    class Breaks(Counting):
        def trial(self, genes, number):
            if number == 4:
                raise KeyboardInterrupt
            return super().trial(genes, number)

    with pytest.raises(KeyboardInterrupt):
        Journal(Breaks(), path).evaluate(np.stack([ONE, TWO]), "first")
    assert len(read_trials(path)) == 4
    with path.open("a") as file:
        file.write('{"number": 4, "gen')  # killed within a line
    reality = Counting()
    trials = Journal(reality, path)
    assert trials.evaluate(np.stack([ONE, TWO]), "first") == pytest.approx([1.0, 4.0])
    assert [number for _, number in reality.seen] == [4, 5]
    assert (trials.used, trials.made) == (6, 2)


@pytest.mark.parametrize("answer", [None, float("nan"), float("inf"), "fast"])
def test_a_reality_that_returns_no_number_is_refused(tmp_path, answer):
    answers = iter([0.5, answer])
    trials = Journal(lambda genes: next(answers), tmp_path / "trials.jsonl")
    with pytest.raises(UserError, match=r"reality returned .* in trial 2, not a fitness"):
        trials.evaluate(ONE[None], "first")
    assert len(read_trials(tmp_path / "trials.jsonl")) == 1


def test_a_reality_that_hangs_is_given_up(tmp_path):
    wait = threading.Event()
    trials = Journal(lambda genes: wait.wait(60), tmp_path / "trials.jsonl", patience=0.1)
    with pytest.raises(RobotError, match=r"did not answer in trial 1 within 0\.1 s"):
        trials.evaluate(ONE[None], "first")
    wait.set()


def test_several_at_once_have_the_time_of_all_and_reality_is_told_to_stop(tmp_path):
    class Slow:
        stopped = False

        def trials(self, genes, numbers):
            time.sleep(0.15 if len(genes) > 2 else 1.0)
            return np.zeros(len(genes))

        def trial(self, genes, number):
            raise AssertionError

        def stop(self):
            self.stopped = True

    reality = Slow()
    trials = Journal(reality, tmp_path / "trials.jsonl", each=1, patience=0.1)
    trials.evaluate(np.stack([ONE, TWO, ONE + 0.1]), "first")
    assert not reality.stopped
    with pytest.raises(RobotError, match=r"in trial 4 to 5 within 0\.2 s"):
        trials.evaluate(np.stack([ONE + 0.2, TWO + 0.2]), "second")
    assert reality.stopped


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="signals for a thread: POSIX")
@pytest.mark.parametrize(("grace", "kept"), [(60.0, 1), (0.01, 0)])
def test_after_ctrl_c_a_trial_under_way_is_seen_to_its_end_if_it_is_short(
    tmp_path, monkeypatch, grace, kept
):
    monkeypatch.setattr("neurosim.loop.journal.GRACE", grace)

    class Slow:
        def trial(self, genes, number):
            signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
            time.sleep(0.5)
            return 1.5

    reality = Slow()
    trials = Journal(reality, tmp_path / "trials.jsonl", each=3)
    with pytest.raises(KeyboardInterrupt):
        trials.evaluate(ONE[None], "first")
    assert [row["fitness"] for row in read_trials(tmp_path / "trials.jsonl")] == [1.5] * kept
    reality.trial = lambda genes, number: 1.5
    assert trials.evaluate(ONE[None], "first") == pytest.approx([1.5])  # it can be continued


def test_what_a_reality_raises_comes_through(tmp_path):
    def lost(genes):
        raise RobotError("the robot is gone")

    with pytest.raises(RobotError, match="the robot is gone"):
        Journal(lost, tmp_path / "trials.jsonl").evaluate(ONE[None], "first")


def seen(*poses):
    return Tracked(0.5, np.array(poses, float))


def test_poses_are_written_and_read_again(tmp_path):
    path, nan = tmp_path / "trials.jsonl", np.nan
    answers = [seen((1, 2, 3), (nan, 0, 0)), seen((2, 2, 3.1), (nan, nan, nan)), 0.25, 0.75]
    trials = Journal(lambda genes: answers.pop(0), path, each=2)
    assert trials.evaluate(np.stack([ONE, TWO]), "first") == pytest.approx([0.5, 0.5])
    trials.close()
    assert [row.get("poses") for row in read_trials(path)] == [
        [[1.0, 2.0, 3.0], None],
        [[2.0, 2.0, 3.1], None],
        None,
        None,
    ]
    for known in (trials, Journal(lambda genes: None, path, each=2)):
        known.evaluate(np.stack([ONE, TWO]), "again")  # makes no trial
        expected = [[[1.0, 2.0, 3.0], [nan] * 3], [[2.0, 2.0, 3.1], [nan] * 3]]
        one, two = known.poses(np.stack([ONE, TWO]))  # the second was not tracked
        np.testing.assert_array_equal(one, expected)
        assert two.shape == (0, 2, 3)
        assert known.poses(TWO[None]) is None


@pytest.mark.parametrize("poses", [[], [1.0, 2.0, 3.0], [[1.0, 2.0]], "here", [[1.0], [1.0, 2.0]]])
def test_what_are_no_poses_is_refused(tmp_path, poses):
    path = tmp_path / "trials.jsonl"
    with pytest.raises(UserError, match=r"poses of shape .* in trial 1, not \[K, 3\]"):
        Journal(lambda genes: Tracked(0.5, np.array(poses, object)), path).evaluate(ONE[None], "")
    trials = Journal(lambda genes: seen((1, 2, 3)), path, each=1)
    trials.evaluate(ONE[None], "first")
    head, line = path.read_text().splitlines()
    path.write_text("\n".join([head, json.dumps(json.loads(line) | {"poses": poses})]) + "\n")
    with pytest.raises(FileError, match="line 2, field 'poses"):
        read_trials(path)


def test_a_person_is_asked_before_every_trial(tmp_path):
    asked, typed = [], iter(["fast", "0.5", "0.7", "0"])
    reality = ByHand(Push(), type_in=lambda message: next(typed))
    with pytest.raises(UserError, match="needs a person"):
        Journal(reality, tmp_path / "trials.jsonl")
    trials = Journal(reality, tmp_path / "trials.jsonl", ask=asked.append)
    assert trials.evaluate(ONE[None], "first") == pytest.approx([0.4])
    assert len(asked) == 3
    assert "Put the robot back" in asked[0]


def test_trials_that_take_long_are_counted_on_stderr(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("neurosim.base.progress.LINE_EVERY", 0.0)
    trials = Journal(Counting(), tmp_path / "trials.jsonl", each=2, progress=True)
    trials.evaluate(ONE[None], "first")
    shown = capsys.readouterr().err
    assert "first: trials in reality: 1 of 2 trials" in shown
    trials.evaluate(ONE[None], "again")  # makes none
    assert capsys.readouterr().err == ""


def test_a_film_gives_the_path_of_a_trial_by_hand(tmp_path):
    """It stands for half a second, drives ahead at 0.2 m/s for a second, and stands again."""
    camera = RoofCamera(CameraParams(size=(640, 480)), 0)
    sink = VideoSink(tmp_path / "film.avi", None, 1, camera.size, 30.0)
    for frame in range(90):
        ahead = 0.2 * np.clip(frame / 30.0 - 0.5, 0.0, 1.0)
        sink.write(frame / 30.0, camera.render(np.array([0.3, 0.1 + ahead, np.pi / 2])))
    sink.close()
    calibration = tmp_path / "calibration.json"
    camera.optics.calibration.write(calibration)
    asked = []

    def type_in(message):
        asked.append(message)
        return ["0.2", "no.avi", str(tmp_path / "film.avi")][len(asked) - 1]

    result = ByHand(Push(), Walking(1.0), type_in, calibration).trial(ONE, 0)
    assert "no.avi" in asked[2]
    assert result.fitness == 0.2
    assert result.poses.shape == (125, 3)
    # Motion is noticed where it is 1 cm, or one frame earlier.
    assert result.poses[-1] == pytest.approx([0.195, 0.0, 0.0], abs=0.01)
    assert result.poses[61] == pytest.approx([0.1, 0.0, 0.0], abs=0.015)
    without = ByHand(Push(), Walking(1.0), lambda m: "" if "Film" in m else "0.3", calibration)
    assert without.trial(ONE, 0) == 0.3
    with pytest.raises(UserError, match="films of trials need the task"):
        ByHand(Push(), calibration=calibration)
    with pytest.raises(UserError, match=r"none\.json"):
        ByHand(Push(), Walking(1.0), calibration=tmp_path / "none.json")


def test_several_at_once_get_numbers_of_their_own(tmp_path):
    class Many(Counting):
        def trials(self, genes, numbers):
            self.seen.append(len(genes))
            return numbers * 1.0

    reality = Many()
    trials = Journal(reality, tmp_path / "trials.jsonl")
    result = trials.evaluate(np.stack([ONE, TWO, ONE + 0.1]), "first")
    assert result == pytest.approx([1.0, 4.0, 7.0])
    assert reality.seen == [6, 3]  # an interruption loses six trials at most


def test_an_individual_that_is_asked_for_twice_at_once_is_tried_once(tmp_path):
    reality = Counting()
    trials = Journal(reality, tmp_path / "trials.jsonl")
    trials.evaluate(ONE[None], "first")
    result = trials.evaluate(np.stack([ONE, ONE, TWO, TWO]), "second", 2)
    assert result == pytest.approx([2.5, 2.5, 8.5, 8.5])
    assert len(reality.seen) == trials.used == 12


def test_a_file_of_another_reality_or_a_damaged_one_is_refused(tmp_path):
    path = tmp_path / "trials.jsonl"
    Journal(Counting(), path).evaluate(ONE[None], "first")
    with pytest.raises(FileError, match="reality"):
        Journal(lambda genes: 0.0, path)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], "nonsense", *lines[1:]]) + "\n")
    with pytest.raises(FileError, match="line 2: expected a JSON object"):
        Journal(Counting(), path)
    row = json.loads(lines[1]) | {"fitness": "fast"}
    path.write_text("\n".join([lines[0], json.dumps(row)]) + "\n")
    with pytest.raises(FileError, match="line 2, field 'fitness'"):
        Journal(Counting(), path)


def test_realities_have_names(monkeypatch):
    monkeypatch.setitem(REALITIES._registered, "counting-test", lambda controller: Counting())
    assert isinstance(make_reality("counting-test", Push()), Counting)
    with open_reality("counting-test", Push()) as reality:
        assert isinstance(reality, Counting)
    with pytest.raises(UserError, match="there is no reality 'moon'"):
        make_reality("moon", Push())
    with pytest.raises(UserError, match="needs no camera"):
        make_reality("counting-test", Push(), camera="0")
