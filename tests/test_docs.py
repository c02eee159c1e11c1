"""Pages of the docs: their code and commands run, links have targets, sentences are short."""

import doctest
import inspect
import json
import re
import shlex
import sys
import types
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import figures
import numpy as np
import pytest
from khepera_data import made_up
from numba import njit
from PIL import Image
from plain_words import NOT_AGAIN

import neurosim as ns
from neurosim.cli.main import cli
from neurosim.controllers import CONTROLLERS, make_controller
from neurosim.evolution.optimisers import OPTIMISERS
from neurosim.loop.evolve import evolve
from neurosim.loop.settings import default_settings
from neurosim.robots.registry import ROBOTS
from neurosim.simulators import TableSimulator
from neurosim.tasks.base import Task
from neurosim.tasks.registry import TASKS
from neurosim.testing import check_task
from neurosim.training.train import train
from neurosim.trials.realities import REALITIES
from tracking.datasets.dataset import Dataset

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))

#: Blocks of code.
CODE = re.compile(r"^```.*?^```", flags=re.DOTALL | re.MULTILINE)
#: Words in a sentence: in the mean over a page, and in its longest.
MEAN_WORDS = 18.0
MOST_WORDS = 35
#: Words written by hand in README and docs together: in prose, and in tables.
MOST_IN_PROSE = 12_000
MOST_IN_TABLES = 5_500
#: Pages that may name the words that are not used elsewhere.
OF_WORDS = ("glossary.md",)


def text_of(page):
    """Return the text of a page, or of a notebook without its code."""
    text = page.read_text(encoding="utf-8")
    if page.suffix == ".ipynb":
        cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "markdown"]
        return "\n\n".join("".join(cell["source"]) for cell in cells)
    return text


def blocks(page, *languages):
    """Give the code blocks of these languages."""
    inside, lines = None, []
    for line in text_of(page).splitlines():
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
                # Text after many blanks is a remark.
                yield shlex.split(re.sub(r" {5,}\S.*", "", line), comments=True)[1:]


def prose(text):
    """Give the paragraphs and list items of a page, without code, tables, headings and links."""
    text = CODE.sub("", text)
    text = re.sub(r"^( *\||#|!\[|<!--| {4,}).*$", "", text, flags=re.M)
    text = re.sub(r"^\s*([-*]|\d+\.)\s", "\n\n", text, flags=re.M)
    text = re.sub(r"\]\([^)]*\)", "]", text)
    for paragraph in re.split(r"\n\s*\n", re.sub(r"`[^`]*`", "CODE", text)):
        if paragraph.strip() and " · " not in paragraph:  # a list of links
            yield " ".join(paragraph.split())


def tables(text):
    """Give the rows of a page's tables, without targets of links."""
    for row in re.findall(r"^ *\|.*$", CODE.sub("", text), flags=re.M):
        yield re.sub(r"\]\([^)]*\)", "]", re.sub(r"`[^`]*`", "CODE", row))


def count(text):
    return len(re.findall(r"[\w'%+.-]*\w[\w'%-]*", text))


def lengths(text):
    """Return the number of words of each sentence of a page."""
    ends = r"(?<=[.!?:;])\s+(?=[A-Z(\[*])"
    counts = [count(part) for paragraph in prose(text) for part in re.split(ends, paragraph)]
    return [words for words in counts if words]


COMMANDS = [(page.name, words) for page in PAGES + NOTEBOOKS for words in commands(page)]
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
    block = block.replace("generations=300", "generations=20")
    # As a module, because dataclasses look up their module by name.
    module = types.ModuleType("block_of_docs")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    exec(compile(block, page, "exec"), module.__dict__)
    for made_here in vars(module).values():
        own = isinstance(made_here, type) and made_here.__module__ == module.__name__
        if own and issubclass(made_here, Task):
            check_task(made_here())


@pytest.mark.parametrize("name", ns.__all__)
@pytest.mark.slow
def test_examples_run(name, made, tmp_path, monkeypatch):
    for folder in made.iterdir():
        (tmp_path / folder.name).symlink_to(folder)
    monkeypatch.chdir(tmp_path)
    known = {"ns": ns, "np": np, "dataclass": dataclass, "NamedTuple": NamedTuple, "njit": njit}
    known |= {"Path": Path, "__name__": "examples"}
    text = inspect.getdoc(getattr(ns, name))
    examples = doctest.DocTestParser().get_doctest(text, known, name, None, 0)
    rolled_out = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(examples)
    assert rolled_out.attempted > 0
    assert rolled_out.failed == 0


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Make the files from which the pages' blocks start: data (few), a simulator, tables."""
    folder = tmp_path_factory.mktemp("made")
    reference = folder / "data" / "reference"
    reference.parent.mkdir()
    Dataset.read(ROOT / "data" / "reference").part(slice(0, 500)).write(reference)
    train(
        reference,
        folder / "simulator",
        centres=20,
        most_parts=4000,
        progress=False,
    )
    (folder / "tables").mkdir()
    TableSimulator(made_up()).write(folder / "tables")
    return folder


