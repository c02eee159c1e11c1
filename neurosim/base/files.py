"""Files that are either whole or absent, and readers that say what is wrong and where.

JSON, CSV and safetensors only: nothing that can run code when it is loaded. Every JSON file
carries ``format`` and ``version``. A file is written beside its place and then renamed, so
that a crash leaves the old file or none.
"""

from __future__ import annotations

import csv
import hashlib
import json
import math
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from neurosim.base.errors import FileError, UserError


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Give a path to write to beside ``path``; rename it into place when the block succeeds.

    Raises:
        UserError: if something stands at ``path`` that is neither file nor folder, such as a
            device, which renaming would replace; or its folder cannot be one.
    """
    path = Path(path)
    _refuse_device(path, "a file")
    make_folder(path.parent)
    # The suffix stays at the end: encoders and savers choose their format by it.
    partial = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        yield partial
        partial.chmod(0o666 & ~_umask())  # some writers make files that only their owner reads
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _refuse_device(path: Path, wanted: str) -> None:
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise UserError(f"{path} is a device; name {wanted} to write")


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def write_text(path: str | Path, text: str) -> None:
    """Write a text file in UTF-8 with ``\\n`` line ends, whole or not at all."""
    with atomic_path(path) as partial:
        partial.write_text(text, encoding="utf-8", newline="\n")


@contextmanager
def new_folder(path: str | Path, *, overwrite: bool = False) -> Iterator[Path]:
    """Give an empty folder to fill; it appears at ``path`` only if the block succeeds.

    Raises:
        UserError: if ``path`` exists and is not an empty folder (and ``overwrite`` is not set).
    """
    path = Path(path)
    check_new_folder(path, overwrite=overwrite)
    make_folder(path.parent)
    partial = Path(tempfile.mkdtemp(prefix=f".{path.name}.partial-", dir=path.parent))
    try:
        yield partial
        partial.chmod(0o777 & ~_umask())  # mkdtemp's 0700 is not what a shared folder wants
        if path.exists():
            # Moved aside rather than deleted first: an interruption leaves one whole folder.
            old = partial.with_name(partial.name + "-old")
            os.replace(path, old)
            os.replace(partial, path)
            shutil.rmtree(old)
        else:
            os.replace(partial, path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def make_folder(path: Path) -> None:
    """Make a folder and those that it is in, where they are not there.

    Raises:
        UserError: if one of them is a file.
    """
    for folder in (path, *path.parents):
        if folder.is_file():
            raise UserError(f"{folder} is a file; name a folder, or a place in one")
    path.mkdir(parents=True, exist_ok=True)


def check_new_folder(path: str | Path, *, overwrite: bool = False) -> None:
    """Refuse an output folder that would overwrite something.

    Raises:
        UserError: if ``path`` is a file, a device, or a folder with something in it.
    """
    path = Path(path)
    _refuse_device(path, "a folder")
    if path.is_file():
        raise UserError(f"{path} is a file; name a folder that does not exist yet")
    if path.is_dir() and any(path.iterdir()) and not overwrite:
        raise UserError(f"{path} is not empty; name a new folder, or remove this one yourself")


def write_json(path: str | Path, format: str, version: int, content: Mapping[str, Any]) -> None:
    """Write ``content`` as JSON under the keys ``format`` and ``version``.

    Raises:
        ValueError: if a number in ``content`` is NaN or infinite: JSON has no word for them.
    """
    document = {"format": format, "version": version, **content}
    write_text(path, json.dumps(document, indent=2, allow_nan=False, default=_plain) + "\n")


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):  # a tensor
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not JSON")


def read_json(
    path: str | Path, format: str, version: int, fields: Mapping[str, type | tuple] | None = None
) -> dict[str, Any]:
    """Read a JSON file of this ``format`` and ``version``.

    Args:
        path: the file.
        format: the expected value of the key ``format``.
        version: the newest version this code reads; older ones are the caller's to refuse.
        fields: keys that must be there, with their types.

    Raises:
        FileError: if the file is missing, cut short, of another format or version, or lacks a
            field.
    """
    path = Path(path)
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        raise FileError(path, f"no such file; expected a {format} file") from None
    except IsADirectoryError:
        raise FileError(path, f"is a folder; expected a {format} file") from None
    except UnicodeDecodeError:
        raise FileError(path, "is not text; expected JSON in UTF-8") from None
    except json.JSONDecodeError as error:
        raise FileError(
            path, f"is not whole JSON ({error.msg}); it may have been cut short", line=error.lineno
        ) from None
    if not isinstance(document, dict):
        raise FileError(path, f"expected a JSON object of format {format!r}")
    if document.get("format") != format:
        raise FileError(
            path, f"expected {format!r}, found {document.get('format')!r}", field="format"
        )
    found = document.get("version")
    if isinstance(found, bool) or not isinstance(found, int) or not 1 <= found <= version:
        raise FileError(
            path,
            f"this neurosim reads version {version}, found {found!r}; "
            "use the neurosim that wrote it, or make it again",
            field="version",
        )
    for name, kind in (fields or {}).items():
        if name not in document:
            raise FileError(path, "is missing", field=name)
        value = document[name]
        wrong_bool = isinstance(value, bool) and kind not in (bool, object)
        if not isinstance(value, kind) or wrong_bool:
            names = kind if isinstance(kind, tuple) else (kind,)
            expected = " or ".join(k.__name__ for k in names)
            raise FileError(path, f"expected {expected}, found {value!r:.60}", field=name)
    return document


Column = Callable[[str], Any]


def number(text: str) -> float:
    """Parse a finite number of a CSV field."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError("not a finite number")
    return value


