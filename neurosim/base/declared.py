"""Values as their annotations declare them: types, and ranges of numbers, checked by msgspec.

A range is written once, in the annotation, and holds for Python, files and the command line::

    @dataclass(frozen=True)
    class Settings(Checked):
        steps: Count = 500
        speed: Annotated[float, Meta(gt=0, le=2)] = 0.5

Every number that a user can give has a lower and an upper limit, so that results stay finite and
computations end.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import math
import re
import sys
import types
import typing
from collections.abc import Callable
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import numpy as np
from msgspec import Meta

from neurosim.base.errors import UserError

_UNIONS = (typing.Union, types.UnionType)
F = TypeVar("F", bound=Callable[..., Any])

#: A seed of random numbers, as every library takes it.
Seed = Annotated[int, Meta(ge=0, le=2**31 - 1)]
#: A number of items, at least 1.
Count = Annotated[int, Meta(ge=1, le=1_000_000)]
#: A number of items, at least 0.
CountOrNone = Annotated[int, Meta(ge=0, le=1_000_000)]
#: A fraction, or a probability.
Fraction = Annotated[float, Meta(ge=0, le=1)]
#: A motor's speed, in percent of full speed.
Percent = Annotated[float, Meta(ge=0.1, le=100)]
#: A duration, s.
Seconds = Annotated[float, Meta(ge=0.001, le=100_000)]
#: A duration that may be 0, s.
SecondsOrNone = Annotated[float, Meta(ge=0, le=100_000)]
#: A delay, s; below 0 it is early.
Delay = Annotated[float, Meta(ge=-60, le=60)]
#: A length, m.
Metres = Annotated[float, Meta(ge=0.0001, le=1000)]
#: A length that may be 0, such as a standard deviation, m.
MetresOrNone = Annotated[float, Meta(ge=0, le=1000)]
#: A coordinate, m.
Coordinate = Annotated[float, Meta(ge=-1000, le=1000)]
#: A heading or a turn, rad.
Angle = Annotated[float, Meta(ge=-1000, le=1000)]
#: A turn without sign, such as a standard deviation of a heading, rad.
Turn = Annotated[float, Meta(ge=0, le=2 * math.pi)]
#: A pose: x, y and heading.
Pose = tuple[Coordinate, Coordinate, Angle]
#: Standard deviations of position and heading when a robot is placed.
Placing = tuple[MetresOrNone, Turn]
#: Wheel speed at 100 %, m/s.
FullSpeed = Annotated[float, Meta(ge=0.001, le=20)]
#: Time between two commands of a closed-loop controller, s.
Step = Annotated[float, Meta(ge=0.001, le=10)]
#: Frames per second.
Fps = Annotated[float, Meta(ge=1, le=240)]
#: Bits per second of a serial line.
Baud = Annotated[int, Meta(ge=300, le=4_000_000)]
#: A TCP port.
Port = Annotated[int, Meta(ge=1, le=65535)]
#: The number of a printed tag.
TagId = Annotated[int, Meta(ge=0, le=100_000)]
#: Any finite number of moderate size.
Number = Annotated[float, Meta(ge=-1e9, le=1e9)]


class Mismatch(Exception):
    """A value is not as declared.

    Attributes:
        field: the field, such as ``actual.poses[3]``; empty for the value itself.
        what: the expected and the actual value, in words.
    """

    def __init__(self, field: str, what: str):
        super().__init__(f"{field}: {what}" if field else what)
        self.field, self.what = field, what


class SettingError(UserError):
    """A setting or an argument that is not as declared; see :class:`Mismatch`."""

    def __init__(self, field: str, what: str):
        super().__init__(f"{field}: {what}")
        self.field, self.what = field, what


def convert(value: Any, kind: Any) -> Any:
    """Convert plain values (from JSON or a caller) to a declared type, such as a dataclass.

    Raises:
        Mismatch: naming the first field that is not as declared.
    """
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        message, _, path = str(error).partition(" - at `$")
        raise _mismatch(value, kind, message, path.rstrip("`")) from None


class Checked:
    """Base of settings: a frozen dataclass whose fields are checked as it is made.

    A subclass compares its fields with each other in its own ``__post_init__``, after calling this
    one.
    """

    def __post_init__(self) -> None:
        """Check every field whose type is declared.

        Raises:
            SettingError: naming the first field that is not as declared.
        """
        hints = _plain_hints(type(self))  # type: ignore[arg-type]
        fields = [one.name for one in dataclasses.fields(self)]  # type: ignore[arg-type]
        _check({name: getattr(self, name) for name in fields if name in hints}, hints)


def without_nulls(document: Any, kind: Any) -> None:
    """Leave out the keys of a checked document that are null and may be missing."""
    bare, _ = bounded(kind)
    parts = typing.get_args(bare)
    if isinstance(document, dict) and hasattr(bare, "__struct_fields__"):
        for name, hint in hints_of(bare).items():
            if name in document and document[name] is None:
                del document[name]
            elif name in document:
                without_nulls(document[name], hint)
    elif typing.get_origin(bare) in (list, dict) and not _is_plain(parts[-1]):
        for part in document.values() if isinstance(document, dict) else document:
            without_nulls(part, parts[-1])


def plain(value: Any) -> Any:
    """Return numbers of NumPy, and tuples and lists of them, as Python's own."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, tuple | list):
        return [plain(each) for each in value]
    return value


