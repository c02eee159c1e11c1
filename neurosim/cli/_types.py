"""Types of words on the command line."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import click
from msgspec import Meta

from neurosim.base.declared import Angle, Coordinate, bounded
from neurosim.base.files import check_name


class _Path(click.Path):
    """A path whose name is valid UTF-8."""

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        check_name(value)
        return super().convert(value, param, ctx)


#: A path as a pathlib.Path; the reader reports a missing file.
PATH = _Path(path_type=Path)
#: The path of an output in addition to the main one.
NEW = _Path(path_type=Path)


class _Named(click.ParamType):
    """A type whose name is shown unchanged."""

    def get_metavar(self, param: Any, ctx: Any = None) -> str:
        """Return the name."""
        return self.name


#: Units of options whose parameters are in SI: conversion to SI, and back.
UNITS: dict[str, tuple[Callable[[float], float], Callable[[float], float]]] = {
    "": (lambda value: value, lambda value: value),
    "mm": (lambda value: value / 1000, lambda value: value * 1000),
    "mm/s": (lambda value: value / 1000, lambda value: value * 1000),
    "cm": (lambda value: value / 100, lambda value: value * 100),
    "degrees": (math.radians, math.degrees),
}


#: The range of a number without a declared one, such as in another package's task.
UNDECLARED = Meta(ge=-(10**12), le=10**12)


class Real(click.FloatRange):
    """A finite number in a range, given in SI or in a unit for people, and converted to SI.

    Args:
        hint: its declared type, such as :data:`neurosim.base.declared.Metres`.
        unit: unit for people, of :data:`UNITS`.
    """

    def __init__(self, hint: Any, unit: str = ""):
        self.unit, (self._to_si, self._from_si) = unit, UNITS[unit]
        self.name = unit or "float"
        super().__init__(**_ends(hint, self._from_si))

    def get_metavar(self, param: Any, ctx: Any = None) -> str | None:
        """Return the unit, or leave it to click."""
        return self.unit or None

    def convert(self, value: Any, param: Any, ctx: Any) -> float:
        """Return the number in SI; a value that is a number already is in SI."""
        typed = isinstance(value, str)
        number = super().convert(value if typed else self._from_si(value), param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return self._to_si(number) if typed else float(value)

    def shown(self, value: float) -> str:
        """Return a number in SI as it is typed."""
        return f"{self._from_si(value):.6g}"


def _ends(hint: Any, scale: Callable[[float], float] = UNITS[""][1]) -> dict[str, Any]:
    """Return the range of a declared number as click takes it."""
    _, meta = bounded(hint)
    if meta == Meta():
        meta, scale = UNDECLARED, UNITS[""][1]
    low, high = (one if one is not None else other for one, other in
                 ((meta.ge, meta.gt), (meta.le, meta.lt)))  # fmt: skip
    ends = {"min": low, "max": high}
    shown = {name: end if end is None else _short(scale(end)) for name, end in ends.items()}
    return {**shown, "min_open": meta.gt is not None, "max_open": meta.lt is not None}


def _short(value: float) -> float:
    value = float(f"{value:.12g}")
    return int(value) if value.is_integer() else value


class Whole(click.IntRange):
    """A whole number in a range.

    Args:
        hint: its declared type, such as :data:`neurosim.base.declared.Count`.
    """

    name = "integer"

    def __init__(self, hint: Any):
        super().__init__(**_ends(hint))


def ranged(hint: Any) -> Whole | Real:
    """Return the type of an option for a declared number."""
    return Whole(hint) if bounded(hint)[0] is int else Real(hint)


def range_of(kind: click.ParamType) -> str:
    """Return the ranges of several numbers in click's form for one number; or nothing."""
    if isinstance(kind, Listed):
        kind = click.Tuple([kind.kind])
    parts = kind.types if isinstance(kind, click.Tuple) else ()
    parts = [kind.part] if isinstance(kind, Numbers) else parts
    ranges = [one._describe_range() for one in parts if isinstance(one, Real | Whole)]
    return "; ".join(dict.fromkeys(ranges))


class Option(click.Option):
    """An option whose help shows the ranges of several numbers, too; click does so for one."""

    def __init__(self, *args: Any, **others: Any):
        super().__init__(*args, **others)
        if ends := range_of(self.type):
            self.help = f"{self.help or ''}  [{ends}]".strip()


#: A pose: x and y in cm, heading in degrees.
POSE = click.Tuple([Real(Coordinate, "cm"), Real(Coordinate, "cm"), Real(Angle, "degrees")])


