"""Driving by hand: keys in a real browser, a robot of the lab, a real video."""

import re
import signal
import threading
from contextlib import contextmanager
from functools import lru_cache
from itertools import groupby
from types import SimpleNamespace

import numpy as np
import pytest
from devtools import browser_tab
from patience import PATIENCE, wait_until
from processes import neurosim, started

from neurosim.base.commands import TWO_WHEELS, Commands, Number
from neurosim.lab import CameraParams, read_truth
from neurosim.lab.camera.optics import Optics
from neurosim.recording.by_hand import Hand
from neurosim.watch import PageServer, Viewer
from tracking.datasets.dataset import Dataset
from tracking.datasets.recordings import DEFAULT_BOARD, DEFAULT_MARKERS, Recording
from tracking.markers.colours import parse_colour

SIZE = (320, 240)
REST = (0.0, 0.0)
#: The command of a robot that stands.
LINE = SimpleNamespace(numbers=REST)
STANDING = "document.getElementById('standing').textContent"


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    with browser_tab(tmp_path_factory.mktemp("browser")) as tab:
        yield tab


@contextmanager
def recorded(folder, *options):
    """Begin a recording by hand; give the process, its page's address, and its messages."""
    optics = Optics(CameraParams(size=SIZE))
    optics.calibration.write(folder / "calibration.json")
    words = ["record", "r", "--by-hand", "--camera-size", "320x240", *options]
    child = started(*words, cwd=folder)
    messages = []

    def hear():
        messages.extend(iter(child.stderr.readline, ""))

    thread = threading.Thread(target=hear, daemon=True)
    thread.start()
    try:
        match = wait_until(
            lambda: re.search(r"Drive at (\S+)", "".join(messages)) or child.poll(), "the page"
        )
        assert not isinstance(match, int), messages
        yield child, match[1], messages
    finally:
        child.kill()
        child.communicate()
        thread.join()


def motor(folder):
    return _motor(folder, (folder / "commands.csv").stat().st_size)


@lru_cache(1)  # waiting for the next line costs the recording's process little
def _motor(folder, size):
    return [line for line in Recording(folder).commands().itertuples() if line.is_motor]


def change(tab, folder, wanted, kind, *keys):
    """Press keys or let go of them; the robot has the command that follows for eight frames."""
    for key in keys:
        tab.key(kind, key)
    wait_until(lambda: (motor(folder) or [LINE])[-1].numbers == wanted, f"{wanted} by {keys}")
    filmed = frames(folder)
    wait_until(lambda: frames(folder) >= filmed + 8, "frames")


def frames(folder):
    return (folder / "frames.csv").read_text().count("\n")


#: Commands of keys for a robot on two wheels at 60 % of its speed.
DRIVES = {"KeyW": (60, 60), "KeyA": (-60, 60), "ArrowDown": (-60, -60), "ArrowRight": (60, -60)}


