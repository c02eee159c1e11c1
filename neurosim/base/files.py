"""Files that are either whole or absent, and readers whose errors say what is wrong and where.

Only JSON, CSV and safetensors, which cannot run code when they are loaded. Every JSON file
carries ``format`` and ``version``. A file is written under a temporary name and then renamed, so
that a crash leaves the old file or none.
"""

from __future__ import annotations

import csv
import glob
import hashlib
import io
import json
import math
import os
import shutil
import socket
import stat
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypeVar

import numpy as np
from filelock import FileLock, Timeout

from neurosim.base.declared import Mismatch, SettingError, convert, without_nulls
from neurosim.base.errors import FileError, UserError

if TYPE_CHECKING:
    import pandas as pd  # 0.4 s, needed where a table is read

Made = TypeVar("Made")

#: Largest number in a CSV file, so that results of measured values stay finite.
LARGEST = 1e150

#: Characters of the target's name that are kept in the name of a temporary file.
_OF_NAME = 32
#: A temporary file older than this, s, was left by a killed program.
_STALE = 86_400


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Give a path to write to next to ``path``; rename it into place when the block succeeds.

    Files that a killed program left next to ``path`` are removed after a day.

    Raises:
        UserError: if ``path`` is neither file nor folder, such as a device, which renaming would
            replace; or its parent is not a folder.
    """
    path = Path(path)
    _refuse_device(path, "a file")
    make_folder(path.parent)
    # The suffix stays at the end: encoders and savers choose their format by it. The rest of the
    # name is random, so that nobody can put a link there beforehand.
    prefix, suffix = f".{path.stem[:_OF_NAME]}.", f".partial{path.suffix}"
    _sweep(path.parent, prefix, suffix)
    number, name = tempfile.mkstemp(prefix=prefix, suffix=suffix, dir=path.parent)
    os.close(number)
    partial = Path(name)
    try:
        yield partial
        partial.chmod(0o666 & ~_umask())  # some writers make files that only their owner reads
        _to_disk(partial)
        os.replace(partial, path)
        _to_disk(path.parent)
    finally:
        partial.unlink(missing_ok=True)


def _sweep(folder: Path, prefix: str, suffix: str = "") -> None:
    """Remove the files that killed programs left in a folder."""
    for path in folder.glob(f"{glob.escape(prefix)}*{glob.escape(suffix)}"):
        with suppress(OSError):
            if not path.is_symlink() and time.time() - path.stat().st_mtime > _STALE:
                shutil.rmtree(path) if path.is_dir() else path.unlink()


def _to_disk(path: Path) -> None:
    """Make the system write a file or a folder's entries to the disk; for a folder, try only."""
    if os.name == "nt":
        return  # there only a program that has a file open for writing can flush it
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    except OSError:
        if path.is_file():
            raise
    finally:
        os.close(number)


def _refuse_device(path: Path, wanted: str) -> None:
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise UserError(f"{path} is a device; name {wanted} to write")


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def open_own(path: str | Path, mode: str = "ab") -> BinaryIO:
    """Open a file that grows in place, such as a log; make it where there is none.

    The maker of the folder may have put something else there: a symbolic or hard link leads to
    another person's file, and a pipe never answers.

    Args:
        path: the file.
        mode: ``ab`` to append, ``wb`` to begin again, ``xb`` to create a file that must not exist.

    Raises:
        UserError: if a link or anything but a plain file is there, or, with ``xb``, anything.
    """
    path = Path(path)
    flags = {"ab": os.O_APPEND, "wb": 0, "xb": os.O_EXCL}[mode] | os.O_WRONLY | os.O_CREAT
    flags |= getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    flags |= getattr(os, "O_BINARY", 0)
    stay = "files must be written in this folder: replace it by a plain file, or remove it"
    if path.is_symlink():
        raise UserError(f"{path} is a link to {os.readlink(path)}, and {stay}")
    _refuse_device(path, "a file")
    try:
        number = os.open(path, flags, 0o666)
    except FileExistsError:
        raise UserError(f"{path} exists already; a recording is never overwritten") from None
    except IsADirectoryError:
        raise UserError(f"{path} is a folder, and {stay}") from None
    try:
        about = os.fstat(number)
        if not stat.S_ISREG(about.st_mode):
            raise UserError(f"{path} is not a plain file, and {stay}")
        if about.st_nlink > 1:
            raise UserError(f"{path} is a hard link to another file, and {stay}")
        if mode == "wb":
            os.ftruncate(number, 0)
        return os.fdopen(number, "ab" if mode == "ab" else "wb")
    except BaseException:
        os.close(number)
        raise


