"""Write the reference from the code: commands from their help, files from their formats, the API.

Each function gives pages, path -> Markdown, for :mod:`make_site`.
"""

from __future__ import annotations

import ast
import html
import importlib
import inspect
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
import msgspec
from click.testing import CliRunner

import neurosim as ns
from neurosim.back_to_reality import run
from neurosim.base import checkpoint, formats, place
from neurosim.base.errors import UserError
from neurosim.cli import demo, pipeline
from neurosim.cli._options import SettingsCommand, documented
from neurosim.cli.main import cli
from neurosim.controllers import files as controllers
from neurosim.loop import journal
from neurosim.sampling import sampler
from neurosim.simulators import base as simulators
from neurosim.tasks import files as tasks
from neurosim.trials import trial
from tracking.camera import camera_model
from tracking.datasets import dataset, recordings

ROOT = Path(__file__).resolve().parents[1]


def escaped(text: str) -> str:
    """Return a text that Markdown shows as it is."""
    return re.sub(r"([\\`*_\[\]|])", r"\\\1", text).replace("<", "&lt;")


def code(text: str) -> str:
    """Return code for a cell of a table."""
    return f"<code>{html.escape(text).replace('|', '&#124;')}</code>"


def table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [titles, ["---"] * len(titles), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines) + "\n\n"


# Commands


class MarkdownHelp(click.HelpFormatter):
    """Writes what ``--help`` prints as Markdown."""

    def write_usage(self, prog: str, args: str = "", prefix: str | None = None) -> None:
        self.write(f"```text\n{prog} {args}\n```\n\n")

    def write_heading(self, heading: str) -> None:
        self.write(f"## {heading}\n\n")

    def write_paragraph(self) -> None:
        self.write("\n\n")

    def write_text(self, text: str) -> None:
        for paragraph in inspect.cleandoc(text).split("\n\n"):
            self.write(f"{escaped(' '.join(paragraph.split()))}\n\n")

    def write_dl(self, rows: Sequence[tuple[str, str]], *_: Any, **__: Any) -> None:
        cells = [[code(term), escaped(" ".join(text.split()))] for term, text in rows]
        self.write(table(["name", "meaning"], cells))

    @contextmanager
    def section(self, name: str) -> Iterator[None]:
        self.write_heading(name)
        yield


def commands() -> dict[str, str]:
    """Return a page for each command."""
    pages = {}
    for words, command in _commands([], cli):
        text = _help(words)
        if isinstance(command, click.Group):
            # Its own commands, whole and with links, in place of the shortened list.
            text = text.partition("## Commands")[0]
            below = [
                [f"[{name}]({'-'.join([*words, name])}.md)", escaped(_first(each))]
                for name, each in command.commands.items()
            ]
            text += "## Commands\n\n" + table(["command", "purpose"], below)
        if isinstance(command, SettingsCommand):
            shown = set(_sections(text))
            for option, names in command.choices().items():
                for name in names:
                    for title, section in _sections(_help([*words, option, name])).items():
                        if title == f"Options of {option} {name}" and title not in shown:
                            text += section
        title = " ".join(["neurosim", *words])
        pages["-".join(words) or "index"] = f"# {title}\n\n{text}"
    return {f"reference/commands/{name}.md": text for name, text in pages.items()}


def _commands(words: list[str], command: click.Command) -> Iterator[tuple[list[str], Any]]:
    yield words, command
    if isinstance(command, click.Group):
        for name, below in command.commands.items():
            yield from _commands([*words, name], below)


def _first(command: click.Command) -> str:
    """Return the first sentence of a command's help."""
    return " ".join(re.split(r"(?<=\.)\s", command.help or "", maxsplit=1)[0].split())


def _help(words: list[str]) -> str:
    """Return the --help of a command as Markdown; nothing if it prints an error."""
    usual = click.Context.formatter_class
    click.Context.formatter_class = MarkdownHelp
    try:
        result = CliRunner().invoke(cli, [*words, "--help"], prog_name="neurosim")
    finally:
        click.Context.formatter_class = usual
    return re.sub(r"\n{3,}", "\n\n", result.stdout) if result.exit_code == 0 else ""