def test_what_is_pressed_becomes_a_dataset_that_is_learned_from(tab, tmp_path):
    """The lab's NXT, tracked as it is driven."""
    folder = tmp_path / "r"
    with recorded(tmp_path, "--calibration", "calibration.json", "--max-speed", 60) as (
        child, url, output,
    ):  # fmt: skip
        tab.open(url)
        tab.until(f"{STANDING} === 'ready'")
        for key in (*DRIVES, *DRIVES, *DRIVES):
            change(tab, folder, DRIVES[key], "Down", key)
            change(tab, folder, REST, "Up", key)
        # Two keys, and at half the speed.
        change(tab, folder, (60, 0), "Down", "KeyW", "KeyD")
        change(tab, folder, (30, 0), "Down", "ShiftLeft")
        given = "document.getElementById('given').textContent"
        tab.until(f"{given}.includes('left: 30 %') && {given}.includes('right: 0 %')")
        change(tab, folder, (60, 60), "Up", "ShiftLeft", "KeyD")
        # The page goes away with the key pressed.
        tab.open("about:blank")
        wait_until(lambda: motor(folder)[-1].kind == "stop", "the robot's stop")
        tab.key("Up", "KeyW")
        tab.open(url)
        tab.until(f"{STANDING} === 'ready'")
        change(tab, folder, (-60, -60), "Down", "KeyS")
        change(tab, folder, REST, "Up", "KeyS")
        sent = len([line for line in motor(folder) if line.kind == "command"])
        tab.until(f"document.getElementById('count').textContent === '{sent}'")
        tab.click_on("#end")
        assert child.wait(timeout=PATIENCE) == 0, output
    tab.open("about:blank")
    tab.complaints.clear()  # the browser's message about the server that has ended
    # Each press is a line at the time of its press; what was pressed follows in the same order.
    lines = [line for line in motor(folder) if line.kind == "command" and any(line.numbers)]
    pressed = [numbers for numbers, _ in groupby(line.numbers for line in lines)]
    expected = [*list(DRIVES.values()) * 3, (60, 0), (30, 0), (60, 60), (-60, -60)]
    left = iter(pressed)
    assert all(numbers in left for numbers in expected), pressed
    assert {*pressed} <= {*expected}
    # The robot followed the keys.
    truth = read_truth(folder)
    assert np.ptp(truth.poses[:, 2]) > 0.1
    recording = Recording(folder)
    assert recording.meta["complete"] is True
    assert (recording.poses().quality > 0).mean() > 0.9
    made = neurosim("dataset", "r", "-o", "dataset", cwd=tmp_path)
    assert "Rows follow one another" in made.stdout, made.stderr
    dataset = Dataset.read(tmp_path / "dataset")
    assert len(dataset) >= 20
    commanded = {*map(tuple, dataset.table[["left", "right"]].to_numpy().tolist())}
    assert {*DRIVES.values()} <= commanded
    learned = neurosim("train", "dataset", "-o", "simulator", "--members", 2, cwd=tmp_path)
    assert learned.returncode == 0, learned.stderr