def write_text(path: str | Path, text: str) -> None:
    """Write a text file in UTF-8 with ``\\n`` line ends, whole or not at all."""
    with atomic_path(path) as partial:
        partial.write_text(text, encoding="utf-8", newline="\n")


@contextmanager
def new_folder(path: str | Path, *, overwrite: bool = False) -> Iterator[Path]:
    """Give an empty folder to fill; it appears at ``path`` only if the block succeeds.

    A folder that a killed program had moved aside is moved back; its unfinished files next to
    ``path`` are removed after a day.

    Raises:
        UserError: if ``path`` exists and is not an empty folder (and ``overwrite`` is not set).
    """
    path = Path(path)
    check_new_folder(path, overwrite=overwrite)
    make_folder(path.parent)
    prefix, aside = f".{path.name[:_OF_NAME]}.partial-", f".{path.name[:_OF_NAME]}.old-"
    _put_back(path, aside)
    _sweep(path.parent, prefix)
    partial = Path(tempfile.mkdtemp(prefix=prefix, dir=path.parent))
    try:
        yield partial
        partial.chmod(0o777 & ~_umask())  # mkdtemp's mode 0700 is too strict for a shared folder
        for written in partial.rglob("*"):
            _to_disk(written)
        check_new_folder(path, overwrite=overwrite)  # another program may have made it meanwhile
        if path.exists():
            # Moved aside rather than deleted first: an interruption leaves one whole folder.
            old = path.with_name(aside + partial.name[len(prefix) :])
            os.replace(path, old)
            os.replace(partial, path)
            shutil.rmtree(old)
        else:
            os.replace(partial, path)
        _to_disk(path.parent)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _put_back(path: Path, aside: str) -> None:
    """Move an old folder back if a kill left no new one; otherwise remove it."""
    for old in path.parent.glob(f"{glob.escape(aside)}*"):
        with suppress(OSError):
            if path.exists():
                shutil.rmtree(old)
            else:
                os.replace(old, path)


def make_folder(path: Path) -> None:
    """Make a folder and its missing parents.

    Raises:
        UserError: if one of them is a file.
    """
    for folder in (path, *path.parents):
        if folder.is_file():
            raise UserError(f"{folder} is a file; name a folder")
    path.mkdir(parents=True, exist_ok=True)


def is_empty(folder: str | Path) -> bool:
    """Return whether a folder does not exist, or holds only leftovers of a killed program."""
    folder = Path(folder)
    return not folder.is_dir() or all(_is_left(path) for path in folder.iterdir())


def _is_left(path: Path) -> bool:
    return path.name == _LOCK or (path.name.startswith(".") and ".partial" in path.name)


#: The name of a folder's lock.
_LOCK = ".lock"


@contextmanager
def locked(folder: str | Path, doing: str) -> Iterator[None]:
    """Lock a folder for this process while the block runs.

    The file ``.lock`` in it names the process and the computer. A lock of a process that has ended
    does not count.

    Args:
        folder: an existing folder.
        doing: the activity, for the message of another process: ``recorded into``.

    Raises:
        UserError: if another process has the lock, or the lock is not a plain file.
    """
    path = Path(folder) / _LOCK
    open_own(path).close()
    lock = FileLock(path, timeout=0)
    try:
        lock.acquire()
    except Timeout:
        holder = ""
        with suppress(OSError):  # on Windows no other process can read it
            holder = path.read_text(encoding="utf-8", errors="replace")[:512].strip()
        raise UserError(
            f"{folder} is being {doing} by {holder or 'another process'}: wait until it ends, or "
            "end it"
        ) from None
    try:
        with suppress(PermissionError), open_own(path, "wb") as file:
            file.write(f"process {os.getpid()} on {socket.gethostname()}\n".encode())
        yield
    finally:
        with suppress(PermissionError):  # Windows cannot remove an open file
            path.unlink(missing_ok=True)
        lock.release()


