"""Figures of the pages, measured by benchmarks.

    python docs/figures.py                                          list those older than their code
    python docs/figures.py measure NAME benchmarks/FILE.py [OPTIONS]
    python docs/figures.py write                                    write them into the pages

``measure`` runs a benchmark with ``--json``. It keeps the result in ``docs/figures/NAME.json``,
with date, commit, command, machine, and the SHA-256 of each file of code that the benchmark loaded,
without its comments and docstrings.
``docs/figures/NAME.md`` is a template. ``{several_objects[rows][0][two_near]:.3f}`` is a figure of
``several_objects.json``; ``:.1f*100`` multiplies it by 100. A page has the template's place::

    <!-- figures: NAME -->
    <!-- end of figures -->
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import hashlib
import io
import json
import os
import platform
import re
import runpy
import string
import subprocess
import sys
import tokenize
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

from neurosim.base.files import write_text

ROOT = Path(__file__).resolve().parents[1]
FIGURES = ROOT / "docs" / "figures"
BLOCK = re.compile(
    r"(?<=^<!-- figures: )([\w-]+)( -->\n)(.*?)(?=^<!-- end of figures -->$)",
    flags=re.DOTALL | re.MULTILINE,
)


# Measuring


def measure(name: str, words: Sequence[str], root: Path = ROOT, out: Path = FIGURES) -> None:
    """Run a benchmark with ``--json``, and keep what it printed.

    Args:
        name: of the result.
        words: the benchmark's file, relative to ``root``, and its options.
        root: the repository. It must be as it was committed.
        out: folder of the results.
    """
    if git(root, "status", "--porcelain", "--untracked-files=no"):
        raise SystemExit("commit your changes first: figures have the commit of their code")
    about = {
        "command": " ".join(["python", *words]),
        "commit": git(root, "rev-parse", "--short=10", "HEAD"),
        "date": datetime.now(UTC).date().isoformat(),
        "machine": machine(),
    }
    printed, script = io.StringIO(), root / words[0]
    sys.path.insert(0, str(script.parent))
    sys.argv = [str(script), *words[1:], "--json"]
    with contextlib.redirect_stdout(printed), contextlib.chdir(root):
        runpy.run_path(str(script), run_name="__main__")
    about["code"] = {path: digest(root / path) for path in loaded(root, script)}
    about["result"] = json.loads(printed.getvalue())
    out.mkdir(parents=True, exist_ok=True)
    write_text(out / f"{name}.json", json.dumps(about, indent=1) + "\n")


def git(root: Path, *words: str) -> str:
    done = subprocess.run(["git", *words], cwd=root, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"git {words[0]}: {done.stderr.strip()}")
    return done.stdout.strip()


def machine() -> str:
    """Return the system, the processor and Python's version."""
    known = Path("/proc/cpuinfo")
    text = known.read_text(encoding="utf-8") if known.exists() else ""
    model = re.search(r"^model name\s*: (.*)$", text, flags=re.MULTILINE)
    processor = model[1] if model else platform.processor() or platform.machine()
    system, python = platform.system(), platform.python_version()
    return f"{system}, {os.cpu_count()} cores ({processor}), Python {python}"


def loaded(root: Path, script: Path) -> list[str]:
    """Return the files of code below a folder that this process has loaded, and a script."""
    files = [getattr(module, "__file__", None) for module in list(sys.modules.values())]
    paths = {Path(file).resolve() for file in files if file} | {script.resolve()}
    paths.discard(Path(__file__).resolve())
    below = [path.relative_to(root) for path in paths if path.is_relative_to(root)]
    return sorted(path.as_posix() for path in below if not path.parts[0].startswith("."))


def digest(path: Path) -> str:
    """Return the first digits of the SHA-256 of a file's code; nothing: there is no file."""
    if not path.is_file():
        return ""
    return hashlib.sha256(bare(path.read_text(encoding="utf-8")).encode()).hexdigest()[:16]


