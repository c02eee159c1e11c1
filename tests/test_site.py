"""The site is built from the pages, the notebooks and the code; its links have targets."""

import ast
import html.parser
import importlib.util
import posixpath
import re
from pathlib import Path
from urllib.parse import unquote, urlsplit

import click
import make_site
import msgspec
import pytest
import reference

import neurosim as ns
from neurosim.base import formats
from neurosim.cli.main import cli

ROOT = Path(__file__).resolve().parents[1]
BUILDS = all(importlib.util.find_spec(name) for name in ("zensical", "mkdocstrings"))
needs_builder = pytest.mark.skipif(not BUILDS, reason="pip install 'neurosim[docs]'")


class Read(html.parser.HTMLParser):
    """A page's links and loaded files, the anchors that links can have as targets, and its text."""

    def __init__(self, path):
        super().__init__()
        self.links, self.loads, self.places, self.text = [], [], set(), ""
        self.feed(path.read_text(encoding="utf-8"))

    def has(self, fragment):
        return not fragment or unquote(fragment) in self.places

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        if "id" in attrs:
            self.places.add(attrs["id"])
        if tag == "a" and "href" in attrs:
            self.links.append(attrs["href"])
        if tag in ("script", "img", "source", "video") and attrs.get("src"):
            self.loads.append(attrs["src"])
        if tag == "link" and attrs.get("rel") in ("stylesheet", "icon", "preload"):
            self.loads.append(attrs["href"])

    def handle_data(self, data):
        self.text += data


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    make_site.main(folder / "site", folder / "build")
    return {
        path.relative_to(folder / "site").as_posix(): Read(path)
        for path in (folder / "site").rglob("*.html")
    }, folder / "site"


@needs_builder
@pytest.mark.slow
def test_all_pages_are_there(site):
    pages, _ = site
    expected = {f"{path.stem}.html" for path in (ROOT / "docs").glob("*.md")}
    expected |= {f"tutorials/{path.stem}.html" for path in (ROOT / "notebooks").glob("*.ipynb")}
    expected |= {f"reference/commands/{name}.html" for name in cli.commands}
    expected |= {"pages.html", "gallery.html", "reference/errors.html"}
    assert expected <= set(pages)
    # The first page is the README, and each page has the navigation to all of them.
    assert "A robot builds its own simulator." in pages["index.html"].text
    assert sum("tutorials/" in load for load in pages["gallery.html"].loads) > 15
    assert expected <= {posixpath.normpath(link) for link in pages["pipeline.html"].links}


@needs_builder
@pytest.mark.slow
def test_links_lead_somewhere(site):
    pages, folder = site
    wrong = []
    for name, page in pages.items():
        if name == "404.html":  # its links are from the root
            continue
        for link in page.links:
            to = urlsplit(link)
            if to.scheme:
                continue
            target = (folder / name).parent / unquote(to.path) if to.path else folder / name
            result = target.resolve().relative_to(folder.resolve()).as_posix()
            if not target.is_file() or (result in pages and not pages[result].has(to.fragment)):
                wrong.append((name, link))
    assert not wrong


@needs_builder
@pytest.mark.slow
def test_nothing_comes_from_a_network(site):
    pages, _ = site
    assert {
        load for page in pages.values() for load in page.loads if urlsplit(load).netloc
    } == set()


@needs_builder
@pytest.mark.slow
def test_names_of_python_are_shown_with_their_docstrings(site):
    pages, _ = site
    page = pages["reference/python/neurosim.html"]
    for name in ns.__all__:
        assert f"neurosim.{name}" in page.places
        first = " ".join(getattr(ns, name).__doc__.split("\n\n")[0].partition("`")[0].split())
        assert first in " ".join(page.text.split()), name
    shown = [page for name, page in pages.items() if name.startswith("reference/python/")]
    assert not [page for page in shown if re.search(r":(class|func|meth|data|mod):", page.text)]


@pytest.mark.slow
def test_commands_have_pages_with_their_help():
    pages = reference.commands()

    def check(words, command):
        text = pages[f"reference/commands/{'-'.join(words) or 'index'}.md"]
        assert text.startswith(f"# {' '.join(['neurosim', *words])}\n")
        for option in command.get_params(click.Context(command)):
            if isinstance(option, click.Option) and not option.hidden:
                assert option.opts[-1] in text, (words, option.opts)
                assert reference.escaped(" ".join((option.help or "").split())) in text
        for name, below in getattr(command, "commands", {}).items():
            check([*words, name], below)

    check([], cli)
    evolve = pages["reference/commands/evolve.md"]
    assert "## Options of --task go-to\n" in evolve
    assert "## Options of --reality virtual-khepera\n" in evolve