def _sections(text: str) -> dict[str, str]:
    parts = re.split(r"^## (.*)$", text, flags=re.M)[1:]
    return {
        title: f"\n## {title}{body}" for title, body in zip(parts[::2], parts[1::2], strict=True)
    }


# Errors

ERRORS = """# Errors

Every message about something that a user can correct, by the file that raises it. Each ends a
command with exit code 1, and is a `neurosim.UserError` in Python. `…` stands for a name or a value.

"""


def errors() -> dict[str, str]:
    """Return the page of all messages of errors that a user can cause."""
    text, kinds = ERRORS, {each.__name__ for each in _below(UserError)}
    for package in ("neurosim", "tracking"):
        for path in sorted((ROOT / package).rglob("*.py")):
            messages = _messages(path.read_text(encoding="utf-8"), kinds)
            if messages:
                text += f"## {path.relative_to(ROOT).as_posix()}\n\n"
                text += "".join(f"- {escaped(message)}\n" for message in messages) + "\n"
    return {"reference/errors.md": text}


def _below(kind: type) -> list[type]:
    return [kind, *(each for below in kind.__subclasses__() for each in _below(below))]


def _messages(source: str, kinds: set[str]) -> list[str]:
    """Return the messages of errors of these kinds in a source, in their order."""
    messages = {}
    for call in ast.walk(ast.parse(source)):
        if isinstance(call, ast.Call) and getattr(call.func, "id", "") in kinds:
            for given in call.args[:2]:
                parts = given.values if isinstance(given, ast.JoinedStr) else [given]
                words = [getattr(part, "value", "") for part in parts]
                words = [word if isinstance(word, str) else "…" for word in words]
                if len(" ".join(words).split()) > 2:
                    messages[call.lineno] = " ".join("".join(words).split())
    return [messages[line] for line in sorted(messages)]


# Files


def _of(module: Any, prefix: str = "") -> tuple[str, int]:
    """Return the format and the version that a module writes."""
    return getattr(module, f"{prefix}FORMAT"), getattr(module, f"{prefix}VERSION", module.VERSION)


#: The JSON files: name, (format, version), keys.
FILES: list[tuple[str, tuple[str, int], type[formats.Format]]] = [
    ("recording.json", _of(recordings), formats.Recording),
    ("tracking.json", _of(recordings, "TRACKING_"), formats.Tracking),
    ("calibration.json", _of(camera_model), formats.Calibration),
    ("markers.json", _of(recordings, "MARKERS_"), formats.Markers),
    ("dataset.json", _of(dataset), formats.Dataset),
    ("simulator.json, motion-network", _of(simulators), formats.MotionNetwork),
    ("simulator.json, tables", _of(simulators), formats.Tables),
    ("simulator.json, legged", _of(simulators), formats.Legged),
    ("sampling.json", _of(sampler), formats.BegunSampling),
    ("place", _of(place), formats.Place),
    ("task", _of(tasks), formats.Task),
    ("controller.json", _of(controllers), formats.Controller),
    ("trial.json", _of(trial), formats.Trial),
    ("foreseen.json", (trial.FORMAT_FORESEEN, trial.VERSION), formats.Foreseen),
    ("back-to-reality.json", _of(run), formats.BackToReality),
    ("parameters", _of(run, "GENES_"), formats.Genes),
    ("trials.jsonl, each line", _of(journal), formats.TrialRow),
    ("pipeline.jsonl, each line", _of(pipeline), formats.StageRow),
    ("demo.json", _of(demo), formats.Demo),
    ("checkpoint", _of(checkpoint), formats.Checkpoint),
]

INTRODUCTION = """# Keys of the JSON files

Readers check files against these definitions (`neurosim/base/formats.py`). Keys that are not listed
are ignored. A key that is not required may be missing or null. [Files](../files.md) explains
folders, CSV files and tensors.

"""


def files() -> dict[str, str]:
    """Return the page of the JSON files and their keys."""
    text, parts, seen = INTRODUCTION, [], set()
    for name, (format, version), struct in FILES:
        text += f'## {name}\n\n`"format": "{format}", "version": {version}`\n\n'
        text += _keys(struct, parts)
    text += "## Parts of several files\n\n"
    for part in sorted(_all_of(parts), key=lambda each: each.__name__):
        if part not in seen:
            seen.add(part)
            text += f"### {part.__name__}\n\n" + _keys(part, [])
    return {"reference/files.md": text}


