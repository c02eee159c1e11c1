"""What a word on the command line can stand for."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from neurosim.base.files import check_name


class _Path(click.Path):
    """A path whose name can be written down: UTF-8."""

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the path."""
        check_name(value)
        return super().convert(value, param, ctx)


#: A path as a pathlib.Path; whether it exists is for the reader to say, in its own sentence.
PATH = _Path(path_type=Path)


class Number(click.types.FloatParamType):
    """A finite number: click's own takes nan and inf for numbers, too."""

    def convert(self, value: Any, param: Any, ctx: Any) -> float:
        """Return the number."""
        return _finite(self, super().convert(value, param, ctx), param, ctx)


class NumberIn(click.FloatRange):
    """A finite number in a range."""

    def convert(self, value: Any, param: Any, ctx: Any) -> float:
        """Return the number."""
        return _finite(self, super().convert(value, param, ctx), param, ctx)


def _finite(kind: click.ParamType, value: float, param: Any, ctx: Any) -> float:
    if not math.isfinite(value):
        kind.fail(f"{value} is not a finite number.", param, ctx)
    return value


NUMBER = Number()
POSITIVE = NumberIn(min=0, min_open=True)
COUNT = click.IntRange(min=1)


class _Named(click.ParamType):
    """A type that is shown by its own name, in its own letters."""

    def get_metavar(self, param: Any, ctx: Any = None) -> str:
        """Return the name."""
        return self.name


class Numbers(_Named):
    """Finite numbers with something between them, as many as its name has parts.

    Args:
        name: such as ``U,V`` or ``WIDTHxHEIGHT``.
        between: what stands between them.
        kind: int or float.
        example: for messages.
        limits: lowest and highest of each.
    """

    def __init__(
        self,
        name: str,
        between: str,
        kind: Callable[[str], Any],
        example: str,
        limits: tuple[float, float] = (-math.inf, math.inf),
    ):
        self.name, self._between, self._kind = name, between, kind
        self._example, self._limits = example, limits

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[Any, ...]:
        """Return the numbers; those of a resumed run's file are numbers already."""
        parts = value.lower().split(self._between) if isinstance(value, str) else value
        try:
            found = tuple(self._kind(part) for part in parts)
        except (TypeError, ValueError):
            found = ()
        if len(found) != self.name.count(self._between) + 1 or not all(map(math.isfinite, found)):
            self.fail(f"{value!r}: expected {self.name}, such as {self._example}", param, ctx)
        low, high = self._limits
        if not all(low <= part <= high for part in found):
            self.fail(f"{value!r}: expected numbers from {low:g} to {high:g}", param, ctx)
        return found

    def shown(self, value: tuple[Any, ...]) -> str:
        """Return numbers as they are typed."""
        return self._between.join(f"{part:g}" for part in value)


RANGE = Numbers("LOW..HIGH", "..", float, "0.5..3")
SIZE = Numbers("WIDTHxHEIGHT", "x", int, "640x480", (120, 8192))
PIXEL = Numbers("U,V", ",", float, "422,178")
PATTERN = Numbers("COLUMNSxROWS", "x", int, "9x6")

#: Units of options whose parameters are in SI: what makes SI of a number, and the way back.
UNITS: dict[str, tuple[Callable[[float], float], Callable[[float], float]]] = {
    "mm": (lambda value: value / 1000, lambda value: value * 1000),
    "mm/s": (lambda value: value / 1000, lambda value: value * 1000),
    "cm": (lambda value: value / 100, lambda value: value * 100),
    "degrees": (math.radians, math.degrees),
}


class Quantity(_Named):
    """A number in a unit for people, handed on in SI."""

    def __init__(self, unit: str):
        self.name = unit
        self._to_si, self._from_si = UNITS[unit]

    def convert(self, value: Any, param: Any, ctx: Any) -> float:
        """Return the number in SI; what is a number already is in SI."""
        found = NUMBER.convert(value, param, ctx)
        return self._to_si(found) if isinstance(value, str) else found

    def shown(self, value: float) -> str:
        """Return a number in SI as it is typed."""
        return f"{self._from_si(value):.6g}"


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
    """Names, each with a word that it stands for: ``x=pos_x,y=pos_y``; a name alone is itself.

    Args:
        name: such as ``NAME=COLUMN,...``.
        example: for messages.
        alone: whether a name may stand alone.
    """

    def __init__(self, name: str, example: str, alone: bool = False):
        self.name, self._example, self._alone = name, example, alone

    def convert(self, value: Any, param: Any, ctx: Any) -> dict[str, str]:
        """Return the word of each name, in their order."""
        if isinstance(value, dict) and all(isinstance(word, str) for word in value.values()):
            return dict(value)
        if not isinstance(value, str):
            self.fail(f"{value!r}: expected {self.name}, such as {self._example}", param, ctx)
        found: dict[str, str] = {}
        for part in value.split(","):
            name, given, word = (side.strip() for side in part.partition("="))
            word = word if given else name
            if not (name and word) or not (given or self._alone):
                self.fail(f"{part!r}: expected {self.name}, such as {self._example}", param, ctx)
            if name in found:
                self.fail(f"{name!r} is named twice", param, ctx)
            found[name] = word
        return found

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
            self.fail(f"{value!r} is not JSON, such as [[0.5, 0, 0]]", param, ctx)

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
