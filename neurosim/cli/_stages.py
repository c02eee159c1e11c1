"""The stages of a pipeline's TOML file, read and checked by the definitions of the commands."""

from __future__ import annotations

import itertools
import json
import re
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Any

import click

from neurosim.base.declared import Mismatch, Seed, convert
from neurosim.base.errors import FileError, UserError
from neurosim.base.files import read_text
from neurosim.cli._options import SettingsCommand
from neurosim.cli._types import NEW, Json, Listed, Numbers, Pairs

#: The kind of each command's output, as later commands name their inputs.
MAKES = {
    "lab photographs": "photographs",
    "record": "recording",
    "track": "recording",
    "dataset": "dataset",
    "train": "simulator",
    "build-tables": "simulator",
    "evolve": "controller",
    "run": "trial",
    "back-to-reality": "alternation",
}
#: Arguments that take several outputs, or have another name.
TAKES = {
    "recordings": ("recording",),
    "place": ("simulator",),
    "source": ("simulator",),
    "folders": ("dataset", "simulator", "controller", "trial", "alternation"),
}
#: Keys of the file that are not stages, and keys of a stage that are not options.
OF_FILE = ("seed", "sweep", "summary")
COMMAND = "command"
#: Options that the pipeline sets itself.
OWN = ("resume", "json", "help")
#: Largest number of combinations of a sweep.
MOST_POINTS = 10_000


@dataclass(frozen=True)
class Made:
    """The output of a stage.

    Attributes:
        path: file or folder; None if the stage only prints.
        kind: of :data:`MAKES`.
        swept: keys of the sweep on which it depends.
        sha256: of the output when the stage ended.
    """

    path: Path | None
    kind: str | None = None
    swept: frozenset[str] = frozenset()
    sha256: str | None = None


@dataclass(frozen=True)
class Line:
    """A stage as a line of words for the command line.

    Attributes:
        words: of the command, without the command itself.
        inputs: parameter -> its files and folders.
        stages: names of the earlier stages that made some of them.
    """

    words: list[str]
    inputs: dict[str, list[Path]]
    stages: list[str]