@functools.cache
def hints_of(source: Any) -> dict[str, Any]:
    """Return the annotations of a class or function, with ranges.

    Each is evaluated in its own module; a name that only type checkers import is ``object``. A
    class that is not a dataclass has the annotations of its ``__init__``.
    """
    hints: dict[str, Any] = {}
    for owner in reversed(source.__mro__[:-1]) if isinstance(source, type) else [source]:
        fields = dataclasses.is_dataclass(owner) or hasattr(owner, "__struct_fields__")
        if isinstance(owner, type) and not fields:
            owner = vars(owner).get("__init__")
        owner = inspect.unwrap(owner) if callable(owner) else owner
        module = sys.modules.get(getattr(owner, "__module__", None) or "")
        for name, annotation in getattr(owner, "__annotations__", {}).items():
            if isinstance(annotation, str):
                try:
                    annotation = eval(annotation, dict(vars(module)) if module else {})
                except Exception:
                    annotation = object
            hints[name] = annotation
    return hints


def checks(function: F) -> F:
    """Return a function that checks its arguments against their annotations; a decorator.

    Raises:
        SettingError: naming the first argument that is not as declared.
    """
    signature = inspect.signature(function)
    hints: dict[str, Any] = {}

    @functools.wraps(function)
    def checked(*args: Any, **named: Any) -> Any:
        if not hints:
            hints.update(_plain_hints(function))
        given = signature.bind(*args, **named).arguments
        _check({name: given[name] for name in hints if name in given}, hints)
        return function(*args, **named)

    return checked  # type: ignore[return-value]


def _check(values: dict[str, Any], hints: dict[str, Any]) -> None:
    for name, value in values.items():
        try:
            convert(plain(value), hints[name])
        except Mismatch as error:
            step = "" if error.field.startswith("[") or not error.field else "."
            raise SettingError(f"{name}{step}{error.field}", error.what) from None


@functools.cache
def _plain_hints(source: Any) -> dict[str, Any]:
    """Return the annotations that consist of numbers or literal words only."""
    hints = hints_of(source).items()
    return {name: hint for name, hint in hints if _is_plain(hint) and not _is_text(hint)}


def _is_text(hint: Any) -> bool:
    parts = [part for part in typing.get_args(bounded(hint)[0]) if part is not ...]
    chosen = typing.get_origin(bounded(hint)[0]) is Literal
    return bounded(hint)[0] is str or (bool(parts) and not chosen and all(map(_is_text, parts)))


def _is_plain(hint: Any) -> bool:
    bare, _ = bounded(hint)
    if typing.get_origin(bare) is Literal:
        return True
    parts = [part for part in typing.get_args(bare) if part is not ...]
    if parts and typing.get_origin(bare) in (tuple, list, *_UNIONS):
        return all(map(_is_plain, parts))
    return bare in (int, float, bool, str, types.NoneType)


