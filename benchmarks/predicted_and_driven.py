"""Whether predictions of drives hold, with the commands that a user calls.

Each robot of the virtual lab records commands (guided and random), a simulator is learned of each
recording, controllers are evolved in it, and each is driven: through driver, radio, brick, camera,
tracker and guard, by the commands of the command line. No constant was chosen on these robots;
their seeds were chosen at random once, before the first run: :data:`ROBOTS`.

A robust plan is driven in open loop and replanned after each command; a plan that was not made
robust in open loop; a network in closed loop. With ``--goals`` a robust plan and a network that go
to poses in turn are driven as well. Plans around the nine rectangles are driven in the lab's bare
physics, too, where the guard ends drives by geometry: the two may differ by chance alone. The
oracle is the better of the robust plan and of that plan evolved on in the lab's physics itself,
with the guard, as both drive in bare physics.

Printed are the predicted probability and the fraction that completed the task, over all drives of
a kind and in bins; the Brier skill over the base rate; and how many replanned drives completed.

    python benchmarks/predicted_and_driven.py KEPT                 go on where the folder KEPT ends
    python benchmarks/predicted_and_driven.py KEPT --robots 2      the first two robots alone
    python benchmarks/predicted_and_driven.py KEPT --show          the table of what there is
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from robust_plans import bound, drive

from neurosim.base.files import write_json
from neurosim.base.statistics import wilson
from neurosim.controllers import read_controller
from neurosim.tasks.files import FORMAT, VERSION

#: Seeds of the lab's robots: from numpy.random.default_rng(20261124).integers(1000, 10000).
ROBOTS = (2953, 9646, 2279, 9667, 5822, 2132, 6743, 4096, 6966, 6173)
#: How the commands of a recording are chosen.
KINDS = {"guided": ["--guided"], "random": []}
NINE = ["--task", "nine-rectangles"]
#: The task of ``--goals``; poses are x (m), y (m), heading (rad).
COURSE = {
    "name": "go-to",
    "settings": {
        "begin": [-0.7, 0.0, 0.0],
        "goals": [[-0.2, 0.3, 0.0], [0.2, -0.3, 0.0], [0.6, 0.1, 0.0]],
        "step": 0.2,
        "seconds": 20.0,
    },
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("kept", type=Path, help="folder of everything; gone on with")
    parser.add_argument("--robots", type=int, default=len(ROBOTS))
    parser.add_argument("--kinds", default="guided,random")
    parser.add_argument("--commands", type=int, default=400, help="of each recording")
    parser.add_argument("--plans", type=int, default=2, help="evolved in each simulator")
    parser.add_argument("--drives", type=int, default=8, help="of each plan, in open loop")
    parser.add_argument("--replanned", type=int, default=2, help="of each plan")
    parser.add_argument("--plain", type=int, default=0, help="drives of a plan without --robust")
    parser.add_argument("--networks", type=int, default=0, help="drives of a network, closed loop")
    parser.add_argument("--goals", type=int, default=0, help="drives of each way to go to poses")
    parser.add_argument("--bare", type=int, default=200, help="of each plan, in bare physics")
    parser.add_argument("--show", action="store_true", help="what there is; nothing is driven")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    options.kept.mkdir(parents=True, exist_ok=True)
    if not options.show:
        for robot in ROBOTS[: options.robots]:
            for kind in options.kinds.split(","):
                one_simulator(options, robot, kind)
    result = summary(list(rows(options.kept)))
    print(json.dumps(result, indent=2) if options.json else table(result))


def neurosim(*words: object) -> dict:
    """Run a command of neurosim; return what it prints for machines."""
    text = [sys.executable, "-m", "neurosim", *map(str, words)]
    done = subprocess.run(text, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(text)}\n{done.stderr}")
    return json.loads(done.stdout) if "--json" in words else {}


def one_simulator(options: argparse.Namespace, robot: int, kind: str) -> None:
    """Record, learn, evolve and drive one robot with commands of one kind."""
    folder = options.kept / f"{robot}-{kind}"
    of_robot, camera = ["--lab-seed", robot], options.kept / "calibration.json"
    if not camera.exists():
        photographs = options.kept / "photographs"
        neurosim("lab", "photographs", photographs)
        points = ["--points", photographs / "points.csv"]
        neurosim("calibrate", photographs, "--square", 40, *points, "-o", camera)
    recording, dataset, simulator = (folder / n for n in ("recording", "dataset", "simulator"))
    if not dataset.exists():
        shutil.rmtree(recording, ignore_errors=True)
        how = [*KINDS[kind], "--commands", options.commands, "--calibration", camera]
        neurosim("record", recording, *how, *of_robot, "--seed", robot)
        neurosim("dataset", recording, "-o", dataset)
        shutil.rmtree(recording)  # 100 MB of video
    if not simulator.exists():
        neurosim("train", dataset, "-o", simulator, "--seed", robot)
    for number in range(options.plans):
        seed = robot + number
        words = [*NINE, "--robust"]
        plan = one_controller(options, folder / f"plan-{seed}", robot, seed, words)
        drives(options, plan, robot, seed, "open-loop", options.drives)
        drives(options, plan, robot, seed, "replanned", options.replanned)
    if options.plain:
        plan = one_controller(options, folder / f"plain-{robot}", robot, robot, NINE)
        drives(options, plan, robot, robot, "plain", options.plain)
    if options.networks:
        words = [*NINE, "--controller", "network"]
        network = one_controller(options, folder / f"network-{robot}", robot, robot, words)
        drives(options, network, robot, robot, "network", options.networks)
    if options.goals:
        course = options.kept / "course.json"
        write_json(course, FORMAT, VERSION, COURSE)
        there = ["--task", course]
        plan = one_controller(
            options, folder / f"goals-plan-{robot}", robot, robot, [*there, "--robust"]
        )
        drives(options, plan, robot, robot, "goals-open-loop", options.goals)
        drives(options, plan, robot, robot, "goals-replanned", options.goals)
        words = [*there, "--controller", "network"]
        network = one_controller(options, folder / f"goals-network-{robot}", robot, robot, words)
        drives(options, network, robot, robot, "goals-network", options.goals)


def one_controller(
    options: argparse.Namespace, made: Path, robot: int, seed: int, words: list
) -> Path:
    """Evolve a controller, and write what is predicted of it next to it."""
    simulator = made.parent / "simulator"
    if not made.exists():
        neurosim("evolve", simulator, *words, "-o", made, "--seed", seed)
    checked = made.with_name(f"{made.name}.check.json")
    if checked.exists():
        return made
    controller = read_controller(made)
    result = {"probability": controller.predicted["probability"]}
    if controller.controller.open_loop:
        result = neurosim("plan-check", made, simulator, "--seed", seed, "--json")
    if controller.controller.open_loop and NINE[1] in words:
        given = [tuple(c) for c in controller.commands if c is not None]
        result["bare"] = sum(drive(given, robot, 1000 * seed + n) for n in range(options.bare))
        result["bare_drives"] = options.bare
        if "--robust" in words:
            best = oracle(given, robot, seed)
            result["oracle"] = sum(drive(best, robot, 2000 * seed + n) for n in range(options.bare))
    checked.write_text(json.dumps(result), encoding="utf-8")
    return made


def drives(
    options: argparse.Namespace, controller: Path, robot: int, seed: int, how: str, count: int
) -> None:
    """Drive a controller ``count`` times with the commands that a user calls."""
    for number in range(count):
        trial = controller.with_name(f"{controller.name}-{how}-{number}")
        if (trial / "trial.json").exists():
            continue
        shutil.rmtree(trial, ignore_errors=True)
        kind = how.removeprefix("goals-")
        words = {"replanned": ["--replan"], "network": []}.get(kind, ["--no-replan"])
        words += ["--calibration", options.kept / "calibration.json", "--lab-seed", robot]
        neurosim("run", controller, *words, "-o", trial, "--seed", 100 * seed + number)
        for video in trial.glob("*.avi"):
            video.unlink()


def oracle(given: list, robot: int, seed: int) -> list:
    """Return the commands of a plan that was evolved further in guarded physics of the lab."""
    options = argparse.Namespace(lab_seed=robot, bound_generations=30)
    result = bound([SimpleNamespace(commands=given)], len(given), seed, options)
    return [command for command in result[0].commands if command is not None]


def rows(kept: Path) -> Iterator[dict]:
    """Give each drive's prediction and result."""
    for file in sorted(kept.glob("*/*.check.json")):
        checked, plan = json.loads(file.read_text(encoding="utf-8")), file.name.split(".")[0]
        robot, kind = file.parent.name.split("-")
        for trial in sorted(file.parent.glob(f"{plan}-*-*/trial.json")):
            report = json.loads(trial.read_text(encoding="utf-8"))
            yield {
                "robot": robot,
                "kind": kind,
                "plan": f"{file.parent.name}/{plan}",
                "how": trial.parent.name.removeprefix(f"{plan}-").rsplit("-", 1)[0],
                "predicted": checked["probability"],
                "completed": bool(report["actual"]["completes"]),
                "stopped": report["stopped"] is not None,
                **in_bare_physics(checked),
            }


