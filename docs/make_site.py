"""Build the site: python docs/make_site.py, or make docs.

The pages stay where they are, and the README is the first one. This script copies them to
build/docs, with links that work in the site, and adds the notebooks and the reference. Zensical
makes site/ of these. The navigation is that of docs/index.md. A broken link is an error.
"""

from __future__ import annotations

import base64
import importlib.util
import json
import posixpath
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
import figures
import reference

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r"(?<=\]\()(?!https?:|mailto:|#)([^)#\s]+)((?:#[^)\s]*)?)(?=\))")
FENCE = re.compile(r"(^```.*?^```[^\n]*\n)", flags=re.DOTALL | re.MULTILINE)


class Pages:
    """The pages of the site, written below a folder."""

    def __init__(self, out: Path):
        self.out = out
        self._added: set[str] = set()
        self._waiting: list[str] = []

    def add(self, path: str) -> str:
        """Take a file or folder of the repository into the site; return its path there."""
        if path not in self._added:
            self._added.add(path)
            self._waiting.append(path)
        return place(path)

    def write(self) -> None:
        """Write everything that was added, and all that it links to."""
        while self._waiting:
            path = self._waiting.pop()
            source, target = ROOT / path, self.out / place(path)
            target.parent.mkdir(parents=True, exist_ok=True)
            if source.is_dir():
                target.write_text(self._listing(path), encoding="utf-8")
            elif source.suffix == ".md":
                text = figures.aged(source.read_text(encoding="utf-8"))
                self.page(target, self.linked(text, path))
            elif source.suffix == ".ipynb":
                self.page(target, notebook(source, target, partial(self.linked, path=path)))
            elif target.suffix == ".md":
                self.page(target, hidden(path) + fenced(source.read_text(encoding="utf-8"), path))
            else:
                shutil.copyfile(source, target)

    def page(self, target: Path, text: str) -> None:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(text, encoding="utf-8")

    def linked(self, text: str, path: str) -> str:
        """Return a page of the repository with links to places in the site."""
        parts = FENCE.split(text)
        parts[::2] = [
            LINK.sub(lambda link: self._to(link[1], path) + link[2], part) for part in parts[::2]
        ]
        return "".join(parts)

    def _to(self, link: str, path: str) -> str:
        target = posixpath.normpath(PurePosixPath(path).parent / link)
        if not (ROOT / target).exists():
            raise SystemExit(f"{path}: the link {link} leads nowhere")
        return posixpath.relpath(self.add(target), PurePosixPath(place(path)).parent)

    def _listing(self, path: str) -> str:
        here, lines = PurePosixPath(place(path)).parent, []
        for each in sorted((ROOT / path).rglob("*")):
            if each.is_file() and "__pycache__" not in each.parts:
                to = self.add(each.relative_to(ROOT).as_posix())
                name = each.relative_to(ROOT / path).as_posix()
                lines.append(f"- [{name}]({posixpath.relpath(to, here)})\n")
        return hidden(path) + "".join(lines)


def place(path: str) -> str:
    """Return where a file or folder of the repository is in the site."""
    folder, name = posixpath.split(path)
    if path in ("README.md", "docs/index.md"):
        return "index.md" if path == "README.md" else "pages.md"
    if folder == "docs":
        return name
    if name.endswith(".ipynb"):
        return f"tutorials/{name.removesuffix('.ipynb')}.md"
    if (ROOT / path).is_dir():
        return f"source/{path}/index.md"
    return f"source/{path}" if name.endswith((".md", ".png", ".svg")) else f"source/{path}.md"


def hidden(title: str) -> str:
    """Return the head of a page that the search leaves out."""
    return f"---\nsearch:\n  exclude: true\n---\n\n# {title}\n\n"


def fenced(text: str, name: str = "") -> str:
    """Return a text as a block of code."""
    fence = "`" * max([3, *(len(ticks) + 1 for ticks in re.findall("`{3,}", text))])
    language = {".py": "python", ".ino": "cpp", ".json": "json", ".toml": "toml"}
    return f"{fence}{language.get(Path(name).suffix, 'text')}\n{text.rstrip()}\n{fence}\n"