def bounded(hint: Any) -> tuple[Any, Meta]:
    """Return a type without its ``Annotated`` and without None, and its range."""
    if typing.get_origin(hint) in _UNIONS:
        others = [part for part in typing.get_args(hint) if part is not types.NoneType]
        return bounded(others[0]) if len(others) == 1 else (hint, Meta())
    if typing.get_origin(hint) is Annotated:
        bare, *others = typing.get_args(hint)
        return bare, next((one for one in others if isinstance(one, Meta)), Meta())
    return hint, Meta()


def in_words(hint: Any) -> str:
    """Return a declared type in words, such as ``a whole number from 1 to 100``."""
    bare, meta = bounded(hint)
    origin, parts = typing.get_origin(bare), typing.get_args(bare)
    if origin is Literal:
        return ("one of " if len(parts) > 1 else "") + ", ".join(map(repr, parts))
    if origin in _UNIONS:
        return " or ".join(in_words(part) for part in parts)
    if origin in (list, tuple):
        size = f" {len(parts)}" if origin is tuple and ... not in parts else ""
        size = size if meta.max_length is None else f" at most {meta.max_length:,}"
        what = " numbers" if bounded(parts[0])[0] in (int, float) else ""
        return f"a list of{size}{what}" if size or what else "a list"
    words = [_WORDS.get(origin or bare, "an object")]
    if meta.gt is not None:
        words.append(f"above {meta.gt:,.12g},")
    if meta.ge is not None:
        words.append(f"from {meta.ge:,.12g}")
    if meta.le is not None:
        words.append(f"{'to' if meta.ge is not None else 'up to'} {meta.le:,.12g}")
    if meta.lt is not None:
        words.append(f"below {meta.lt:,.12g}")
    return " ".join(words).rstrip(",")


_WORDS = {
    float: "a number",
    int: "a whole number",
    str: "text",
    bool: "true or false",
}


def _mismatch(value: Any, kind: Any, message: str, path: str) -> Mismatch:
    """Return an error of msgspec in plain words, with the field and its value."""
    field = ""
    for name, index in re.findall(r"\.([^.\[]+)|\[(\d+|\.\.\.)\]", path):
        kind, key = _within(value, kind, name or index)
        value = value[key]
        field += f".{key}" if isinstance(key, str) and field else str(key)
        field = field if isinstance(key, str) else f"{field.removesuffix(str(key))}[{key}]"
    named = re.search(r"(?:missing required|unknown) field `(.+)`", message)
    if named:
        what = "is missing" if "missing" in message else "is not a field here"
        return Mismatch(f"{field}.{named[1]}".lstrip("."), what)
    if not re.match("Expected|Invalid", message):  # the message of a dataclass about its fields
        return Mismatch(field, message)
    bare, _ = bounded(kind)
    if typing.get_origin(bare) is list and not isinstance(value, list | tuple):
        kind = bare  # the length of a list does not matter if the value is not a list
    return Mismatch(field, f"expected {in_words(kind)}, found {value!r:.60}")


def _within(value: Any, kind: Any, step: str) -> tuple[Any, Any]:
    """Return the declared type of a part of a value, and its key."""
    bare, _ = bounded(kind)
    if typing.get_origin(bare) in _UNIONS:  # a number, or a list
        bare = next(one for one, _ in map(bounded, typing.get_args(bare)) if typing.get_args(one))
    parts = typing.get_args(bare)
    if step == "...":
        return parts[1], next(key for key, each in value.items() if not _is(each, parts[1]))
    if step.isdigit() and isinstance(value, list | tuple):
        single = typing.get_origin(bare) is list or ... in parts
        return parts[0 if single else int(step)], int(step)
    hints = hints_of(bare)
    return hints.get(step, hints.get(f"{step}_")), step


def _is(value: Any, kind: Any) -> bool:
    try:
        msgspec.convert(value, kind)
    except msgspec.ValidationError:
        return False
    return True
