"""The virtual brick's telegrams, against LEGO's appendices byte by byte."""

import struct
from contextlib import suppress

import pytest
from brick_body import Body, Output
from hypothesis import given
from hypothesis import strategies as st

from neurosim.lab.nxt.brick import _DIRECT, _SYSTEM, VirtualBrick, telegram_length


@pytest.fixture
def body():
    return Body()


@pytest.fixture
def brick(body):
    return VirtualBrick(body, "Pippin", address="00:16:53:0A:0B:0C")


def ask(brick, text):
    reply = brick.handle(bytes.fromhex(text))
    return None if reply is None else reply.hex(" ")


def test_who_it_is(brick):
    name = b"Pippin".ljust(15, b"\0").hex(" ")
    assert ask(brick, "01 9b") == f"02 9b 00 {name} 00 16 53 0a 0b 0c 00 00 00 00 00 00 00 00 00"
    assert ask(brick, "01 88") == "02 88 00 7c 01 1f 01"
    assert ask(brick, "00 0b") == "02 0b 00 dc 1e"
    assert ask(brick, "00 0d") == "02 0d 00 c0 27 09 00"
    assert ask(brick, "01 9a") == "02 9a 00 00 16 53 0a 0b 0c 00"
    assert ask(brick, "01 98" + b"Merry".ljust(15, b"\0").hex()) == "02 98 00"
    assert brick.name == "Merry"


def test_output_state_goes_in_and_comes_out(brick, body):
    assert ask(brick, "00 04 01 ce 07 01 9c 20 10 27 00 00") == "02 04 00"
    assert body.outputs[1] == Output(-50, 7, 1, -100, 0x20, 10000)
    assert body.outputs[0] == body.outputs[2] == Output()
    body.outputs[1].tacho_count, body.outputs[1].rotation_count = -2, 2**31 + 5
    reply = brick.handle(bytes.fromhex("00 06 01"))
    assert len(reply) == 25
    counts = struct.unpack("<iii", reply[-12:])
    assert counts == (-2, 0, -(2**31) + 5)
    assert reply[:9].hex(" ") == "02 06 00 01 ce 07 01 9c 20"


def test_port_ff_sets_all_three_outputs(brick, body):
    ask(brick, "80 04 ff 1e 07 01 00 20 00 00 00 00")
    assert [output.power for output in body.outputs] == [30, 30, 30]


def test_thirteen_byte_set_output_of_other_clients_is_taken(brick, body):
    assert ask(brick, "00 04 00 64 01 00 00 20 00 00 00 00 00") == "02 04 00"
    assert body.outputs[0].power == 100


def test_no_reply_bit_means_no_reply_but_the_deed(brick, body):
    assert ask(brick, "80 05 02 05 00") is None
    assert body.types[2] == (5, 0)
    assert ask(brick, "80 55") is None
    assert ask(brick, "81 9b") is None


def test_reset_of_a_counter(brick, body):
    assert ask(brick, "00 0a 02 01") == "02 0a 00"
    assert body.resets == [(2, True)]


