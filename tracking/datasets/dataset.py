"""Datasets: one row per command, with the command and the displacement that it caused.

A dataset is a folder: ``dataset.csv`` with the columns ``recording, command, <inputs>, <outputs>,
quality`` and, if known, ``start_x, start_y, start_theta``; and ``dataset.json``, which has the
names and units of inputs and outputs, the source files, and the numbers of left-out commands by
reason. The names are in the file because inputs differ between robots. If the robot was seen during
commands, ``within.csv`` has poses at some instants of them (:mod:`tracking.datasets.within`).

The outputs are the displacement (dx, dy, dtheta) of the middle of the axle in the robot's frame
at the command's start, REP 103: the dy of Pretorius et al. (2009) is dx here, its dx is -dy.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from neurosim.base import files, formats
from neurosim.base.errors import FileError, UserError, counted
from neurosim.base.perimeter import Perimeter
from neurosim.base.progress import track
from neurosim.base.provenance import is_virtual, robot_kind
from tracking.datasets import driven, logs
from tracking.datasets import readings as sensor_readings
from tracking.datasets import within as within_commands
from tracking.datasets.displacements import REASONS, Settings, displacements
from tracking.datasets.recordings import Recording

FORMAT, VERSION = "neurosim-dataset", 2

#: Inputs of a robot with two motors, and the outputs of any robot in the plane, with units.
MOTOR_INPUTS = {"prev_left": "%", "prev_right": "%", "left": "%", "right": "%", "duration": "s"}
OUTPUTS = {"dx": "m", "dy": "m", "dtheta": "rad"}
#: Columns of the pose at a command's beginning, in the recording's frame (m, m, rad), if known.
STARTS = ("start_x", "start_y", "start_theta")


#: Smallest number of rows for training; importers warn about fewer.
FEWEST_ROWS = 20


@dataclass
class Dataset:
    """Commands and the displacements that they caused, in the order of the commands.

    Attributes:
        table: columns recording, command, the inputs, the outputs, quality; and :data:`STARTS`, if
            known for every row.
        inputs: names of the input columns.
        outputs: names of the output columns.
        meta: content of dataset.json: inputs and outputs [{name, unit}], sources
            [{path, sha256}], rows, left_out {reason: count}, settings, and more.
        within: poses at instants within the commands, columns row (place in ``table``), time
            (s since the command's beginning), dx, dy (m), dtheta (rad) since that beginning, in
            the robot's frame there; in the order of row and time; empty if there are none.
        readings: readings of the robot's sensors with its poses, see
            :mod:`tracking.datasets.readings`; of all recordings, also without kept rows.
    """

    table: pd.DataFrame
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    meta: dict[str, Any]
    within: pd.DataFrame = field(default_factory=within_commands.none_within)
    readings: pd.DataFrame = field(default_factory=sensor_readings.no_readings)

    def __len__(self) -> int:
        return len(self.table)

    def input_array(self) -> NDArray[np.float64]:
        """Return the inputs (N, I), in the units that ``meta`` names."""
        return self.table[list(self.inputs)].to_numpy(np.float64, copy=True)

    def output_array(self) -> NDArray[np.float64]:
        """Return the outputs (N, 3): metres, metres, radians."""
        return self.table[list(self.outputs)].to_numpy(np.float64, copy=True)

    def start_array(self) -> NDArray[np.float64] | None:
        """Return the pose at each command's beginning (N, 3) m, m, rad; None: unknown."""
        if STARTS[0] not in self.table:
            return None
        return self.table[list(STARTS)].to_numpy(np.float64, copy=True)

    def split(self, held_out: float = 0.2) -> tuple[Dataset, Dataset]:
        """Split by time into the earlier rows and the last ``held_out`` fraction of them.

        Of equal rows only the first counts (:meth:`once`), so that no row is in both parts. The
        first part has floor((1 - held_out) N) of the N rows that are left.

        Raises:
            UserError: if either part would be empty.
        """
        if not 0 < held_out < 1:
            raise UserError(f"the fraction to hold out must be between 0 and 1, not {held_out:g}")
        rows = self.once()
        # The small amount keeps 0.8 * 5 from being 3.9999.
        earlier = int(len(rows) * (1 - held_out) + 1e-9)
        if not 0 < earlier < len(rows):
            raise UserError(
                f"the dataset has {counted(len(rows), 'row')}, too few to hold out "
                f"{held_out:.0%} of them; record more commands"
            )
        return rows.part(slice(None, earlier)), rows.part(slice(earlier, None))

    @property
    def joined(self) -> NDArray[np.bool_] | None:
        """Whether each row (N,) begins at the end of the previous one; None: rows are independent.

        They are independent unless ``meta["windows"]`` says that rows follow one another.
        """
        if not self.meta.get("windows"):
            return None
        number, name = self.table["command"].to_numpy(), self.table["recording"].to_numpy()
        joined = np.zeros(len(number), np.bool_)
        joined[1:] = (np.diff(number) == 1) & (name[1:] == name[:-1])
        return joined

    @property
    def repeated(self) -> int:
        """Number of rows with exactly the inputs and outputs of an earlier one.

        No robot repeats a motion so exactly: such rows are copies.
        """
        return int(self._is_repeated().sum())

    def once(self) -> Dataset:
        """Return the dataset without the rows that :attr:`repeated` counts."""
        kept = ~self._is_repeated()
        if kept.all():
            return self
        within = within_commands.rows_of(self.within, kept)
        table = self.table[kept].reset_index(drop=True)
        meta = {**self.meta, "rows": len(table), "within": len(within)}
        return Dataset(table, self.inputs, self.outputs, meta, within, self.readings)

    def _is_repeated(self) -> NDArray[np.bool_]:
        columns = [*self.inputs, *self.outputs]
        return self.table[columns].duplicated().to_numpy(np.bool_)

    def part(self, rows: slice) -> Dataset:
        """Return a run of rows, a slice with step 1, with the poses within them."""
        first, last, step = rows.indices(len(self))
        if step != 1:
            raise ValueError("a part of a dataset is a run of rows: a slice with step 1")
        table = self.table.iloc[first:last].reset_index(drop=True)
        within = within_commands.part_of(self.within, first, last)
        meta = {**self.meta, "rows": len(table), "within": len(within)}
        return Dataset(table, self.inputs, self.outputs, meta, within, self.readings)

    def write(self, folder: str | Path) -> None:
        """Write the dataset to a new folder, whole or not at all.

        Raises:
            UserError: if ``folder`` exists.
        """
        with files.new_folder(folder) as partial:
            columns = {name: self.table[name].tolist() for name in self.table.columns}
            files.write_csv(partial / "dataset.csv", columns)
            if len(self.within):
                within_commands.write(partial / "within.csv", self.within)
            meta = {**self.meta, "within": len(self.within)}
            if len(self.readings):
                sensor_readings.write(partial / "readings.csv", self.readings)
                meta["readings"] = len(self.readings)
            files.write_json(partial / "dataset.json", FORMAT, VERSION, meta)

    @classmethod
    def read(cls, folder: str | Path) -> Dataset:
        """Read and check a dataset.

        Raises:
            FileError: naming file, line and field: a missing file or column, another version,
                a word or NaN instead of a number, no rows, missing rows or poses, or a pose that is
                not within a command.
        """
        folder = Path(folder)
        if not folder.is_dir():
            raise FileError(folder, "no such dataset; expected a folder with dataset.json")
        json_path, csv_path = folder / "dataset.json", folder / "dataset.csv"
        meta = files.read_json(json_path, FORMAT, VERSION, formats.Dataset, oldest=VERSION)
        inputs, outputs = (_names(json_path, field, meta[field]) for field in ("inputs", "outputs"))
        if outputs != tuple(OUTPUTS):
            raise FileError(json_path, f"expected {', '.join(OUTPUTS)}", field="outputs")
        columns = {"recording": str, "command": files.integer}
        starts = STARTS if meta.get("starts") else ()
        columns |= dict.fromkeys((*inputs, *outputs, "quality", *starts), files.number)
        table = files.read_csv(csv_path, columns, rows=meta["rows"])
        if len(table) == 0:
            raise FileError(csv_path, "holds no rows")
        if "duration" in inputs:
            wrong = table["duration"] <= 0
            files.refuse_lines(csv_path, table, wrong, "expected a number above 0", "duration")
        table = table.reset_index(drop=True)
        meta = {key: value for key, value in meta.items() if key not in ("format", "version")}
        expected = meta.get("within")
        within = within_commands.read(folder / "within.csv", expected, table)
        readings = sensor_readings.read(folder / "readings.csv", meta.get("readings"))
        return cls(table, inputs, outputs, {**meta, "within": len(within)}, within, readings)


def _names(path: Path, field: str, columns: list[dict[str, str]]) -> tuple[str, ...]:
    names = [column["name"] for column in columns]
    if not all(names) or not names:
        raise FileError(path, "expected a list of {name, unit}", field=field)
    if len(set(names)) != len(names):
        raise FileError(path, "names a column twice", field=field)
    return tuple(names)


def make(
    rows: Sequence[Mapping[str, Any]],
    inputs: Mapping[str, str],
    *,
    sources: Sequence[Mapping[str, str]],
    left_out: Mapping[str, int],
    settings: Mapping[str, Any],
    **more: Any,
) -> Dataset:
    """Make a dataset from rows.

    Args:
        rows: one mapping per row, with recording, command, every input and output, quality;
            ``start``, the pose (m, m, rad) at the command's beginning, if known; and ``within``, if
            any, the poses within the command in the order of time: a sequence of mappings with
            time, dx, dy, dtheta.
        inputs: name of every input column -> its unit.
        sources: path and sha256 of the files that the rows came from.
        left_out: reason -> number of commands without a row.
        settings: settings of the import.
        more: further keys of dataset.json.

    Raises:
        UserError: if there are no rows.
    """
    if not rows:
        reasons = ", ".join(f"{count} {reason}" for reason, count in left_out.items() if count)
        where = " and ".join(dict.fromkeys(source["path"] for source in sources))
        raise UserError(f"{where}: no usable command (left out: {reasons or 'none'})")
    names = ("recording", "command", *inputs, *OUTPUTS, "quality")
    table = pd.DataFrame({name: [row[name] for row in rows] for name in names})
    known = all("start" in row for row in rows)
    if known:
        table[list(STARTS)] = np.array([row["start"] for row in rows], np.float64).reshape(-1, 3)
    within = within_commands.table_of([row.get("within", ()) for row in rows])
    meta = {
        "inputs": [{"name": name, "unit": unit} for name, unit in inputs.items()],
        "outputs": [{"name": name, "unit": unit} for name, unit in OUTPUTS.items()],
        "rows": len(table),
        "within": len(within),
        "starts": known,
        "left_out": dict(left_out),
        "settings": dict(settings),
        "sources": list(sources),
        **more,
    }
    return Dataset(table, tuple(inputs), tuple(OUTPUTS), meta, within)


def build(
    recordings: Iterable[str | Path],
    out: str | Path,
    *,
    settings: Settings | None = None,
    correct_delay: bool = True,
    mixed: bool = False,
    doubtful: bool = False,
    windows: bool | None = None,
) -> Dataset:
    """Turn tracked recordings into a dataset: one row for every complete, well-tracked command.

    If commands change all the time, rows follow one another (:mod:`tracking.datasets.driven`).

    Args:
        recordings: folders with commands.csv and poses.csv, in the order of their recording.
        out: the folder to write.
        settings: of displacements, and of commands to leave out.
        correct_delay: whether displacements begin at the motors' answers instead of the times of
            sending.
        mixed: whether recordings may be of different robots.
        doubtful: whether doubtful poses count, too.
        windows: whether rows follow one another, for learning from windows; None: if a person gave
            the commands, or most of a recording's are shorter than 0.5 s and fewer than 100 of all
            are longer.

    Raises:
        FileError: if a recording's files are missing or wrong, or its clock goes backwards.
        UserError: if no command is usable, a recording is named twice, recordings are of
            different robots, or ``out`` is taken.
    """
    settings = settings or Settings()
    recordings = [Path(path) for path in recordings]
    files.check_new_folder(out)
    names = _recording_names(recordings)
    if not mixed:
        _check_one_robot(recordings)
    rows: list[dict[str, Any]] = []
    sent: list[dict[str, Any]] = []
    left_out = Counter(dict.fromkeys(REASONS, 0))
    delays: list[dict[str, Any]] = []
    clocks: list[dict[str, Any]] = []
    markers: list[dict[str, Any]] = []
    readings: list[pd.DataFrame] = []
    sources, robots, perimeters, virtual = [], [], [], False
    inputs: dict[str, str] = {}
    chained = _changes_fast(recordings, windows)
    drives: list[logs.Log] = []
    warnings: list[str] = []
    for name, path in track(list(zip(names, recordings, strict=True)), "dataset", unit="recording"):
        recording = Recording(path)
        measured = displacements(
            recording, settings, correct_delay=correct_delay, doubtful=doubtful
        )
        warnings += [
            f"{name}: session {session}: no pose from {counted(count, 'command')} at its end: if "
            "it was filmed on, run neurosim track again"
            for session, count in measured.untracked.items()
        ]
        if chained:
            measured.corrected.clear()  # training estimates the delay
            stretches, notes = driven.logs_of(recording, name, logs.Settings(), doubtful=doubtful)
            drives += stretches
            warnings += [f"{name}: {sentence}" for sentence in notes]
        rows += [{"recording": name, **row} for row in measured.rows]
        sent += measured.sent
        seen = sensor_readings.readings_of(recording, name, doubtful=doubtful)
        readings.append(seen)
        left_out.update(measured.left_out)
        delays += [
            {
                "recording": name,
                "session": session,
                **asdict(delay),
                "corrected": session in measured.corrected,
            }
            for session, delay in measured.delays.items()
        ]
        for session in recording.tracked_sessions():
            of = {"recording": name, "session": session["session"]}
            clocks.append(of | session["clock"])
            markers.append(of | session.get("markers", {}))
        sources += [
            {"path": f"{name}/{file}", "sha256": files.sha256(path / file)}
            for file in ("commands.csv", "poses.csv", "observations.csv")[: 2 + (len(seen) > 0)]
        ]
        virtual = virtual or bool(is_virtual(recording.meta))
        if recording.meta["robot"] not in robots:
            robots.append(recording.meta["robot"])
        perimeters.append(Perimeter.of_recording(recording.meta))
        own = logs.inputs_of(recording.takes.units)
        inputs = inputs or own
        if own != inputs:
            raise UserError(
                f"{recordings[0]} and {path} have other commands ({', '.join(inputs)}; "
                f"{', '.join(own)}): make a dataset of each"
            )
    if chained:
        names_of = [name for name in inputs if f"prev_{name}" in inputs]
        rows, counts, _ = logs.any_rows_of(drives, names_of, logs.Settings(windows=True))
        how = {"reasons": logs.REASONS, "windows": True}
    else:
        counts, how = left_out, {"reasons": REASONS, "cutting": cutting(sent)}
    dataset = make(
        rows,
        inputs,
        sources=sources,
        left_out=counts,
        settings=asdict(settings),
        **how,
        **({"warnings": warnings} if warnings or chained else {}),
        motor_delays=delays,
        clocks=clocks,
        markers=markers,
        robots=robots,
        virtual=virtual,
        # With several boards, the one of later drives is unknown.
        perimeter=perimeters[0].describe() if len(set(perimeters)) == 1 else None,
    )
    dataset.readings = sensor_readings.joined(readings)
    dataset.write(out)
    return dataset


def _changes_fast(recordings: Sequence[Path], windows: bool | None) -> bool:
    """Return whether rows follow one another.

    Raises:
        UserError: if they should not, but commands have no planned durations.
    """
    every = [Recording(path) for path in recordings]
    if windows is None:
        counts = [driven.lasting(recording, logs.Settings().shortest) for recording in every]
        fast = any(short > held for held, short in counts)
        few = sum(held for held, _ in counts) < logs.FEW
        return any(recording.by_hand for recording in every) or (fast and few)
    by_hand = next((recording for recording in every if recording.by_hand), None)
    if not windows and by_hand is not None:
        raise UserError(
            f"{by_hand.path} was driven by hand, where no command is held: leave out --held"
        )
    return windows


#: Keys of a robot's description that differ between robots, or between their commands.
_IDENTITY = ("dialect", "name", "address", "virtual", "invert", "full_speed", "speed_unit")


def _check_one_robot(recordings: Sequence[Path]) -> None:
    """Raise an error for recordings of different robots: one simulator cannot fit both."""
    first: dict[str, Any] | None = None
    for path in recordings:
        meta = Recording(path).meta
        robot, lab = meta["robot"], meta.get("virtual_lab")
        identity = {"kind": robot_kind(robot), **{key: robot.get(key) for key in _IDENTITY}}
        ports = robot.get("ports")
        for side in ("left", "right"):
            identity[f"{side} motor"] = ports.get(side) if isinstance(ports, Mapping) else None
        identity["robot of the lab"] = lab.get("robot_seed") if isinstance(lab, Mapping) else None
        first = identity if first is None else first
        for key, value in identity.items():
            if value != first[key]:
                raise UserError(
                    f"{recordings[0]} and {path} are of different robots ({key}: {first[key]!r} "
                    f"and {value!r}): make a dataset of each, or mix them with --mixed"
                )


def _recording_names(paths: Sequence[Path]) -> list[str]:
    if not paths:
        raise UserError("name at least one recording")
    resolved = [path.resolve() for path in paths]
    for index, path in enumerate(resolved):
        if path in resolved[:index]:
            raise UserError(f"{paths[index]} is named twice; its commands would count double")
    names = [path.name for path in resolved]
    if len(set(names)) == len(names):
        return names
    return [str(path) for path in paths]


def cutting(sent: Iterable[Mapping[str, Any]], bin_width: float = 0.5) -> dict[str, Any]:
    """Report how cutting commands at the lines has changed the data.

    A command that goes far is more likely to meet a line: without a counter-measure the
    commands that were completed are slower, shorter and turn more than those that were sent.

    Args:
        sent: forward, turn (percent), duration (s), fate and attempt (from 1) of every command
            that was sent, one that was cut and sent again as often as it was sent.
        bin_width: width of the bins of duration, s.

    Returns:
        ``by_class`` (random, equal, stop) and ``by_duration``: how many were sent, cut and
        completed; ``equal_reach``: mean |speed| x duration of the commands with equal speeds
        that were sampled, completed at the first attempt, and completed at any; ``ratio`` is the
        last over the first: 1 where cutting has taken nothing away; ``ratio_first`` is what it
        would be if nothing were sent again.
    """
    sent = list(sent)
    classes: dict[str, list] = {"random": [], "equal": [], "stop": []}
    bins: dict[int, list] = {}
    for command in sent:
        classes[_class(command)].append(command)
        bins.setdefault(int(command["duration"] / bin_width + 1e-9), []).append(command)
    straight = classes["equal"]
    done = [command for command in straight if command["fate"] == "completed"]
    figure = _reach(command for command in straight if command["attempt"] == 1)
    completed_first = _reach(command for command in done if command["attempt"] == 1)
    completed = _reach(done)
    return {
        "by_class": {name: _fates(commands) for name, commands in classes.items()},
        "by_duration": [
            {"from": number * bin_width, "to": (number + 1) * bin_width, **_fates(bins[number])}
            for number in sorted(bins)
        ],
        "equal_reach": {
            "unit": "% s",
            "sampled": figure,
            "completed_first": completed_first,
            "completed": completed,
            "ratio_first": completed_first / figure if figure and completed_first else None,
            "ratio": completed / figure if figure and completed else None,
        },
    }


def _reach(commands: Iterable[Mapping[str, Any]]) -> float | None:
    values = [abs(command["forward"]) * command["duration"] for command in commands]
    return float(np.mean(values)) if values else None


def _class(command: Mapping[str, Any]) -> str:
    if command["turn"] == 0:
        return "stop" if command["forward"] == 0 else "equal"
    return "random"


def _fates(commands: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    fates = Counter(command["fate"] for command in commands)
    return {"sent": len(commands), "cut": fates["cut"], "completed": fates["completed"]}