def check_free(folder: str | Path, doing: str) -> None:
    """Raise an error for a folder that another process has locked; see :func:`locked`.

    Raises:
        UserError: naming the process.
    """
    if (Path(folder) / _LOCK).exists():
        # A folder that cannot be written has the lock of a process that has ended.
        with suppress(PermissionError), locked(folder, doing):
            pass


def check_new_file(path: Path, what: str, *, overwrite: bool = False) -> None:
    """Raise an error for an output file that would overwrite another one.

    Args:
        path: the file.
        what: what it is, for the message.
        overwrite: whether it may be replaced.

    Raises:
        UserError: naming the option that replaces it.
    """
    if path.exists() and not overwrite:
        raise UserError(f"{path} exists; name another {what}, or add --overwrite to replace it")


def check_new_folder(path: str | Path, *, overwrite: bool = False) -> None:
    """Raise an error for an output folder that would overwrite something.

    Raises:
        UserError: if ``path`` is a file, a device, or a folder with something in it.
    """
    path = Path(path)
    _refuse_device(path, "a folder")
    if path.is_file():
        raise UserError(f"{path} is a file; name a folder that does not exist yet")
    if not is_empty(path) and not overwrite:
        raise UserError(f"{path} is not empty; name a new folder, or remove this one yourself")


def inside(folder: str | Path, name: object, *, file: str | Path, field: str) -> Path:
    """Return the path of a file that an artefact names, in the artefact's folder.

    Args:
        folder: of the artefact.
        name: the name in the artefact.
        file: the file with the name, for the message.
        field: the field with the name.

    Raises:
        FileError: if it is not a plain file name, and so could lead out of the folder.
    """
    plain = isinstance(name, str) and name not in ("", ".", "..") and not set(name) & set("/\\:\0")
    if not plain:
        raise FileError(
            file, f"expected the name of a file in this folder, found {name!r:.60}", field=field
        )
    return Path(folder) / str(name)


def check_no_links(folder: str | Path) -> None:
    """Raise an error for a folder that holds links: files must not be written through them.

    Raises:
        UserError: naming the first link in it.
    """
    for path in sorted(Path(folder).rglob("*")):
        if path.is_symlink():
            raise UserError(
                f"{path} is a link to {os.readlink(path)}, and files must be written inside this "
                "folder: replace the link by the file itself, or remove it"
            )


def write_json(path: str | Path, format: str, version: int, content: Mapping[str, Any]) -> None:
    """Write ``content`` as JSON under the keys ``format`` and ``version``.

    Raises:
        ValueError: if a number in ``content`` is NaN or infinite: JSON has no word for them.
    """
    document = {"format": format, "version": version, **content}
    write_text(path, json.dumps(document, indent=2, allow_nan=False, default=plain) + "\n")


def plain(value: Any) -> Any:
    """Return an array, a tensor or a path as a JSON value."""
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not JSON")


#: Largest size of a JSON file or another text file, bytes.
MOST_JSON, MOST_TEXT = 64 * 2**20, 1024 * 2**20


def check_name(path: str | Path) -> str:
    """Return the name of a file as text for libraries that are not written in Python.

    Raises:
        FileError: if it is not UTF-8, which crashes some of them.
    """
    try:
        str(path).encode("utf-8")
    except UnicodeEncodeError:
        raise FileError(ascii(str(path)), "the name is not UTF-8; rename the file") from None
    return str(path)


def _instead(path: Path) -> str:
    """Return the end of a message about a missing file: the kind of its folder, if known."""
    kinds = ("trial", "recording", "dataset", "simulator", "controller")
    kind = next((one for one in kinds if (path.parent / f"{one}.json").is_file()), None)
    return "" if kind is None or path.suffix != ".json" else f", but {path.parent} is a {kind}"


