"""Messages, help, docstrings and names are plain English: some words and patterns are errors."""

import ast
import json
import re
from pathlib import Path

import click
import make_site
import pytest
from plain_words import NAMES, NOT_IN_DOCSTRINGS, NOT_IN_MESSAGES, NOT_IN_NAMES

from neurosim.cli.main import cli

ROOT = Path(__file__).resolve().parents[1]
FILES = sorted(path for name in ("neurosim", "tracking") for path in (ROOT / name).rglob("*.py"))
NAMED = FILES + sorted(
    path
    for name in ("benchmarks", "docs", "examples", "firmware", "tests")
    for path in (ROOT / name).rglob("*.py")
)
NAMED += sorted((ROOT / "notebooks").glob("*.ipynb"))
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def code(path):
    """Return the code of a file, or of a notebook's cells."""
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".ipynb":
        return text
    cells = json.loads(text)["cells"]
    return "\n".join("".join(one["source"]) for one in cells if one["cell_type"] == "code")


def texts(source):
    """Give the strings of three words or more that are not docstrings, with their lines."""
    tree = ast.parse(source)
    passed_over = set()
    for node in ast.walk(tree):
        if isinstance(node, DOCUMENTED) and node.body and isinstance(node.body[0], ast.Expr):
            passed_over.add(id(node.body[0].value))
        if isinstance(node, ast.JoinedStr):
            passed_over |= {id(part) for part in ast.walk(node) if part is not node}
    for node in ast.walk(tree):
        if id(node) in passed_over:
            continue
        text = ""
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            text = node.value
        elif isinstance(node, ast.JoinedStr):
            text = "".join(getattr(part, "value", "X") if isinstance(part, ast.Constant) else "X"
                           for part in node.values)  # fmt: skip
        if len(text.split()) >= 3:
            yield node.lineno, " ".join(text.split())


def helps(name, command):
    """Give the help of a command, of its options and of the commands below it."""
    context = click.Context(command)
    yield name, " ".join((command.help or "").split())
    for option in command.get_params(context):
        yield f"{name} {option.opts[0]}", " ".join((getattr(option, "help", None) or "").split())
    if isinstance(command, click.Group):
        for below in command.list_commands(context):
            yield from helps(f"{name} {below}", command.get_command(context, below))


def test_messages():
    hits = [
        f"{path.relative_to(ROOT)}:{line}: {hit.group()!r} in {text[:100]}"
        for path in FILES
        for line, text in texts(path.read_text(encoding="utf-8"))
        if (hit := NOT_IN_MESSAGES.search(text))
    ]
    assert not hits


def test_docstrings():
    hits = [
        f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 1)}: {hit.group()!r} in {text[:100]}"
        for path in NAMED
        for node in ast.walk(ast.parse(code(path)))
        if isinstance(node, DOCUMENTED)
        and (text := " ".join((ast.get_docstring(node) or "").split()))
        if (hit := NOT_IN_DOCSTRINGS.search(text))
    ]
    assert not hits


def names(source):
    """Give the names that a file defines, and the keys of its dictionaries, with their lines."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.attr
        elif isinstance(node, DOCUMENTED[1:]) and not node.name.startswith("test_"):
            yield node.lineno, node.name
        elif isinstance(node, ast.Dict):
            for key in node.keys:
                if isinstance(key, ast.Constant) and isinstance(key.value, str):
                    yield key.lineno, key.value


def test_errors_are_short():
    """No part of an error, between full stops, semicolons and colons, has more than 25 words."""
    messages = [
        each[2:] for each in make_site.reference.errors()["reference/errors.md"].splitlines()
    ]
    parts = [part for message in messages for part in re.split(r"(?<=[.;:]) ", message)]
    assert not [part for part in parts if len(re.findall(r"[\w'-]*\w[\w'-]*", part)) > 25]


def test_names():
    hits = [
        f"{path.relative_to(ROOT)}:{line}: {name}"
        for path in NAMED
        for line, name in names(code(path))
        if name not in NAMES and NOT_IN_NAMES & set(name.lower().split("_"))
    ]
    assert not hits


def test_help():
    hits = [
        f"{name}: {hit.group()!r} in {text[:100]}"
        for name, text in helps("neurosim", cli)
        if (hit := NOT_IN_MESSAGES.search(text))
    ]
    assert not hits


@pytest.mark.parametrize(
    "text",
    [
        "a line of 0 m is none",
        "as the wheels were told",
        "x: what was sent is kept",
        "it is no file",
    ],
)
def test_patterns(text):
    assert NOT_IN_MESSAGES.search(text)


@pytest.mark.parametrize(
    "text",
    [
        "What it is.",
        "Return what it is.",
        "A robot. What it does.",
        "the speed it is told",
        "it is none",
        "a packet of so many bytes",
    ],
)
def test_patterns_of_docstrings(text):
    assert NOT_IN_DOCSTRINGS.search(text)
    assert not NOT_IN_DOCSTRINGS.search("Return the speed; say what is wrong where there is none.")


@pytest.mark.parametrize("text", ["found = 1", "def way(): pass", "{'said': 1}", "a.told_left = 1"])
def test_patterns_of_names(text):
    ((_, name),) = names(text)
    assert NOT_IN_NAMES & set(name.split("_"))


def test_good_messages_pass():
    assert not NOT_IN_MESSAGES.search("there is no controller of this name: what did you give?")