@cache
def bare(source: str) -> str:
    """Return Python code without comments, docstrings and blank lines."""
    lines, left_out = source.splitlines(), set()
    for node in ast.walk(ast.parse(source)):
        documented = isinstance(
            node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
        )
        if documented and ast.get_docstring(node) is not None:
            first = node.body[0]
            left_out |= set(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][:column]
    return "\n".join(
        line.rstrip() for n, line in enumerate(lines, 1) if n not in left_out and line.strip()
    )


def changed(measured: Mapping[str, Any], root: Path = ROOT) -> list[str]:
    """Return the files of code that are not as they were when figures were measured."""
    return [path for path, known in measured["code"].items() if digest(root / path) != known]


# Writing


class Template(string.Formatter):
    """Writes the figures of a folder into templates; knows which results it used."""

    def __init__(self, folder: Path = FIGURES):
        self._folder = folder
        self.used: dict[str, dict[str, Any]] = {}

    def get_field(self, field_name: str, args: Any, kwargs: Any) -> tuple[Any, str]:
        name, *keys = re.findall(r"[^\[\]]+", field_name)
        try:
            if name not in self.used:
                path = self._folder / f"{name}.json"
                self.used[name] = json.loads(path.read_text(encoding="utf-8"))
            value = self.used[name]["result"]
            for key in keys:
                value = value[int(key) if isinstance(value, list) else key]
        except (OSError, LookupError, TypeError, ValueError) as error:
            raise SystemExit(f"{self._folder}: there is no figure {field_name}: {error}") from None
        return value, name

    def format_field(self, value: Any, format_spec: str) -> str:
        spec, _, factor = format_spec.partition("*")
        return format(value * float(factor) if factor else value, spec)


def block(name: str, folder: Path = FIGURES) -> str:
    """Return the text of a template, with its figures and how they were measured."""
    template, path = Template(folder), folder / f"{name}.md"
    if not path.exists():
        raise SystemExit(f"{path}: there is no such template")
    text = template.format(path.read_text(encoding="utf-8")).strip()
    for one in template.used.values():
        text += (
            f"\n\n*Measured on {one['date']}, commit {one['commit']}: `{one['command']}`. "
            f"{one['machine']}.*"
        )
    return text + "\n"


def written(text: str, folder: Path = FIGURES) -> str:
    """Return a page with its figures."""
    return BLOCK.sub(lambda match: match[1] + match[2] + block(match[1], folder), text)


def aged(text: str, folder: Path = FIGURES, root: Path = ROOT) -> str:
    """Return a page that says below its figures if they are older than their code."""

    def noted(match: re.Match[str]) -> str:
        template = Template(folder)
        template.format((folder / f"{match[1]}.md").read_text(encoding="utf-8"))
        notes = [note for one in template.used.values() for note in age(one, root)]
        return "".join([match[0], *(f"\n**Older than their code:** {note}.\n" for note in notes)])

    return BLOCK.sub(noted, text)


def age(measured: Mapping[str, Any], root: Path = ROOT) -> Iterator[str]:
    """Give a note if figures are older than their code."""
    if files := changed(measured, root):
        yield (
            f"{len(files)} of {len(measured['code'])} files of `{measured['command']}` have "
            f"changed since, `{files[0]}` among them"
        )


def pages() -> list[Path]:
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    actions = parser.add_subparsers(dest="action")
    actions.add_parser("write")
    measuring = actions.add_parser("measure")
    measuring.add_argument("name")
    measuring.add_argument(
        "words", nargs=argparse.REMAINDER, metavar="benchmarks/FILE.py [OPTIONS]"
    )
    options = parser.parse_args()
    if options.action == "measure":
        measure(options.name, options.words)
    elif options.action == "write":
        for page in pages():
            text = page.read_text(encoding="utf-8")
            if (new := written(text)) != text:
                write_text(page, new)
    else:
        for path in sorted(FIGURES.glob("*.json")):
            for note in age(json.loads(path.read_text(encoding="utf-8"))):
                print(f"{path.stem}: {note}")


if __name__ == "__main__":
    main()
