"""The page in a real browser: seen, clicked on, saved."""

import threading
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from devtools import browser_tab
from patience import wait_until

from neurosim.base.perimeter import Board
from neurosim.base.place import Line, Place
from neurosim.cli.main import cli
from neurosim.lab import CameraParams
from neurosim.lab.camera.camera import RoofCamera
from neurosim.lab.nxt.params import BOARD
from neurosim.watch import PageServer, Viewer
from tracking.camera.camera_model import CameraModel
from tracking.datasets.recordings import DEFAULT_BOARD, DEFAULT_MARKERS, read_markers
from tracking.live import LiveTracker
from tracking.markers.colours import parse_colour
from tracking.markers.tracker import Geometry
from tracking.poses import marker_geometry

POSE, BARE = np.array([0.62, -0.31, 0.8]), Place()


class Scene:
    """A robot that stands still under the lab's camera, at ten pictures a second."""

    def __init__(
        self, folder: Path, colours=("pink", "blue"), *, lens=False, around=BARE, place=None
    ):
        self.camera = RoofCamera(CameraParams(size=(640, 480)), 3, around=around)
        optics = self.camera.optics
        lens_of = (self.camera.size, optics.matrix, optics.distortion)
        known = CameraModel(*lens_of) if lens else None
        if place is not None:
            known = CameraModel(*lens_of, optics.rotation, optics.translation)
        board = asdict(around.board) if around.board else DEFAULT_BOARD
        self.viewer = Viewer(
            self.camera.size,
            DEFAULT_MARKERS,
            tuple(parse_colour(colour) for colour in colours),
            camera=known,
            board=board,
            look_for=self.look_for,
            calibration_file=folder / "calibration.json",
            markers_file=folder / "markers.json",
            place_file=folder / "place.json",
            place=place,
        )
        self.tracker = LiveTracker(
            tuple(parse_colour(colour) for colour in colours),
            None,
            time.monotonic,
            self.viewer.show,
        )
        self.pose = POSE
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._film, daemon=True)

    def look_for(self, colours, model):
        geometry = Geometry() if model is None else marker_geometry(DEFAULT_MARKERS, model)
        self.tracker.look_for(colours, geometry)

    def _film(self):
        number = 0
        while not self._end.wait(0.1):
            number += 1
            self.tracker.take(number / 10, self.camera.render(self.pose))

    def pixel(self, *point):
        return self.camera.project(np.array([point], float))[0]

    def marker(self, which):
        cos, sin = np.cos(POSE[2]), np.sin(POSE[2])
        x = DEFAULT_MARKERS[which]["x"]
        return self.pixel(POSE[0] + cos * x, POSE[1] + sin * x, 0.10)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *error):
        self._end.set()
        self._thread.join()
        self.tracker.close()


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    with browser_tab(tmp_path_factory.mktemp("browser")) as tab:
        yield tab


def click_picture(tab, pixel):
    """Click on a pixel of the picture, once its place on the page stays the same for a frame."""
    u, v = (float(place) for place in pixel)
    before = None
    while (place := tab.run(
        "new Promise(done => requestAnimationFrame(() => {"
        "const c = document.getElementById('picture');"
        "c.scrollIntoView({block: 'nearest'}); const b = c.getBoundingClientRect();"
        f"done([b.x + ({u} + 0.5) * b.width / c.width, b.y + ({v} + 0.5) * b.height / c.height]);"
        "}))"
    )) != before:  # fmt: skip
        before = place
    tab.click(*place)


STATUS = "document.getElementById('status').textContent"
SAYS = "document.getElementById('says').textContent"


def chosen(mode):
    return f"document.querySelector(`[data-mode='{mode}']`).ariaPressed === 'true'"


