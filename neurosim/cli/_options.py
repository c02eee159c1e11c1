"""Options made from the parameters of settings classes, drivers and functions.

A parameter's name, type and default are those of its signature, its help is the first sentence
about it in the docstring, under ``Args:`` or ``Attributes:``. So nothing is written twice, and a
robot or task that a package or a script registers has its options on the command line, too.
"""

from __future__ import annotations

import inspect
import re
import types
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass, replace
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, Protocol, Union, get_args, get_origin

import click
from click.core import ParameterSource

from neurosim.base.declared import bounded, hints_of
from neurosim.base.errors import UserError
from neurosim.cli._types import (
    PATH,
    Json,
    Listed,
    Option,
    Real,
    Whole,
    low_high,
    ranged,
    shown,
)

_EMPTY = inspect.Parameter.empty


class Choices(Protocol):
    """Objects that have names, such as a :class:`neurosim.base.registry.Registry`."""

    def names(self) -> list[str]:
        """Return all names."""
        ...

    def get(self, name: str) -> Any:
        """Return the object of this name; raise UserError if the name is unknown."""
        ...


@dataclass(frozen=True)
class Parameter:
    """A parameter of a callable that can be an option.

    Attributes:
        name: keyword.
        kind: type of the option.
        hint: declared type.
        default: value in the signature, or ``inspect.Parameter.empty``.
        help: first sentence about it, or empty.
    """

    name: str
    kind: click.ParamType
    hint: Any
    default: Any
    help: str


def parameters(source: Any) -> Sequence[Parameter]:
    """Return the parameters of a class or function that can be options.

    Those of other types (a clock, a generator, another settings class) are left out. A settings
    object has those of its class, with its values as defaults.
    """
    if is_dataclass(source) and not isinstance(source, type):
        made = source
        return [replace(each, default=getattr(made, each.name)) for each in parameters(type(made))]
    return _declared(source) if isinstance(source, Hashable) else ()


@cache
def _declared(source: Any) -> tuple[Parameter, ...]:
    """Return the parameters of a class or function; a command asks for each several times."""
    try:
        signature = inspect.signature(source)
    except (TypeError, ValueError):
        return ()
    annotations, helps = hints_of(source), documented(source)
    result = []
    for name, each in signature.parameters.items():
        if each.kind in (each.POSITIONAL_ONLY, each.VAR_POSITIONAL, each.VAR_KEYWORD):
            continue
        hint = annotations.get(name, _EMPTY)
        kind = _kind(hint, each.default)
        if kind is not None:
            default = _default(source, name, each.default)
            result.append(Parameter(name, kind, hint, default, helps.get(name, "")))
    return tuple(result)


def _owners(source: Callable[..., Any]) -> list[Any]:
    return list(reversed(source.__mro__[:-1])) if isinstance(source, type) else [source]


def _default(source: Callable[..., Any], name: str, default: Any) -> Any:
    """Return a default; for a dataclass field with a factory, the factory's value."""
    declared = getattr(source, "__dataclass_fields__", {}).get(name)
    if declared is not None and callable(getattr(declared, "default_factory", None)):
        return declared.default_factory()
    return default


def _kind(annotation: Any, default: Any) -> click.ParamType | None:
    """Return the type of an option; None if the type cannot be an option."""
    if annotation is _EMPTY:
        annotation = str if default is None or default is _EMPTY else type(default)
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin in (Union, types.UnionType):
        # Of a union, the type that can be an option counts; a number or a word is a word.
        kinds = [kind for part in parts if (kind := _kind(part, _EMPTY)) is not None]
        if len(kinds) < 2:
            return next(iter(kinds), None)
        if any(isinstance(kind, Listed | Json) for kind in kinds):
            return Json()
        return PATH if PATH in kinds else click.STRING
    if origin is Literal:
        return click.Choice([str(part) for part in parts])
    if origin is tuple and len(parts) == 2 and parts[0] == parts[1] and _is_float(parts[0]):
        return low_high(parts[0])
    if origin in (tuple, list, Sequence):
        kinds = [_kind(part, _EMPTY) for part in parts if part is not ...]
        if not all(isinstance(kind, _NUMBERS) or kind is click.STRING for kind in kinds):
            return Json()
        return click.Tuple(kinds) if origin is tuple and ... not in parts else Listed(kinds[0])
    if bounded(annotation)[0] in (int, float):
        return ranged(annotation)
    kind = {bool: click.BOOL, str: click.STRING, Path: PATH}.get(annotation)
    if kind is None and isinstance(annotation, type):
        from neurosim.base.place import Place  # with Numba, for which --help need not wait

        kind = PATH if annotation is Place else None
    return kind


