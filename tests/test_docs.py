"""What the pages show runs: every block of Python, and every command as far as its options."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from khepera_data import made_up
from neurosim.loop.network_evolution import NetworkEvolution, NetworkSettings, TableTrials

from neurosim.cli.main import cli
from neurosim.simulators import TableSimulator
from neurosim.tasks.obstacle_avoidance import FITNESS

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


@pytest.fixture
def _same_fitness():
    before = dict(FITNESS)
    yield
    FITNESS.clear()
    FITNESS.update(before)


@pytest.mark.usefixtures("_same_fitness")
@pytest.mark.parametrize(("page", "block"), PYTHON, ids=lambda x: x if ".md" in x else "")
def test_python_runs(page, block):
    exec(compile(block, page, "exec"), {})


@pytest.mark.slow
@pytest.mark.usefixtures("_same_fitness")
def test_networks_are_evolved_for_the_distance_to_a_path():
    (block,) = (block for page, block in PYTHON if page == "tables.md" and "near_a_line" in block)
    shown: dict = {}
    exec(compile(block, "tables.md", "exec"), shown)
    evolution = NetworkEvolution(NetworkSettings(generations=1, population=40, parents=8), 0)
    trials = TableTrials(TableSimulator(made_up()), shown["task"])
    for _ in range(25):
        evolution.generation(trials)
    assert np.mean(evolution.mean[-5:]) > np.mean(evolution.mean[:3]) + 0.01
    assert max(evolution.best) < 0


def test_there_is_something_to_test():
    assert len(COMMANDS) > 20
    assert PYTHON