def test_a_student_sets_colours_and_corners_and_saves_them(tab, tmp_path):
    """It begins with wrong colours, and ends with files that the other commands accept."""
    with (
        Scene(tmp_path, ("green", "orange"), lens=True) as scene,
        PageServer(scene.viewer) as server,
    ):
        tab.open(server.url)
        tab.until(f"{STATUS}.includes('not found yet')")
        tab.click_on("button[data-mode=front]")
        for which in ("front", "rear"):  # the second is chosen when the first is set
            click_picture(tab, scene.marker(which) + np.array([2.0, -1.5]))
            tab.until(f"{SAYS}.startsWith('{which} marker: #')")
        tab.until(f"{STATUS} === 'the robot is seen'")
        assert tab.run("document.getElementById('place').textContent") == "–"
        # A corner that is wrong is clicked once more.
        tab.click_on("button[data-mode='top left']")
        click_picture(tab, (320, 240))
        tab.until(chosen("top right"))
        assert tab.run(SAYS) == "next: the top right corner"
        tab.click_on("button[data-mode='top left']")
        for corner, x, y, then in (
            ("top left", -1, 1, "top right"),
            ("top right", 1, 1, "bottom right"),
            ("bottom right", 1, -1, "bottom left"),
            ("bottom left", -1, -1, None),
        ):
            tab.until(chosen(corner))
            click_picture(tab, scene.pixel(x * BOARD.length / 2, y * BOARD.width / 2, 0.0))
            tab.until(chosen(then) if then else f"{SAYS}.includes('above the board')")
        place = tab.until("document.getElementById('place').textContent.replace('–', '')")
        x, y = (float(word) for word in place.removesuffix(" m").split(", "))
        assert np.hypot(x - POSE[0], y - POSE[1]) < 0.01
        for what in ("markers", "calibration"):
            tab.click_on(f"button[data-save={what}]")
            tab.until(f"{SAYS}.includes('{what}.json is written')")
        model = CameraModel.read(tmp_path / "calibration.json")
        assert model.has_board
        assert model.image_size == (640, 480)
        assert read_markers(tmp_path / "markers.json")["front"]["colour"].startswith("#")
        # An existing file is not replaced without a question.
        (tmp_path / "markers.json").write_text("mine")
        scene.viewer._saved.clear()
        tab.click_on("button[data-save=markers]")
        tab.until(f"{SAYS}.includes('exists already')")
        assert (tmp_path / "markers.json").read_text() == "mine"
        tab.click_on("#says button")
        tab.until(f"{SAYS}.includes('is written')")
        assert read_markers(tmp_path / "markers.json")
        # A hand takes the robot away.
        scene.pose = None
        tab.until(f"{STATUS}.startsWith('the robot is lost, for')")
        tab.until("document.title.startsWith('LOST')")
        scene.pose = POSE
        tab.until(f"{STATUS} === 'the robot is seen'")
        scene.viewer.end("the camera stopped")
        tab.until(f"{STATUS} === 'the camera stopped'")
    assert tab.complaints == []


def test_all_of_it_by_keyboard(tab, tmp_path):
    with Scene(tmp_path) as scene, PageServer(scene.viewer) as server:
        tab.open(server.url)
        tab.until(f"{STATUS} === 'the robot is seen'")
        tab.run("document.querySelector('[data-mode=front]').focus()")
        tab.press("Enter", "\r")
        tab.until(chosen("front"))
        tab.run("picture_ = document.getElementById('picture'); picture_.focus()")
        du, dv = np.round(scene.marker("front") - (320, 240)).astype(int)
        for steps, key in ((du, "Right" if du > 0 else "Left"), (dv, "Down" if dv > 0 else "Up")):
            tens, ones = divmod(abs(int(steps)), 10)
            for _ in range(tens):
                tab.press(f"Arrow{key}", modifiers=8)
            for _ in range(ones):
                tab.press(f"Arrow{key}")
        tab.press("Enter", "\r")
        tab.until(f"{SAYS}.startsWith('front marker: #')")
    assert tab.complaints == []


def test_a_page_that_outlives_its_server_says_so(tab, tmp_path):
    with Scene(tmp_path) as scene:
        with PageServer(scene.viewer) as server:
            tab.open(server.url)
            tab.until(f"{STATUS} === 'the robot is seen'")
        tab.until(f"{STATUS}.includes('neurosim has ended')")
    tab.complaints.clear()  # the browser's message about the server that has ended


def test_another_sites_page_gets_nothing(tab, tmp_path, monkeypatch):
    """The other page even knows the secret; the server does not fetch a picture."""
    with (
        Scene(tmp_path) as scene,
        Scene(tmp_path / "other") as elsewhere,
        PageServer(scene.viewer) as server,
        PageServer(elsewhere.viewer) as other,
    ):
        answered = []
        for name in ("picture", "set_colour"):
            monkeypatch.setattr(
                scene.viewer, name, lambda *_, **__: answered.append(1) or (b"", {})
            )
        # Without the page's own policy, which would block the request first.
        tab.call("Page.setBypassCSP", enabled=True)
        for host in ("localhost", "127.0.0.1"):  # another site, and another port of the same
            tab.open(other.url.replace("127.0.0.1", host))
            tab.until(f"{STATUS} === 'the robot is seen'")
            body = '{"which": "front", "u": 50, "v": 50}'
            for what, how in (
                ("picture", "{}"),
                ("picture", "{mode: 'no-cors'}"),
                ("colour", f"{{method: 'POST', mode: 'no-cors', body: '{body}'}}"),
                ("colour", f"{{method: 'POST', body: '{body}', "
                 "headers: {'Content-Type': 'application/json'}}"),
            ):  # fmt: skip
                tab.run(f"fetch('{server.url}{what}', {how}).then(r => r.status, () => -1)")
            image = "new Promise(done => { const i = new Image(); i.onload = () => done('seen');"
            image += f" i.onerror = () => done('refused'); i.src = '{server.url}picture'; }})"
            assert tab.run(image) == "refused"
        tab.call("Page.setBypassCSP", enabled=False)
        assert answered == []
        # The same server answers its own page.
        tab.open(server.url)
        wait_until(lambda: answered, "its own page")
    tab.complaints.clear()