_NUMBERS = (Whole, Real)


def _is_float(hint: Any) -> bool:
    return bounded(hint)[0] is float


_ENTRY = re.compile(r"    (\w+(?:, \w+)*): (.*)")


def documented(source: Callable[..., Any]) -> dict[str, str]:
    """Return the first sentence about each parameter in the docstrings."""
    entries: dict[str, str] = {}
    for title in ("Attributes:", "Args:"):  # a text about an argument has precedence
        for owner in _owners(source):
            init = vars(owner).get("__init__") if isinstance(owner, type) else None
            for doc in (owner.__doc__, getattr(init, "__doc__", None)):
                entries |= _entries(inspect.cleandoc(doc or ""), title)
    return {name: _sentence(text) for name, text in entries.items()}


def _entries(doc: str, title: str) -> dict[str, str]:
    """Return the explanations of names in a section of a docstring."""
    entries: dict[str, str] = {}
    inside, names = False, []
    for line in doc.splitlines():
        if line and not line.startswith(" "):
            inside, names = line == title, []
        elif inside and (entry := _ENTRY.match(line)):
            names = entry[1].split(", ")
            entries |= dict.fromkeys(names, entry[2])
        elif line.strip():
            for name in names:
                entries[name] += " " + line.strip()
    return entries


def _sentence(text: str) -> str:
    """Return the first sentence, without reStructuredText's marks."""
    text = re.sub(r":\w+:`~?(?:[\w.]*\.)?([^`]*)`", r"\1", text).replace("``", "")
    first = re.split(r"(?<=[.!?])\s+(?=[A-Z])", text, maxsplit=1)[0].strip().rstrip(".")
    return f"{first[:1].upper()}{first[1:]}." if first else ""


#: The choices: the command's parameter -> a name.
Chosen = Mapping[str, str]


@dataclass(frozen=True)
class Group:
    """Options for the parameters of one callable.

    Attributes:
        into: the command's parameter that gets a dict of the given options.
        source: the callable; or a settings object, whose values are the defaults; or
            :class:`Choices`, of which an option names one; or, with ``by_choice``, a function from
            the choice to any of these. Text, ``module:attribute``, is imported when it is needed.
        by_choice: whether ``source`` makes the callable of the choice.
        option: the option that names one, such as ``--task``; None where there is no choice.
        default: default name, or a function that returns it from the earlier choices.
        help: of the option that names one; the names are added.
        of: returns, for the named object, the callable whose parameters are options; or None.
        only: parameters that are options; None: all that can be.
        skip: parameters that are not options, or a function that returns them from the choice.
        optional: parameters without a default that need not be given.
        prefix: before the names of the options.
        names: names of options that differ from their parameters'.
        units: units for people of parameters in SI, of :data:`neurosim.cli._types.UNITS`; for a
            pair, one for each.
        helps: help texts that replace those of the docstring.
        kinds: types of options that replace those of the annotations.
        outside: tells by the name whether the choice is outside this program, such as a robot.
            ``--resume`` does not take such a choice or its options from the interrupted run: a
            file, which may be from anybody, must not choose which device is opened or driven.
    """

    into: str
    source: Any
    by_choice: bool = False
    option: str | None = None
    default: str | Callable[[Chosen], str] | None = None
    help: str = ""
    of: Callable[[Any], Any] = lambda item: item
    only: Sequence[str] | None = None
    skip: Sequence[str] | Callable[[Chosen], Sequence[str]] = ()
    optional: Sequence[str] = ()
    prefix: str = ""
    names: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str | tuple[str, ...]] = field(default_factory=dict)
    helps: Mapping[str, str] = field(default_factory=dict)
    kinds: Mapping[str, click.ParamType] = field(default_factory=dict)
    outside: Callable[[str], bool] = lambda name: False

    @property
    def chooser(self) -> str:
        """The command's parameter that gets the chosen name."""
        return (self.option or "").strip("-").replace("-", "_")

    def choices(self) -> Choices:
        """Return the choices."""
        return _loaded(self.source)

    def default_name(self, chosen: Chosen) -> str:
        """Return the default name."""
        return self.default(chosen) if callable(self.default) else str(self.default)

    def chosen_by(self, chosen: Chosen) -> Any:
        """Return the callable with the parameters, or None."""
        if self.option is not None:
            return self.of(self.choices().get(chosen[self.chooser]))
        source = _loaded(self.source)
        return source(chosen) if self.by_choice else source

    def options(self, chosen: Chosen, taken: Sequence[str] = ()) -> dict[str, click.Option]:
        """Return the options, by parameter.

        Args:
            chosen: the choices.
            taken: options of the command; one of the same name is prefixed with the choice.
        """
        made = {}
        for flag, each in self.flags(chosen).items():
            if f"--{flag}" in taken:
                flag = f"{(self.option or self.into).strip('-').replace('_', '-')}-{flag}"
            made[each.name] = self.made(each, flag)
        return made

    def flags(self, chosen: Chosen) -> dict[str, Parameter]:
        """Return the parameters that are options, by the option's name without dashes."""
        source = self.chosen_by(chosen)
        skip = self.skip(chosen) if callable(self.skip) else self.skip
        return {
            self.prefix + self.names.get(each.name, each.name.replace("_", "-")): each
            for each in (parameters(source) if source is not None else ())
            if each.name not in skip and (self.only is None or each.name in self.only)
        }

    def made(self, each: Parameter, flag: str) -> click.Option:
        """Return the option of a parameter."""
        kind, help_ = self.kinds.get(each.name, each.kind), self.helps.get(each.name, each.help)
        default = each.default
        if (units := self.units.get(each.name)) is not None:
            pair = (units,) if isinstance(units, str) else units
            listed = isinstance(each.kind, Listed)  # the unit of a list is that of each number
            hints = get_args(each.hint) if listed or len(pair) > 1 else (each.hint,)
            quantities = [Real(hint, unit) for hint, unit in zip(hints, pair, strict=not listed)]
            kind = quantities[0] if isinstance(units, str) else click.Tuple(quantities)
            kind = Listed(kind) if listed else kind
            help_ = re.sub(r", (m|m/s|rad|m and rad)(?=[.;])", f", {' and '.join(pair)}", help_)
        declared, is_flag = f"--{flag}", each.kind is click.BOOL
        if is_flag and default is not False:
            declared += f"/--no-{flag}"
        if not (default is None or default is _EMPTY or default is False or default == ()):
            help_ += f"  [default: {flag if is_flag else shown(kind, default)}]"
        return Option(
            [flag.replace("-", "_"), declared],
            type=None if is_flag else kind,
            is_flag=is_flag,
            required=default is _EMPTY and each.name not in self.optional,
            **({} if default is _EMPTY else {"default": default}),
            show_default=False,
            help=help_,
        )