def in_bare_physics(checked: dict) -> dict:
    """Return the fractions of drives in bare physics that completed, where there were any."""
    fractions = {name: checked[name] for name in ("bare", "oracle") if name in checked}
    if "oracle" in fractions:
        fractions["oracle"] = max(fractions.values())
    return {name: count / checked["bare_drives"] for name, count in fractions.items()}


def summary(drives: list[dict]) -> dict:
    """Return the summary of each way of driving, and of all drives that are not replanned."""
    results: dict = {}
    hows = ["open-loop", "replanned", "plain", "network"]
    hows += [f"goals-{how}" for how in hows if how != "plain"]
    groups = {how: [row for row in drives if row["how"] == how] for how in hows}
    # None that is replanned: its probability was predicted of the plan in open loop.
    groups["all predicted"] = [row for row in drives if "replanned" not in row["how"]]
    for how, chosen in groups.items():
        if not chosen:
            continue
        done = np.array([row["completed"] for row in chosen], float)
        predicted = np.array([row["predicted"] for row in chosen])
        about = {
            "drives": len(chosen),
            "robots": len({row["robot"] for row in chosen}),
            "completed": float(done.mean()),
            "interval": wilson(int(done.sum()), len(done)),
            "stopped by the guard": float(np.mean([row["stopped"] for row in chosen])),
        }
        if "replanned" not in how:
            base = float(done.mean() * (1 - done.mean()))
            brier = float(((predicted - done) ** 2).mean())
            about |= {
                "predicted": float(predicted.mean()),
                "Brier score": brier,
                "Brier skill": 1 - brier / base if base > 0 else None,
                "bins": bins(predicted, done),
            }
        for name, title in (("bare", "in bare physics"), ("oracle", "oracle")):
            if "replanned" not in how and all(name in row for row in chosen):
                about[title] = float(np.mean([row[name] for row in chosen]))
        results[how] = about
        for kind in KINDS:
            part = [row for row in chosen if row["kind"] == kind]
            if part:
                results[f"{how}, {kind}"] = {
                    "drives": len(part),
                    "predicted": float(np.mean([row["predicted"] for row in part])),
                    "completed": float(np.mean([row["completed"] for row in part])),
                }
    return results


def bins(predicted: np.ndarray, done: np.ndarray) -> list[dict]:
    place = np.minimum((predicted * 10).astype(int), 9)
    return [
        {
            "from": low / 10,
            "drives": int((place == low).sum()),
            "predicted": float(predicted[place == low].mean()),
            "completed": float(done[place == low].mean()),
        }
        for low in range(10)
        if (place == low).any()
    ]


def table(result: dict) -> str:
    lines = []
    for name, about in result.items():
        lines.append(name)
        for key, value in about.items():
            if key == "bins":
                lines += [
                    f"    predicted {b['predicted']:.0%}: completed {b['completed']:.0%} of "
                    f"{b['drives']} drives"
                    for b in value
                ]
            elif key == "interval":
                lines.append(f"    95 % interval: {value[0]:.0%} to {value[1]:.0%}")
            elif isinstance(value, float) and "Brier" not in key:
                lines.append(f"    {key}: {value:.1%}")
            else:
                lines.append(f"    {key}: {value if value is None else round(value, 3)}")
    return "\n".join(lines) or "no drives yet"


if __name__ == "__main__":
    main()
