"""The virtual Khepera's protocol, letter by letter, as clients of the real robot expect it."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neurosim.lab.khepera.firmware import BANNER, KheperaFirmware


class Body:
    """Remembers the values that it was given."""

    def __init__(self):
        self.wheel, self.at, self.goal = (0, 0), (0, 0), None

    def set_speeds(self, left, right):
        self.wheel = (left, right)

    def set_positions(self, left, right, limits):
        self.goal = (left, right, limits)

    def speeds(self):
        return self.wheel

    def counts(self):
        return self.at

    def set_counts(self, left, right):
        self.at = (left, right)

    def proximity(self):
        return [0, 1, 2, 3, 4, 5, 6, 1023]

    def ambient(self):
        return [500, 501, 502, 503, 504, 505, 506, 507]


@pytest.fixture
def body():
    return Body()


@pytest.fixture
def firmware(body):
    return KheperaFirmware(body)


@pytest.mark.parametrize(
    ("command", "answer"),
    [
        ("A,3800,800,100", "a"),
        ("B", "b,5.02,5.02-virtual"),
        ("C,100,-200", "c"),
        ("D,5,-5", "d"),
        ("E", "e,0,0"),
        ("F,3000,20,4000", "f"),
        ("G,0,0", "g"),
        ("H", "h,0,0"),
        ("I,3", "i,0"),
        ("J,20,64,20,64", "j"),
        ("K", "k,1,1,0,1,1,0"),
        ("L,0,1", "l"),
        ("N", "n,0,1,2,3,4,5,6,1023"),
        ("O", "o,500,501,502,503,504,505,506,507"),
        ("P,0,0", "p"),
        ("R,0", "r,255"),
        ("W,255,0", "w"),
        ("T,1,B", "z,Protocol error"),
        ("D, 5 ,+5", "d"),
        ("D,5", "z,Protocol error"),
        ("D,5,5,5", "z,Protocol error"),
        ("D,a,5", "z,Protocol error"),
        ("D,5.0,5", "z,Protocol error"),
        ("N,1", "z,Protocol error"),
        ("L,2,0", "z,Protocol error"),
        ("L,0,3", "z,Protocol error"),
        ("I,6", "z,Protocol error"),
        ("G,2147483648,0", "z,Protocol error"),
        ("J,0,1,20,64", "z,Protocol error"),
        ("n", "z,Command not found"),
        ("X", "z,Command not found"),
        ("NN", "z,Command not found"),
        ("é", "z,Command not found"),
    ],
)
@pytest.mark.parametrize("end", [b"\r", b"\n", b"\r\n"])
def test_letter_by_letter(firmware, command, answer, end):
    assert firmware.feed(command.encode("latin-1") + end) == answer.encode() + b"\r\n"


def test_what_is_set_is_read(firmware, body):
    firmware.feed(b"D,12,-7\r")
    assert firmware.feed(b"E\r") == b"e,12,-7\r\n"
    firmware.feed(b"G,100,-100\r")
    assert firmware.feed(b"H\r") == b"h,100,-100\r\n"
    firmware.feed(b"J,5,64,6,64\rC,10,20\r")
    assert body.goal == (10, 20, (5, 6))
    assert firmware.feed(b"K\r") == b"k,0,0,-90,0,0,120\r\n"
    firmware.feed(b"D,300,-300\r")
    assert body.wheel == (127, -127)
    firmware.feed(b"P,255,-51\r")
    assert body.wheel == (100, -20)


def test_lights_toggle(firmware):
    firmware.feed(b"L,1,2\rL,0,1\r")
    assert firmware.leds == [True, True]
    firmware.feed(b"L,1,2\rL,0,0\r")
    assert firmware.leds == [False, False]


def test_pieces_make_a_command_and_empty_lines_none(firmware):
    assert firmware.feed(b"D,1") == b""
    assert firmware.feed(b"0,3\n\r\n\r  \r") == b"d\r\n"


def test_a_line_too_long_is_one_error(firmware):
    assert firmware.feed(b"D," + b"1" * 500) == b""
    assert firmware.feed(b"\rB\r") == b"z,Protocol error\r\nb,5.02,5.02-virtual\r\n"


def test_restart_stops_and_says_who_it_is(firmware, body):
    firmware.feed(b"D,5,5\rG,9,9\rL,0,1\r")
    assert firmware.feed(b"restart\r") == BANNER
    assert (body.wheel, body.at, firmware.leds) == ((0, 0), (0, 0), [False, False])


@settings(deadline=None)
@given(st.lists(st.binary(max_size=40), max_size=8))
def test_no_bytes_break_it_and_every_answer_is_whole_lines(pieces):
    firmware = KheperaFirmware(Body())
    answer = b"".join(firmware.feed(piece) for piece in pieces)
    assert answer == b"" or answer.endswith(b"\r\n")
    assert firmware.feed(b"\rB\r").endswith(b"b,5.02,5.02-virtual\r\n")


@given(st.integers(-127, 127), st.integers(-127, 127))
def test_any_speed_echoes(left, right):
    firmware = KheperaFirmware(Body())
    assert firmware.feed(f"D,{left},{right}\rE\r".encode()) == f"d\r\ne,{left},{right}\r\n".encode()