def _loaded(source: Any) -> Any:
    if not isinstance(source, str):
        return source
    module, _, attribute = source.partition(":")
    return getattr(import_module(module), attribute)


def settings_options(into: str, source: Any, **others: Any) -> Callable[[Callable], Callable]:
    """Return a decorator that makes options of a callable's parameters.

    The command gets the given options as a dict, for a call of the callable.

    Args:
        into: the command's parameter.
        source: a settings class or a function; see :class:`Group`.
        others: see :class:`Group`.
    """
    return _adds(Group(into, source, **others))


def choice_options(
    option: str,
    choices: Any,
    *,
    default: str | Callable[[Chosen], str],
    help: str,
    **others: Any,
) -> Callable[[Callable], Callable]:
    """Return a decorator that adds an option with a name, and the options of the named object.

    For ``--task`` the command gets ``task``, the name, and ``task_options``, a dict of the given
    options of the task. ``--help`` lists the options of the named task, or of the default.

    Args:
        option: such as ``--task``.
        choices: :class:`Choices`, or ``module:attribute``.
        default: a name; see :class:`Group`.
        help: of the option; the names are added.
        others: see :class:`Group`.
    """
    into = option.strip("-").replace("-", "_") + "_options"
    return _adds(Group(into, choices, option=option, default=default, help=help, **others))


def _adds(group: Group) -> Callable[[Callable], Callable]:
    def add(function: Callable) -> Callable:
        if not hasattr(function, "__click_params__"):
            function.__click_params__ = []
        function.__click_params__.append(group)
        return function

    return add