class Numbers(_Named):
    """Finite numbers with a separator, as many as the type's name has parts.

    Args:
        name: such as ``U,V`` or ``WIDTHxHEIGHT``.
        between: the separator.
        hint: declared type of each.
        example: for messages.
    """

    def __init__(self, name: str, between: str, hint: Any, example: str):
        self.name, self.between, self._example = name, between, example
        self.part = ranged(hint)

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[Any, ...]:
        """Return the numbers; those of a resumed run's file are numbers already."""
        parts = value.lower().split(self.between) if isinstance(value, str) else value
        if not isinstance(parts, list | tuple) or (len(parts) != self.name.count(self.between) + 1):
            self.fail(f"{value!r}: expected {self.name}, such as {self._example}", param, ctx)
        try:
            return tuple(self.part.convert(part, param, ctx) for part in parts)
        except (click.BadParameter, TypeError) as error:
            expected = f"expected {self.name}, such as {self._example}"
            self.fail(f"{value!r}: {expected} ({error})", param, ctx)

    def shown(self, value: tuple[Any, ...]) -> str:
        """Return numbers as they are typed."""
        return self.between.join(f"{part:g}" for part in value)


def low_high(hint: Any) -> Numbers:
    """Return the type of an option for the two ends of a range."""
    return Numbers("LOW..HIGH", "..", hint, "0.5..3")


#: Sides of a frame; a pixel in one, also out of it; corners of a chessboard along each side.
SIZE = Numbers("WIDTHxHEIGHT", "x", Annotated[int, Meta(ge=120, le=8192)], "640x480")
PIXELS = Annotated[float, Meta(ge=-100_000, le=100_000)]
PIXEL = Numbers("U,V", ",", PIXELS, "422,178")
PATTERN = Numbers("COLUMNSxROWS", "x", Annotated[int, Meta(ge=2, le=100)], "9x6")


class Listed(_Named):
    """Values of one kind, with commas between them."""

    def __init__(self, kind: click.ParamType):
        self.kind = kind
        self.name = f"{kind.name.upper()},..."

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[Any, ...]:
        """Return the values."""
        parts = value.split(",") if isinstance(value, str) else value
        if not isinstance(parts, (list, tuple)):
            self.fail(f"{value!r}: expected {self.name}", param, ctx)
        return tuple(self.kind.convert(part, param, ctx) for part in parts)

    def shown(self, value: Any) -> str:
        """Return values as they are typed."""
        return ",".join(shown(self.kind, part) for part in value)


class Pairs(_Named):
    """Names with a word each: ``x=pos_x,y=pos_y``; a name alone is its own word.

    Args:
        name: such as ``NAME=COLUMN,...``.
        example: for messages.
        alone: whether a name may have no word.
    """

    def __init__(self, name: str, example: str, alone: bool = False):
        self.name, self._example, self._alone = name, example, alone

    def convert(self, value: Any, param: Any, ctx: Any) -> dict[str, str]:
        """Return the word of each name, in their order."""
        if isinstance(value, dict) and all(isinstance(word, str) for word in value.values()):
            return dict(value)
        if not isinstance(value, str):
            self.fail(f"{value!r}: expected {self.name}, such as {self._example}", param, ctx)
        pairs: dict[str, str] = {}
        for part in value.split(","):
            name, given, word = (side.strip() for side in part.partition("="))
            word = word if given else name
            if not (name and word) or not (given or self._alone):
                self.fail(f"{part!r}: expected {self.name}, such as {self._example}", param, ctx)
            if name in pairs:
                self.fail(f"{name!r} is named twice", param, ctx)
            pairs[name] = word
        return pairs

    def shown(self, value: dict[str, str]) -> str:
        """Return names and words as they are typed."""
        return ",".join(f"{name}={word}" for name, word in value.items())


class Json(click.ParamType):
    """A value written as JSON."""

    name = "JSON"

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the value."""
        if not isinstance(value, str):
            return value
        try:
            return json.loads(value)
        except ValueError:
            self.fail(f"{value!r} is not JSON, such as 0.5 or [[0, 1], [0, 2]]", param, ctx)

    def shown(self, value: Any) -> str:
        """Return a value as it is typed."""
        return json.dumps(value)


def shown(kind: click.ParamType, value: Any) -> str:
    """Return a value of a kind as it is typed."""
    if hasattr(kind, "shown"):
        return kind.shown(value)
    if isinstance(kind, click.Tuple):
        return " ".join(shown(part, one) for part, one in zip(kind.types, value, strict=True))
    return f"{value:g}" if isinstance(value, float) else str(value)