#: As the lab's camera sees it; its box is four walls.
BOX = ((0.30, -0.30), (0.45, -0.20), (0.39, -0.11), (0.24, -0.21))
SKETCH = Place(
    outline=(
        (-0.55, -0.40), (0.55, -0.40), (0.55, 0.40), (0.10, 0.40), (0.10, 0.20), (-0.55, 0.20)
    ),
    walls=((-0.20, -0.30, 0.05, -0.10), *((*BOX[i], *BOX[(i + 1) % 4]) for i in range(4))),
    obstacles=((0.30, 0.10, 0.08),),
    lines=(
        Line(((-0.45, -0.30), (-0.45, 0.05), (-0.25, 0.10)), 0.03, closed=False),
        Line(((0.0, -0.3), (0.15, -0.3), (0.1, -0.2)), 0.02),
    ),
    lights=((0.45, 0.32),),
    board=Board(1.3, 1.0, line_inset=0.06, line_width=0.02),
    start=(-0.30, -0.05, -2.0),
)  # fmt: skip


def set_corners(tab, scene, board):
    tab.click_on("button[data-mode='top left']")
    for corner, x, y in (
        ("top left", -1, 1), ("top right", 1, 1), ("bottom right", 1, -1), ("bottom left", -1, -1)
    ):  # fmt: skip
        tab.until(chosen(corner))
        click_picture(tab, scene.pixel(x * board.length / 2, y * board.width / 2, 0.0))
    tab.until(f"{SAYS}.includes('above the board')")


def draw(tab, scene, part, *points, says, width=None):
    """Choose a part and click on points of the floor; the last click is answered with words."""
    tab.click_on(f"button[data-mode='{part}']")
    tab.until(chosen(part))
    if width is not None:
        tab.run(f"document.getElementById('line-width').value = '{width}'")
    for place, point in enumerate(points):
        click_picture(tab, scene.pixel(*point, 0.0))
        last = place == len(points) - 1
        tab.until(f"!setting && {SAYS}.includes('{says if last else 'next: '}')")
    tab.click_on(f"button[data-mode='{part}']")  # no longer chosen


