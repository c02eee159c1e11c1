"""Small artefact folders of every kind, written by the real writers where these exist."""

import math

import numpy as np
import torch

from neurosim.base import files, se2
from neurosim.controllers import FixedPlan, SavedController
from neurosim.networks import ProductSummationNetwork
from neurosim.simulators import MotionNetwork
from neurosim.simulators.motion.files import write_motion
from tracking.datasets import dataset

#: Of a plan of two wheels, as trial.json names them.
COLUMNS = [
    {"name": "left", "unit": "%"},
    {"name": "right", "unit": "%"},
    {"name": "duration", "unit": "s"},
]
INPUTS = [{"name": name, "unit": unit} for name, unit in dataset.MOTOR_INPUTS.items()]

#: A plan around the course, as displacements in the robot's frame: it stands, drives and turns.
LEGS = [
    (0.50, 0.0, 0.0),
    (0.15, -0.15, -math.pi / 2),
    (1.10, 0.0, 0.0),
    (0.35, -0.35, -math.pi / 2),
    (0.45, 0.0, 0.0),
    (0.25, -0.25, -math.pi / 2),
    (0.90, 0.0, 0.0),
    (0.40, -0.38, -math.pi / 2),
    (0.25, 0.0, 0.0),
]
START = (-0.8, 0.0, math.pi / 2)
TASK = {"name": "nine-rectangles", "settings": {"penalty": 32.0, "longest_arc": 1.5}}


def make_dataset(folder, rows=150, seed=1, virtual=True):
    rng = np.random.default_rng(seed)
    motors = rng.uniform(-50, 50, (rows + 1, 2)).round(1)
    duration = rng.uniform(0.5, 3, rows)
    now, before = motors[1:], motors[:-1]
    turn = (now[:, 1] - now[:, 0]) / 100 * 0.5 / 0.13 * duration
    ahead = now.mean(1) / 100 * 0.5 * duration
    moved = se2.exp(np.stack([ahead, 0 * ahead, turn], 1)) + rng.normal(0, 0.003, (rows, 3))
    table = [
        {
            "recording": "rec", "command": place + 1, "prev_left": before[place, 0],
            "prev_right": before[place, 1], "left": now[place, 0], "right": now[place, 1],
            "duration": duration[place], "dx": moved[place, 0], "dy": moved[place, 1],
            "dtheta": moved[place, 2], "quality": 1.0,
        }
        for place in range(rows)
    ]  # fmt: skip
    sent = [
        {
            "left": left,
            "right": right,
            "duration": time,
            "forward": (left + right) / 2.0,
            "turn": right - left,
            "fate": "cut" if time > 2.9 else "completed",
            "attempt": 1,
        }
        for (left, right), time in zip(now, duration, strict=True)
    ]
    dataset.make(
        table,
        dataset.MOTOR_INPUTS,
        sources=[{"path": "rec/commands.csv", "sha256": "ab" * 32}],
        left_out={"cut": 7, "jump": 2, "clock": 0},
        settings={"timing": 0.15},
        reasons={"cut": "cut short at a line"},
        cutting=dataset.cutting(sent),
        clocks=[
            {
                "recording": "rec",
                "session": 1,
                "flashes": [1.0, 90.0],
                "sd": 0.0012,
                "drift": 2.1e-5,
                "drift_sd": 1.3e-5,
            },
            {"recording": "rec", "session": 2, "flashes": [], "sd": 0.003, "drift": 0.0},
        ],
        motor_delays=[
            {
                "recording": "rec",
                "session": 1,
                "delay": 0.0213,
                "sd": 0.0034,
                "lag": 0.104,
                "answers": 40,
                "corrected": True,
            },
        ],
        robots=[{"kind": "nxt", "virtual": virtual}],
    ).write(folder)
    return folder


