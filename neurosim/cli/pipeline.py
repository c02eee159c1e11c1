"""``neurosim pipeline``: the stages of a TOML file, each done once."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shlex
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, get_args

import click

import neurosim
from neurosim.base import formats
from neurosim.base.checkpoint import Checkpoint
from neurosim.base.cluster import Name
from neurosim.base.declared import Mismatch, convert
from neurosim.base.errors import FileError, UserError
from neurosim.base.files import (
    JsonLines,
    is_empty,
    locked,
    make_folder,
    plain,
    sha256,
    write_csv,
)
from neurosim.cli._common import emit, json_option
from neurosim.cli._processes import Processes
from neurosim.cli._stages import MAKES, Experiment, Line, Made, Stage, experiment_of, read_tables
from neurosim.cli._types import PATH

FORMAT, VERSION = "neurosim-pipeline", 1
#: Results that are printed if the file names none.
MOST_SHOWN = 6


@click.command()
@click.argument("file", type=PATH)
@click.option(
    "-o", "--out", type=PATH, help="Folder of all outputs.  [default: FILE without .toml]"
)
@click.option(
    "--at-once",
    type=click.IntRange(1, 10_000),
    help="Combinations of a sweep that run at once.  [default: 1; ray: the cluster's cores]",
)
@click.option(
    "--workers",
    type=click.Choice(get_args(Name)),
    default="local",
    show_default=True,
    help="Where stages run: local, on this computer; or ray, on a Ray cluster. Its computers need "
    "access to the same folders.",
)
@json_option
@click.pass_context
def pipeline(
    ctx: click.Context,
    file: Path,
    out: Path | None,
    at_once: int | None,
    workers: Name,
    as_json: bool,
) -> None:
    """Run the stages of FILE in their order, each with the options of its table.

    FILE is TOML: a table for each stage, such as [train], with the options of that command as keys.
    The whole file is checked first. A stage that was done with the same options and inputs is not
    done again; an interrupted one is continued. The table [sweep] has lists of values: the stages
    run for each combination of them. docs/experiments.md has an example.
    """
    commands = ctx.find_root().command
    assert isinstance(commands, click.Group)
    plugins = [path.absolute() for path in ctx.find_root().params.get("plugins") or ()]
    tables, folder = read_tables(file), (out or file.with_suffix("")).absolute()
    if folder == file.absolute():
        raise UserError(f"{file} has no ending: name a folder for the outputs with -o")
    with contextlib.chdir(file.absolute().parent):
        experiment = experiment_of(file, tables, commands)
        make_folder(folder)
        with locked(folder, "used"), contextlib.ExitStack() as stack:
            # The output of the stages is for people.
            stack.enter_context(contextlib.redirect_stdout(sys.stderr if as_json else sys.stdout))
            processes = None
            if workers != "local" or (at_once or 1) > 1:
                processes = Processes(at_once, workers, plugins)
            run = _Run(experiment, _shown(folder), commands, processes)
            stack.callback(run.log.close)
            points = run.points()
    rows = [_row(point) for point in points]
    summary = None
    if experiment.sweep:
        summary = folder / "summary.csv"
        names = list(dict.fromkeys(name for row in rows for name in row))
        write_csv(summary, {name: [row.get(name) for row in rows] for name in names})
    emit(
        {"pipeline": str(folder), "summary": summary, "points": points},
        as_json,
        lambda: _in_words(folder, summary, rows, experiment),
    )


@dataclass
class _Run:
    """The stages of an experiment in a folder.

    Attributes:
        experiment: its stages.
        folder: of all outputs.
        commands: the group of all commands.
        processes: where the stages of several combinations run at once; None: all in this process.
    """

    experiment: Experiment
    folder: Path
    commands: click.Group
    processes: Processes | None = None
    log: JsonLines = field(init=False)
    _digests: dict[Path, str] = field(default_factory=dict)
    #: Locks of running stages: combinations share the stages that do not depend on their values.
    _busy: dict[tuple[Path, str], threading.Lock] = field(default_factory=dict)
    _writing: threading.Lock = field(default_factory=threading.Lock)

    def __post_init__(self) -> None:
        self.log = JsonLines(self.folder / "pipeline.jsonl", FORMAT, VERSION, {})
        for line, row in enumerate(self.log.rows, 2):
            try:
                convert(row, formats.StageRow)
            except Mismatch as error:
                raise FileError(self.log.path, error.what, line=line, field=error.field) from None

    def points(self) -> list[dict[str, Any]]:
        """Run all combinations of swept values; return :meth:`point` of each."""
        points = self.experiment.points()
        if self.processes is None:
            return [self.point(point) for point in points]
        with ThreadPoolExecutor(self.processes.count) as pool:
            waiting = [pool.submit(self.point, point) for point in points]
            try:
                for one in as_completed(waiting):
                    one.result()  # the first error ends the others
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                self.processes.end()
                raise
        return [one.result() for one in waiting]

    def point(self, point: Mapping[str, Any]) -> dict[str, Any]:
        """Run all stages with a combination of swept values; return the result of each."""
        made: dict[str, Made] = {}
        stages = {}
        for stage in self.experiment.at(point):
            folder = self._folder_of(stage, made, point)
            with self._writing:
                busy = self._busy.setdefault((folder[0], stage.name), threading.Lock())
            with busy:
                row, now = self._stage(stage, made, folder)
            stages[stage.name] = {
                "out": None if row.get("out") is None else (self.folder / row["out"]).absolute(),
                "seconds": row["seconds"],
                "done_before": not now,
                "result": row.get("result") or {},
            }
        return {"sweep": dict(point), "stages": stages}

    def _folder_of(
        self, stage: Stage, made: Mapping[str, Made], point: Mapping[str, Any]
    ) -> tuple[Path, frozenset[str]]:
        """Return the folder of a stage's output and the swept keys on which it depends."""
        line = stage.line(made, Path(), Path())
        swept = stage.swept.union(*(made[name].swept for name in line.stages))
        parts = [f"{key}={_word(point[key])}" for key in point if key in swept]
        name = re.sub(r"[^\w.=,+-]+", "_", ",".join(parts))
        if len(name) > 100:
            name = f"{name[:80]}-{hashlib.sha256(name.encode()).hexdigest()[:12]}"
        return self.folder / name if name else self.folder, swept

    def _stage(
        self, stage: Stage, made: dict[str, Made], place: tuple[Path, frozenset[str]]
    ) -> tuple[dict[str, Any], bool]:
        """Run a stage, unless it was done before; return its row, and whether it ran now."""
        folder, swept = place
        name = stage.output()
        line = stage.line(made, None if name is None else folder / name, folder)
        about = self._about(stage, line, made)
        ended = [
            row
            for row in self.log.rows
            if row["key"] == about["key"]
            and "seconds" in row
            and (row.get("out") is None or (self.folder / row["out"]).exists())
        ]
        if ended:
            row, now = ended[-1], False
            where = "" if row["out"] is None else f" ({self.folder / row['out']})"
            click.echo(f"{stage.name}: done before{where}")
        else:
            row, now = self._do(stage, line, made, folder, about), True
        out = None if row["out"] is None else self.folder / row["out"]
        kind = MAKES.get(" ".join(stage.words))
        made[stage.name] = Made(out, kind, swept, row.get("sha256"))
        return row, now

    def _about(self, stage: Stage, line: Line, made: Mapping[str, Made]) -> dict[str, Any]:
        """Return the inputs of a stage, and their digest."""
        inputs = {
            key: [{"path": str(path), "sha256": self._digest(path)} for path in paths]
            for key, paths in line.inputs.items()
        }
        if stage.in_place:  # its input has changed
            for each in inputs["recording"]:
                kept = [one.sha256 for one in made.values() if str(one.path) == each["path"]]
                each["sha256"] = kept[-1] or each["sha256"] if kept else each["sha256"]
        options = {
            key: value for key, value in stage.options.items() if key not in (*line.inputs, "out")
        }
        options = json.loads(json.dumps(options, default=str))
        digests = {key: [one["sha256"] for one in each] for key, each in inputs.items()}
        identity = [stage.name, *stage.words, stage.output(), options, digests]
        key = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()
        return {
            "stage": stage.name,
            "key": key,
            "command": " ".join(stage.words),
            "options": options,
            "inputs": inputs,
            "neurosim": neurosim.__version__,
        }

    def _do(
        self,
        stage: Stage,
        line: Line,
        made: Mapping[str, Made],
        folder: Path,
        about: dict[str, Any],
    ) -> dict[str, Any]:
        """Run a stage's command, and save a row about it."""
        name, resume = stage.output(), False
        out = line.inputs["recording"][0] if stage.in_place else None
        if name is not None:
            make_folder(folder)
            out = self._begun(stage, about["key"])
            resume = out is not None
            out = out or _free(folder, name)
            line = stage.line(made, out, folder)
        relative = None if out is None else os.path.relpath(out, self.folder)
        about = {**about, "out": relative, "time": datetime.now(UTC).isoformat()}
        self._append(about)
        result: dict[str, Any] = {}
        began = time.monotonic()
        if not (resume and out is not None and _is_recorded(out)):
            words = [*stage.words, *line.words, *(["--resume"] if resume else [])]
            click.secho(f"$ neurosim {shlex.join(words)}", bold=True)
            with stage.named():
                result = self._result(words)
            ended = f"{stage.name}: done in {time.monotonic() - began:.0f} s ({out or folder})"
            click.echo("" if self.processes is None else ended)
        if out is not None:
            self._digests.pop(out, None)
        row = {
            **about,
            "seconds": time.monotonic() - began,
            "sha256": None if out is None else self._digest(out),
            "result": result,
        }
        return self._append(row)

    def _result(self, words: list[str]) -> dict[str, Any]:
        """Run a stage's command; return its result."""
        if self.processes is not None:
            return self.processes.run(words)
        result: dict[str, Any] = {}
        code = self.commands.main(words, prog_name="neurosim", standalone_mode=False, obj=result)
        if code:
            click.get_current_context().exit(code)
        return result

    def _append(self, row: dict[str, Any]) -> dict[str, Any]:
        row = json.loads(json.dumps(row, default=plain))
        with self._writing:
            self.log.append(row)
            self.log.rows.append(row)
        return row

    def _begun(self, stage: Stage, key: str) -> Path | None:
        """Return the interrupted output of the same stage, which can be continued."""
        if stage.resumes:
            for row in reversed(self.log.rows):
                if row["key"] == key and row["out"] is not None:
                    out = self.folder / row["out"]
                    kept = ("recording.json", "round-01", "sampling.json")
                    if Checkpoint(out, "").begun or any((out / each).exists() for each in kept):
                        return out
        return None

    def _digest(self, path: Path) -> str:
        """Return the SHA-256 of a file, or of the names and hashes of a folder's files."""
        if path not in self._digests:
            parts = [path] if path.is_file() else sorted(path.rglob("*"))
            sums = [
                f"{part.relative_to(path).as_posix()} {sha256(part)}\n"
                for part in parts
                if part.is_file() and not part.name.startswith(".")
            ]
            self._digests[path] = hashlib.sha256("".join(sums).encode()).hexdigest()
        return self._digests[path]


