"""Declared shapes of JSON documents: checked once, where a file is read.

A shape is one of:

- a type: ``str``, ``bool``, ``int``, ``float`` (any finite number), ``list``, ``dict``, ``object``;
- a tuple of types: one of them;
- ``[shape]``: a list of that;
- ``{"key": shape, "perhaps?": shape}``: an object with these keys; one with a question mark may be
  missing, or null, which is then left out. Other keys are passed over;
- ``{str: shape}``: an object of any keys, each with that;
- :class:`Maybe`: that, or null; :class:`Rows`: numbers in rows and columns.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
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
    elif isinstance(shape, list):
        if not isinstance(value, list):
            raise Mismatch(field, "a list", value)
        for index, each in enumerate(value):
            check(each, shape[0], f"{field}[{index}]")
    elif isinstance(shape, Mapping):
        _check_object(value, shape, field)
    else:
        kinds = shape if isinstance(shape, tuple) else (shape,)
        if not any(_is(value, kind) for kind in kinds):
            raise Mismatch(field, " or ".join(_name(kind) for kind in kinds), value)


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
    if not isinstance(value, list) or size not in (None, len(value)):
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
    return isinstance(value, kind)


def _name(kind: type) -> str:
    return {float: "a number", dict: "an object", list: "a list"}.get(kind, kind.__name__)
