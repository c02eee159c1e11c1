"""How well the camera's clock and the robot's are matched, by flashes and by motion alone.

    python benchmarks/clock_sync.py             about 2 minutes
    python benchmarks/clock_sync.py --quick     half a minute, fewer robots
    python benchmarks/clock_sync.py --correction    a minute, the last part only

Everything is compared with the lab's clock. The lab's radio carries a telegram for 20 ms on average
(standard deviation 4 ms), and its lamp follows with a lag of 4 ms.

  - motion: robots of the lab drive 40 commands of Pretorius et al. (2009), section 5.1; a camera
  whose clock drifts sees their true path 30 times a second, with the tracker's errors and dropped
  frames. Printed are: the motors' delay, estimated on the true clock, less the radio's 20 ms, and
  this error over its stated standard deviation; and the largest error, between the first frame and
  the last, of the clock from the motion alone (``--sync motion``), less the same 20 ms.
  - rendered: recordings of 15 commands in the lab, filmed, tracked as ``neurosim track`` does. The
    time of each flash less when its light changed in the lab (the mean over its edges), and the
    clock by motion less the radio's 20 ms.
  - correction: 500 commands, whose track is on the clock that the flashes give, or 50 ms late on
  it, as if the radio carried the lamp's telegrams 50 ms sooner than the motors'. A dataset
    with the delay corrected and one as sent; the mean absolute errors, on the held-out fifth of the
    rows, of a network that is trained on each.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.lab import VirtualRig, read_truth
from neurosim.recording.commands import RandomCommands
from neurosim.recording.record import Guard, RecordSettings, Rig, record
from neurosim.training.train import train
from tracking.clock.motion import fit_clock_to_motion
from tracking.clock.motor_delay import motion_delay
from tracking.clock.sync import GROUP_GAP
from tracking.datasets.dataset import build
from tracking.datasets.recordings import Poses, Recording
from tracking.track import track

FPS, RADIO, LAMP = 30.0, 0.020, 0.004
#: The tracker's errors in the lab: standard deviations, m, m, rad.
NOISE = (0.0005, 0.0005, 0.003)
#: Name: fraction of frames that is dropped, and how much the clocks drift.
CASES = {
    "clean": (0.0, 0.0),
    "5 % of frames dropped": (0.05, 0.0),
    "30 % of frames dropped": (0.30, 0.0),
    "drift of 50 ppm": (0.05, 50e-6),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--robots", type=int, default=12)
    parser.add_argument("--recordings", type=int, default=3, help="rendered ones")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--correction", action="store_true")
    options = parser.parse_args()
    if options.correction:
        with tempfile.TemporaryDirectory() as name:
            rows = correction(Path(name))
        print(json.dumps(rows) if options.json else "\n".join(map(str, rows)))
        return
    if options.quick:
        options.robots, options.recordings = 4, 1
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        drives = [drive(folder / f"drive-{seed}", seed) for seed in range(options.robots)]
        motion = {case: summary(drives, *values) for case, values in CASES.items()}
        rendered = [film(folder / f"film-{seed}", seed) for seed in range(options.recordings)]
    if options.json:
        print(json.dumps({"robots": options.robots, "motion": motion, "rendered": rendered}))
        return
    print(
        f"{options.robots} robots, ms{'':14}delay: RMSE   error / sd   --sync motion: RMSE   worst"
    )
    for case, value in motion.items():
        print(
            f"{case:28}{value['delay_rmse_ms']:11.1f}{value['delay_over_sd']:13.2f}"
            f"{value['motion_rmse_ms']:19.1f}{value['motion_worst_ms']:8.1f}"
            + (f"   refused: {value['refused']}" if value["refused"] else "")
        )
    print("rendered, errors in ms   first flash, last (stated sd)   by motion (stated sd)")
    for place, value in enumerate(rendered):
        first, last = value["flash_ms"]
        print(
            f"recording {place}{first:22.1f}{last:7.1f} ({value['flash_sd_ms']:.1f})"
            f"{value['motion_ms']:20.1f} ({value['motion_sd_ms']:.1f})"
        )


def drive(folder: Path, seed: int) -> Recording:
    """Record 40 commands of a robot of the lab, without a camera."""
    with VirtualRig(seed, noise_seed=100 + seed, camera=False) as rig:
        return record(
            folder, Rig.of_lab(rig), RandomCommands(seed=seed), RecordSettings(40),
            say=lambda message: None,
        )  # fmt: skip


def correction(folder: Path) -> list[dict[str, Any]]:
    """Train on a drive with its delay corrected and without; return the held-out errors."""
    with VirtualRig(3, noise_seed=103, camera=False) as rig:
        drive = record(
            folder / "drive", Rig.of_lab(rig), RandomCommands(seed=3),
            RecordSettings(500, Guard("ignore")), say=lambda message: None,
        )  # fmt: skip
    times, poses = seen(drive, 0.0, np.random.default_rng(0))
    count, rows = len(times), []
    for late in (0.0, 0.050):
        copy = Recording(shutil.copytree(drive.path, folder / f"late-{late}"))
        clock = times - RADIO + late
        copy.write_poses(Poses(np.ones(count, int), np.arange(count), clock, poses, np.ones(count)))
        for correct in (True, False):
            out = folder / f"dataset-{late}-{correct}"
            dataset = build([copy.path], out, correct_delay=correct)
            simulator = train(
                out, folder / f"{out.name}-sim", members=1, noise=False, progress=False,
            )  # fmt: skip
            result = simulator.meta["test_errors"]
            rows.append(
                {
                    "late_ms": 1000 * late,
                    "corrected": dataset.meta["motor_delays"][0]["corrected"],
                    "delay_ms": 1000 * dataset.meta["motor_delays"][0]["delay"],
                    **{name: error["mean_absolute_error"] for name, error in result.items()},
                }
            )
    return rows


def summary(drives: list[Recording], dropped: float, drift: float) -> dict[str, Any]:
    """Find delay and clock of every drive, and give the errors in ms."""
    delays, ratios, clocks, refused = [], [], [], 0
    for place, recording in enumerate(drives):
        lines = [line for line in recording.commands().itertuples() if line.is_motor]
        times, poses = seen(recording, dropped, np.random.default_rng(place))
        delay = motion_delay(times, poses, lines)
        if delay is not None:
            delays.append(delay.delay - RADIO)
            ratios.append((delay.delay - RADIO) / delay.sd)
        camera = 12.5 + (1 + drift) * times
        try:
            fit = fit_clock_to_motion(camera, poses, lines)
        except UserError:
            refused += 1
            continue
        miss = fit.to_robot(camera[[0, -1]]) - times[[0, -1]] + RADIO
        clocks.append(miss[np.abs(miss).argmax()])
    return {
        "delay_rmse_ms": rms(1000 * np.array(delays)),
        "delay_over_sd": rms(np.array(ratios)),
        "motion_rmse_ms": rms(1000 * np.array(clocks)),
        "motion_worst_ms": float(1000 * np.abs(clocks).max()),
        "refused": refused,
    }


def seen(recording: Recording, dropped: float, rng: np.random.Generator) -> tuple[NDArray, NDArray]:
    """Return times [N] on the lab's clock and poses [N, 3] as a camera and tracker give them."""
    truth = read_truth(recording.path)
    times = np.arange(truth.times[0] + rng.uniform(0, 1 / FPS), truth.times[-1], 1 / FPS)
    times = times[rng.random(len(times)) >= dropped]
    return times, truth.pose_at(times) + NOISE * rng.standard_normal((len(times), 3))


