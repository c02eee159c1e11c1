"""What the pages show runs: every block of Python, and every command as far as its options."""

import re
import shlex
import sys
import types
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from khepera_data import made_up

from neurosim.cli.main import cli
from neurosim.controllers import CONTROLLERS, make_controller
from neurosim.evolution.optimisers import OPTIMISERS
from neurosim.loop.evolve import evolve
from neurosim.loop.settings import default_settings
from neurosim.simulators import TableSimulator
from neurosim.tasks.registry import TASKS
from neurosim.training.train import train
from neurosim.trials.realities import REALITIES

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


def blocks(page, *languages):
    """Give what stands between fences of these languages."""
    inside, lines = None, []
    for line in page.read_text(encoding="utf-8").splitlines():
        if line.startswith("```"):
            if inside in languages:
                yield "\n".join(lines) + "\n"
            inside, lines = (line[3:].strip() if inside is None else None), []
        else:
            lines.append(line)


def commands(page):
    for block in blocks(page, "", "sh"):
        for line in block.replace("\\\n", " ").splitlines():
            if line.startswith("neurosim "):
                # What follows many blanks is a remark.
                yield shlex.split(re.sub(r" {5,}\S.*", "", line), comments=True)[1:]


COMMANDS = [(page.name, words) for page in PAGES for words in commands(page)]
PYTHON = [(page.name, block) for page in PAGES for block in blocks(page, "python")]


@pytest.mark.parametrize(("page", "words"), COMMANDS, ids=lambda x: x if isinstance(x, str) else "")
def test_commands_take_these_options(page, words):
    command, words = cli, [word.replace("...", "x") for word in words]
    while hasattr(command, "commands"):
        command, words = command.commands[words[0]], words[1:]
    command.make_context(command.name, words)


@pytest.mark.parametrize(("page", "block"), PYTHON, ids=lambda x: x if ".md" in x else "")
@pytest.mark.slow
def test_python_runs(page, block, made, tmp_path, monkeypatch):
    for folder in made.iterdir():
        (tmp_path / folder.name).symlink_to(folder)
    monkeypatch.chdir(tmp_path)
    if "import cma" in block:
        pytest.importorskip("cma")
    # As a module, so that its dataclasses find themselves.
    module = types.ModuleType("block_of_docs")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    exec(compile(block, page, "exec"), module.__dict__)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Make what the pages' blocks start from: data, a simulator, tables."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "data").symlink_to(ROOT / "data")
    train(
        ROOT / "data" / "reference",
        folder / "simulator",
        hidden=4,
        centres=20,
        most_parts=4000,
        progress=False,
    )
    (folder / "tables").mkdir()
    TableSimulator(made_up()).write(folder / "tables")
    return folder


@pytest.fixture(autouse=True)
def _nothing_stays_registered():
    registries = (TASKS, CONTROLLERS, OPTIMISERS, REALITIES)
    before = [dict(registry._registered) for registry in registries]
    yield
    for registry, names in zip(registries, before, strict=True):
        registry._registered = names


@pytest.mark.slow
def test_networks_are_evolved_for_the_distance_to_a_path():
    (block,) = (block for page, block in PYTHON if page == "tables.md" and "NearALine" in block)
    shown: dict = {}
    exec(compile(block, "tables.md", "exec"), shown)
    tables, task = TableSimulator(made_up()), shown["NearALine"]()
    family = make_controller("network", tables, task)
    settings = default_settings(family, task, generations=25)
    genetic = replace(settings.genetic, population=40, parents=8)
    settings = replace(settings, genetic=genetic)
    (found,) = evolve(tables, task, family, settings=settings, progress=False)
    history = found.evolution["history"]
    assert np.mean(history["mean"][-5:]) > np.mean(history["mean"][:3]) + 0.01
    assert max(history["best"]) < 0


def test_the_page_of_libraries_shows_the_examples():
    shown = list(blocks(ROOT / "docs" / "libraries.md", "py"))
    examples = sorted((ROOT / "examples").glob("use_*.py"))
    assert examples
    for path in examples:
        assert path.read_text(encoding="utf-8") in shown, path.name


def test_there_is_something_to_test():
    assert len(COMMANDS) > 20
    assert PYTHON
