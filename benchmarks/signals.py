"""Ends commands at random moments, by Ctrl-C, a kill or a closed terminal.

Each case runs a command in a process of its own and sends one signal, or three in a burst, at a
random moment: early or late, relative to a command's time on this computer now, or once the robot
drives. In some cases the machine code of all loops has to be compiled first. It is a fault if

  - the command takes longer than --patience to end, or ends with another code than 128 plus the
  signal's number (`lab` and `watch`: or 0, after Ctrl-C);
  - there is not one line on stderr that says so, or a traceback;
  - a robot outside of the process, on its line, still moves a second later;
  - a file that it left cannot be read, or --resume refuses the files.

A signal before the command's own code runs ends it as it ends any Python program; such cases are
counted as "before".

    python benchmarks/signals.py                  200 cases, about half an hour on one core
    python benchmarks/signals.py --cases 20 --seed 1 --made ARTEFACTS
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from fuzz import make

SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
#: Commands, in a folder of the artefacts that :mod:`fuzz` makes. NXT and KHEPERA are the lines of
#: robots that are outside of the process.
COMMANDS = (
    "--help",
    "record out --robot nxt --filename NXT --camera none --at-line ignore --commands 30",
    "record out --robot khepera --port KHEPERA --camera none --at-line ignore --commands 30",
    "record out --commands 60",
    "record out --commands 60 --calibration calibration.json --camera-size 640x480",
    "record out --guided --calibration calibration.json --camera-size 640x480",
    "sample out",
    "calibrate photographs --square 40 --points photographs/points.csv -o out.json",
    "track recording",
    "dataset recording -o out",
    "train dataset -o out",
    "evaluate simulator dataset",
    "build-tables wall.sample cylinder.sample -o out",
    "evolve simulator -o out",
    "evolve simulator -o out --robust --runs 2 --generations 50",
    "evolve tables --task obstacle-avoidance -o out",
    "evolve sensing --task follow-line -o out",
    "--plugin plugin.py evolve simulator --controller turner --task go-to -o out",
    "evolve tables --task obstacle-avoidance -o out --generations 3 --robot-generations 2",
    "plan-check plan simulator --draws 100000",
    "view tables --controller net -o out.svg",
    "run plan -o out --calibration calibration.json",
    "run plan -o out --calibration calibration.json --replan",
    "run net -o out --robot virtual-khepera --camera none",
    "back-to-reality -o out",
    "report dataset simulator tables plan net trial -o out.html",
    "export simulator --to torch -o out.pt",
    "watch --camera lab --port 0",
    "lab nxt",
    "demo out",
)
#: A user's own controller, which is stepped.
PLUGIN = """
import neurosim as ns

def turn(seen, genes):
    return 100 * genes[:, 0].tanh(), 100 * genes[:, 1].tanh()

ns.register("controller", "turner", ns.Function(turn, inputs=("x",), genes=2, name="turner"))
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--command", default="", help="commands that begin so alone")
    parser.add_argument("--only", type=int, help="repeat one case")
    parser.add_argument("--patience", type=float, default=5.0, help="a command may take to end, s")
    parser.add_argument("--made", type=Path, help="a folder of artefacts to keep, or to use again")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    for number in SIGNALS:  # a shell's background ignores Ctrl-C, and so would the commands
        signal.signal(number, signal.default_int_handler)
    results = []
    with tempfile.TemporaryDirectory() as scratch:
        made = Path(scratch) / "made" if options.made is None else options.made.resolve()
        if not (made / "whole").exists():
            make(made)
            (made / "whole").touch()
        numbers = range(options.cases) if options.only is None else [options.only]
        for number in numbers:
            result = case(made, Path(scratch) / "work", number, options)
            results.append(result)
            if not options.json:
                faults = "".join(f"\n    {fault}" for fault in result["faults"])
                ended = f"{result['ended']} in {result['took']:.1f} s"
                print(f"{number}: {result['what']}: {ended}{faults}", flush=True)
    faults = [one for one in results if one["faults"]]
    took = sorted(one["took"] for one in results)
    ended = dict(Counter(one["ended"].split(" ")[0] for one in results))
    if options.json:
        print(json.dumps({"cases": len(results), "ended": ended, "took": took, "faults": faults}))
        return
    print(f"{len(results)} signals: {ended}; {took[len(took) // 2]:.1f} s to end in the median, "
          f"{took[-1]:.1f} s at most; {len(faults)} faults")  # fmt: skip
    sys.exit(1 if faults else 0)


def case(made: Path, work: Path, number: int, options: argparse.Namespace) -> dict[str, Any]:
    """Run a command and send it signals; it may be resumed once, and is asked to end again.

    Returns:
        ``what`` was done, how it ``ended``, what it ``took`` to end (s), and ``faults``.
    """
    rng, patience = random.Random(f"{options.seed} {number}"), options.patience
    line = rng.choice([line for line in COMMANDS if line.startswith(options.command)])
    cold = rng.random() < 0.25
    shutil.copytree(made, work)
    (work / "plugin.py").write_text(PLUGIN)
    with robots(line) as (words, stands):
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(work / "compiled")} if cold else None
        what, ended, took, faults = asked_to_end(words, work, environment, rng, patience, stands)
        kept = "out" if line.startswith(("record", "sample")) else "out.checkpoint"
        if (work / kept).exists() and "demo" not in line:
            words = [*words, "--resume"]
            then, ended, later, more = asked_to_end(words, work, environment, rng, patience, stands)
            what, took = f"{what}, then {then}", max(took, later)
            faults += more
    faults += unreadable(work)
    shutil.rmtree(work)
    what = f"{line}{' (cold)' * cold} {what}"
    return {"what": what, "ended": ended, "took": took, "faults": faults}