def notebook(source: Path, target: Path, linked: Callable[[str], str] = str) -> str:
    """Return a notebook as Markdown, with its outputs; write it and its pictures next to the page.

    Args:
        source: the notebook.
        target: its page.
        linked: function that gives a text with links that work in the site.
    """
    text, pictures = "", 0
    for cell in json.loads(source.read_text(encoding="utf-8"))["cells"]:
        content = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            text += linked(content) + "\n\n"
            continue
        text += fenced(content, "cell.py") + "\n"
        for output in cell["outputs"]:
            data = output.get("data", {})
            kind = next((each for each in ("png", "jpeg") if f"image/{each}" in data), None)
            if kind is not None:
                pictures += 1
                picture = target.with_name(f"{target.stem}-{pictures}.{kind}")
                picture.write_bytes(base64.b64decode(data[f"image/{kind}"]))
                text += f"![output {pictures}]({picture.name})\n\n"
            elif "text/html" in data:
                table = re.search(r"<table.*</table>", "".join(data["text/html"]), re.DOTALL)
                text += f"{table.group() if table else ''}\n\n"
            else:
                shown = output.get("text", data.get("text/plain", ""))
                text += fenced("".join(shown)) + "\n"
    shutil.copyfile(source, target.with_suffix(".ipynb"))
    title, _, rest = text.partition("\n")
    return f"{title}\n\n[Download this notebook]({target.stem}.ipynb) to run it.\n{rest}"


def gallery(out: Path) -> str:
    """Return a page of all pictures of the README and the notebooks, which are written to a folder.

    Each picture of a notebook links to it.
    """
    text = "# Gallery\n\n![A drive and its prediction](drive.webp)\n\n"
    for page in sorted((out / "tutorials").glob("*.md")):
        title = page.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")
        text += f"## {title}\n\n"
        pictures = {
            int(path.stem.rpartition("-")[2]): path for path in page.parent.glob(f"{page.stem}-*.*")
        }
        for number in sorted(pictures):
            shown = f"![picture {number}](tutorials/{pictures[number].name}){{ width=420 }}"
            text += f"[{shown}](tutorials/{page.name})\n"
        text += "\n"
    return text


def navigation(pages: Pages) -> list[dict[str, Any]]:
    """Return the sections and pages that docs/index.md lists, for Zensical."""
    sections: list[dict[str, Any]] = [{"Home": pages.add("README.md")}]
    added = {"Results": {"Gallery": "gallery.md"}, "Project": {"All pages": "pages.md"}}
    text = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    for section in re.split(r"^## ", text, flags=re.MULTILINE)[1:]:
        title, _, items = section.partition("\n")
        links = re.findall(r"^- \[([^\]]+)\]\(([^)]+)\)", items, flags=re.MULTILINE)
        listed = [
            {name: pages.add(posixpath.normpath(PurePosixPath("docs") / to))} for name, to in links
        ]
        if title == "Reference":
            listed += generated(pages)
        listed += [added[title]] if title in added else []
        sections.append({title: listed if len(listed) > 1 else next(iter(listed[0].values()))})
    return sections


def generated(pages: Pages) -> list[dict[str, Any]]:
    """Write the pages of the reference; return their navigation."""
    listed: list[dict[str, Any]] = []
    for title, made in (
        ("Keys of the JSON files", reference.files()),
        ("Commands", reference.commands()),
        ("Errors", reference.errors()),
        ("Python", reference.python()),
    ):
        for path, text in made.items():
            pages.page(pages.out / path, text)
        below = [{text.partition("\n")[0].removeprefix("# "): path} for path, text in made.items()]
        listed.append(below[0] if len(below) == 1 else {title: below})
    return listed


def main(site: Path = ROOT / "site", build: Path = ROOT / "build" / "docs") -> None:
    """Build the site, whole or not at all.

    Args:
        site: its folder, which is replaced.
        build: folder for the pages that it is made of.
    """
    missing = [name for name in ("zensical", "mkdocstrings") if not importlib.util.find_spec(name)]
    if missing:
        raise SystemExit(f"the site needs {' and '.join(missing)}: pip install 'neurosim[docs]'")
    shutil.rmtree(build, ignore_errors=True)
    pages = Pages(build / "pages")
    nav = navigation(pages)
    pages.add("docs/index.md")
    pages.add("docs/site.css")
    pages.write()
    pages.page(pages.out / "gallery.md", gallery(pages.out))
    python = {
        "paths": [str(ROOT)],
        "options": {"extensions": [str(ROOT / "docs" / "docstrings.py")]},
    }
    settings = {
        "INHERIT": str(ROOT / "docs" / "site.yml"),
        "docs_dir": pages.out.name,
        "nav": nav,
        "plugins": {"mkdocstrings": {"handlers": {"python": python}}},
    }
    config = build / "site.yml"
    config.write_text(json.dumps(settings, indent=1), encoding="utf-8")
    command = [sys.executable, "-m", "zensical", "build", "--strict", "--clean", "-f", str(config)]
    if subprocess.run(command, cwd=ROOT).returncode:
        raise SystemExit("the site was not built: see the messages above")
    shutil.rmtree(site, ignore_errors=True)
    shutil.move(build / "site", site)
    print(f"{site / 'index.html'}")


if __name__ == "__main__":
    main()