class SettingsCommand(click.Command):
    """A command with groups of options: see :func:`settings_options`, :func:`choice_options`.

    The options depend on the choices, so the line is read twice: first with the options of all
    choices.

    With ``--resume``, options that are not given are those of the first start. Objects outside this
    program (see :class:`Group`) must be named again.

    Args:
        begun: returns, from the command's values, the options of the first start.
    """

    def __init__(
        self,
        *args: Any,
        begun: Callable[[dict[str, Any]], dict[str, Any]] | None = None,
        **others: Any,
    ):
        super().__init__(*args, **others)
        self._parts, self._begun = self.params, begun
        self.params = [part for part in self._parts if not isinstance(part, Group)]
        self._groups = [part for part in self._parts if isinstance(part, Group)]

    # Which options there are

    def choices(self) -> dict[str, list[str]]:
        """Return the possible names of each option, such as those of ``--task``."""
        named = [group for group in self._groups if group.option is not None]
        return {str(group.option): group.choices().names() for group in named}

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """Return the parameters, with the options of the choice."""
        state = _state(ctx)
        if state.params is None:
            for group in self._groups:
                if group.option is not None:
                    state.chosen.setdefault(group.chooser, group.default_name(state.chosen))
            state.params = [*self._expanded(state), *super().get_params(ctx)[len(self.params) :]]
        return state.params

    def _expanded(self, state: _State) -> Iterator[click.Parameter]:
        taken = {"--help", *(flag for each in self.params for flag in each.opts)}
        taken |= {f"--{each.name}".replace("_", "-") for each in self.params}
        taken |= {group.option for group in self._groups if group.option is not None}
        for part in self._parts:
            if not isinstance(part, Group):
                yield part
                continue
            if part.option is not None:
                yield _chooser(part)
            state.options[part.into] = part.options(state.chosen, sorted(taken))
            for option in state.options[part.into].values():
                taken |= {*option.opts}
                yield option

    def _everything(self) -> list[click.Parameter]:
        """Return the parameters with the options of each possible choice, one choice at a time."""
        every: dict[str, click.Parameter] = {str(each.name): each for each in self.params}
        default: dict[str, str] = {}
        for group in self._groups:
            if group.option is not None:
                default[group.chooser] = group.default_name(default)
                every[group.chooser] = _chooser(group)
        for chosen in [default, *self._alternatives(default)]:
            for group in self._groups:
                for flag, each in _or_none(group.flags, chosen).items():
                    if (name := flag.replace("-", "_")) not in every:
                        every[name] = group.made(each, flag)
        return list(every.values())

    def _alternatives(self, chosen: Chosen) -> Iterator[Chosen]:
        for group in self._groups:
            if group.option is not None:
                for name in group.choices().names():
                    yield {**chosen, group.chooser: name}

    # Reading the line

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the line."""
        state = _state(ctx)
        if self._begun or any(group.option for group in self._groups):
            self._look(ctx, args, state)
        try:
            rest = super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            raise self._of_another(error, state) or error from None
        except click.MissingParameter as error:
            raise self._missing(error, state) or error from None
        except (TypeError, AttributeError) as error:
            if not ctx.default_map:
                raise
            raise UserError(
                f"the options of the first start cannot be read ({error}): give them again, or "
                "start in a new folder"
            ) from None
        given = {each.name: each for each in self.get_params(ctx) if _is_set(ctx, each.name)}
        state.given = {
            name: ctx.params[name]
            for name, each in given.items()
            if isinstance(each, click.Option) and name not in ("out", "as_json", "resume")
        }
        for group in self._groups:
            if group.option is not None:
                ctx.params[group.chooser] = state.chosen[group.chooser]
            options = state.options[group.into]
            values = {name: ctx.params.pop(each.name, None) for name, each in options.items()}
            ctx.params[group.into] = {
                name: value for name, value in values.items() if options[name].name in given
            }
        return rest

    def _look(self, ctx: click.Context, args: list[str], state: _State) -> None:
        """Find the choices, and the options that --resume uses, before all options are known."""
        look = click.Command(self.name, params=self._everything())
        settings = {"ignore_unknown_options": True, "allow_extra_args": True}
        first = look.make_context(
            self.name, list(args), parent=ctx.parent, resilient_parsing=True, **settings
        )
        needed = [each.name for each in self.params if each.required]
        whole = all(first.params.get(name) is not None for name in needed)
        if self._begun and whole and first.params.get("resume"):
            kept = self._begun(first.params).items()
            ctx.default_map = {name: value for name, value in kept if value is not None}
        for group in self._groups:
            if group.option is not None:
                kept_name = str((ctx.default_map or {}).get(group.chooser) or "")
                if _is_set(first, group.chooser):
                    name = first.params[group.chooser]
                elif kept_name and group.outside(kept_name):
                    raise UserError(
                        f"this was started with {group.option} {kept_name}: give it and its "
                        "options again, because --resume does not open devices from a file"
                    )
                else:
                    name = kept_name or group.default_name(state.chosen)
                state.chosen[group.chooser] = name
                if ctx.default_map and group.outside(name):
                    for option in _or_none(group.options, state.chosen).values():
                        ctx.default_map.pop(option.name, None)

    def _of_another(self, error: click.NoSuchOption, state: _State) -> UserError | None:
        """Return the error for an option that belongs to another choice."""
        flag = error.option_name

        def has(chosen: Chosen) -> bool:
            options = [
                each for one in self._groups for each in _or_none(one.options, chosen).values()
            ]
            return any(flag in (*each.opts, *each.secondary_opts) for each in options)

        for group in self._groups:
            if group.option is None:
                continue
            names = group.choices().names()
            those = [name for name in names if has({**state.chosen, group.chooser: name})]
            if those:
                return UserError(
                    f"{group.option} {state.chosen[group.chooser]} has no option {flag}: leave it "
                    f"out, or choose {group.option} {' or '.join(those)}"
                )
        return None

    def _missing(self, error: click.MissingParameter, state: _State) -> UserError | None:
        """Return the error for a missing option that a choice needs."""
        for group in self._groups:
            for each in state.options[group.into].values():
                if each is error.param and group.option is not None:
                    what = f"{each.help[:1].lower()}{each.help[1:]}".rstrip(".")
                    chosen = state.chosen[group.chooser]
                    return UserError(f"{group.option} {chosen} needs {each.opts[0]}: {what}")
        return None

    # Help

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, those of the choices under separate headings."""
        params, state = self.get_params(ctx), _state(ctx)
        apart: dict[str | None, str] = {}
        for group in self._groups:
            if group.option is not None:
                title = f"Options of {group.option} {state.chosen[group.chooser]}"
                apart |= {each.name: title for each in state.options[group.into].values()}
        sections: dict[str, list] = {"Options": []}
        for each in params:
            record = each.get_help_record(ctx) if isinstance(each, click.Option) else None
            if record is not None:
                sections.setdefault(apart.get(each.name, "Options"), []).append(record)
        for title, records in sections.items():
            with formatter.section(title):
                formatter.write_dl(records)
        if others := list(self._others(state)):
            with formatter.section("Options of other choices"):
                formatter.write_text(
                    f"To read about them: {ctx.command_path} {others[0][0]} --help"
                )
                formatter.write_dl(others)

    def _others(self, state: _State) -> Iterator[tuple[str, str]]:
        """Give each other name, with the options that it would add."""
        shown = {flag for each in state.params or () for flag in each.opts}
        for group in self._groups:
            for name in group.choices().names() if group.option is not None else ():
                other = _State({**state.chosen, group.chooser: name})
                try:
                    list(self._expanded(other))
                except UserError:
                    continue  # of a package that cannot be imported
                flags = [each.opts[0] for each in other.options[group.into].values()]
                if more := [flag for flag in flags if flag not in shown]:
                    yield f"{group.option} {name}", ", ".join(more)


