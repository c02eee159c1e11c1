"""Animated drives: on the page, and as a video."""

import json
import re
import shutil

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from devtools import browser_tab
from ideal_simulator import IdealWheels, SlippingWheels
from report_artefacts import LEGS, predicted_poses

from neurosim.base import files, se2
from neurosim.base.errors import UserError
from neurosim.cli.main import cli
from neurosim.reports import write_report
from neurosim.reports.artefacts import gather
from neurosim.reports.course import Paths, Scene, course
from neurosim.reports.film import along, film, write_film
from tracking.datasets.recordings import Recording


def test_poses_are_those_of_the_trial_at_their_times(folders):
    artefacts = gather(folders)
    (trial,) = artefacts.trials
    shown = film(artefacts, trial)
    # Every command takes 2 s; the track has 15 poses a second.
    path = np.array(trial.meta["actual"]["path"])
    for time, robot, predicted in zip(shown.times, shown.robot, shown.predicted, strict=True):
        near = np.argmin(abs(path[:, 0] - path[0, 0] - time))
        if time < path[-1, 0] - path[0, 0]:
            assert np.abs(robot - path[near, 1:]).max() < 0.08
        leg = min(int(time / 2), len(LEGS) - 1)
        if time < 2 * len(LEGS):
            part = se2.exp(se2.log(LEGS[leg]) * (time / 2 - leg))
            assert predicted == pytest.approx(se2.compose(predicted_poses()[leg], part), abs=1e-9)
    assert shown.times[-1] >= 2 * len(LEGS)
    assert shown.predicted[-1] == pytest.approx(trial.meta["predicted"]["rest"])
    assert shown.names == ()


def test_samples_are_drives_of_the_simulator_with_its_noise(folders):
    artefacts = gather(folders)
    (trial,) = artefacts.trials
    shown = film(artefacts, trial)
    assert shown.samples.shape == (20, len(shown.times), 3)
    ideal = IdealWheels().rollouts(artefacts.controllers[0].content.controller, trial.task.episode)
    assert ideal is None  # stepped here, as the film is
    start = np.array(artefacts.controllers[0].meta["start"])
    at = np.argmin(abs(shown.times - 2.0))
    # The first command is 40 % on both wheels for 2 s: 0.4 m ahead, on average.
    expected = se2.compose(start, [0.2 * shown.times[at], 0, 0])
    spread = shown.samples[:, at, :2] - expected[:2]
    assert np.abs(spread.mean(axis=0)).max() < 0.02
    assert 0.002 < spread[:, 1].std() < 0.03
    assert np.array_equal(film(artefacts, trial).samples, shown.samples)
    # There are none for another simulator, without noise, or for a replanned drive.
    assert not len(film(gather(folders[:2]), trial).samples)
    artefacts.simulators[0].content = IdealWheels()
    assert not len(film(artefacts, trial).samples)
    artefacts.simulators[0].content = SlippingWheels()
    trial.meta["replanned"] = True
    assert not len(film(artefacts, trial).samples)


def test_sensors_read_what_they_read_at_the_last_look(folders, tmp_path):
    (trial,) = gather(folders).trials
    path = np.array(trial.meta["actual"]["path"])
    begun = path[0, 0]
    Recording.create(tmp_path / "r", {})
    shutil.copy(tmp_path / "r" / "recording.json", trial.path)
    # The first sensor was not read at the last look, nor the second at the first one.
    rows = {"session": [1] * 3, "command": [0, 1, 2], "time": [begun, begun + 3.0, begun + 4.0]}
    rows |= dict.fromkeys(("x", "y", "theta"), [0] * 3)
    rows |= {"light": [0.25, 0.75, None], "other": [None, 0.5, 0.6]}
    files.write_csv(trial.path / "observations.csv", rows)
    shown = film(gather(folders), trial)
    assert shown.names == ("light", "other")
    assert set(shown.readings[shown.times < 2.9, 0]) == {0.25}
    assert set(shown.readings[shown.times > 3.1, 0]) == {0.75}
    frames = json.loads(shown.as_json(0, 0, 1))["readings"]
    assert frames[0] == [0.25, 0.5]
    assert frames[-1] == [0.75, 0.6]


def test_a_robot_that_nothing_saw_for_a_while_is_not_shown_there(folders):
    (trial,) = gather(folders).trials
    path = [row for row in trial.meta["actual"]["path"] if not 3 < row[0] < 5]
    trial.meta["actual"]["path"] = path
    shown = film(gather(folders), trial)
    begun = path[0][0]
    hidden = np.isnan(shown.robot[:, 0])
    assert hidden[(shown.times + begun > 3.1) & (shown.times + begun < 4.9)].all()
    assert not hidden[(shown.times + begun < 2.9)].any()
    assert json.loads(shown.as_json(0, 0, 1))["robot"].count(None) == hidden.sum()
    trial.meta["actual"]["path"] = []
    assert film(gather(folders), trial) is None