@pytest.mark.slow
def test_errors_are_listed_by_their_messages():
    (text,) = reference.errors().values()
    by_file = dict(zip(*[iter(re.split(r"^## (.*)$", text, flags=re.M)[1:])] * 2, strict=True))
    assert "- there is no … …; …\n" in by_file["neurosim/base/registry.py"]
    assert "are too few to learn sensors from" in by_file["neurosim/training/sensors.py"]
    assert text.count("\n- ") > 600


def test_files_have_their_keys():
    (text,) = reference.files().values()
    shown = dict(
        zip(*[iter(re.split(r"^##+ (.*)$", text, flags=re.MULTILINE)[1:])] * 2, strict=True)
    )
    for name, (format, version), struct in reference.FILES:
        assert f'"format": "{format}", "version": {version}' in shown[name]
        for key in msgspec.structs.fields(struct):
            assert f"<code>{key.encode_name}</code>" in shown[name]
    assert "|  |\n" not in text  # each has a meaning
    assert "<code>from</code>" in shown["SentOfDuration"]
    assert "number, 0 to 1" in shown["Prediction"]


@pytest.mark.slow
def test_every_format_that_is_read_is_in_the_reference():
    read = set()
    for folder in ("neurosim", "tracking"):
        for path in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Call):
                    name = ast.unparse(node.func).rpartition(".")[2]
                    given = node.args[{"read_json": 3, "convert": 1}.get(name, len(node.args)) :]
                    read |= {ast.unparse(each).removeprefix("formats.") for each in given}
    declared = {name for name in read if isinstance(getattr(formats, name, None), type)}
    assert len(declared) > 12
    shown = {struct for _, _, struct in reference.FILES}
    # Classes that read a part of a file belong to the same file as another class.
    parts = {"Kind", "Sampling", "TrialRecording", "Simulator"}
    assert declared - parts <= {struct.__name__ for struct in shown}


def test_a_missing_builder_is_named(monkeypatch, tmp_path):
    find = importlib.util.find_spec
    gone = "zensical"
    monkeypatch.setattr(
        make_site.importlib.util, "find_spec", lambda name: None if name == gone else find(name)
    )
    with pytest.raises(SystemExit, match=r"the site needs zensical.*neurosim\[docs\]"):
        make_site.main(tmp_path / "site", tmp_path / "build")


def test_a_link_to_nothing_is_an_error(tmp_path):
    pages = make_site.Pages(tmp_path)
    text = "[a](../README.md#x)\n```\n[b](c)\n```\n"
    assert pages.linked(text, "docs/x.md") == text.replace("../README", "index")
    with pytest.raises(SystemExit, match="nowhere"):
        pages.linked("[a](gone.md)", "docs/x.md")


def test_a_page_notes_figures_that_are_older_than_their_code(tmp_path, monkeypatch):
    def page():
        pages = make_site.Pages(tmp_path)
        pages.page = lambda target, text: shown.update({target.name: text})
        pages.add("docs/results.md")
        shown = {}
        pages.write()
        return shown["results.md"]

    monkeypatch.setattr(make_site.figures, "digest", lambda path: "other")
    assert "**Older than their code:**" in page()
    monkeypatch.setattr(make_site.figures, "changed", lambda measured, root: [])
    assert "**Older than their code:**" not in page()


def test_a_notebook_is_shown_with_its_outputs(tmp_path):
    picture = "iVBORw0KGgo="
    cells = [
        {"cell_type": "markdown", "source": ["# Title"]},
        {
            "cell_type": "code",
            "source": ["print('```')"],
            "outputs": [
                {"output_type": "stream", "text": ["seen\n"]},
                {"output_type": "display_data", "data": {"image/png": picture}},
                {"output_type": "execute_result", "data": {"text/plain": ["42"]}},
                {
                    "output_type": "execute_result",
                    "data": {"text/html": ["<style>\n\n</style>\n", "<table>\n", "</table>"]},
                },
            ],
        },
    ]
    (tmp_path / "a.ipynb").write_text(msgspec.json.encode({"cells": cells}).decode())
    text = make_site.notebook(tmp_path / "a.ipynb", tmp_path / "b.md")
    assert text == (
        "# Title\n\n[Download this notebook](b.ipynb) to run it.\n\n"
        "````python\nprint('```')\n````\n\n```text\nseen\n```\n\n"
        "![output 1](b-1.png)\n\n```text\n42\n```\n\n<table>\n</table>\n\n"
    )
    assert (tmp_path / "b-1.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "b.ipynb").read_bytes() == (tmp_path / "a.ipynb").read_bytes()