def check_file(path: str | Path, expected: str, *, most: int | None = None) -> None:
    """Check that a file can be read to its end, which a pipe or a device may not have.

    Args:
        path: the file.
        expected: the expected kind, for messages: ``a CSV file``.
        most: largest size, bytes.

    Raises:
        FileError: if there is no such file, or it is a folder or a device.
    """
    path = Path(path)
    try:
        status = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        raise FileError(path, f"no such file; expected {expected}{_instead(path)}") from None
    except OSError as error:
        raise FileError(path, f"cannot be read ({error.strerror}); expected {expected}") from None
    if stat.S_ISDIR(status.st_mode):
        raise FileError(path, f"is a folder; expected {expected}")
    if not stat.S_ISREG(status.st_mode):
        raise FileError(path, f"is a pipe or a device; expected {expected}")
    if most is not None and status.st_size > most:
        raise FileError(path, f"is larger than {most // 2**20} MB; expected {expected}")


def read_text(
    path: str | Path,
    expected: str,
    *,
    encoding: str = "utf-8",
    most: int = MOST_TEXT,
    not_text: str | None = None,
) -> str:
    """Return the text of a file, line ends as they are.

    Args:
        path: the file.
        expected: the expected kind, for messages: ``a CSV file``.
        encoding: of the file.
        most: largest size, bytes.
        not_text: advice for a file that is not text; by default the expected kind.

    Raises:
        FileError: if there is no such file, or it is a folder or a device, or not text.
    """
    check_file(path, expected, most=most)
    try:
        with open(path, encoding=encoding, newline="") as file:
            return file.read()
    except UnicodeDecodeError:
        raise FileError(path, f"is not text; {not_text or f'expected {expected}'}") from None


def _json_integer(text: str) -> int:
    if len(text) > 20 or abs(int(text)) >= 2**64:
        raise ValueError(f"the number {text[:12]}... of {len(text)} digits is too large")
    return int(text)


def _json_number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:20]} cannot be written as a number")
    return value


def _json_object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the key {twice!r:.40} appears twice in one object")
    return content


def parse_json(text: str) -> Any:
    """Return the content of a JSON text; its numbers fit into a float or 64 bits.

    Raises:
        json.JSONDecodeError: if it is not JSON.
        ValueError: if a number is too large, a key appears twice, or it is nested too deeply.
    """
    try:
        return json.loads(
            text,
            parse_int=_json_integer,
            parse_float=_json_number,
            parse_constant=_json_number,
            object_pairs_hook=_json_object,
        )
    except RecursionError:
        raise ValueError("is nested too deeply") from None


def read_json(
    path: str | Path, format: str, version: int, kind: Any = None, oldest: int = 1
) -> dict[str, Any]:
    """Read a JSON file of this ``format`` and ``version``.

    Args:
        path: the file.
        format: the expected value of the key ``format``.
        version: the newest version that this code reads.
        kind: the declared content (:mod:`neurosim.base.formats`); optional keys that are null are
            left out of the result.
        oldest: the oldest version that this code reads.

    Raises:
        FileError: if the file is missing, cut short, of another format or version, or a field is
            not as declared.
    """
    path = Path(path)
    text = read_text(path, f"a {format} file, JSON in UTF-8", most=MOST_JSON)
    try:
        document = parse_json(text)
    except json.JSONDecodeError as error:
        raise FileError(
            path, f"is not whole JSON ({error.msg}); it may have been cut short", line=error.lineno
        ) from None
    except ValueError as error:
        raise FileError(path, f"{error}; expected a {format} file") from None
    if not isinstance(document, dict):
        raise FileError(path, f"expected a JSON object of format {format!r}")
    if document.get("format") != format:
        raise FileError(
            path, f"expected {format!r}, found {document.get('format')!r}", field="format"
        )
    stored = document.get("version")
    if isinstance(stored, bool) or not isinstance(stored, int) or not oldest <= stored <= version:
        read = f"version {version}" if oldest == version else f"versions {oldest} to {version}"
        raise FileError(
            path,
            f"this neurosim reads {read}, found {stored!r}; "
            "use the neurosim that wrote it, or make it again",
            field="version",
        )
    if kind is not None:
        try:
            convert(document, kind)
        except Mismatch as error:
            raise FileError(path, error.what, field=error.field or None) from None
        without_nulls(document, kind)
    return document