def test_a_path_of_nearly_whole_turns_is_a_straight_line():
    poses = [[0, 0, 0], [0.4, 0, 2 * np.pi - 1e-3]]
    result = along(poses, [0.0, 1.0], np.array([0.5]))
    assert result[0] == pytest.approx([0.2, 0, np.pi], abs=1e-2)
    assert np.isnan(along([], [], np.array([0.5]))).all()


def test_a_drawing_says_where_its_metres_are():
    poses = [[-0.5, 0.1, 0.0], [0.7, 0.4, 0.0]]
    drawing = course(Scene(), Paths(poses), "words", "p")
    line = re.search(
        r'd="M ([\d.]+) ([\d.]+) L ([\d.]+) ([\d.]+)[^"]*"[^>]*var\(--pred', drawing.svg
    )
    ends = np.array([float(number) for number in line.groups()]).reshape(2, 2)
    placed = np.array(drawing.origin) + drawing.scale * np.array(poses)[:, :2] * [1, -1]
    assert ends == pytest.approx(placed, abs=0.05)


@pytest.mark.slow
def test_a_drive_is_played_on_the_page(folders, tmp_path):
    page = tmp_path / "report.html"
    write_report(folders, page)
    source = page.read_text()
    assert "http" not in source
    assert not re.search(r"<script[^>]*\ssrc", source)
    (text,) = re.findall(r'<script type="application/json">(.*?)</script>', source)
    content = json.loads(text)
    assert len(content["robot"]) == len(content["predicted"]) == len(content["times"])
    assert {len(row) for row in content["samples"]} == {40}
    moved = "document.querySelector('.moving').lastChild.getAttribute('transform')"
    with browser_tab(tmp_path) as tab:
        tab.open(page.as_uri())

        def at(frame):
            x, y, turn = content["robot"][frame]
            return f"translate({x:g} {y:g}) rotate({turn:g})"

        assert tab.run(moved).startswith(at(0))
        assert tab.run("document.querySelectorAll('.moving circle').length") == 20
        tab.run(
            "(() => { const bar = document.querySelector('.film input'); bar.value = 50;"
            "bar.dispatchEvent(new Event('input')); })()"
        )
        assert tab.run(moved).startswith(at(50))
        tab.click_on(".film button")
        assert tab.run("document.querySelector('.film button').textContent") == "Pause"
        tab.until("Number(document.querySelector('.film input').value) > 55")
        tab.click_on(".film button")
        assert tab.run("document.querySelector('.film button').textContent") == "Play"
        assert tab.complaints == []


def frames_of(path):
    video = cv2.VideoCapture(str(path))
    results = []
    while True:
        read, frame = video.read()
        if not read:
            return np.array(results)
        results.append(frame)


@pytest.mark.slow
def test_a_video_shows_the_robot_where_it_was(folders, tmp_path):
    trial, controller, simulator = folders
    out = tmp_path / "drive.mp4"
    words = ["view", trial, "--simulator", simulator, "--controller", controller, "--video", out]
    done = CliRunner().invoke(cli, [*map(str, words), "--json"], catch_exceptions=False)
    made = json.loads(done.stdout)
    frames = frames_of(out)
    assert made["frames"] == len(frames)
    assert made["samples"] == 20
    assert made["seconds"] >= 2 * len(LEGS)

    def robot(frame):
        blue, green, red = frame[24:].astype(int).transpose(2, 0, 1)
        v, u = np.nonzero((red > 170) & (green < 130) & (blue < 70))
        return np.array([np.median(u), np.median(v)]), len(u)

    # It starts at the left, and drives up first, then to the right; its trail grows.
    (first, few), (later, more), (_, most) = (robot(frames[place]) for place in (2, 55, -1))
    assert few < more < most
    assert first[0] < frames.shape[2] / 3
    assert later[1] < first[1]
    with pytest.raises(UserError, match="exists; name another video, or add --overwrite"):
        write_film(trial, out)
    assert write_film(trial, out, overwrite=True)["samples"] == 0


def test_what_a_video_cannot_be(folders, tmp_path):
    trial, controller, _ = folders

    def view(*words):
        return CliRunner().invoke(cli, ["view", *map(str, words)], catch_exceptions=False)

    for words, says in (
        ([trial], "name the picture with -o"),
        ([trial, "--video", "x.avi"], "ends in .mp4"),
        ([trial, "--video", "x.mp4", "--noise"], "leave out --noise"),
        ([controller, "--video", "x.mp4"], "is not a trial"),
    ):
        with pytest.raises(UserError, match=says):
            view(*words)
    assert not list(tmp_path.glob("x*"))
