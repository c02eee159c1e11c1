"""The virtual Thymio and the driver's program, seen by the makers' own client, thymiodirect."""

import asyncio
import threading
import time
from contextlib import contextmanager

import pytest

from neurosim.lab import VirtualThymioRig
from neurosim.robots.thymio.aseba import Description
from neurosim.robots.thymio.driver import _program

pytest.importorskip("thymiodirect")

#: The driver's program in the assembler of that client.
SOURCE = """
    dc end_toc
    dc _ev.motor, motor
end_toc:
motor:
    load _userdata+1
    load _userdata+1
    push.s 0
    gt
    sub
    store _userdata+1
""" + "".join(f"""
    load _userdata+{place}
    load _userdata+1
    push.s 0
    gt
    mult
    store motor.{side}.target
""" for place, side in ((2, "left"), (3, "right"))) + """
    push.s _userdata+7
    push.s _userdata+6
    push.s _userdata+5
    callnat _nf.leds.top
""" + "".join(f"""
    load _userdata+{total}
    load motor.{side}.speed
    add
    store _userdata+{total}
    load _userdata+{count}
    load _userdata+{total}
    push.s 32
    div
    add
    store _userdata+{count}
    load _userdata+{total}
    push.s 32
    mod
    store _userdata+{total}
""" for total, count, side in ((8, 10, "left"), (9, 11, "right"))) + """
    stop
"""  # fmt: skip


@contextmanager
def client(rig):
    """Give the client's connection to a virtual robot."""
    from thymiodirect.connection import Connection

    host, port = rig.address.removeprefix("socket://").split(":")
    loop = asyncio.new_event_loop()
    threading.Thread(target=loop.run_forever, daemon=True).start()

    async def make():
        return Connection.tcp(host, int(port), loop=loop, refreshing_rate=0.05, discover_rate=0.5)

    connection = asyncio.run_coroutine_threadsafe(make(), loop).result(10)
    try:
        yield connection
    finally:
        connection.shutdown()


def test_the_makers_client_reaches_the_virtual_robot_and_assembles_the_same_program():
    from thymiodirect.assembler import Assembler

    with VirtualThymioRig(1, camera=False, device="socket") as rig, client(rig) as connection:
        connection.wait_for_handshake(timeout=20)
        number = connection.one_remote_node_id()
        node = connection.remote_nodes[number]
        assert node.name == "thymio-II"
        connection.set_var(number, "motor.left.target", -120)
        connection.set_var(number, "motor.right.target", 340)
        end = time.monotonic() + 20
        while rig.firmware.targets != (-120, 340) and time.monotonic() < end:
            time.sleep(0.02)
        assert rig.firmware.targets == (-120, 340)
        known = Description(
            "thymio-II", dict(node.var_offset), node.var_total_size, node.local_events,
            node.native_functions,
        )  # fmt: skip
        assert _program(known) == Assembler(node, SOURCE).assemble()
