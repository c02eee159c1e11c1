"""neurosim docs: the site is shown, built first if there is none, and errors are one sentence."""

import importlib.util
import json
import socket
import sys
import webbrowser
from urllib.request import urlopen

import pytest

from neurosim.cli import docs as module
from neurosim.cli.main import main


@pytest.fixture
def clone(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "CLONE", tmp_path)
    return tmp_path


@pytest.fixture
def opened(monkeypatch):
    """Return the pages that a browser has got."""
    pages = []
    monkeypatch.setattr(webbrowser, "open", lambda url: pages.append(urlopen(url).read()))
    return pages


@pytest.fixture
def with_extra(monkeypatch):
    """Let the builder's libraries be found."""
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name)


def run(monkeypatch, *words):
    words = ["neurosim", "docs", "--open", "--seconds", "0.01", *words]
    monkeypatch.setattr(sys, "argv", words)
    main()


def write_builder(clone, script):
    (clone / "docs").mkdir()
    (clone / "docs" / "make_site.py").write_text(script)


def test_the_site_is_shown(clone, opened, monkeypatch, capsys):
    (clone / "site").mkdir()
    (clone / "site" / "index.html").write_text("<p>Start</p>")
    run(monkeypatch, "--json")
    assert opened == [b"<p>Start</p>"]
    assert json.loads(capsys.readouterr().out)["url"].startswith("http://127.0.0.1:")


@pytest.mark.usefixtures("with_extra")
def test_it_is_built_first(clone, opened, monkeypatch, capfd):
    write_builder(
        clone,
        "from pathlib import Path\nprint('built')\nsite = Path(__file__).parents[1] / 'site'\n"
        "site.mkdir()\n(site / 'index.html').write_text('new')\n",
    )
    run(monkeypatch, "--json")
    assert opened == [b"new"]
    out, err = capfd.readouterr()
    assert [*json.loads(out)] == ["url"]
    assert "building the site" in err
    assert "built" in err


@pytest.mark.usefixtures("with_extra")
def test_a_builder_that_fails(clone, opened, monkeypatch, capfd):
    write_builder(clone, "raise SystemExit('a link leads nowhere')")
    with pytest.raises(SystemExit, match="1"):
        run(monkeypatch)
    assert "the documentation was not built" in capfd.readouterr().err
    assert not opened


def test_without_the_builders_libraries(clone, monkeypatch, capsys):
    write_builder(clone, "")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SystemExit, match="1"):
        run(monkeypatch)
    assert f"'neurosim[docs]', and run make docs in {clone}" in capsys.readouterr().err


@pytest.mark.usefixtures("clone")
def test_without_a_clone(monkeypatch, capsys):
    with pytest.raises(SystemExit, match="1"):
        run(monkeypatch)
    assert "clone its repository" in capsys.readouterr().err


def test_a_port_that_is_taken(clone, monkeypatch, capsys):
    (clone / "site").mkdir()
    (clone / "site" / "index.html").touch()
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(SystemExit, match="1"):
        run(monkeypatch, "--port", str(taken.getsockname()[1]))
    assert "choose another one with --port" in capsys.readouterr().err
