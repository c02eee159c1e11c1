"""Declared shapes of JSON documents: checked once, where a file is read.

A shape is one of:

- a type: ``str``, ``bool``, ``int``, ``float`` (any finite number), ``list``, ``dict``, ``object``;
- a tuple of shapes: one of them;
- ``[shape]``: a list of that;
- ``{"key": shape, "perhaps?": shape}``: an object with these keys; one with a question mark may be
  missing, or null, which is then left out. Other keys are passed over;
- ``{str: shape}``: an object of any keys, each with that;
- :class:`Maybe`: that, or null; :class:`Rows`: numbers in rows and columns; :class:`Number`: one
  within bounds; :class:`OneOf`: one of some values; :class:`Only`: an object without other keys.

:func:`fields_of` gives the shape of what a dataclass takes as keywords, from its annotations.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Shape = Any


@dataclass(frozen=True)
class Maybe:
    """A shape, or null."""

    shape: Shape


@dataclass(frozen=True)
class Rows:
    """Finite numbers in nested lists: ``Rows(None, 3)`` is any number of rows of three.

    Attributes:
        sizes: of each dimension; None stands for any.
        gaps: whether a row of the last dimension may be null.
        most: the largest absolute value.
    """

    sizes: tuple[int | None, ...]
    gaps: bool = False
    most: float = math.inf

    def __init__(self, *sizes: int | None, gaps: bool = False, most: float = math.inf):
        for name, value in (("sizes", sizes), ("gaps", gaps), ("most", most)):
            object.__setattr__(self, name, value)


@dataclass(frozen=True)
class Number:
    """A finite number within bounds, which count as within.

    Attributes:
        low, high: the bounds.
        above: what it must be above, where that is no number of the range itself.
        whole: whether it has no fraction.
    """

    low: float = -math.inf
    high: float = math.inf
    above: float = -math.inf
    whole: bool = False

    def __str__(self) -> str:
        words = ["a whole number" if self.whole else "a number"]
        if self.above > -math.inf:
            words.append(f"above {self.above:g}")
        if self.low > -math.inf:
            words.append(f"from {self.low:g}")
        if self.high < math.inf:
            words.append(f"up to {self.high:g}")
        return " ".join(words)

    def holds(self, value: Any) -> bool:
        """Return whether a value is such a number."""
        if not _is(value, int if self.whole else float):
            return False
        return bool(self.low <= value <= self.high and value > self.above)


@dataclass(frozen=True)
class OneOf:
    """One of some values, such as the names of kinds."""

    values: tuple[Any, ...]

    def __init__(self, *values: Any):
        object.__setattr__(self, "values", values)


@dataclass(frozen=True)
class Only:
    """An object with these keys and no others: one that is not known would be of consequence."""

    fields: Mapping[str, Shape]


class Mismatch(Exception):
    """A value has another shape.

    Attributes:
        field: where, such as ``actual.poses[3]``.
        what: what was expected, and what is there.
    """

    def __init__(self, field: str, expected: str, found: Any):
        super().__init__(f"expected {expected}, found {found!r:.60}")
        self.field, self.what = field, str(self)


def check(value: Any, shape: Shape, field: str = "") -> None:
    """Make sure that a value has a shape; leave out null where a key may be missing.

    Raises:
        Mismatch: naming the first field that has not.
    """
    if isinstance(shape, Maybe):
        if value is not None:
            check(value, shape.shape, field)
    elif isinstance(shape, Rows):
        _check_rows(value, shape, shape.sizes, field)
    elif isinstance(shape, Number):
        if not shape.holds(value):
            raise Mismatch(field, str(shape), value)
    elif isinstance(shape, OneOf):
        if not any(type(value) is type(one) and value == one for one in shape.values):
            what = "one of " if len(shape.values) > 1 else ""
            raise Mismatch(field, what + ", ".join(map(repr, shape.values)), value)
    elif isinstance(shape, list):
        if not _is(value, list):
            raise Mismatch(field, "a list", value)
        for index, each in enumerate(value):
            check(each, shape[0], f"{field}[{index}]")
    elif isinstance(shape, Only):
        _check_object(value, shape.fields, field)
        names = [name.removesuffix("?") for name in shape.fields]
        for name in value:
            if name not in names:
                raise Mismatch(field, f"{', '.join(names)} and nothing else", name)
    elif isinstance(shape, Mapping):
        _check_object(value, shape, field)
    elif isinstance(shape, tuple):
        _check_either(value, shape, field)
    elif not _is(value, shape):
        raise Mismatch(field, _name(shape), value)


def _check_either(value: Any, shapes: Sequence[Shape], field: str) -> None:
    for shape in shapes:
        try:
            return check(value, shape, field)
        except Mismatch as error:
            last = error
    if all(isinstance(shape, type) for shape in shapes):
        raise Mismatch(field, " or ".join(_name(kind) for kind in shapes), value)
    raise last


def fields_of(kind: Any) -> dict[str, Shape]:
    """Return the shape of the JSON object that holds the keywords of a dataclass.

    Every field may be missing; one of a type that JSON does not have may be anything. What is no
    dataclass may be anything, too: no fields.
    """
    if not (isinstance(kind, type) and dataclasses.is_dataclass(kind)):
        return {}
    try:
        hints = typing.get_type_hints(kind)
    except (NameError, TypeError):  # names that only its own module knows
        return {}
    return {
        f"{one.name}?": _shape_of(hints[one.name]) for one in dataclasses.fields(kind) if one.init
    }


def _shape_of(hint: Any) -> Shape:
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if hint in (str, bool, int, float):
        return hint
    if origin is typing.Literal:
        return OneOf(*parts)
    if origin in (typing.Union, types.UnionType):
        shapes = tuple(_shape_of(part) for part in parts if part is not type(None))
        shape = shapes[0] if len(shapes) == 1 else shapes
        return Maybe(shape) if type(None) in parts else shape
    if origin is tuple and parts[1:] == (...,):
        return [_shape_of(parts[0])]
    if origin is tuple and len(set(parts)) == 1 and parts[0] in (int, float):
        return Rows(len(parts))
    return object


def _check_object(value: Any, shape: Mapping[Any, Shape], field: str) -> None:
    if not isinstance(value, Mapping):
        raise Mismatch(field, "an object", value)
    for key, inner in shape.items():
        if key is str:
            for name, each in value.items():
                check(each, inner, f"{field}.{name}" if field else name)
            continue
        name = key.removesuffix("?")
        place = f"{field}.{name}" if field else name
        if name != key and value.get(name) is None:
            if isinstance(value, dict):
                value.pop(name, None)
            continue
        if name not in value:
            raise Mismatch(place, f"{name!r} to be there", list(value))
        check(value[name], inner, place)


def _check_rows(value: Any, shape: Rows, sizes: tuple[int | None, ...], field: str) -> None:
    if not sizes:
        if not _is(value, float):
            raise Mismatch(field, "a number", value)
        if abs(value) > shape.most:
            raise Mismatch(field, f"a number up to {shape.most:g}", value)
        return
    if value is None and shape.gaps and len(sizes) == 1:
        return
    size, rest = sizes[0], sizes[1:]
    if not _is(value, list) or size not in (None, len(value)):
        many = "" if size is None else f"{size} "
        raise Mismatch(field, f"a list of {many}{'lists' if rest else 'numbers'}", value)
    for index, each in enumerate(value):
        _check_rows(each, shape, rest, f"{field}[{index}]")


def _is(value: Any, kind: type) -> bool:
    if kind is object:
        return True
    if isinstance(value, bool):
        return kind is bool
    if kind is float:
        return isinstance(value, int | float) and math.isfinite(value)
    if kind is list:  # what was not written yet may be a tuple
        return isinstance(value, list | tuple)
    return isinstance(value, kind)


def _name(kind: type) -> str:
    return _NAMES.get(kind, kind.__name__)


_NAMES = {
    float: "a number",
    int: "a whole number",
    str: "text",
    bool: "true or false",
    dict: "an object",
    list: "a list",
}