@pytest.mark.parametrize(
    ("telegram", "status"),
    [
        ("00 55", 0xBE),
        ("01 55", 0xBE),
        ("00 9b", 0xBE),  # a system command in a direct telegram
        ("01 03 00 00 00 00", 0xBE),
        ("00 04 01", 0xBF),
        ("00 0b 00", 0xBF),
        ("00 04 03 00 00 00 00 00 00 00 00 00", 0xC0),  # output port 3
        ("00 04 00 65 00 00 00 00 00 00 00 00", 0xC0),  # power 101
        ("00 04 00 00 08 00 00 00 00 00 00 00", 0xC0),  # mode
        ("00 04 00 00 00 03 00 00 00 00 00 00", 0xC0),  # regulation
        ("00 04 00 00 00 00 65 00 00 00 00 00", 0xC0),  # turn ratio
        ("00 04 00 00 00 00 00 30 00 00 00 00", 0xC0),  # run state
        ("00 05 04 05 00", 0xC0),  # sensor port 5
        ("00 05 00 13 00", 0xC0),  # sensor type
        ("00 06 03", 0xC0),
        ("00 07 04", 0xC0),
        ("00 08 04", 0xC0),
        ("00 0a 03 00", 0xC0),
        ("00 00 61 2e 72 78 65 00", 0xC0),  # start a.rxe
        ("00 01", 0xEC),
        ("00 11", 0xEC),
        ("00 02 00 61 00", 0xC0),  # sound file
        ("00 13 00 00 00", 0x40),
        ("00 13 14 00 00", 0xEE),
        ("00 09 14 01 00", 0xEE),
        ("00 09 00 02 41 42", 0xC0),  # message without its closing zero
        ("01 80" + "61" + "00" * 19, 0x87),
        ("01 86 2a 2e 2a" + "00" * 17, 0x87),
        ("01 87 00", 0x93),
        ("01 84 00", 0x93),
        ("01 85 61" + "00" * 19, 0x87),
        ("01 81 61" + "00" * 23, 0x82),
        ("01 90 2a 2e 2a" + "00" * 17, 0x90),
        ("01 94 01 00 0d 00 00 00 01 00", 0x90),
        ("00 0e 00", 0xE0),
        ("00 0f 00 02 01 02 00", 0xE0),
    ],
)
def test_error_statuses(brick, telegram, status):
    reply = brick.handle(bytes.fromhex(telegram))
    assert reply[:3] == bytes([0x02, bytes.fromhex(telegram)[1], status])


def test_a_refused_telegram_changes_nothing(brick, body):
    ask(brick, "00 04 ff 65 07 01 00 20 00 00 00 00")
    ask(brick, "00 05 00 13 00")
    assert body.outputs == [Output()] * 3
    assert body.types == [(0, 0)] * 4


def test_i2c_without_a_device_is_a_bus_error(brick):
    ask(brick, "00 05 03 0b 00")
    assert ask(brick, "00 0e 03") == "02 0e 00 00"
    assert ask(brick, "00 0f 03 02 08 02 00") == "02 0f 00"
    assert ask(brick, "00 0e 03") == "02 0e dd 00"
    assert ask(brick, "00 10 03").startswith("02 10 dd")
    assert ask(brick, "00 0f 03 00 08") == "02 0f ed"


def test_messages_come_back_in_order(brick):
    assert ask(brick, "00 09 02 03 41 42 00") == "02 09 00"
    assert ask(brick, "00 09 02 02 43 00") == "02 09 00"
    first = brick.handle(bytes.fromhex("00 13 02 07 00"))
    assert len(first) == 64
    assert first[:8].hex(" ") == "02 13 00 07 03 41 42 00"
    assert brick.handle(bytes.fromhex("00 13 02 07 01")) == first
    assert brick.handle(bytes.fromhex("00 13 02 07 01"))[4:7] == b"\x02C\0"
    assert ask(brick, "00 13 02 07 01")[6:8] == "40"


def values(brick, type_, mode, port=0):
    brick.handle(bytes([0x80, 0x05, port, type_, mode]))
    reply = brick.handle(bytes([0x00, 0x07, port]))
    assert len(reply) == 16
    return struct.unpack("<BBBBBHHhh", reply[3:])


def test_light_sensor_as_the_firmware_sees_it(brick, body):
    body.raw = 460  # 1023 - 563: light of 0.55
    # 200 + 0.68 x 460, rounded up; (313 x 100) // 68 = 460 back.
    assert values(brick, 5, 0x00) == (0, 1, 0, 5, 0, 513, 563, 563, 563)
    assert values(brick, 5, 0x80)[7] == 55
    assert values(brick, 6, 0x20)[7] == 0
    body.raw = 1023
    assert values(brick, 5, 0x20)[6:8] == (0, 1)
    body.raw = 0
    assert values(brick, 5, 0x80)[7] == 100


def test_other_sensors(brick, body):
    body.raw = 1023  # nothing there, or a touch sensor that is not pressed
    assert values(brick, 1, 0x20)[5:8] == (1023, 1023, 0)
    body.raw = 180
    assert values(brick, 1, 0x20)[7] == 1
    body.raw = 460
    assert values(brick, 0x0E, 0x00)[6] == pytest.approx(563, abs=1)
    assert values(brick, 0x0D, 0x00)[7] == 6  # white
    body.raw = 1000
    assert values(brick, 0x0D, 0x00)[7] == 1  # black
    body.raw = 511
    assert values(brick, 2, 0xA0)[7] == 511 * 900 // 1023 - 200
    assert values(brick, 0x0B, 0x00)[5:8] == (511, 0, 0)


