"""Datasets from the UTIAS Multi-Robot Cooperative Localization and Mapping format (MRCLAM).

K. Leung, Y. Halpern, T. Barfoot, H. Liu, "The UTIAS multi-robot cooperative localization and
mapping dataset", IJRR 30(8), 2011. Text files of numbers between blanks, comments after ``#``:
an odometry file with time (s), commanded forward velocity (m/s) and angular velocity (rad/s),
and a ground-truth file with time (s), x, y (m) and heading (rad). Times may be unix times, and
the two files need have neither times nor rates in common. :mod:`tracking.datasets.logs` makes rows
of such a log; poses within commands are taken at samples of the odometry.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from neurosim.base import files
from neurosim.base.errors import FileError, UserError
from tracking.datasets.clocks import in_step
from tracking.datasets.dataset import Dataset, make
from tracking.datasets.logs import REASONS, Log, Settings, any_rows_of, inputs_of

#: Inputs of a robot that is commanded by its velocities, with units.
VELOCITY_INPUTS = inputs_of({"v": "m/s", "w": "rad/s"})

_COLUMNS = {
    "odometry": ("time", "v", "w"),
    "groundtruth": ("time", "x", "y", "heading"),
}


def import_mrclam(
    paths: Sequence[str | Path] | str | Path, out: str | Path, *, settings: Settings | None = None
) -> Dataset:
    """Turn one robot's odometry and ground truth into a dataset.

    Args:
        paths: the odometry and the ground-truth file, in either order, or one folder with
            both. They are distinguished by name (``...Odometry...``, ``...Groundtruth...``) or
            by their number of columns.
        out: the folder to write; inputs prev_v, prev_w, v, w, duration.
        settings: how runs become rows; by default those of held commands alone.

    Raises:
        FileError: if a file is missing, or wrong in some line.
        UserError: if the two files cannot be distinguished or share no time, no row is left, or
            ``out`` is taken.
    """
    settings = settings or Settings()
    settings = replace(settings, windows=bool(settings.windows))
    files.check_new_folder(out)
    by_role = _find([paths] if isinstance(paths, str | Path) else paths)
    odometry = read_numbers(by_role["odometry"], _COLUMNS["odometry"])
    truth = read_numbers(by_role["groundtruth"], _COLUMNS["groundtruth"])
    if odometry[-1, 0] < truth[0, 0] or truth[-1, 0] < odometry[0, 0]:
        raise UserError(
            f"{by_role['odometry']} and {by_role['groundtruth']} have no time in common "
            f"({odometry[0, 0]:.3f} to {odometry[-1, 0]:.3f} s and "
            f"{truth[0, 0]:.3f} to {truth[-1, 0]:.3f} s)"
        )
    poses = np.column_stack([truth[:, 1], truth[:, 2], np.unwrap(truth[:, 3])])
    seen = np.ones(len(odometry), bool)
    stem = by_role["odometry"].stem
    log = Log(stem, odometry[:, 0], odometry[:, 1:], seen, truth[:, 0], poses)
    (log,), warnings = in_step([log], settings.delay)
    settings, notes = settings.fitted([log])
    rows, left_out, windows = any_rows_of([log], ("v", "w"), settings)
    dataset = make(
        rows,
        VELOCITY_INPUTS,
        sources=[{"path": path.name, "sha256": files.sha256(path)} for path in by_role.values()],
        left_out=left_out,
        settings=asdict(settings),
        reasons=REASONS,
        warnings=warnings + notes,
        windows=windows,
    )
    dataset.write(out)
    return dataset


def read_numbers(path: Path, columns: Sequence[str]) -> NDArray:
    """Read a file of numbers between blanks, one row a line, comments after ``#``.

    Returns:
        (N, len(columns)), the first column, time, never decreasing.

    Raises:
        FileError: naming the wrong line and column.
    """
    lines = {line: " ".join(fields) for line, fields in _fields(path)}
    table = files.table_of_lines(path, " ".join(columns), lines, " ")
    table = table.apply(partial(files.parsed, path, parse=files.number))
    files.refuse_lines(path, table, table["time"].diff() < 0, "the clock goes backwards", "time")
    if len(table) < 2:
        raise FileError(path, f"holds too few rows of numbers ({len(table)}; expected 2 or more)")
    return table.to_numpy(float)


def _fields(path: Path) -> Iterator[tuple[int, list[str]]]:
    text = files.read_text(path, "a file of numbers between blanks")
    for line, content in enumerate(text.splitlines(), start=1):
        fields = content.split("#", 1)[0].split()
        if fields:
            yield line, fields


def _find(paths: Sequence[str | Path]) -> dict[str, Path]:
    """Tell the odometry file and the ground-truth file apart."""
    paths = [Path(path) for path in paths]
    wanted = "one odometry and one ground-truth file, or a folder with both"
    if len(paths) == 1 and paths[0].is_dir():
        folder = paths[0]
        # A folder of the dataset also holds its landmarks' ground truth and its measurements.
        paths = sorted(
            path
            for path in folder.iterdir()
            if path.is_file() and _role_by_name(path) and "landmark" not in path.name.lower()
        )
        if len(paths) > 2:
            raise UserError(f"{folder} holds several robots; name the two files of one of them")
        wanted = f"one file ...Odometry... and one ...Groundtruth... in {folder}"
    by_role: dict[str, Path] = {}
    for path in paths:
        role = _role_by_name(path) or _role_by_content(path)
        if role in by_role:
            raise UserError(f"{by_role[role]} and {path} are both {role}; expected {wanted}")
        by_role[role] = path
    if len(by_role) != 2:
        names = ", ".join(path.name for path in paths) or "neither"
        raise UserError(f"expected {wanted}; found {names}")
    return {role: by_role[role] for role in _COLUMNS}


def _role_by_name(path: Path) -> str | None:
    name = path.name.lower().replace("_", "")
    return next((role for role in _COLUMNS if role in name), None)


def _role_by_content(path: Path) -> str:
    line, fields = next(_fields(path), (1, []))
    for role, columns in _COLUMNS.items():
        if len(fields) == len(columns):
            return role
    raise FileError(
        path,
        "expected 3 numbers (odometry: time, v, w) or 4 (ground truth: time, x, y, heading), "
        f"found {len(fields)}",
        line=line,
    )
