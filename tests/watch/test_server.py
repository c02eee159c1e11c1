"""Which requests the page's server answers, and which it rejects."""

import http.client
import json
import socket
import subprocess
import sys
from contextlib import suppress
from urllib.request import urlopen

import numpy as np
import pytest
from patience import PATIENCE, wait_until

from neurosim.base.errors import UserError
from neurosim.watch import PageServer, Viewer
from neurosim.watch import server as server_module
from tracking.datasets.recordings import DEFAULT_BOARD, DEFAULT_MARKERS
from tracking.live import Seen
from tracking.markers.colours import parse_colour
from tracking.markers.tracker import Sighting

PINK, BLUE = (160, 70, 235), (225, 105, 40)  # BGR


def picture():
    frame = np.full((120, 160, 3), 128, np.uint8)
    frame[40:60, 40:60], frame[40:60, 80:100] = PINK, BLUE
    return frame


def make_viewer(folder, settable=True):
    asked = []
    viewer = Viewer(
        (160, 120),
        DEFAULT_MARKERS,
        (parse_colour("pink"), parse_colour("blue")),
        board=DEFAULT_BOARD,
        look_for=(lambda *what: asked.append(what)) if settable else None,
        calibration_file=folder / "calibration.json",
        markers_file=folder / "markers.json",
    )
    viewer.asked = asked
    front, rear = np.array([50.0, 50.0]), np.array([90.0, 50.0])
    viewer.show(Seen(0, 0.0, 0.0, picture(), Sighting(front, rear, 0.9, 20.0)))
    return viewer


@pytest.fixture
def viewer(tmp_path):
    return make_viewer(tmp_path)


@pytest.fixture
def server(viewer):
    with PageServer(viewer) as server:
        yield server


def ask(server, what="", method="GET", body=None, path=None, **headers):
    """Return status, headers and body; the header names with _ for -, None to leave one out."""
    connection = http.client.HTTPConnection(*server.address, timeout=PATIENCE)
    port = server.address[1]
    given = {"Host": f"127.0.0.1:{port}"}
    if body is not None:
        body = body if isinstance(body, bytes) else json.dumps(body).encode()
        given |= {"Content-Type": "application/json", "Content-Length": str(len(body))}
    given |= {name.replace("_", "-"): value for name, value in headers.items()}
    place = "/" + server.url.split("/", 3)[3] + what if path is None else path
    connection.putrequest(method, place, skip_host=True, skip_accept_encoding=True)
    for name, value in given.items():
        if value is not None:
            connection.putheader(name, value)
    connection.endheaders(body)
    reply = connection.getresponse()
    answer = reply.status, reply.headers, reply.read()
    connection.close()
    return answer


def test_it_listens_on_the_loopback_address_alone(server):
    assert server.address[0] == "127.0.0.1"
    others = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None)}
    for address in others - {"127.0.0.1", "::1"}:
        with pytest.raises(OSError):  # noqa: PT011 - refused or unreachable, as the system says
            socket.create_connection((address, server.address[1]), timeout=2)


def test_its_own_page_is_answered(server):
    assert ask(server)[0] == 200
    assert ask(server, Sec_Fetch_Site="none")[0] == 200
    status, headers, body = ask(
        server,
        "picture?after=0",
        Sec_Fetch_Site="same-origin",
        Origin=f"http://127.0.0.1:{server.address[1]}",
    )
    assert status == 200
    assert body.startswith(b"\xff\xd8")
    assert json.loads(headers["Neurosim-State"])["in_view"] is True
    policy = headers["Content-Security-Policy"]
    assert policy.startswith("default-src 'none'")
    assert "frame-ancestors 'none'" in policy
    assert "unsafe" not in policy


FOREIGN = [
    {"Host": None},
    {"Host": "evil.example"},
    {"Host": "127.0.0.1.evil.example:80"},
    {"Host": "127.0.0.1"},
    {"Origin": "http://evil.example"},
    {"Origin": "null"},
    {"Origin": "https://127.0.0.1"},
    {"Origin": "http://127.0.0.1:1"},
    {"Sec_Fetch_Site": "cross-site"},
    {"Sec_Fetch_Site": "same-site"},
]