def make_simulator(folder, dataset_folder, seed=0):
    """Write a motion network with random weights: its predictions do not matter here."""
    network = ProductSummationNetwork(5, 2, 2)
    generator = torch.Generator().manual_seed(seed)
    genes = torch.rand((3, network.genes), generator=generator, dtype=torch.float64) - 0.5
    meta = {
        "training": {"trainer": "ga", "generations": 30, "seed": seed, "held_out": 0.2},
        "history": [
            {"generation": n, "mse": [0.02 / n, 0.01 / n, 0.5 / n]} for n in range(1, 31)
        ],
        "test_errors": {
            name: {"mse": 7.125, "mean_absolute_error": value, "unit": unit}
            for name, value, unit in (
                ("dx", 1.375, "cm"), ("dy", 2.625, "cm"), ("dtheta", 3.875, "deg")
            )
        },
        "source": {
            "dataset": dataset_folder.name,
            "sha256": files.sha256(dataset_folder / "dataset.csv"),
        },
        "wall_clock": {"training_seconds": 4.2},
        "composition": {
            "actuators": {
                "left": {"lag": 0.0824, "dead_band": 0.07}, "right": {"lag": 0.1, "dead_band": 0.0},
            },
            "delay": 0.028,
            "drift": [2.1, 1.3],
            "kernel_units": 75,
            "process": {"dx": 0.3, "dy": 0.8, "dtheta": 0.0},
        },
    }  # fmt: skip
    simulator = MotionNetwork(
        INPUTS,
        network,
        genes,
        torch.tensor([50.0, 50.0, 50.0, 50.0, 3.0]),
        torch.tensor([0.3, 0.2, 2.0]),
        meta=meta,
    )
    folder.mkdir(parents=True)
    write_motion(simulator, folder)
    return folder


def predicted_poses():
    poses = [np.array(START)]
    for leg in LEGS:
        poses.append(se2.compose(poses[-1], leg))
    return np.array(poses)


def make_trial(
    folder, seed=0, slip=0.02, completes=True, unseen=(), virtual=True, probability=None
):
    """Write a trial whose robot slips: the twist of every command is off by a random fraction."""
    rng = np.random.default_rng(seed)
    predicted = predicted_poses()
    actual, path, time = [np.array(START)], [], 0.0
    for leg in LEGS:
        twist = se2.log(leg) * (1 + rng.normal(0, slip, 3)) + rng.normal(0, slip / 4, 3)
        for fraction in np.linspace(0, 1, 31)[1:]:
            time += 1 / 15
            path.append([time, *se2.compose(actual[-1], se2.exp(fraction * twist))])
        actual.append(np.array(path[-1][1:]))
    shown = [None if k in unseen else pose.tolist() for k, pose in enumerate(actual)]
    errors = [
        None if shown[k] is None else {
            "command": k,
            "position": float(np.hypot(*(actual[k] - predicted[k])[:2])),
            "heading": float(actual[k][2] - predicted[k][2]),
        }
        for k in range(len(actual))
    ]  # fmt: skip
    folder.mkdir(parents=True)
    files.write_json(
        folder / "trial.json", "neurosim-trial", 1,
        {
            "controller": {"path": "plan", "sha256": "cd" * 32},
            "simulator": {"path": "sim", "sha256": "ef" * 32},
            "virtual": virtual,
            "task": TASK,
            "columns": COLUMNS,
            "commands": [[40.0 + k, 40.0, 2.0] for k in range(len(LEGS))],
            "plan_length": len(LEGS),
            "start": {"planned": list(START), "actual": [START[0] + 0.01, START[1], START[2]]},
            "predicted": {
                "poses": predicted.tolist(), "rest": [-0.75, 0.25, -1.5 * math.pi],
                "fitness": 63.9, "completes": True, "probability": probability,
            },
            "actual": {
                "rest": [-0.72, 0.29, 0.5 * math.pi],
                "poses": shown, "fitness": 63.8 if completes else 48.5, "completes": completes,
                "path": path,
            },
            "errors": errors,
            "ended_early": False,
            "created": "2024-05-06T07:08:09+00:00",
        },
    )  # fmt: skip
    return folder


def make_controller(folder):
    poses = predicted_poses()
    rest = se2.compose(poses[-1], (0.02, 0.0, 0.0))
    SavedController(
        FixedPlan((*((40.0 + k, 40.0, 2.0) for k in range(len(LEGS))), None)),
        np.empty(0),
        task=TASK,
        start=START,
        predicted={
            "poses": poses.tolist(), "rest": rest.tolist(), "fitness": 63.9, "completes": True
        },
        simulator={"path": "sim", "sha256": "ef" * 32},
        evolution={
            "seed": 3, "generations": 40,
            "history": {
                "best": [63.9 - 80 / n for n in range(1, 41)],
                "mean": [20.0 - 60 / n for n in range(1, 41)],
            },
        },
    ).write(folder)  # fmt: skip
    return folder