def made(path: str | Path, field: str, make: Callable[..., Made], settings: Mapping) -> Made:
    """Return the result of a function called with settings from a file.

    Args:
        path: the file, for messages.
        field: the field with the settings.
        make: a function that takes the settings as keywords.
        settings: from the file.

    Raises:
        FileError: naming the setting that is wrong or unknown.
    """
    try:
        return make(**settings)
    except SettingError as error:
        raise FileError(path, error.what, field=f"{field}.{error.field}") from None
    except FileError:
        raise
    except (UserError, TypeError, ValueError) as error:
        raise FileError(path, f"cannot be used ({error})", field=field) from None


Column = Callable[[str], Any]


def number(text: str) -> float:
    """Parse a number of a CSV field; it is finite and no larger than ``LARGEST``."""
    value = float(text)
    if not abs(value) <= LARGEST:
        raise ValueError("not a finite number, or too large")
    return value


def optional_number(text: str) -> float:
    """Parse a finite number, or nothing as NaN."""
    return math.nan if text == "" else number(text)


def integer(text: str) -> int:
    """Parse an integer of a CSV field."""
    value = int(text)
    if abs(value) >= 2**63:
        raise ValueError("too large")
    return value


def flag(text: str) -> bool:
    """Parse 0 or 1."""
    if text not in ("0", "1"):
        raise ValueError("not 0 or 1")
    return text == "1"


#: Parser -> the text that it expects, and the type of its column.
_PARSED: dict[Column, tuple[str, Any]] = {
    number: ("a finite number", float),
    optional_number: ("a finite number or nothing", float),
    integer: ("a whole number", int),
    flag: ("0 or 1", bool),
    str: ("text", str),
}


def read_csv(
    path: str | Path,
    columns: Mapping[str, Column],
    *,
    drop_torn_line: bool = False,
    rows: int | None = None,
) -> pd.DataFrame:
    """Read the named columns of a CSV file, checking every field.

    Args:
        path: the file; its first line names the columns. Other columns are ignored.
        columns: column name -> parser (``number``, ``optional_number``, ``integer``, ``flag``,
            ``str``, or any function that raises ValueError).
        drop_torn_line: ignore a last line without a line end, in which a writer was killed.
        rows: expected number, if the JSON next to the file has it.

    Returns:
        The columns, in the order of ``columns``; the index has each row's line in the file.

    Raises:
        FileError: naming the line and the field that is missing or wrong.
    """
    import pandas as pd

    path = Path(path)
    text = read_text(path, "a CSV file in UTF-8")
    if drop_torn_line and not text.endswith("\n"):
        text = text[: text.rfind("\n") + 1]
    lines = dict(enumerate(text.splitlines(), start=1))
    if not lines.get(1):
        raise FileError(path, "is empty; expected a line with the column names", line=1)
    table = table_of_lines(path, lines.pop(1), lines)
    if rows is not None and len(table) != rows:
        what = f"holds {len(table)} rows where its JSON says {rows}; it may have been cut short"
        raise FileError(path, what)
    for name in columns:
        if name not in table:
            present = ", ".join(table.columns)
            raise FileError(path, f"this column is missing; found {present}", field=name)
        if table.columns.to_list().count(name) > 1:
            raise FileError(path, "this column appears twice", line=1, field=name)
    return pd.DataFrame(
        {
            name: pd.Series(
                parsed(path, table[name], parse), table.index, _PARSED.get(parse, ("", object))[1]
            )
            for name, parse in columns.items()
        }
    )