@pytest.mark.parametrize("headers", FOREIGN, ids=str)
def test_others_are_refused(server, viewer, headers):
    for what, method, body in (
        ("", "GET", None),
        ("picture", "GET", None),
        ("colour", "POST", {"which": "front", "u": 50, "v": 50}),
    ):
        status, _, message = ask(server, what, method, body, **headers)
        assert status == 403
        assert b"\xff\xd8" not in message
        assert server.url.split("/")[3].encode() not in message
    assert viewer.asked == []


@pytest.mark.parametrize("name", ["Host", "Origin"])
def test_who_asks_twice_is_refused(server, name):
    port = server.address[1]
    own = f"127.0.0.1:{port}" if name == "Host" else f"http://127.0.0.1:{port}"
    with socket.create_connection(server.address, timeout=PATIENCE) as line:
        path = server.url.split("/", 3)[3]
        both = f"{name}: {own}\r\n{name}: http://evil.example\r\n"
        host = "" if name == "Host" else f"Host: 127.0.0.1:{port}\r\n"
        line.sendall(f"GET /{path} HTTP/1.1\r\n{host}{both}\r\n".encode())
        assert line.recv(100).startswith(b"HTTP/1.1 403 ")


def test_a_number_of_any_length_is_no_trouble(server):
    assert ask(server, "picture?after=" + "9" * 6000)[0] == 200


@pytest.mark.parametrize("path", ["/", "/picture", "//", "/wrong/", "/wrong/picture", "*"])
def test_without_the_secret_there_is_nothing(server, path):
    assert ask(server, path=path)[0] == 403


def test_a_path_leads_nowhere_else(server):
    for what in ("page.py", "../server.py", "..%2fserver.py", "//etc/passwd", "page.html"):
        assert ask(server, what)[0] == 404
    assert ask(server, "nothing", "POST", {})[0] == 404


def test_two_runs_have_two_secrets(viewer):
    with PageServer(viewer) as a, PageServer(viewer) as b:
        assert a.url.split("/")[3] != b.url.split("/")[3]
        assert len(a.url.split("/")[3]) >= 32


@pytest.mark.parametrize(
    ("what", "body", "status"),
    [
        ("colour", b"{", 400),
        ("colour", [], 400),
        ("colour", b"[" * 4000, 400),
        ("colour", {"which": "left", "u": 1, "v": 1}, 400),
        ("colour", {"which": "front", "u": "1", "v": 1}, 400),
        ("colour", {"which": "front", "u": True, "v": 1}, 400),
        ("colour", b'{"which": "front", "u": NaN, "v": 1}', 400),
        ("colour", b'{"which": "front", "u": 1e999, "v": 1}', 400),
        ("colour", {"which": "front"}, 400),
        ("corner", {"corner": {}, "u": 1, "v": 1}, 400),
        ("board", {"length": None, "width": 1}, 400),
        ("save", {"what": "/etc/passwd"}, 400),
        ("draw", {"part": "house", "u": 1, "v": 1, "width": 0.02}, 400),
        ("draw", {"part": "wall", "u": 1, "v": 1}, 400),
        ("finish", {}, 400),
        ("colour", {"which": "front", "u": "x" * 5000}, 413),
    ],
)
def test_what_is_no_click_is_refused(server, viewer, what, body, status):
    assert ask(server, what, "POST", body)[0] == status
    assert viewer.asked == []


def test_a_form_of_another_site_cannot_post(server):
    body = b'{"which": "front", "u": 50, "v": 50}'
    for kind in ("text/plain", "application/x-www-form-urlencoded", None):
        assert ask(server, "colour", "POST", body, Content_Type=kind)[0] == 415
    assert ask(server, "colour", "POST", body, Content_Length=None)[0] == 411


def test_what_cannot_be_is_said_in_a_sentence(server, tmp_path):
    def say(command, **asked):
        status, _, body = ask(server, command, "POST", asked)
        assert status == 200
        return json.loads(body)

    assert "grey" in say("colour", which="front", u=10, v=10)["error"]
    assert "outside" in say("colour", which="front", u=1000, v=10)["error"]
    assert "four corners" in say("save", what="calibration")["error"]
    assert "m long" in say("board", length=-1, width=1)["error"]
    for corner in ("top left", "top right", "bottom right"):
        u = {"top left": 20, "top right": 60, "bottom right": 100}[corner]
        assert say("corner", corner=corner, u=u, v=50)["message"].startswith("next")
    assert "in a wrong order" in say("corner", corner="bottom left", u=140, v=50)["error"]
    say("corner", corner="top left", u=20, v=10)
    say("corner", corner="top right", u=140, v=10)
    say("corner", corner="bottom right", u=140, v=90)
    assert "lens is not known" in say("corner", corner="bottom left", u=20, v=90)["message"]
    assert list(tmp_path.iterdir()) == []


