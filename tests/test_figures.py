"""Figures of the pages are those of the benchmarks' results; a note says when the code is newer."""

import json
import os
import re
import subprocess
import sys

import figures
import pytest

BENCHMARK = """
import argparse, json
from helper import TWO
parser = argparse.ArgumentParser()
parser.add_argument("--count", type=int)
parser.add_argument("--json", action="store_true")
options = parser.parse_args()
print(json.dumps({"rows": [{"name": "a", "error": 0.01234 * options.count}], "0.5": TWO}))
"""
TEMPLATE = "| {one[rows][0][name]} |\n|---|\n| {one[rows][0][error]:.2f*100} cm, {one[0.5]} |\n"
PAGE = "Before.\n\n<!-- figures: one -->\n<!-- end of figures -->\n\nAfter.\n"


@pytest.fixture
def repository(tmp_path, monkeypatch):
    for name in list(os.environ):
        if name.startswith("GIT_"):
            monkeypatch.delenv(name)
    root = tmp_path / "repository"
    (root / "benchmarks").mkdir(parents=True)
    (root / "benchmarks" / "b.py").write_text(BENCHMARK)
    (root / "benchmarks" / "helper.py").write_text("TWO = 2\n")
    (root / "benchmarks" / "unused.py").write_text("")
    who = ["-c", "user.name=a", "-c", "user.email=a@b"]
    for words in (["init", "-q"], ["add", "."], [*who, "commit", "-q", "-m", "first"]):
        subprocess.run(["git", *words], cwd=root, check=True)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(sys, "argv", [*sys.argv])
    yield root
    sys.modules.pop("helper", None)


def test_a_benchmark_is_measured_written_into_a_page_and_grows_old(repository, tmp_path):
    out = tmp_path / "figures"
    figures.measure("one", ["benchmarks/b.py", "--count", "3"], repository, out)
    measured = json.loads((out / "one.json").read_text())
    rows = [{"name": "a", "error": pytest.approx(0.03702)}]
    assert measured["result"] == {"rows": rows, "0.5": 2}
    assert measured["command"] == "python benchmarks/b.py --count 3"
    assert re.fullmatch("[0-9a-f]{10}", measured["commit"])
    assert re.fullmatch(r"20\d\d-\d\d-\d\d", measured["date"])
    assert "cores" in measured["machine"]
    assert [*measured["code"]] == ["benchmarks/b.py", "benchmarks/helper.py"]

    (out / "one.md").write_text(TEMPLATE)
    page = figures.written(PAGE, out)
    assert page.startswith("Before.\n\n<!-- figures: one -->\n| a |\n|---|\n| 3.70 cm, 2 |\n\n")
    assert page.endswith("<!-- end of figures -->\n\nAfter.\n")
    assert all(measured[key] in page for key in ("command", "commit", "date", "machine"))
    assert figures.written(page, out) == page

    assert figures.aged(page, out, repository) == page
    (repository / "benchmarks" / "unused.py").write_text("1\n")
    assert figures.aged(page, out, repository) == page
    (repository / "benchmarks" / "helper.py").write_text("TWO = 3\n")
    old = figures.aged(page, out, repository)
    assert "Older than their code:** 1 of 2 files" in old
    assert "`benchmarks/helper.py`" in old
    with pytest.raises(SystemExit, match="commit your changes first"):
        figures.measure("one", ["benchmarks/b.py", "--count", "3"], repository, out)


@pytest.mark.parametrize("field", ["two[x]", "one[rows][1]", "one[none]", "one[rows][a]"])
def test_a_figure_that_was_not_measured(field, tmp_path):
    (tmp_path / "one.json").write_text(json.dumps({"result": {"rows": [1]}}))
    (tmp_path / "one.md").write_text(f"{{{field}}}")
    with pytest.raises(SystemExit, match=re.escape(f"there is no figure {field}")):
        figures.written(PAGE, tmp_path)
    with pytest.raises(SystemExit, match="there is no such template"):
        figures.written(PAGE.replace("one", "three"), tmp_path)


def test_pages_have_the_figures_of_their_results():
    used, measured = set(), set()
    for page in figures.pages():
        text = page.read_text(encoding="utf-8")
        assert figures.written(text) == text, "write them: python docs/figures.py write"
        assert text.count("<!-- figures:") == text.count("<!-- end of figures -->")
        used |= {each_result[1] for each_result in figures.BLOCK.finditer(text)}
        assert text.count("<!-- figures:") == len(figures.BLOCK.findall(text))
    for name in used:
        template = figures.Template()
        template.format((figures.FIGURES / f"{name}.md").read_text(encoding="utf-8"))
        measured |= set(template.used)
    assert used == {path.stem for path in figures.FIGURES.glob("*.md")}
    assert measured == {path.stem for path in figures.FIGURES.glob("*.json")}