@pytest.fixture(autouse=True)
def _nothing_stays_registered():
    registries = (TASKS, CONTROLLERS, OPTIMISERS, REALITIES, ROBOTS)
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
    (evolved,) = evolve(tables, task, family, settings=settings, progress=False)
    history = evolved.evolution["history"]
    assert np.mean(history["mean"][-5:]) > np.mean(history["mean"][:3]) + 0.01
    assert max(history["best"]) < 0


def test_the_page_of_libraries_shows_the_examples():
    shown = list(blocks(ROOT / "docs" / "libraries.md", "py"))
    examples = sorted((ROOT / "examples").glob("use_*.py"))
    assert examples
    for path in examples:
        assert path.read_text(encoding="utf-8") in shown, path.name


@pytest.mark.parametrize("page", PAGES + NOTEBOOKS, ids=lambda page: page.name)
def test_sentences_are_short(page):
    counts = lengths(text_of(page))
    assert np.mean(counts) < MEAN_WORDS
    assert max(counts) <= MOST_WORDS


def test_pages_do_not_grow():
    pages = [figures.BLOCK.sub("", text_of(page)) for page in figures.pages()]
    assert sum(count(part) for page in pages for part in prose(page)) <= MOST_IN_PROSE
    assert sum(count(row) for page in pages for row in tables(page)) <= MOST_IN_TABLES


def test_words_are_counted():
    code = "```sh\n| no |\n```\n\n"
    text = f"# No\n\nOne `a b` [three](x.md#y).\n\n- Four, 5 %.\n\n{code}| 1 | [2](z) `3 3` |\n"
    assert lengths(text) == [3, 2]
    assert [count(row) for row in tables(text)] == [3]


@pytest.mark.parametrize("page", PAGES + NOTEBOOKS, ids=lambda page: page.name)
def test_words_that_do_not_come_back(page):
    if page.name in OF_WORDS:
        return
    text = text_of(page)
    text = re.sub(r"`[^`]*`", "CODE", CODE.sub("", text))
    # Titles of sections stay as long as other pages link to them.
    text = re.sub(r"^#.*$|\]\([^)]*\)", "", text, flags=re.M)
    hits = [hit.group() for hit in NOT_AGAIN.finditer(" ".join(text.split()))]
    assert not hits


def test_the_readme_begins_with_a_small_moving_picture():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    match = re.search(r"^!\[.+\]\((.+)\)$", readme, re.MULTILINE)
    assert readme[: match.start()].count("\n") < 12
    assert (ROOT / match[1]).stat().st_size < 2e6
    with Image.open(ROOT / match[1]) as picture:
        assert picture.n_frames > 50


def test_pages_are_linked_from_the_index_and_the_index_from_the_readme():
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    others = [page.name for page in PAGES[2:] if page.name != "index.md"]
    others += [f"../notebooks/{path.name}" for path in NOTEBOOKS]
    assert not [name for name in others if f"]({name})" not in index]
    assert "](docs/index.md)" in (ROOT / "README.md").read_text(encoding="utf-8")


def test_links_lead_somewhere():
    def anchors(page):
        titles = re.findall(r"^#+ (.*)$", text_of(page), flags=re.M)
        return {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}

    for page in PAGES + NOTEBOOKS:
        for to, anchor in re.findall(r"\]\((?!https?:)([^)#\s]*)(?:#([^)\s]*))?\)", text_of(page)):
            target = (page.parent / to) if to else page
            assert target.exists(), (page.name, to)
            if anchor:
                assert anchor in anchors(target), (page.name, to, anchor)


def test_files_named_next_to_the_papers_exist():
    text = text_of(ROOT / "docs" / "papers.md")
    paths = re.findall(r"`((?:[a-z_]+/)+(?:[a-z_]+\.py)?)`", text)
    assert len(paths) > 30
    assert not [
        path for path in paths if not any((ROOT / at / path).exists() for at in ("", "neurosim"))
    ]


def test_there_is_something_to_test():
    assert len(COMMANDS) > 20
    assert PYTHON