def optional_number(text: str) -> float:
    """Parse a finite number, or nothing as NaN."""
    return math.nan if text == "" else number(text)


def integer(text: str) -> int:
    """Parse an integer of a CSV field."""
    return int(text)


def flag(text: str) -> bool:
    """Parse 0 or 1."""
    if text not in ("0", "1"):
        raise ValueError("not 0 or 1")
    return text == "1"


_EXPECTED = {
    number: "a finite number",
    optional_number: "a finite number or nothing",
    integer: "a whole number",
    flag: "0 or 1",
    str: "text",
}


def read_csv(
    path: str | Path, columns: Mapping[str, Column], *, drop_torn_line: bool = False
) -> dict[str, list]:
    """Read the named columns of a CSV file, checking every field.

    Args:
        path: the file; its first line names the columns. Columns not asked for are passed over.
        columns: column name -> parser (``number``, ``optional_number``, ``integer``, ``flag``,
            ``str``, or any function that raises ValueError).
        drop_torn_line: pass over a last line without a line end: a writer was killed in it.

    Returns:
        Column name -> list of values, in the order of ``columns``.

    Raises:
        FileError: naming the line and the field, if something is missing or is not what it
            should be.
    """
    path = Path(path)
    try:
        with open(path, encoding="utf-8", newline="") as file:
            text = file.read()
    except FileNotFoundError:
        raise FileError(path, "no such file") from None
    except IsADirectoryError:
        raise FileError(path, "is a folder; expected a CSV file") from None
    except UnicodeDecodeError:
        raise FileError(path, "is not text; expected CSV in UTF-8") from None
    if drop_torn_line and not text.endswith("\n"):
        text = text[: text.rfind("\n") + 1]
    reader = csv.reader(text.splitlines())
    header = next(reader, None)
    if not header:
        raise FileError(path, "is empty; expected a line with the column names", line=1)
    for name in columns:
        if name not in header:
            raise FileError(path, f"this column is missing; found {', '.join(header)}", field=name)
    places = [(name, header.index(name), parse) for name, parse in columns.items()]
    table: dict[str, list] = {name: [] for name in columns}
    for row in reader:
        if not row:
            continue
        if len(row) != len(header):
            raise FileError(
                path, f"expected {len(header)} fields, found {len(row)}", line=reader.line_num
            )
        for name, place, parse in places:
            try:
                table[name].append(parse(row[place]))
            except ValueError:
                raise FileError(
                    path,
                    f"expected {_EXPECTED.get(parse, parse.__name__)}, found {row[place]!r}",
                    line=reader.line_num,
                    field=name,
                ) from None
    return table


def read_header(path: str | Path) -> tuple[str, ...]:
    """Return the column names in the first line of a CSV file.

    Raises:
        FileError: if there is no such file, or it is not CSV.
    """
    try:
        with open(path, encoding="utf-8", newline="") as file:
            return tuple(next(csv.reader(file), ()))
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(path, f"cannot be read as CSV in UTF-8: {error}") from None


class LineLog:
    """A CSV file that grows line by line, each flushed to the disk as it is written.

    A kill between two lines loses nothing; one within a line leaves a torn last line, which
    ``read_csv(..., drop_torn_line=True)`` passes over and reopening this log removes.
    """

    def __init__(self, path: str | Path, columns: Sequence[str]):
        self.path = Path(path)
        self.columns = tuple(columns)
        header = ",".join(self.columns) + "\n"
        if self.path.exists():
            text = self.path.read_bytes()
            whole = text[: text.rfind(b"\n") + 1]
            if whole and not whole.startswith(header.encode()):
                raise FileError(
                    self.path, f"expected the columns {', '.join(self.columns)}", line=1
                )
            if whole != text:
                with open(self.path, "r+b") as file:
                    file.truncate(len(whole))
        self._file = open(self.path, "a", encoding="utf-8", newline="")  # noqa: SIM115
        self._writer = csv.writer(self._file, lineterminator="\n")
        if self._file.tell() == 0:
            self._file.write(header)
            self._file.flush()

    def append(self, *values: Any) -> None:
        """Write one line and flush it; floats in shortest exact form, None and NaN as nothing."""
        if len(values) != len(self.columns):
            raise ValueError(f"expected {len(self.columns)} values, got {len(values)}")
        self._writer.writerow([_field(value) for value in values])
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> LineLog:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _field(value: Any) -> Any:
    if value is None:
        return ""
    if isinstance(value, bool | np.bool_):
        return int(value)
    if isinstance(value, float | np.floating):
        return "" if math.isnan(value) else repr(float(value))
    return value