def test_a_place_drawn_by_clicks_is_the_place_that_the_camera_sees(tab, tmp_path):
    """Every part, with a known lens and clicked corners; wrong clicks are undone."""
    with Scene(tmp_path, lens=True, around=SKETCH) as scene, PageServer(scene.viewer) as server:
        scene.pose = None
        tab.open(server.url)
        tab.until(f"{STATUS}.includes('not found yet')")
        draw(tab, scene, "wall", (0.0, 0.0), says="no calibration says where on the floor")
        assert tab.run("drawing.solid.length") == 0
        set_corners(tab, scene, SKETCH.board)
        # Wrong clicks.
        draw(tab, scene, "light", (0.0, 0.57), says="7 cm outside the board")
        tab.click_on("#finish")
        tab.until(f"{SAYS}.startsWith('there is nothing to finish')")
        tab.click_on("#undo")
        tab.until(f"{SAYS} === 'there is nothing to undo'")
        draw(tab, scene, "outline", *SKETCH.outline[:2], says="or finish")
        tab.click_on("#finish")
        tab.until(f"{SAYS} === 'an outline has at least 3 corners'")
        draw(tab, scene, "light", (0.0, 0.0), says="finish the outline first")
        tab.click_on("button[data-save=place]")
        tab.until(f"{SAYS}.includes('finish the outline first')")
        tab.until("drawing.clicks.length === 2")
        # A corner too many is undone, and the outline continues.
        draw(tab, scene, "outline", (0.2, 0.1), says="or finish")
        tab.click_on("#undo")
        tab.until(f"{SAYS} === 'the last click on the outline is undone'")
        draw(tab, scene, "outline", *SKETCH.outline[2:], says="or finish")
        tab.click_on("#finish")
        tab.until(f"{SAYS}.includes('the outline is drawn')")
        x1, y1, x2, y2 = SKETCH.walls[0]
        draw(tab, scene, "wall", (x1, y1), (x2, y2), says="the wall is drawn")
        draw(
            tab, scene, "cylinder", (-0.08, -0.15), (-0.08, 0.0), says="obstacle 0 overlaps a wall"
        )
        tab.click_on("#undo")  # the middle
        tab.until("!drawing.clicks.length")
        x, y, radius = SKETCH.obstacles[0]
        draw(tab, scene, "cylinder", (x, y), (x, y - radius), says="the cylinder is drawn")
        draw(tab, scene, "box", *BOX[:2], BOX[2], says="the box is drawn")
        for line, part in zip(SKETCH.lines, ("line", "closed line"), strict=True):
            draw(tab, scene, part, *line.points, says="or finish", width="0")
            tab.click_on("#finish")
            tab.until(f"{SAYS}.startsWith('type the width')")
            tab.run(f"document.getElementById('line-width').value = '{line.width}'")
            tab.click_on("#finish")
            tab.until(f"{SAYS}.includes('the {part} is drawn')")
        draw(tab, scene, "light", *SKETCH.lights, says="the light is drawn")
        draw(tab, scene, "light", (0.0, -0.35), says="the light is drawn")
        tab.click_on("#undo")
        tab.until(f"{SAYS} === 'the last part is undone'")
        x, y, theta = SKETCH.start
        ahead = (x + 0.2 * np.cos(theta), y + 0.2 * np.sin(theta))
        draw(tab, scene, "start", (x, y), ahead, says="the start is drawn")
        draw(tab, scene, "perimeter", (0.2, 0.44), says="the perimeter is drawn", width="0,02")
        # What is drawn over the picture lies where the lab's camera sees it.
        tab.until(f"drawing.solid.length === {len(SKETCH.walls) + 1}")
        ring = np.array(tab.run("drawing.solid.at(-1)"))
        x, y, radius = SKETCH.obstacles[0]
        assert ring[0] == pytest.approx(scene.pixel(x + radius, y, 0.0), abs=1.5)
        assert np.ptp(ring[:, 1]) == pytest.approx(
            np.ptp([scene.pixel(x, y + side, 0.0)[1] for side in (-radius, radius)]), abs=2
        )
        (tmp_path / "place.json").write_text("mine")
        tab.click_on("button[data-save=place]")
        tab.until(f"{SAYS}.includes('exists already')")
        assert (tmp_path / "place.json").read_text() == "mine"
        tab.click_on("#says button")
        tab.until(f"{SAYS}.includes('place.json is written')")
        assert tab.complaints == []
    result = Place.read(tmp_path / "place.json")
    assert (result.board.length, result.board.width) == (1.3, 1.0)
    # The browser rounds a click down to a pixel of the screen, here 2.5 mm.
    for name in ("outline", "walls", "obstacles", "lights"):
        assert np.array(getattr(result, name)) == pytest.approx(
            np.array(getattr(SKETCH, name)), abs=0.004
        )
    for line, true in zip(result.lines, SKETCH.lines, strict=True):
        assert np.array(line.points) == pytest.approx(np.array(true.points), abs=0.004)
        assert (line.width, line.closed) == (true.width, true.closed)
    assert result.board.line_inset == pytest.approx(0.06, abs=0.004)
    assert result.board.line_width == 0.02
    assert result.start[:2] == pytest.approx(SKETCH.start[:2], abs=0.004)
    assert result.start[2] == pytest.approx(SKETCH.start[2], abs=0.03)
    words = ["view", str(tmp_path / "place.json"), "-o", str(tmp_path / "place.png")]
    done = CliRunner().invoke(cli, words)
    assert done.exit_code == 0, done.output
    # It is shown when it is given again, and can be continued.
    (tmp_path / "again").mkdir()
    with (
        Scene(tmp_path / "again", around=SKETCH, place=result) as scene,
        PageServer(scene.viewer) as server,
    ):
        tab.open(server.url)
        tab.until(f"drawing.solid.length === {len(SKETCH.walls) + 1}")
        draw(tab, scene, "light", (0.0, -0.35), says="the light is drawn")
        tab.click_on("button[data-save=place]")
        tab.until(f"{SAYS}.includes('place.json is written')")
        assert Place.read(tmp_path / "again" / "place.json").lights[:1] == result.lights
    tab.complaints.clear()  # the browser's message about the servers that have ended