@given(st.integers(0, 1023))
def test_light_comes_through_within_one_step(raw):
    body = Body(raw)
    assert abs(values(VirtualBrick(body), 5, 0)[6] - (1023 - raw)) <= 1


@given(st.binary(max_size=80))
def test_any_bytes_get_a_proper_answer_or_none(telegram):
    _check_answer(telegram)


@given(
    st.sampled_from([0x00, 0x01, 0x80, 0x81]),
    st.sampled_from([*_DIRECT, *_SYSTEM]),
    st.binary(max_size=30),
)
def test_any_body_of_a_known_opcode_gets_a_proper_answer(kind, opcode, body):
    _check_answer(bytes([kind, opcode]) + body)


def _check_answer(telegram):
    reply = VirtualBrick(Body()).handle(telegram)
    asks = len(telegram) >= 2 and telegram[0] in (0x00, 0x01)
    assert (reply is not None) == asks
    if asks:
        assert reply[0] == 0x02
        assert reply[1] == telegram[1]
        assert 3 <= len(reply) <= 64


def test_lengths_of_what_nxt_python_sends():
    """Every telegram that nxt-python's Brick can build, cut out of a stream by its head."""
    import nxt.brick
    from nxt.motor import Mode, Port, RegulationMode, RunState
    from nxt.sensor import Mode as SensorMode
    from nxt.sensor import Port as SensorPort
    from nxt.sensor import Type

    sent = []

    class Sock:
        def send(self, data):
            sent.append(data)

        def recv(self):
            raise EOFError

        def close(self):
            pass

    brick = nxt.brick.Brick(Sock())
    calls = [
        (brick.start_program, "a.rxe"),
        (brick.stop_program,),
        (brick.play_sound_file, False, "a.rso"),
        (brick.play_tone, 440, 100),
        (brick.set_output_state, Port.A, 9, Mode.ON, RegulationMode.SPEED, 0, RunState.RUNNING, 0),
        (brick.set_input_mode, SensorPort.S1, Type.SWITCH, SensorMode.BOOL),
        (brick.get_output_state, Port.A),
        (brick.get_input_values, SensorPort.S1),
        (brick.reset_input_scaled_value, SensorPort.S1),
        (brick.message_write, 3, b"hello"),
        (brick.reset_motor_position, Port.A, True),
        (brick.get_battery_level,),
        (brick.stop_sound_playback,),
        (brick.keep_alive,),
        (brick.ls_get_status, SensorPort.S1),
        (brick.ls_write, SensorPort.S1, b"\x02\x00", 8),
        (brick.ls_read, SensorPort.S1),
        (brick.get_current_program_name,),
        (brick.message_read, 1, 2, True),
        (brick.file_open_read, "a.rxe"),
        (brick.file_open_write, "a.rxe", 9),
        (brick.file_read, 1, 9),
        (brick.file_close, 1),
        (brick.file_delete, "a.rxe"),
        (brick.file_find_first, "*.*"),
        (brick.file_find_next, 1),
        (brick.get_firmware_version,),
        (brick.module_find_first, "*.*"),
        (brick.read_io_map, 1, 2, 3),
        (brick.write_io_map, 1, 2, b"abc"),
        (brick.set_brick_name, "Sam"),
        (brick.get_device_info,),
        (brick.delete_user_flash,),
        (brick.poll_command_length, 0),
        (brick.poll_command, 0, 4),
    ]
    for call, *arguments in calls:
        with suppress(EOFError):
            call(*arguments)
    assert len(sent) == len(calls)
    for telegram in sent:
        assert telegram_length(telegram + b"\0\6\0") == len(telegram), telegram.hex(" ")
        assert telegram_length(telegram[:1]) is None
        reply = VirtualBrick(Body()).handle(telegram)
        if reply is not None:
            assert reply[2] not in (0xBE, 0xBF)
