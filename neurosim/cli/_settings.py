"""Options made from settings dataclasses, where names, types, defaults and help are written."""

from __future__ import annotations

import dataclasses
import inspect
import json
import re
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import click

from neurosim.cli._common import NUMBER, Range, is_given

#: Adds options to a command, by the values of some that are read before the others.
Dynamic = Callable[[Mapping[str, str]], Sequence[click.Parameter]]


class Json(click.ParamType):
    """A value written as JSON, such as [[0.5, 0, 0]]; or a list of numbers, such as 5,3."""

    name = "JSON"

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the value."""
        if not isinstance(value, str):
            return value
        try:
            if re.fullmatch(r"[\w.+-]+(,[\w.+-]+)*", value) and not value.startswith("["):
                return [_plain(part) for part in value.split(",")]
            return json.loads(value)
        except ValueError:
            self.fail(f"{value!r} is neither JSON nor values separated by commas", param, ctx)


def _plain(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text


def options_of(
    cls: Any, *, skip: Sequence[str] = (), names: Mapping[str, str] | None = None
) -> list[click.Option]:
    """Return an option for every field of a settings dataclass.

    Args:
        cls: a dataclass, whose docstring has an ``Attributes:`` section, or an instance, whose
            values are then shown as defaults; of anything else there are no options.
        skip: fields that are no options.
        names: field -> option, where they differ.
    """
    if not dataclasses.is_dataclass(cls):
        return []
    instance = None if isinstance(cls, type) else cls
    cls = cls if instance is None else type(instance)
    hints, texts, found = typing.get_type_hints(cls), documented(cls), []
    for field in dataclasses.fields(cls):
        if field.name in skip:
            continue
        option = (names or {}).get(field.name, field.name).replace("_", "-")
        default = field.default
        if default is dataclasses.MISSING and field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        if instance is not None:
            default = getattr(instance, field.name)
        text = texts.get(field.name, "")
        if default is not dataclasses.MISSING and default not in (None, "", ()):
            text += f"  [{_shown(default)}]"
        kind = _kind(hints[field.name])
        if kind is bool:
            found.append(
                click.Option([f"--{option}/--no-{option}", field.name], default=None, help=text)
            )
        else:
            found.append(click.Option([f"--{option}", field.name], type=kind, help=text))
    return found


def given_of(cls: Any, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a dataclass's fields that were given on the command line."""
    if not dataclasses.is_dataclass(cls):
        return {}
    names = [field.name for field in dataclasses.fields(cls)]
    return {name: values[name] for name in names if name in values and is_given(name)}


def documented(cls: Any) -> dict[str, str]:
    """Return what a docstring's ``Attributes:`` section says of each name, as one sentence."""
    text = inspect.getdoc(cls) or ""
    _, _, section = text.partition("Attributes:\n")
    found: dict[str, str] = {}
    for entry in re.split(r"\n(?=    \w)", "\n" + section.split("\n\n")[0]):
        match = re.match(r"\s*([\w, ]+):\s+(.*)", entry.strip(), re.DOTALL)
        if match:
            says = " ".join(match[2].split()).replace("``", "")
            says = re.sub(r":\w+:`~?([^`]*)`", r"\1", says)
            for name in match[1].split(","):
                found[name.strip()] = says[:1].upper() + says[1:]
    return found


def _kind(hint: Any) -> Any:
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
        rest = [part for part in typing.get_args(hint) if part is not type(None)]
        return _kind(rest[0]) if len(rest) == 1 else Json()
    if hint in (int, str, bool):
        return hint
    if hint is float:
        return NUMBER
    if hint == tuple[float, float]:
        return Range()
    return Json()


def _shown(default: Any) -> str:
    if isinstance(default, tuple):
        if len(default) == 2 and all(isinstance(part, int | float) for part in default):
            return f"{default[0]:g}..{default[1]:g}"
        return json.dumps(default)
    return f"{default:g}" if isinstance(default, float) else str(default)


class DynamicCommand(click.Command):
    """A command some of whose options depend on the values of others, such as ``--task``.

    Args:
        first: names of the options that decide, with their defaults.
        dynamic: makes the options that they ask for.
    """

    def __init__(self, *args: Any, first: Mapping[str, str], dynamic: Dynamic, **others: Any):
        super().__init__(*args, **others)
        self._first, self._dynamic, self._static = first, dynamic, list(self.params)

    def make_context(
        self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any
    ) -> click.Context:
        """Look at what decides, add the options, and go on as any command."""
        values = dict(self._first)
        for index, word in enumerate(args):
            name, equals, value = word.partition("=")
            key = name.removeprefix("--").replace("-", "_")
            if name.startswith("--") and key in values:
                values[key] = value if equals else next(iter(args[index + 1 : index + 2]), "")
        values["words"] = "\0".join(args)
        self.params = [*self._static]
        known = {name for param in self.params for name in param.opts}
        for option in self._dynamic(values):
            if not known & set(option.opts):
                known |= set(option.opts)
                self.params.insert(-1, option)
        return super().make_context(info_name, args, parent, **extra)