class Heard:
    """The lab's brick, and the times on the lab's clock of telegrams to the lamp's motor port."""

    def __init__(self, rig: VirtualRig):
        self.rig, self.lamp = rig, []

    def handle(self, telegram: bytes) -> bytes | None:
        """Carry out one telegram; those that set an output name the port in their third byte."""
        if telegram[1:3] == b"\x04\x00":
            self.lamp.append(self.rig.lab.clock.now())
        return self.rig.brick.handle(telegram)


def film(folder: Path, seed: int) -> dict[str, Any]:
    """Film 15 commands in the lab and track them twice; return the clocks' errors in ms."""
    with VirtualRig(seed, noise_seed=200 + seed) as rig:
        rig.radio.brick = heard = Heard(rig)
        optics, params = rig.camera.optics, rig.camera.params
        record(
            folder, Rig.of_lab(rig), RandomCommands(seed=seed), RecordSettings(15),
            live=False, say=lambda message: None,
        )  # fmt: skip
    model = optics.calibration
    recording = Recording(folder)

    def camera_clock(time: NDArray) -> NDArray:
        return params.clock_offset + (1 + params.clock_drift) * time

    def robot_clock(sync: str, camera: NDArray) -> tuple[NDArray, float]:
        clock = track(folder, calibration=model, sync=sync)["sessions"][0]["clock"]
        return clock["offset"] + (1 + clock["drift"]) * camera, clock["sd"]

    sent = np.array(
        [line.time for line in recording.commands().itertuples() if line.kind.startswith("lamp")]
    )
    # Each edge comes once its telegram has arrived and the filament has followed.
    lit = np.array(heard.lamp[: len(sent)]) + LAMP
    at, flash_sd = robot_clock("flash", camera_clock(lit))
    flashes = np.split(at - sent, 1 + np.flatnonzero(np.diff(sent) > GROUP_GAP))
    ends = recording.frame_times(1)[[0, -1]]
    lab = (ends - params.clock_offset) / (1 + params.clock_drift)
    at, motion_sd = robot_clock("motion", ends)
    miss = at - lab + RADIO
    return {
        "flash_ms": [float(1000 * edges.mean()) for edges in flashes],
        "flash_sd_ms": 1000 * flash_sd,
        "motion_ms": float(1000 * miss[np.abs(miss).argmax()]),
        "motion_sd_ms": 1000 * motion_sd,
    }


def rms(values: NDArray) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    main()