def _all_of(parts: list[type]) -> list[type]:
    for part in parts:  # grows on the way
        _keys(part, parts)
    return parts


def _keys(struct: type, parts: list[type]) -> str:
    """Return a format's description and a table of its keys; append formats that it consists of."""
    info, meanings = msgspec.inspect.type_info(struct), documented(struct)
    text = _prose(struct.__doc__ or "")
    rows = [
        [
            code(key.encode_name),
            _type(key.type, parts),
            "yes" if key.required else "",
            meanings.get(key.name, ""),
        ]
        for key in info.fields
    ]
    return f"{text}\n\n" + table(["key", "type", "required", "meaning"], rows)


def _prose(doc: str) -> str:
    """Return a docstring without its list of attributes."""
    text = inspect.cleandoc(doc).partition("\n\nAttributes:")[0].replace("``", "`")
    return " ".join(text.split())


def _type(of: Any, parts: list[type]) -> str:
    """Return a type in words, with links to formats."""
    kinds = msgspec.inspect
    if isinstance(of, kinds.UnionType):
        shown = [_type(each, parts) for each in of.types if not isinstance(each, kinds.NoneType)]
        return " or ".join(shown)
    if isinstance(of, kinds.StructType):
        if of.cls not in parts:
            parts.append(of.cls)
        return f"[{of.cls.__name__}](#{of.cls.__name__.lower()})"
    if isinstance(of, kinds.ListType | kinds.VarTupleType):
        return f"list of {_type(of.item_type, parts)}{_length(of)}"
    if isinstance(of, kinds.TupleType):
        shown = [_type(each, parts) for each in of.item_types]
        return f"{len(shown)} x {shown[0]}" if len({*shown}) == 1 else f"({', '.join(shown)})"
    if isinstance(of, kinds.DictType):
        value = _type(of.value_type, parts)
        return "object" if value == "anything" else f"object, name: {value}"
    if isinstance(of, kinds.LiteralType):
        return " or ".join(code(repr(each).replace("'", '"')) for each in of.values)
    if isinstance(of, kinds.IntType | kinds.FloatType):
        return ("whole number" if isinstance(of, kinds.IntType) else "number") + _range(of)
    names = {
        kinds.StrType: "text",
        kinds.BoolType: "true or false",
        kinds.AnyType: "anything",
    }
    return names[type(of)]


def _range(of: Any) -> str:
    low = of.ge if of.ge is not None else of.gt
    high = of.le if of.le is not None else of.lt
    if low is None or high is None:
        return "" if low is None else f", {low:g} or more"
    return f", {'above ' if of.ge is None else ''}{low:g} to {high:g}"


def _length(of: Any) -> str:
    least, most = getattr(of, "min_length", None), getattr(of, "max_length", None)
    if least is None and most is None:
        return ""
    return f" ({least or 0} to {most})" if most is not None else f" ({least} or more)"


# Python

#: Packages that are not for scripts.
INTERNAL = {"neurosim.cli"}


def python() -> dict[str, str]:
    """Return a page of the names in `neurosim`, and one for each package."""
    pages = {"neurosim": [f"neurosim.{name}" for name in ns.__all__]}
    for folder in ("neurosim", "tracking"):
        for path in sorted((ROOT / folder).glob("*/__init__.py")):
            name = f"{folder}.{path.parent.name}"
            if name not in INTERNAL:
                pages[name] = _parts(name, path.parent)
    pages["neurosim.testing"] = ["neurosim.testing"]
    return {
        f"reference/python/{name}.md": f"# {name}\n\n"
        + "".join(f"::: {part}\n\n" for part in parts)
        for name, parts in pages.items()
    }


def _parts(name: str, folder: Path) -> list[str]:
    """Return the public names of a package: those that it declares, or else its public modules."""
    package = importlib.import_module(name)
    if hasattr(package, "__all__"):
        offered = [each for each in package.__all__ if callable(getattr(package, each))]
        return [f"{name}.{each}" for each in offered]
    modules = sorted(path.stem for path in folder.glob("*.py") if not path.stem.startswith("_"))
    return [f"{name}.{module}" for module in modules]