@dataclass(frozen=True)
class Stage:
    """A table of the file.

    Attributes:
        file: the TOML file, for messages.
        name: of the table, and of the output.
        words: the command, such as ``("lab", "photographs")``.
        command: its definition.
        options: its keys and values, with the ``seed`` of the file, if any.
        swept: keys of the sweep that set an option of it.
    """

    file: Path
    name: str
    words: tuple[str, ...]
    command: click.Command
    options: dict[str, Any]
    swept: frozenset[str] = frozenset()

    @property
    def in_place(self) -> bool:
        """Whether the command writes into its input."""
        return self.words == ("track",)

    @property
    def resumes(self) -> bool:
        """Whether the command can continue an interrupted run."""
        return any(each.name == "resume" for each in self.command.params)

    def wrong(self, what: str, key: str | None = None) -> FileError:
        """Return an error about this table, or a key of it."""
        return FileError(self.file, what, field=".".join(filter(None, (self.name, key))))

    def output(self) -> str | None:
        """Return the name of the output; None: the command has none of its own."""
        out = next((each for each in self.command.params if each.name == "out"), None)
        name = self.options.get("out")
        default = getattr(out, "default", None)
        if name is None and isinstance(default, Path):
            return self.name + default.suffix
        if out is None or (name is None and not out.required):
            return None
        if name is None:
            return self.name
        if not (isinstance(name, str) and name == Path(name).name):
            raise self.wrong(f"expected a name without a folder, found {name!r}", "out")
        return name

    def line(self, made: Mapping[str, Made], out: Path | None, folder: Path) -> Line:
        """Return the command line of this stage.

        Args:
            made: the outputs of the stages before it, by their names.
            out: its own output.
            folder: folder of additional files.

        Raises:
            FileError: naming the key that is wrong.
        """
        params = self._params()
        arguments, options = [], []
        inputs: dict[str, list[Path]] = {}
        stages: list[str] = []
        for each in params:
            key, value = key_of(each), self._value(each)
            if each.name == "out":
                value = None if out is None else str(out)
            elif value is None and isinstance(each, click.Argument):
                value = _latest(made, each.name or "")
                if not value:
                    raise self.wrong(
                        f"is missing: {' '.join(self.words)} needs one, and no stage before it "
                        "makes one",
                        key,
                    )
                value = value if each.nargs == -1 else value[-1]
            if value is None:
                continue
            if isinstance(each.type, click.Path) and each.name != "out":
                value = self._paths(each, value, made, folder, inputs, stages)
            elif each.name != "out" and _is_file(value):
                inputs[key] = [Path(value)]  # such as the JSON of a task
            texts = self._texts(each, value)
            if isinstance(each, click.Argument):
                arguments += texts
            else:
                options += texts
        for key in self.options.keys() - {name for each in params for name in keys_of(each)}:
            if key in OWN:
                raise self.wrong("is set by the pipeline; leave it out", key)
            options.append(f"--{key}={self.options[key]}")  # the command reports that it is unknown
        return Line(arguments + options, inputs, list(dict.fromkeys(stages)))

    def check(self, line: Line) -> None:
        """Check a line by the definition of the command, without running it.

        Raises:
            FileError: naming the key that is wrong.
        """
        with self.named():
            _read(self.command, tuple(line.words))

    @contextmanager
    def named(self) -> Iterator[None]:
        """Raise errors of the command line as errors of the file."""
        try:
            yield
        except click.NoSuchOption as error:
            key = error.option_name.lstrip("-")
            known = [name for each in self._params() for name in keys_of(each)]
            name = " ".join(self.words)
            raise self.wrong(f"{name} has no such option{_nearest(key, known)}", key) from None
        except click.BadParameter as error:
            key = key_of(error.param) if error.param is not None else None
            missing = isinstance(error, click.MissingParameter)
            raise self.wrong("is missing" if missing else error.message, key) from None
        except click.UsageError as error:
            raise self.wrong(error.message) from None
        except UserError as error:
            raise self.wrong(str(error)) from None

    def _params(self) -> list[click.Parameter]:
        """Return the parameters of the command, with those of its choices."""
        choosers = self.command.choices() if isinstance(self.command, SettingsCommand) else ()
        chosen = [
            f"{flag}={self.options[flag[2:]]}" for flag in choosers if flag[2:] in self.options
        ]
        with self.named():
            return _params_of(self.command, tuple(chosen))

    def _value(self, each: click.Parameter) -> Any:
        given = [name for name in keys_of(each) if name in self.options]
        if len(given) > 1:
            raise self.wrong(f"is the same as {given[0]}; leave one out", given[1])
        if not given:
            return None
        value = self.options[given[0]]
        if isinstance(value, bool) and _is_flag(each):
            return value != (f"--{given[0]}" in each.secondary_opts)
        return value

    def _paths(
        self,
        each: click.Parameter,
        value: Any,
        made: Mapping[str, Made],
        folder: Path,
        inputs: dict[str, list[Path]],
        stages: list[str],
    ) -> Any:
        """Return paths, in which names of earlier stages are replaced by their outputs."""
        several = isinstance(value, list)
        paths = []
        for text in value if several else [value]:
            if not isinstance(text, str):
                raise self.wrong(f"expected a path, found {text!r}", key_of(each))
            first, *rest = Path(text).parts or ("",)
            if each.type is NEW:
                paths.append(str(folder / text))
                continue
            path = Path(text)
            if first in made and made[first].path is not None:
                stages.append(first)
                path = Path(str(made[first].path), *rest)
            elif not path.exists():
                near = _nearest(text, [name for name, one in made.items() if one.path])
                raise self.wrong(
                    f"{text} is neither a file nor an earlier stage{near}", key_of(each)
                )
            inputs.setdefault(key_of(each), []).append(path)
            paths.append(str(path))
        return paths if several else paths[0]

    def _texts(self, each: click.Parameter, value: Any) -> list[str]:
        """Return a value as words of the command line."""
        key = key_of(each)
        if isinstance(each, click.Argument):
            return [
                self._text(each.type, one, key)
                for one in (value if isinstance(value, list) and each.nargs == -1 else [value])
            ]
        flag = each.opts[-1]
        if isinstance(value, bool):
            if not _is_flag(each) and not (value and getattr(each, "_flag_needs_value", False)):
                raise self.wrong(f"expected a value, found {json.dumps(value)}", key)
            other = each.secondary_opts
            return [flag] if value else other[-1:]
        if _is_flag(each):
            raise self.wrong(f"expected true or false, found {value!r}", key)
        if each.multiple:
            value = value if isinstance(value, list) else [value]
            return [f"{flag}={self._text(each.type, one, key)}" for one in value]
        if each.nargs > 1:
            if not isinstance(value, list) or len(value) != each.nargs:
                raise self.wrong(f"expected a list of {each.nargs}, found {value!r}", key)
            kinds = each.type.types if isinstance(each.type, click.Tuple) else [each.type] * 99
            parts = zip(kinds, value, strict=False)
            return [flag, *(self._text(kind, one, key) for kind, one in parts)]
        return [f"{flag}={self._text(each.type, value, key)}"]

    def _text(self, kind: click.ParamType, value: Any, key: str) -> str:
        if isinstance(value, str):
            return value
        if isinstance(kind, Json):
            return json.dumps(value)
        if isinstance(value, list) and isinstance(kind, Listed):
            return ",".join(self._text(kind.kind, one, key) for one in value)
        if isinstance(value, list) and isinstance(kind, Numbers):
            return kind.between.join(self._text(kind.part, one, key) for one in value)
        if isinstance(value, dict) and isinstance(kind, Pairs):
            return ",".join(f"{name}={word}" for name, word in value.items())
        if isinstance(value, list | dict | bool):
            raise self.wrong(f"expected one value, found {json.dumps(value, default=str)}", key)
        return str(value)