def asked_to_end(
    words: list[str],
    work: Path,
    environment: Any,
    rng: random.Random,
    patience: float,
    stands: Callable[[], bool],
) -> tuple[str, str, float, list[str]]:
    number, burst = rng.choice(SIGNALS), rng.choice([1, 1, 3])
    after, drives = rng.uniform(0.05, rng.choice([0.5, 2.0, 6.0]) * start_up()), ""
    drive = any("/dev/" in word for word in words) and rng.random() < 0.75  # a robot on its line
    with subprocess.Popen(
        [sys.executable, "-m", "neurosim", *words], cwd=work, env=environment, text=True,
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
    ) as process:  # fmt: skip
        began = time.monotonic()
        while drive and stands() and process.poll() is None and time.monotonic() < began + 120.0:
            time.sleep(0.01)
        if drive and not stands():
            after, drives = rng.uniform(0.0, 5.0), " that it drives"
        what = f"{number.name} x {burst} after {after:.2f} s{drives}"
        with suppress(subprocess.TimeoutExpired):
            process.wait(after)
        done, began = process.poll() is not None, time.monotonic()
        for _ in range(burst):
            process.send_signal(number)
            time.sleep(rng.uniform(0.0, 0.4) if burst > 1 else 0.0)
        try:
            _, stderr = process.communicate(timeout=100.0)
        except subprocess.TimeoutExpired:
            process.kill()
            return what, "hung", 100.0, ["did not end within 100 s"]
    took, code = time.monotonic() - began, process.returncode
    time.sleep(1.0)
    if not stands():
        return what, "interrupted", took, ["the robot drives on"]
    lines = [line for line in stderr.splitlines() if line.startswith("neurosim: ")]
    if code == 0 and (done or not lines):
        return what, "done", 0.0 if done else took, []
    if done:
        fine = "nothing to resume" in stderr
        return what, "done", 0.0, [] if fine else [f"ended by itself, code {code}: {stderr[-300:]}"]
    if code == -number or "init_import_site" in stderr:
        return what, "before", took, []
    faults = []
    if code != 128 + number:
        faults.append(f"code {code}")
    if sum("interrupted" in line for line in lines) != 1:
        faults.append(f"{len(lines)} lines")
    if any(word in stderr for word in ("Traceback", "Exception ignored", "Fatal", "Warning")):
        faults.append("a traceback")
    if faults:
        faults[-1] += f": {stderr[-1500:]}"
    if took > patience:
        faults.append(f"took {took:.1f} s to end")
    return what, "interrupted", took, faults


def start_up() -> float:
    """Return the time now to start Python and import the modules of most commands, s."""
    began = time.monotonic()
    subprocess.run([sys.executable, "-c", "import neurosim.loop.evolve"], check=True)
    return time.monotonic() - began


@contextmanager
def robots(line: str) -> Iterator[tuple[list[str], Callable[[], bool]]]:
    """Put virtual robots outside of a command on their lines, where it drives them.

    Gives the words of the command, and a function that says whether they stand.
    """
    from neurosim.lab import Pacer, VirtualKheperaRig, VirtualRig
    from neurosim.lab.khepera import physics as khepera
    from neurosim.lab.nxt import physics as nxt

    words, rig = line.split(), None
    with ExitStack() as stack:
        if "NXT" in words:
            rig = stack.enter_context(VirtualRig(0, camera=False, real_time=True))
            words[words.index("NXT")], at = str(rig.address["filename"]), nxt.S.SPEED
        if "KHEPERA" in words:
            rig = stack.enter_context(VirtualKheperaRig(0, real_time=True))
            words[words.index("KHEPERA")], at = str(rig.address), khepera.S.SPEED
        if rig is not None:
            stack.enter_context(Pacer(rig.lab))
        yield words, lambda: rig is None or abs(rig.lab.body.state[at : at + 2]).max() < 1e-4


def unreadable(work: Path) -> list[str]:
    """Return the files left that cannot be read."""
    from neurosim.base.errors import UserError
    from neurosim.reports import write_report

    results = []
    for path in work.rglob("*.json"):
        try:
            json.loads(path.read_text())
        except ValueError as error:
            results.append(f"{path.relative_to(work)}: {error}")
    for path in work.glob("out*"):
        if any((path / name).exists() for name in ("recording.json", "controller.json",
                                                   "simulator.json", "dataset.json")):  # fmt: skip
            try:
                write_report([path], work / "read.html")
            except UserError as error:
                results.append(str(error))
    return results


if __name__ == "__main__":
    main()
