"""What several verbs share."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

#: A path as a pathlib.Path; whether it exists is for the reader to say, in its own sentence.
PATH = click.Path(path_type=Path)


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
SHARE = NumberIn(0, 1)

json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print the result as JSON, for machines."
)
seed_option = click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of all random draws."
)
placing_option = click.option(
    "--placing",
    type=(NumberIn(min=0), NumberIn(min=0)),
    default=(3.0, 0.5),
    show_default=True,
    help="How exactly the robot is put down: standard deviations, mm and degrees.",
)


class Size(click.ParamType):
    """WIDTHxHEIGHT in pixels."""

    name = "WxH"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int, int]:
        """Return (width, height)."""
        if isinstance(value, tuple):
            return value
        try:
            width, height = (int(part) for part in value.lower().split("x"))
        except ValueError:
            self.fail(f"{value!r} is not a size such as 640x480", param, ctx)
        if not (160 <= width <= 8192 and 120 <= height <= 8192):
            self.fail(f"{value!r} is not between 160x120 and 8192x8192", param, ctx)
        return width, height


class Range(click.ParamType):
    """Two numbers, LOW..HIGH."""

    name = "LOW..HIGH"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[float, float]:
        """Return (low, high)."""
        if isinstance(value, tuple):
            return value
        try:
            low, high = (float(part) for part in value.split(".."))
        except ValueError:
            low = high = math.nan
        if not (math.isfinite(low) and math.isfinite(high)):
            self.fail(f"{value!r} is not a range such as 0.5..3", param, ctx)
        return low, high


class Resumable(click.Command):
    """A verb that, with --resume, takes options that are not given from what it goes on with.

    Args:
        begun: finds, by the verb's values, the options that what is resumed was begun with.
    """

    def __init__(
        self, *args: Any, begun: Callable[[dict[str, Any]], dict[str, Any]], **others: Any
    ):
        super().__init__(*args, **others)
        self._begun = begun

    def invoke(self, ctx: click.Context) -> Any:
        """Run the verb."""
        if ctx.params["resume"]:
            known = {parameter.name: parameter for parameter in self.params}
            for name, value in self._begun(ctx.params).items():
                if name in known and value is not None and not is_given(name):
                    value = tuple(value) if isinstance(value, list) else value
                    ctx.params[name] = known[name].type_cast_value(ctx, value)
                    ctx.set_parameter_source(name, ParameterSource.COMMANDLINE)
        return super().invoke(ctx)


def given_options() -> dict[str, Any]:
    """Return the options that were given to the verb that runs, to be kept for --resume."""
    ctx = click.get_current_context()
    left_out = {"out", "as_json", "resume"}
    return {
        parameter.name: _kept(ctx.params[parameter.name])
        for parameter in ctx.command.params
        if isinstance(parameter, click.Option)
        and parameter.name in ctx.params
        and parameter.name not in left_out
        and is_given(parameter.name)
    }


def is_given(name: str) -> bool:
    """Return whether an option was given to the verb that runs."""
    context = click.get_current_context(silent=True)
    return context is not None and context.get_parameter_source(name) == ParameterSource.COMMANDLINE


def _kept(value: Any) -> Any:
    return str(value) if isinstance(value, Path) else value


def emit(result: dict[str, Any], as_json: bool, text: str | Callable[[], str]) -> None:
    """Print a verb's result: JSON for machines, or text for people."""
    if as_json:
        click.echo(json.dumps(result, indent=2, default=_plain))
    else:
        click.echo(text() if callable(text) else text)


def next_step(*words: Any) -> str:
    """Return the line that names the next command, quoted so that it can be pasted."""
    return f"Next: neurosim {shlex.join(str(word) for word in words)}"


def _plain(value: Any) -> Any:
    if hasattr(value, "tolist"):
        return value.tolist()
    return str(value)