@cache
def _read(command: click.Command, words: tuple[str, ...]) -> None:
    command.make_context(str(command.name), list(words))


@cache
def _params_of(command: click.Command, chosen: tuple[str, ...]) -> list[click.Parameter]:
    """Return the parameters of a command, without those that the pipeline sets itself."""
    context = command.make_context(str(command.name), list(chosen), resilient_parsing=True)
    return [each for each in command.get_params(context) if key_of(each) not in OWN]


def key_of(each: click.Parameter) -> str:
    """Return the key of a parameter in the file: the option's name, without its dashes."""
    return keys_of(each)[-1]


def keys_of(each: click.Parameter) -> list[str]:
    """Return all keys of a parameter; single letters do not count."""
    if isinstance(each, click.Argument):
        return [str(each.name).replace("_", "-")]
    flags = [*each.secondary_opts, *each.opts]
    return [flag[2:] for flag in flags if flag.startswith("--")]


def _is_flag(each: click.Parameter) -> bool:
    return isinstance(each, click.Option) and bool(each.is_flag)


def _nearest(key: str, known: list[str]) -> str:
    near = get_close_matches(key, known, n=1)
    return f"; did you mean {near[0]}?" if near else ""


def _latest(made: Mapping[str, Made], argument: str) -> list[str]:
    """Return the names of the earlier stages that an argument takes by default."""
    kinds = TAKES.get(argument, (argument,))
    latest = {}
    for name, one in made.items():
        if one.kind in kinds:
            latest[one.kind if len(kinds) == 1 else name] = name
    return list(latest.values())


@dataclass(frozen=True)
class Experiment:
    """A pipeline's TOML file.

    Attributes:
        file: it.
        stages: its tables, in their order.
        sweep: ``seed``, or a stage and its option -> values.
        summary: results to print, such as ``run:fitness.actual``; empty: those that differ.
    """

    file: Path
    stages: list[Stage]
    sweep: dict[str, list[Any]] = field(default_factory=dict)
    summary: list[str] = field(default_factory=list)

    def points(self) -> list[dict[str, Any]]:
        """Return the combinations of the swept values; without a sweep, a single empty one."""
        values = itertools.product(*self.sweep.values())
        return [dict(zip(self.sweep, each, strict=True)) for each in values]

    def at(self, point: Mapping[str, Any]) -> list[Stage]:
        """Return the stages with the options of a combination."""
        stages = []
        for stage in self.stages:
            options, swept = dict(stage.options), set()
            for key, value in point.items():
                name, _, option = key.partition(".")
                if name == stage.name or (key == "seed" and options.get("seed") is SWEPT):
                    options[option or "seed"] = value
                    swept.add(key)
            stages.append(replace(stage, options=options, swept=frozenset(swept)))
        return stages


#: Name of a sweep's seed.
SWEPT = object()


def read_tables(file: Path) -> dict[str, Any]:
    """Return the tables of a TOML file.

    Raises:
        FileError: if it is missing or is not TOML, with the line.
    """
    try:
        return tomllib.loads(read_text(file, "a TOML file in UTF-8", most=2**20))
    except tomllib.TOMLDecodeError as error:
        raise FileError(file, f"is not TOML ({error})") from None