def _is_recorded(out: Path) -> bool:
    """Return whether an output is a complete recording."""
    from neurosim.recording.rounds import parts_of
    from tracking.datasets.recordings import Recording

    parts = [Recording(part) for part in parts_of(out) if (part / "recording.json").exists()]
    if not parts or not all(part.meta["complete"] for part in parts):
        return False
    source = parts[-1].meta["settings"]["source"]
    rounds = source.get("rounds")
    return rounds is None or (len(parts) == rounds and parts[-1].is_tracked)


def _free(folder: Path, name: str) -> Path:
    """Return a free path in a folder; if the name exists, a number is added."""
    path, number = folder / name, 1
    while not (is_empty(path) and not path.is_file()) or Checkpoint(path, "").begun:
        number += 1
        path = folder / f"{Path(name).stem}-{number}{Path(name).suffix}"
    return path


def _shown(path: Path) -> Path:
    """Return the shortest name of a path from the working folder."""
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path


def _word(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, default=str)


def _row(point: Mapping[str, Any]) -> dict[str, Any]:
    """Return the swept values of a combination, and the numbers in its results."""
    row = {key: _word(value) for key, value in point["sweep"].items()}
    for name, stage in point["stages"].items():
        row.update(_numbers(f"{name}:", stage["result"]))
        row[f"{name}:seconds"] = stage["seconds"]
    return row


def _numbers(name: str, value: Any) -> Iterator[tuple[str, float]]:
    if isinstance(value, bool | int | float):
        yield name, value
    for key, part in value.items() if isinstance(value, dict) else ():
        yield from _numbers(f"{name}{'' if name.endswith(':') else '.'}{key}", part)


def _in_words(
    folder: Path, summary: Path | None, rows: list[dict[str, Any]], experiment: Experiment
) -> str:
    """Return the table of a sweep as text."""
    names = experiment.summary or _differing(rows, list(experiment.sweep))[:MOST_SHOWN]
    if not names and summary is None:
        return f"{folder}: all stages are done."
    lines = [[*experiment.sweep, *names]]
    for row in rows:
        lines.append([_cell(row.get(name)) for name in lines[0]])
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    text = "\n".join(
        "  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )
    return f"{text}\n{summary or folder}"


def _differing(rows: list[dict[str, Any]], swept: list[str]) -> list[str]:
    """Return the results that differ between rows, without the stages' times."""
    names = dict.fromkeys(name for row in rows for name in row)
    return [
        name
        for name in names
        if name not in swept
        and not name.endswith("seconds")
        and len({row.get(name) for row in rows}) > 1
    ]


def _cell(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)