def _fields(column: Sequence) -> list:
    if isinstance(column, np.ndarray) and column.dtype == np.float64:
        return ["" if value != value else repr(value) for value in column.tolist()]
    return [_field(value) for value in column]


def write_csv(path: str | Path, columns: Mapping[str, Sequence]) -> None:
    """Write columns of equal length as CSV, whole or not at all; NaN as nothing."""
    with atomic_path(path) as partial, open(partial, "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*(_fields(column) for column in columns.values()), strict=True))


def sha256(path: str | Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_tensors(path: str | Path, tensors: Mapping[str, Any]) -> None:
    """Write NumPy arrays (or CPU tensors) as safetensors, whole or not at all."""
    from safetensors.numpy import save

    data = save({name: np.ascontiguousarray(value) for name, value in tensors.items()})
    with atomic_path(path) as partial:
        partial.write_bytes(data)


def read_tensors(
    path: str | Path, shapes: Mapping[str, Sequence[int | None]] | None = None
) -> dict[str, np.ndarray]:
    """Read a safetensors file as NumPy arrays.

    Args:
        path: the file.
        shapes: tensors that must be there, with their shapes; None stands for any length.

    Raises:
        FileError: if the file is missing or cut short, or a tensor is missing, has another
            shape or holds a number that is not finite.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    path = Path(path)
    try:
        tensors = load_file(str(path))
    except FileNotFoundError:
        raise FileError(path, "no such file") from None
    except (SafetensorError, OSError) as error:
        raise FileError(
            path, f"is not a whole safetensors file ({error}); it may have been cut short"
        ) from None
    for name, shape in (shapes or {}).items():
        if name not in tensors:
            raise FileError(path, "this tensor is missing", field=name)
        found = tensors[name].shape
        matches = len(found) == len(shape) and all(
            want is None or want == have for want, have in zip(shape, found, strict=True)
        )
        if not matches:
            raise FileError(path, f"expected shape {tuple(shape)}, found {found}", field=name)
        if not np.isfinite(tensors[name]).all():
            raise FileError(path, "holds a number that is not finite", field=name)
    return tensors


def read_json_lines(path: str | Path) -> tuple[list[dict[str, Any]], int]:
    """Read the objects of a file of JSON lines, without a torn last one.

    Returns:
        The objects, the head first, and how many bytes of the file they are.

    Raises:
        FileError: if the file is missing, or a line is no JSON object.
    """
    path = Path(path)
    try:
        text = path.read_bytes()
    except OSError as error:
        raise FileError(path, f"cannot be read: {error.strerror}") from None
    whole = text[: text.rfind(b"\n") + 1]
    found = []
    for line, part in enumerate(whole.splitlines(), 1):
        try:
            row = json.loads(part)
        except ValueError:
            row = None
        if not isinstance(row, dict):
            raise FileError(path, "expected a JSON object", line=line)
        found.append(row)
    return found, len(whole)


class JsonLines:
    """A file of JSON objects, one a line, each on the disk before :meth:`append` returns.

    The first line has ``format``, ``version`` and what all lines share. A kill within a line
    leaves a torn last line, which opening the file again removes.

    Attributes:
        rows: the objects that stood there when it was opened.
    """

    def __init__(self, path: str | Path, format: str, version: int, about: Mapping[str, Any]):
        """Open the file, or begin it.

        Raises:
            FileError: if it is another file, or a line of it is damaged.
        """
        self.path = Path(path)
        make_folder(self.path.parent)
        head = json.loads(
            json.dumps({"format": format, "version": version, **about}, default=_plain)
        )
        found, length = read_json_lines(self.path) if self.path.exists() else ([], 0)
        for row in found[:1]:
            wrong = [name for name in {**head, **row} if head.get(name) != row.get(name)]
            if wrong:
                raise FileError(
                    self.path,
                    f"expected {head.get(wrong[0])!r}, found {row.get(wrong[0])!r}",
                    line=1,
                    field=wrong[0],
                )
        self.rows = found[1:]
        self._file = open(self.path, "ab")  # noqa: SIM115
        self._file.truncate(length)
        if not found:
            self.append(head)

    def append(self, row: Mapping[str, Any]) -> None:
        """Write one line, and wait until it is on the disk.

        Raises:
            ValueError: if a number in it is NaN or infinite.
        """
        self._file.write(json.dumps(row, allow_nan=False, default=_plain).encode() + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file."""
        self._file.close()