def table_of_lines(
    path: Path, header: str, lines: Mapping[int, str], delimiter: str = ","
) -> pd.DataFrame:
    """Split lines of a CSV file into fields.

    Args:
        path: the file, for messages.
        header: the line with the column names.
        lines: line number in the file -> line; empty ones are ignored.
        delimiter: between fields; a blank stands for any number of them.

    Returns:
        The fields as text, a column for each name, indexed by the number of the line.

    Raises:
        FileError: naming the line that has more or fewer fields than there are names.
    """
    import pandas as pd

    options: dict[str, Any] = {
        "sep": r"\s+" if delimiter == " " else delimiter,
        "header": None,
        "dtype": object,
        "na_filter": False,
        "skipinitialspace": True,
    }
    lines = {place: line for place, line in lines.items() if line.strip()}
    try:
        names = pd.read_csv(io.StringIO(header), **options).iloc[0].str.strip().tolist()
        for place, line in lines.items():
            count = _count(line, delimiter)
            if count != len(names):
                what = f"expected {len(names)} fields ({', '.join(names)}), found {count}"
                if count > len(names) and delimiter == ",":
                    what += "; a number has a decimal point, not a comma"
                raise FileError(path, what, line=place)
        if not lines:
            return pd.DataFrame(columns=names, dtype=object)
        table = pd.read_csv(io.StringIO("\n".join(lines.values())), **options)
    except (pd.errors.ParserError, csv.Error) as error:
        raise FileError(path, f"is not a CSV file ({error})") from None
    if table.shape != (len(lines), len(names)):
        raise FileError(path, "is not a CSV file: a quotation mark is not closed on its line")
    table.columns, table.index = pd.Index(names), pd.Index(lines, name="line")
    return table


def _count(line: str, delimiter: str) -> int:
    """Return how many fields a line has."""
    if delimiter == " ":
        return len(line.split())
    if '"' in line:
        return len(next(csv.reader([line], delimiter=delimiter, skipinitialspace=True)))
    return line.count(delimiter) + 1


def parsed(path: Path, column: pd.Series, parse: Column, expected: str = "") -> list:
    """Parse a column of text (N,), indexed by the number of the line.

    Args:
        path: the file, for the message.
        column: of :func:`table_of_lines`.
        parse: of a field; it raises ValueError.
        expected: the values that it accepts, for the message.

    Raises:
        FileError: naming line, column and text of the first field that is wrong.
    """
    values: list = []
    try:
        for text in column:
            values.append(parse(text))
    except ValueError:
        raise FileError(
            path,
            f"expected {expected or _PARSED.get(parse, (parse.__name__,))[0]}, found {text!r:.60}",
            line=int(column.index[len(values)]),
            field=str(column.name),
        ) from None
    return values


def refuse_lines(path: Path, table: pd.DataFrame, wrong: Any, what: str, field: str = "") -> None:
    """Raise an error for a table of :func:`read_csv` if any row is wrong, (N,) bool.

    Raises:
        FileError: naming the first such line.
    """
    if np.any(wrong):
        line = int(table.index[int(np.argmax(wrong))])
        raise FileError(path, what, line=line, field=field or None)


def read_header(path: str | Path) -> tuple[str, ...]:
    """Return the column names in the first line of a CSV file.

    Raises:
        FileError: if there is no such file, or it is not CSV.
    """
    check_file(path, "a CSV file in UTF-8")
    try:
        with open(path, encoding="utf-8", newline="") as file:
            return tuple(next(csv.reader(file), ()))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileError(path, f"cannot be read as CSV in UTF-8: {error}") from None


