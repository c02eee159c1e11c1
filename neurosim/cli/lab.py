"""``neurosim lab``: the virtual lab by itself."""

from __future__ import annotations

import time
from pathlib import Path

import click

from neurosim.cli._common import PATH, Size, emit, json_option, next_step, seed_option


@click.group()
def lab() -> None:
    """The virtual lab by itself: a brick for other programs, photographs for calibration."""


@lab.command()
@click.option("--socket", "by_socket", is_flag=True, help="Serve a socket instead of a device.")
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Of the socket; 0: any.")
@click.option("--seconds", type=float, help="Stop by itself after so long.  [default: Ctrl-C]")
@seed_option
@json_option
def nxt(by_socket: bool, port: int, seconds: float | None, seed: int, as_json: bool) -> None:
    """Keep a virtual NXT running in real time, for any program that speaks to bricks."""
    from neurosim.lab import VirtualRig
    from neurosim.lab.world import Pacer

    with VirtualRig(
        seed, camera=False, device="socket" if by_socket else None, port=port, real_time=True
    ) as rig:
        where, how = _ways(rig.address)
        with Pacer(rig.lab):
            emit(
                where,
                as_json,
                f"A virtual NXT runs in real time. Reach it with:\n{how}\nCtrl-C ends it.",
            )
            end = time.monotonic() + seconds if seconds is not None else float("inf")
            try:
                while time.monotonic() < end and rig.alive:
                    time.sleep(0.1)
            except KeyboardInterrupt:
                pass


def _ways(address: dict[str, str | int]) -> tuple[dict, str]:
    if "filename" in address:
        name = address["filename"]
        return address, (
            f"  nxt-test --backend devfile --filename {name}\n"
            f"  neurosim record OUT --robot nxt --device {name} --camera none"
        )
    host, port = address["server_host"], address["server_port"]
    return address, (
        f"  nxt-test --backend socket --server-host {host} --server-port {port}\n"
        f"  neurosim record OUT --robot nxt --server {host}:{port} --camera none"
    )


@lab.command()
@click.argument("out", type=PATH)
@click.option("--count", type=click.IntRange(min=3), default=20, show_default=True)
@click.option("--camera-size", type=Size(), default="640x480", show_default=True)
@seed_option
@json_option
def photographs(
    out: Path, count: int, camera_size: tuple[int, int], seed: int, as_json: bool
) -> None:
    """Take photographs of a chessboard and of the board with the lab's camera, into OUT."""
    from neurosim.lab.params import CameraParams
    from neurosim.lab.photographs import render_photographs

    render_photographs(out, CameraParams(size=camera_size), seed, count)
    emit(
        {"folder": str(out), "photographs": count},
        as_json,
        f"{out}: {count} photographs of a chessboard, a picture of the board, and points.csv "
        f"with the points that a person marked in it.\n"
        + next_step("calibrate", out, "--square", 40, "--points", out / "points.csv"),
    )
