"""Reads damaged files by every command: an answer other than success or one sentence is a fault.

Small artefacts of every kind are made. In each case one file of them is damaged
(:mod:`mutations`), a command reads it in the process of a worker, and the case is a fault where

  - the result is neither a success nor an exit with one sentence (a traceback, a crash);
  - it takes longer than 10 s, or more than 1 GB of memory beyond the worker's before;
  - there is an output although the command failed, or something next to it was changed.

The seed determines the cases: ``--only 17`` repeats case 17 alone and shows what happens.

    python benchmarks/fuzz.py                      20,000 cases, about an hour on one core
    python benchmarks/fuzz.py --cases 500 --seed 1
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import queue
import random
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mutations import damage

#: Longest time of a case, s, and largest growth of memory in it, bytes.
LONGEST, LARGEST = 10.0, 2**30
#: Outputs that a command may write although it fails: its drives are kept.
KEEPS = ("record", "sample", "run", "track")


@dataclass(frozen=True)
class Target:
    """A command and what it reads.

    Attributes:
        line: the words of the command; those that name something in ``reads`` stand for it.
        reads: files and folders that are damaged, one in a case.
        needs: other files that it needs.
        lab: whether making these takes the virtual lab, which takes a minute.
        weight: how often it is chosen, relative to the others.
    """

    line: str
    reads: tuple[str, ...]
    needs: tuple[str, ...] = ()
    lab: bool = False
    weight: float = 1.0


TARGETS = (
    Target("dataset --from csv log.csv -o out", ("log.csv",)),
    Target("dataset --from csv rows.csv -o out --rows", ("rows.csv",)),
    Target("dataset --from mrclam R_Odometry.dat R_Groundtruth.dat -o out",
           ("R_Odometry.dat", "R_Groundtruth.dat")),
    Target("train dataset -o out --trainer ga --generations 1 --population 20", ("dataset",)),
    Target("evaluate simulator dataset", ("simulator", "dataset"), weight=2),
    Target("evaluate paper dataset", ("paper",), ("dataset",)),
    Target("plan-check plan simulator --draws 20", ("plan", "simulator"), weight=2),
    Target("evolve simulator -o out --generations 1 --runs 1 --population 40 --commands 3 "
           "--final-draws 4 --robust --robust-generations 1 --draws 2", ("simulator",)),
    Target("plan-check plan paper --draws 20", ("paper",), ("plan",)),
    Target("evolve simulator --task task.json -o out --generations 1 --runs 1 --population 4 "
           "--final-draws 4", ("task.json",), ("simulator",)),
    Target("evolve tables --task obstacle-avoidance -o out --generations 1 --population 4 "
           "--steps 6 --starts 2", ("tables",), weight=2),
    Target("evolve tables --task obstacle-avoidance -o out --generations 1 --population 4 "
           "--steps 6 --starts 2 --place arena.json", ("arena.json",), ("tables",)),
    Target("evolve tables --task obstacle-avoidance -o begun --resume", ("begun.checkpoint",),
           ("tables",)),
    Target("build-tables wall.sample cylinder.sample -o out --place arena.json",
           ("wall.sample", "cylinder.sample", "arena.json")),
    Target("view tables --controller net -o out.svg --seconds 1", ("tables", "net")),
    Target("view simulator --controller plan -o out.svg", ("simulator", "plan")),
    Target("view arena.json -o out.svg", ("arena.json",)),
    Target("report dataset -o out.html", ("dataset",), weight=2),
    Target("report simulator -o out.html", ("simulator",), weight=2),
    Target("report tables net -o out.html", ("tables", "net"), weight=2),
    Target("report plan simulator -o out.html", ("plan", "simulator"), weight=2),
    Target("report trial plan -o out.html", ("trial", "plan"), lab=True, weight=3),
    Target("report found found/controller -o out.html", ("found",), lab=True, weight=2),
    Target("report recording -o out.html", ("recording",), lab=True),
    Target("dataset recording -o out", ("recording",), lab=True, weight=3),
    Target("track recording", ("recording",), lab=True, weight=0.3),
    Target("dataset sensed -o out", ("sensed",), lab=True),
    Target("report felt -o out.html", ("felt",), lab=True),
    Target("evaluate sensing felt", ("sensing", "felt"), lab=True),
    Target("evolve sensing --task follow-line -o out --generations 1 --population 4 --seconds 1",
           ("sensing",), lab=True),
    Target("record out --place line.json --commands 1 --durations 0.5..0.6 --camera none",
           ("line.json",), lab=True, weight=0.5),
    Target("calibrate photographs --square 40 --points photographs/points.csv -o out.json "
           "--pattern 9x6", ("photographs",), lab=True, weight=0.3),
    Target("record driven --resume", ("driven",), lab=True, weight=0.5),
    Target("record out --commands 1 --markers markers.json --calibration calibration.json "
           "--camera none", ("markers.json", "calibration.json"), lab=True, weight=0.5),
    Target("run plan -o out --calibration calibration.json --markers markers.json",
           ("plan", "calibration.json", "markers.json"), lab=True, weight=0.2),
    Target("run net -o out --robot virtual-khepera --camera none", ("net",), lab=True, weight=0.3),
    Target("sample sampled --resume", ("sampled",), lab=True, weight=0.5),
    Target("build-tables sampled/wall.sample sampled/cylinder.sample --motors sampled/motors.csv "
           "-o out", ("sampled",), lab=True, weight=2),
    Target("back-to-reality -o walked --resume", ("walked.checkpoint",), lab=True, weight=0.3),
    Target("back-to-reality -o out --settings paper --start start.json --seconds 1 --budget 2 "
           "--generations 1 --candidates 1 --adapt none", ("start.json",), lab=True, weight=0.1),
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--cases", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--command", help="cases of commands whose line begins so alone")
    parser.add_argument("--only", type=int, help="repeat one case, and show what happens")
    parser.add_argument("--made", type=Path, help="a folder of artefacts to keep, or to use again")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--worker", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.made is None:
        with tempfile.TemporaryDirectory() as folder:
            run(Path(folder), options)
    else:
        run(options.made.resolve(), options)


def run(made: Path, options: argparse.Namespace) -> None:
    targets = [one for one in TARGETS if one.line.startswith(options.command or "")]
    if options.worker is not None:
        _work(made, targets, options)
        return
    if not (made / "whole").exists():
        make(made)
        (made / "whole").touch()
    if options.only is not None:
        with tempfile.TemporaryDirectory() as scratch:
            print(case(made, Path(scratch), targets, options.seed, options.only, show=True))
        return
    faults, ended, seconds = [], Counter(), time.monotonic()
    for number, result in _results(made, options):
        ended[result["ended"]] += 1
        if result["fault"]:
            faults.append({"case": number, **result})
            if not options.json:
                print(f"case {number}: {result['line']}: {result['what']}\n    {result['fault']}")
    seconds = time.monotonic() - seconds
    if options.json:
        print(json.dumps({"cases": options.cases, "seconds": seconds, "ended": ended,
                          "faults": faults}))  # fmt: skip
        return
    print(f"{options.cases} cases in {seconds:.0f} s: {dict(ended)}; {len(faults)} faults")
    sys.exit(1 if faults else 0)


# One case


def case(
    made: Path, scratch: Path, targets: Sequence[Target], seed: int, number: int, show: bool = False
) -> dict[str, Any]:
    """Damage one file, let a command read it; return the result.

    Args:
        made: folder of whole artefacts.
        scratch: an empty folder to work in; it is emptied again.
        targets: that are chosen from.
        seed: of all cases.
        number: of this one.
        show: whether what the command prints and its traceback are shown.

    Returns:
        ``line`` (the command), ``what`` (was damaged), ``ended`` (``success``, ``refused`` or
        ``fault``) and ``fault`` (what is wrong, or nothing).
    """
    rng = random.Random(f"{seed} {number}")
    target = rng.choices(targets, [one.weight for one in targets])[0]
    work = scratch / "work"
    work.mkdir(parents=True)
    for name in dict.fromkeys((*target.reads, *target.needs)):
        _copy(made / name, work / name)
    damaged = rng.choice([file for name in target.reads for file in _files(work / name)])
    what = damage(damaged, rng)
    words = target.line.split()
    before = _state(scratch, words)
    code, message, fault = call(words, work, show)
    if not fault and code not in (0, 1, 2):
        fault = f"exit code {code}"
    if (
        not fault
        and code == 1
        and not message.strip().splitlines()[-1:][0].startswith("neurosim: ")
    ):
        fault = f"no sentence: {message[-200:]!r}"
    if not fault and code and words[0] not in KEEPS and any(work.glob("out*")):
        fault = "an output stands there although the command failed"
    if not fault and _state(scratch, words) != before:
        fault = "something next to the output was changed"
    shutil.rmtree(work)
    ended = "fault" if fault else "refused" if code else "success"
    return {"line": target.line, "what": what, "ended": ended, "fault": fault}


def call(words: Sequence[str], folder: Path, show: bool = False) -> tuple[int, str, str]:
    """Run a command line in this process, in a folder.

    Returns:
        Its exit code, its text on stderr, and a fault: an exception other than a UserError.
    """
    from neurosim.cli.main import main as neurosim

    here, argv, signals = Path.cwd(), sys.argv, _signals()
    out, err = io.StringIO(), io.StringIO()
    code, fault = 0, ""
    os.chdir(folder)
    sys.argv = ["neurosim", *words]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            neurosim()
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        fault = f"{type(error).__name__}: {error!s:.150} ({Path(last.filename).name}:{last.lineno})"
        if show:
            traceback.print_exc()
    finally:
        sys.argv = argv
        os.chdir(here)
        _restore(signals)
    if show:
        print(out.getvalue(), err.getvalue(), code)
    if "not enough memory" in err.getvalue():
        fault = "out of memory"
    return code, err.getvalue(), fault


def _signals() -> dict[int, Any]:
    import signal

    names = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP")
    return {
        getattr(signal, name): signal.getsignal(getattr(signal, name))
        for name in names
        if hasattr(signal, name)
    }


def _restore(signals: dict[int, Any]) -> None:
    import signal

    if threading.current_thread() is threading.main_thread():
        for number, handler in signals.items():
            signal.signal(number, handler)


def _files(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    return sorted(
        file for file in path.rglob("*") if file.is_file() and "truth" not in file.parts
    )  # fmt: skip


def _copy(source: Path, target: Path) -> None:
    if source.is_dir():
        shutil.copytree(source, target, dirs_exist_ok=True)
    else:
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, target)


def _state(scratch: Path, words: Sequence[str]) -> set[str]:
    """Return the files next to the folder in which a command works."""
    return {path.name for path in scratch.iterdir()} | {path.name for path in
            scratch.parent.iterdir() if path.name == "out"}  # fmt: skip


# Workers


def _results(made: Path, options: argparse.Namespace) -> Iterator[tuple[int, dict[str, Any]]]:
    """Give number and result of every case; a worker that hangs or dies is replaced."""
    number = 0
    while number < options.cases:
        words = [sys.executable, __file__, "--made", str(made), "--seed", str(options.seed)]
        words += ["--cases", str(options.cases), "--worker", str(number)]
        words += ["--command", options.command] if options.command else []
        with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as worker:
            lines: queue.Queue[str] = queue.Queue()
            threading.Thread(target=_read, args=(worker.stdout, lines), daemon=True).start()
            patience = 600.0  # all loops are compiled first
            while number < options.cases:
                try:
                    line = lines.get(timeout=patience)
                except queue.Empty:
                    worker.kill()
                    yield number, _lost(made, options, number, f"hangs for over {LONGEST:g} s")
                    number += 1
                    break
                if not line:
                    why = f"the process died (exit code {worker.wait()})"
                    yield number, _lost(made, options, number, why)
                    number += 1
                    break
                patience = 2 * LONGEST
                if line.startswith("{"):
                    yield number, json.loads(line)
                    number += 1


def _read(stream: Any, lines: queue.Queue[str]) -> None:
    for line in stream:
        lines.put(line)
    lines.put("")


def _lost(made: Path, options: argparse.Namespace, number: int, why: str) -> dict[str, Any]:
    rng = random.Random(f"{options.seed} {number}")
    targets = [one for one in TARGETS if one.line.startswith(options.command or "")]
    line = rng.choices(targets, [one.weight for one in targets])[0].line
    return {"line": line, "what": f"repeat it with --only {number}", "ended": "fault", "fault": why}


def _work(made: Path, targets: Sequence[Target], options: argparse.Namespace) -> None:
    """Work cases off, a line of JSON on stdout for each."""
    stdout = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what native code prints is no result
    with tempfile.TemporaryDirectory() as scratch:
        for target in targets:  # whole artefacts first, so that every loop is compiled
            work = Path(scratch) / "work"
            work.mkdir()
            for name in dict.fromkeys((*target.reads, *target.needs)):
                _copy(made / name, work / name)
            code, message, fault = call(target.line.split(), work)
            if code or fault:
                raise SystemExit(f"{target.line}: whole files are refused: {message}{fault}")
            shutil.rmtree(work)
        print("ready", file=stdout, flush=True)
        for number in range(options.worker, options.cases):
            base, began = _memory(reset=True), time.monotonic()
            result = case(made, Path(scratch), targets, options.seed, number)
            seconds, most = time.monotonic() - began, _memory() - base
            if not result["fault"] and most > LARGEST:
                result |= {"fault": f"{most / 2**30:.1f} GB", "ended": "fault"}
            if not result["fault"] and seconds > LONGEST:
                result |= {"fault": f"{seconds:.0f} s", "ended": "fault"}
            print(json.dumps(result), file=stdout, flush=True)


def _memory(reset: bool = False) -> int:
    """Return the largest resident size since it was reset, bytes; 0 where it is not known."""
    try:
        if reset:
            Path("/proc/self/clear_refs").write_text("5")
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
    except OSError:
        pass
    return 0


# Whole artefacts


def make(folder: Path, lab: bool = True) -> None:
    """Make whole artefacts of every kind; those of the lab where it is wanted."""
    folder.mkdir(parents=True, exist_ok=True)
    _write_inputs(folder)

    def do(line: str) -> None:
        began = time.monotonic()
        code, message, fault = call(line.split(), folder)
        if code or fault:
            raise SystemExit(f"{line}: {message}{fault}")
        print(f"{time.monotonic() - began:6.1f} s  {line}", file=sys.stderr)

    do("dataset --from csv rows.csv -o dataset --rows")
    do("train dataset -o simulator --members 2")
    do("train dataset -o paper --trainer ga --generations 2")
    do("evolve simulator -o plan --generations 3 --runs 1 --population 50 --commands 3 "
       "--final-draws 8")  # fmt: skip
    do("build-tables wall.sample cylinder.sample -o tables")
    do("evolve tables --task obstacle-avoidance -o net --generations 2 --population 10 --steps 20")
    with _kept_checkpoints():
        do("evolve tables --task obstacle-avoidance -o begun --generations 2 --population 6 "
           "--steps 6 --starts 2")  # fmt: skip
        if lab:
            do("back-to-reality -o walked --settings paper --seconds 1 --budget 2 --generations 2 "
               "--candidates 1")  # fmt: skip
    for name in ("begun", "walked"):
        shutil.rmtree(folder / name, ignore_errors=True)
    if not lab:
        return
    do("lab photographs photographs --count 3")
    do("calibrate photographs --square 40 --points photographs/points.csv -o calibration.json")
    do("record recording --commands 3 --durations 0.5..0.6 --calibration calibration.json "
       "--camera-size 640x480 --fps 15")  # fmt: skip
    do("track recording")
    do("record sensed --commands 50 --durations 0.5..1 --readings --guard-by position "
       "--place rectangle --calibration calibration.json --camera-size 640x480")  # fmt: skip
    do("dataset sensed -o felt")
    do("train felt -o sensing --members 2")
    do("record driven --camera none --commands 1 --durations 0.5..0.6")
    _edit(folder / "driven" / "recording.json", complete=False)
    do("run plan -o trial --calibration calibration.json")
    do("sample sampled --angles 8 --distances 2 --step 10 --grid 2")
    do("back-to-reality -o found --seconds 1 --budget 8 --candidates 3 --compare recent")


def _edit(path: Path, **changes: Any) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


@contextlib.contextmanager
def _kept_checkpoints() -> Iterator[None]:
    """Have every generation saved, and the checkpoint stay, as if it had been killed."""
    from neurosim.base.checkpoint import Checkpoint
    from neurosim.base.generations import run_generations

    remove, defaults = Checkpoint.remove, dict(run_generations.__kwdefaults__)
    Checkpoint.remove = lambda self: None  # type: ignore[method-assign]
    run_generations.__kwdefaults__["every"] = 0.0
    try:
        yield
    finally:
        Checkpoint.remove = remove  # type: ignore[method-assign]
        run_generations.__kwdefaults__ |= defaults


def _write_inputs(folder: Path) -> None:
    """Write the inputs that no command makes: logs, samples, an arena, a task, markers."""
    import numpy as np

    from neurosim.base import se2
    from neurosim.base.files import write_csv, write_json
    from neurosim.base.place import Line, Place
    from neurosim.simulators.tables.samples import Samples

    rng = np.random.default_rng(0)
    speeds, duration = rng.uniform(-50, 50, (60, 2)).round(1), rng.uniform(0.5, 3, 60).round(2)
    ahead, turn = speeds.mean(1) / 200 * duration, np.diff(speeds)[:, 0] / 26 * duration
    moved = se2.exp(np.stack([ahead, 0 * ahead, turn], 1)) + rng.normal(0, 0.003, (60, 3))
    write_csv(
        folder / "rows.csv",
        {"left": speeds[:, 0], "right": speeds[:, 1], "duration": duration}
        | dict(zip(("dx", "dy", "dtheta"), moved.T, strict=True)),
    )
    time = np.arange(0, 30, 0.1).round(2)
    distance, angle = 0.1 * time, 0.2 * np.sin(time)
    write_csv(
        folder / "log.csv",
        {"time": time, "x": distance, "y": 0.1 * distance, "heading": angle, "v": 0.1 + 0 * time,
         "w": 0.2 * np.cos(time // 2)},
    )  # fmt: skip
    lines = zip(time, 0.1 + 0 * time, 0.2 * np.cos(time // 2), strict=True)
    text = "".join(f"{a:.3f}\t{b:.3f}\t{c:.3f}\n" for a, b, c in lines)
    (folder / "R_Odometry.dat").write_text("# Time [s]\tv [m/s]\tw [rad/s]\n" + text)
    lines = zip(time, distance, 0.1 * distance, angle, strict=True)
    text = "".join("\t".join(f"{n:.3f}" for n in row) + "\n" for row in lines)
    (folder / "R_Groundtruth.dat").write_text("# Time [s]\tx [m]\ty [m]\tyaw [rad]\n" + text)
    to = -2 * np.pi * np.arange(12)[:, None] / 12
    looks = np.maximum(np.cos(to - np.radians([70, 45, 10, -10, -45, -70, -170, 170])), 0) ** 4
    for name, bright in (("wall", 0.8), ("cylinder", 0.4)):
        fades = np.exp(-np.arange(4) / 2)[:, None, None]
        Samples((bright * fades * looks).round(3), 0.005, 0.01).write(folder / f"{name}.sample")
    Place.rectangle(0.5, 0.4, [(0, 0, 0.0275)]).write(folder / "arena.json")
    write_json(
        folder / "task.json", "neurosim-task", 1,
        {"name": "nine-rectangles", "settings": {"longest_arc": 1.5}},
    )  # fmt: skip
    corners = ((-0.7, -0.4), (0.7, -0.4), (0.5, 0.4), (-0.5, 0.3))
    Place(lines=(Line(corners),)).write(folder / "line.json")
    from neurosim.controllers.gait import Gait
    from tracking.datasets.recordings import DEFAULT_MARKERS, write_markers

    write_json(
        folder / "start.json", "neurosim-parameters", 1, {"genes": list(Gait().hand_tuned())}
    )
    write_markers(folder / "markers.json", DEFAULT_MARKERS)


if __name__ == "__main__":
    main()