class LineLog:
    """A CSV file that grows line by line; each line is given to the system at once.

    A kill of the program between two lines loses nothing; one within a line leaves a torn last
    line, which ``read_csv(..., drop_torn_line=True)`` ignores and reopening this log removes.
    A failure of the computer can lose the last seconds, until the log is closed, which waits for
    the disk: a line is written down before a motor is set, and a disk may take longer than a robot
    can wait.
    """

    def __init__(self, path: str | Path, columns: Sequence[str]):
        self.path = Path(path)
        self.columns = tuple(columns)
        header, whole = ",".join(self.columns) + "\n", b""
        if self.path.exists():
            check_file(self.path, "a CSV file")
            text = self.path.read_bytes()
            whole = text[: text.rfind(b"\n") + 1]
            if whole and not whole.startswith(header.encode()):
                raise FileError(
                    self.path, f"expected the columns {', '.join(self.columns)}", line=1
                )
        log = open_own(self.path)
        if self.path.stat().st_size > len(whole):
            log.truncate(len(whole))
            log.seek(0, os.SEEK_END)
        self._file = io.TextIOWrapper(log, encoding="utf-8", newline="")
        self._writer = csv.writer(self._file, lineterminator="\n")
        if self._file.tell() == 0:
            self._file.write(header)
            self._file.flush()

    def append(self, *values: Any) -> None:
        """Give one line to the system; floats in shortest exact form, None and NaN as nothing."""
        if len(values) != len(self.columns):
            raise ValueError(f"expected {len(self.columns)} values, got {len(values)}")
        self._writer.writerow([_field(value) for value in values])
        self._file.flush()

    def close(self) -> None:
        """Close the file after it is on the disk."""
        if not self._file.closed:
            with self._file:
                os.fsync(self._file.fileno())

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
    """Write columns of equal length as CSV, whole or not at all; NaN as an empty field."""
    with atomic_path(path) as partial, open(partial, "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*(_fields(column) for column in columns.values()), strict=True))


def sha256(path: str | Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal.

    Raises:
        FileError: if it is not a file.
    """
    check_file(path, "a file")
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
        shapes: required tensors with their shapes; None stands for any length.

    Raises:
        FileError: if the file is missing or cut short, or a tensor is missing, has another
            shape, half precision or a number that is not finite.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    path = Path(path)
    check_file(path, "a safetensors file")
    try:
        tensors = load_file(str(path))
    except (SafetensorError, OSError, ValueError, OverflowError, MemoryError) as error:
        raise FileError(
            path, f"is not a whole safetensors file ({error}); it may have been cut short"
        ) from None
    for name, shape in (shapes or {}).items():
        if name not in tensors:
            raise FileError(path, "this tensor is missing", field=name)
        stored = tensors[name].shape
        matches = len(stored) == len(shape) and all(
            want is None or want == have for want, have in zip(shape, stored, strict=True)
        )
        if not matches:
            raise FileError(path, f"expected shape {tuple(shape)}, found {stored}", field=name)
        if tensors[name].dtype.kind == "f" and tensors[name].itemsize < 4:
            raise FileError(
                path, f"expected float32 or float64, found {tensors[name].dtype}", field=name
            )
        if not np.isfinite(tensors[name]).all():
            raise FileError(path, "holds a number that is not finite", field=name)
    return tensors


def read_json_lines(path: str | Path) -> tuple[list[dict[str, Any]], int]:
    """Read the objects of a file of JSON lines, without an incomplete last one.

    Returns:
        The objects, the head first, and their number of bytes in the file.

    Raises:
        FileError: if the file is missing, or a line is not a JSON object.
    """
    path = Path(path)
    text = read_text(path, "a file of JSON lines in UTF-8")
    whole = text[: text.rfind("\n") + 1]
    rows = []
    for line, part in enumerate(whole.removesuffix("\n").split("\n") if whole else (), 1):
        try:
            row = parse_json(part)
        except ValueError:
            row = None
        if not isinstance(row, dict):
            raise FileError(path, "expected a JSON object", line=line)
        rows.append(row)
    return rows, len(whole.encode())


class JsonLines:
    """A file of JSON objects, one a line, each on the disk before :meth:`append` returns.

    The first line has ``format``, ``version`` and the values common to all lines. A kill within a
    line leaves a torn last line, which opening the file again removes.

    Attributes:
        rows: the objects in the file when it was opened.
    """

    def __init__(self, path: str | Path, format: str, version: int, about: Mapping[str, Any]):
        """Open the file, or begin it.

        Raises:
            FileError: if it is a file of another kind, or a line of it is damaged.
        """
        self.path = Path(path)
        make_folder(self.path.parent)
        head = json.loads(
            json.dumps({"format": format, "version": version, **about}, default=plain)
        )
        rows, length = read_json_lines(self.path) if self.path.exists() else ([], 0)
        for row in rows[:1]:
            wrong = [name for name in {**head, **row} if head.get(name) != row.get(name)]
            if wrong:
                raise FileError(
                    self.path,
                    f"expected {head.get(wrong[0])!r}, found {row.get(wrong[0])!r}",
                    line=1,
                    field=wrong[0],
                )
        self.rows = rows[1:]
        self._file = open_own(self.path)
        self._file.truncate(length)
        if not rows:
            self.append(head)

    def append(self, row: Mapping[str, Any]) -> None:
        """Write one line, and wait until it is on the disk.

        Raises:
            ValueError: if a number in it is NaN or infinite.
        """
        self._file.write(json.dumps(row, allow_nan=False, default=plain).encode() + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file."""
        self._file.close()