@dataclass
class _State:
    """The state of reading a command line."""

    chosen: dict[str, str] = field(default_factory=dict)
    params: list[click.Parameter] | None = None
    options: dict[str, dict[str, click.Option]] = field(default_factory=dict)
    given: dict[str, Any] = field(default_factory=dict)


def _state(ctx: click.Context) -> _State:
    # Not in ctx.meta, which contexts within each other share.
    if not hasattr(ctx, "_neurosim"):
        ctx._neurosim = _State()
    return ctx._neurosim


def given_options() -> dict[str, Any]:
    """Return the options given to the running command, to be saved for --resume."""
    return _state(click.get_current_context()).given


def _chooser(group: Group) -> click.Option:
    names = ", ".join(group.choices().names())
    default = None if callable(group.default) else group.default
    first, stop, rest = group.help.partition(". ")
    help_ = f"{first.rstrip('.')}: {names}.{stop[1:]}{rest}"
    return click.Option(
        [group.chooser, str(group.option)],
        default=default,
        show_default=default is not None,
        metavar="NAME",
        help=help_,
    )


def _or_none(made: Callable[[Chosen], dict[str, Any]], chosen: Chosen) -> dict[str, Any]:
    try:
        return made(chosen)
    except UserError:
        return {}  # of a package that cannot be imported; the error comes when it is used


def _is_set(ctx: click.Context, name: str | None) -> bool:
    return ctx.get_parameter_source(str(name)) not in (None, ParameterSource.DEFAULT)