def test_nothing_can_be_set_where_nothing_may_be(tmp_path):
    viewer = make_viewer(tmp_path, settable=False)
    with PageServer(viewer) as server:
        assert ask(server, "picture")[0] == 200
        for what in ("colour", "corner", "board", "clear", "save", "draw", "finish", "undo"):
            reply = json.loads(ask(server, what, "POST", {"which": "front", "u": 50, "v": 50})[2])
            assert "recording" in reply["error"]


def test_a_port_that_is_taken_is_said(viewer):
    with (
        PageServer(viewer) as server,
        pytest.raises(UserError, match=rf"port {server.address[1]} is taken"),
    ):
        PageServer(viewer, server.address[1])


def test_a_reader_waits_for_the_next_picture_and_gets_each_once(viewer):
    data, state = viewer.picture(0, 0.0)
    assert data.startswith(b"\xff\xd8")
    assert viewer.picture(state["number"], 0.01)[0] == b""
    viewer.end("over")
    assert viewer.picture(state["number"], 30.0)[1]["ended"] == "over"


@pytest.mark.slow
def test_connections_that_ask_for_nothing_are_few_and_closed(server, monkeypatch):
    """Over a thousand open connections killed it, and used up a recording's descriptors."""
    address = server.address
    monkeypatch.setattr(server_module, "ASK_WITHIN", 0.5)
    held = [socket.create_connection(address) for _ in range(100)]
    for each in held[::2]:
        each.sendall(b"GET / HT")  # half of a request
    wait_until(lambda: len(server._server.asking) <= server_module.CONNECTIONS, "few connections")
    for each in held:
        each.settimeout(PATIENCE)
        with suppress(ConnectionError):
            assert each.recv(1) == b""
        each.close()
    wait_until(lambda: not server._server.asking, "none")
    with urlopen(server.url, timeout=PATIENCE) as reply:
        assert reply.status == 200


CROWD = """
import selectors, socket, sys
address = ("127.0.0.1", int(sys.argv[1]))
held, opened = selectors.DefaultSelector(), 0
while True:
    # As many as it can hold, and a new one for each that is closed.
    while len(held.get_map()) < 64:
        one = socket.create_connection(address)
        one.sendall([b"", b"GET / HT", b"GET /x HTTP/1.1\\r\\n\\r\\n"][opened % 3])
        held.register(one, selectors.EVENT_READ)
        opened += 1
        if opened == 200:
            print("crowded", flush=True)
    for key, _ in held.select(1):
        held.unregister(key.fileobj)
        key.fileobj.close()
"""


@pytest.mark.slow
def test_a_crowd_that_reconnects_all_the_time_keeps_nobody_out(server):
    command = [sys.executable, "-c", CROWD, str(server.address[1])]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as crowd:
        try:
            assert crowd.stdout.readline() == "crowded\n"
            for _ in range(20):
                with urlopen(server.url, timeout=PATIENCE) as reply:
                    assert reply.status == 200
                assert len(server._server.asking) <= server_module.CONNECTIONS
        finally:
            crowd.kill()
    wait_until(lambda: not server._server.asking, "none")
    assert not server._server.known


def test_who_has_shown_the_secret_keeps_its_place(server):
    mine = http.client.HTTPConnection(*server.address, timeout=PATIENCE)
    place = "/" + server.url.split("/", 3)[3]
    mine.request("GET", place)
    assert mine.getresponse().read()
    for _ in range(2 * server_module.CONNECTIONS):
        socket.create_connection(server.address).close()
    held = [socket.create_connection(server.address) for _ in range(server_module.CONNECTIONS)]
    mine.request("GET", place)
    assert mine.getresponse().status == 200
    mine.close()
    for each in held:
        each.close()