def experiment_of(file: Path, tables: Mapping[str, Any], commands: click.Group) -> Experiment:
    """Return the experiment in a file; relative paths in it start at the working folder.

    Args:
        file: for messages.
        tables: of :func:`read_tables`.
        commands: the group of all commands.

    Raises:
        FileError: naming table and key of the first mistake.
    """
    tables = dict(tables)
    sweep = _sweep(file, tables.pop("sweep", {}))
    seed = tables.pop("seed", None)
    seed = SWEPT if "seed" in sweep else seed
    for value in sweep.get("seed", () if seed in (None, SWEPT) else (seed,)):
        try:
            convert(value, Seed)
        except Mismatch as error:
            raise FileError(file, error.what, field="seed") from None
    summary = tables.pop("summary", [])
    if not (isinstance(summary, list) and all(isinstance(one, str) for one in summary)):
        raise FileError(
            file, "expected a list of results, such as run:fitness.actual", field="summary"
        )
    if not tables:
        raise FileError(file, "has no table; each stage needs one, such as [train]")
    stages = [_stage(file, name, table, seed, commands) for name, table in tables.items()]
    experiment = Experiment(file, stages, sweep, summary)
    names = [stage.name for stage in stages]
    for key in sweep:
        name, _, option = key.partition(".")
        if key != "seed" and (name not in names or not option):
            what = f"is neither seed nor an option of a stage{_nearest(name, names)}"
            raise FileError(file, what, field=f"sweep.{key}")
    for point in experiment.points():
        made: dict[str, Made] = {}
        for stage in experiment.at(point):
            name = stage.output()
            out = None if name is None else Path(name)
            line = stage.line(made, out, Path())
            stage.check(line)
            out = next(iter(line.inputs.values()))[0] if stage.in_place else out
            taken = [one.path for one in made.values()]
            if out is not None and out in taken and not stage.in_place:
                raise stage.wrong(f"another stage writes {out}, too", "out")
            made[stage.name] = Made(out, MAKES.get(" ".join(stage.words)))
    return experiment


def _sweep(file: Path, table: Any) -> dict[str, list[Any]]:
    if not isinstance(table, dict):
        raise FileError(file, "expected a table", field="sweep")
    axes: dict[str, list[Any]] = {}
    for key, value in table.items():
        parts = value.items() if isinstance(value, dict) else [("", value)]
        for option, values in parts:
            name = f"{key}.{option}" if option else key
            if not isinstance(values, list) or not values:
                raise FileError(file, f"expected a list, found {values!r}", field=f"sweep.{name}")
            if len({json.dumps(each, default=str) for each in values}) < len(values):
                raise FileError(file, "has a value twice", field=f"sweep.{name}")
            axes[name] = values
    count = 1
    for values in axes.values():
        count *= len(values)
    if count > MOST_POINTS:
        what = f"has {count} combinations; expected at most {MOST_POINTS}"
        raise FileError(file, what, field="sweep")
    return axes


def _stage(file: Path, name: str, table: Any, seed: Any, commands: click.Group) -> Stage:
    if not isinstance(table, dict):
        what = f"is not a key of a pipeline; expected {', '.join(OF_FILE)} or tables"
        raise FileError(file, what + _nearest(name, list(OF_FILE)), field=name)
    if not re.fullmatch(r"\w[\w-]{0,99}", name):
        raise FileError(file, "expected letters, digits, - and _ in a stage's name", field=name)
    options = dict(table)
    words = options.pop(COMMAND, name)
    if not isinstance(words, str):
        raise FileError(file, f"expected text, found {words!r}", field=f"{name}.{COMMAND}")
    command: click.Command = commands
    path: list[str] = []
    for word in words.split():
        known = list(command.commands) if isinstance(command, click.Group) else []
        if word not in known or word in ("pipeline", "demo"):
            given = COMMAND in table
            what = f"there is no command {words!r}"
            if not given:
                what += f", and a table of another name needs the key {COMMAND}"
            field = f"{name}.{COMMAND}" if given else name
            raise FileError(file, what + _nearest(word, known), field=field)
        command = command.commands[word]  # type: ignore[attr-defined]
        path.append(word)
    if isinstance(command, click.Group):
        what = f"{words} needs one of {', '.join(command.commands)}"
        raise FileError(file, what, field=f"{name}.{COMMAND}")
    seeded = any(each.name == "seed" for each in command.params)
    if seeded and seed is not None:
        options.setdefault("seed", seed)
    return Stage(file, name, tuple(path), command, options)


def _is_file(value: Any) -> bool:
    return isinstance(value, str) and bool(Path(value).suffix) and Path(value).is_file()