@pytest.mark.slow
def test_ctrl_c_leaves_what_was_driven(tab, tmp_path):
    """An omnidirectional base, with a lever for each of its numbers; filmed, and tracked later."""
    with recorded(tmp_path, "--robot", "virtual-omni") as (child, url, output):
        tab.open(url)
        tab.until(f"{STANDING} === 'ready'")
        assert tab.run("document.getElementById('status').textContent") == "filmed, not tracked"
        names = tab.run("[...document.querySelectorAll('#levers li')].map(l => l.firstChild.data)")
        assert names == ["vx", "vy", "omega"]
        limits = [one.high for one in Recording(tmp_path / "r").takes.numbers]
        for place, key in enumerate(("KeyW", "KeyA", "KeyQ", "KeyS", "KeyD", "KeyE") * 2):
            full = 0.5 * limits[place % 3] * (-1 if place // 3 % 2 else 1)
            wanted = tuple(full if n == place % 3 else 0.0 for n in range(3))
            change(tab, tmp_path / "r", wanted, "Down", key)
            change(tab, tmp_path / "r", (0.0,) * 3, "Up", key)
        change(tab, tmp_path / "r", (0.0, 0.0, 0.5 * limits[2]), "Down", "KeyQ")
        child.send_signal(signal.SIGINT)
        assert child.wait(timeout=PATIENCE) == 130, output
        tab.key("Up", "KeyQ")
        tab.until("document.body.dataset.ended")
    tab.open("about:blank")
    tab.complaints.clear()
    assert Recording(tmp_path / "r").meta["complete"] is False
    tracked = neurosim("track", "r", "--calibration", "calibration.json", cwd=tmp_path)
    assert tracked.returncode == 0, tracked.stderr
    made = neurosim("dataset", "r", "-o", "dataset", cwd=tmp_path)
    assert made.returncode == 0, made.stderr
    dataset = Dataset.read(tmp_path / "dataset")
    assert dataset.inputs[3:6] == ("vx", "vy", "omega")
    assert len(dataset) >= 15


CAR = Commands(
    (Number("v", "m/s", -0.4, 0.8), Number("steer", "rad", -0.5, 0.5, speed=False)), "car"
)
PADS = "navigator.getGamepads = () => [{{connected: true, id: 'pad', axes: {}}}]"


@contextmanager
def page(tab, takes):
    """Give the input of a page without a camera or a robot."""
    hand = Hand(100.0)
    colours = (parse_colour("pink"), parse_colour("blue"))
    viewer = Viewer(
        SIZE, DEFAULT_MARKERS, colours, board=DEFAULT_BOARD, seen_by="nobody", hand=hand
    )
    with PageServer(viewer) as server:
        tab.open(server.url)
        tab.until(f"{STANDING}.startsWith('wait')")
        hand.begin(takes)
        tab.until(f"{STANDING} === 'ready'")
        yield hand, server
        viewer.end("the recording has ended")
        tab.until("document.body.dataset.ended || state.ended")
    tab.open("about:blank")
    tab.complaints.clear()


def test_sticks_of_a_game_pad_are_levers_with_a_dead_band(tab):
    with page(tab, CAR) as (hand, _):
        tab.run(PADS.format("[0.05, -0.11, 0, 0]"))
        wait_until(lambda: hand.wish() == (0, 0), "sticks in their middle")
        tab.until("document.getElementById('pad').textContent === 'game pad: pad'")
        tab.run(PADS.format("[1, -1, 0, 0]"))
        wait_until(lambda: hand.wish() == (0.8, -0.5), "sticks at their ends")
        tab.run(PADS.format("[0, 0.56, 0, 0]"))
        wait_until(lambda: hand.wish() == (-0.2, 0), "half way beyond the dead band")
        for _ in range(5):
            tab.click_on("#slower")
        wait_until(lambda: hand.wish() == (-0.1, 0), "half of the speed")
        assert tab.run("document.getElementById('speed').textContent") == "50 %"
        # Keys count before sticks.
        tab.key("Down", "KeyW")
        wait_until(lambda: hand.wish() == (0.4, 0), "a key")
        tab.key("Up", "KeyW")


def test_buttons_are_levers_too_and_a_hidden_page_lets_go(tab):
    with page(tab, TWO_WHEELS) as (hand, _):
        x, y = tab.run(
            "(() => { const b = document.querySelector('[data-codes^=KeyW]')"
            ".getBoundingClientRect(); return [b.x + b.width / 2, b.y + b.height / 2]; })()"
        )
        button = {"x": x, "y": y, "button": "left", "clickCount": 1}
        tab.call("Input.dispatchMouseEvent", type="mousePressed", **button)
        wait_until(lambda: hand.wish() == (100, 100), "the button")
        tab.call("Input.dispatchMouseEvent", type="mouseReleased", **button)
        wait_until(lambda: hand.wish() == (0, 0), "its release")
        tab.key("Down", "KeyA")
        wait_until(lambda: hand.wish() == (-100, 100), "the key")
        tab.run("Object.defineProperty(document, 'hidden', {value: true, configurable: true});"
                "document.dispatchEvent(new Event('visibilitychange'))")  # fmt: skip
        wait_until(lambda: hand.wish() is None, "nobody who drives")
        tab.run("delete document.hidden")
        # For the page, the key that is still down was released.
        wait_until(lambda: hand.wish() == (0, 0), "a page that is back")
        tab.key("Up", "KeyA")
        # Another window of the browser takes the keys.
        tab.key("Down", "KeyW")
        wait_until(lambda: hand.wish() == (100, 100), "the key")
        tab.run("window.dispatchEvent(new Event('blur'))")
        wait_until(lambda: hand.wish() == (0, 0), "its release")
        tab.key("Up", "KeyW")
        hand.end()
        tab.until(f"{STANDING} === 'the recording has ended'")


def test_a_second_page_is_told_that_it_does_not_drive(tab):
    with page(tab, TWO_WHEELS) as (hand, _):
        tab.key("Down", "KeyW")
        wait_until(lambda: hand.wish() == (100, 100), "the key")
        other = (
            "fetch('drive', {method: 'POST', headers: {'Content-Type': 'application/json'}, "
            "body: JSON.stringify({page: 'other', levers: [0, 0], speed: 1})}).then(r => r.json())"
        )
        assert "another page drives" in tab.run(other)["error"]
        for wrong in ("{}", "{page: 'a', levers: 1}", "{page: 'a', levers: ['x', 0]}"):
            asked = other.replace("{page: 'other', levers: [0, 0], speed: 1}", wrong)
            status = tab.run(asked.replace("r.json()", "r.status"))
            assert status == 400
        tab.key("Up", "KeyW")
