"""The origin of every number of the page: files, checksums, settings, versions, seeds, dates."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping
from importlib import metadata
from typing import Any

from neurosim.reports.artefacts import Artefact, Artefacts, files_of
from neurosim.reports.page import Block, Section, Table

#: Keys of the content itself, or of values elsewhere on the page.
_CONTENT = {
    "format", "version", "history", "cutting", "reasons", "left_out", "commands", "predicted",
    "actual", "errors", "inputs", "outputs", "units", "sources", "source",
}  # fmt: skip
_LONGEST = 600


def section(artefacts: Artefacts) -> Section:
    """Write the section on the origin of the numbers."""
    blocks: list[Block] = [_files(artefacts)]
    for artefact in artefacts.everything:
        rows = _settings(artefact)
        if rows:
            blocks.append(
                Table(
                    f"{artefact.kind} {artefact.name}: settings, seeds, versions and dates",
                    ["what", "value"],
                    rows,
                    folded=True,
                    words=True,
                )
            )
    return Section("provenance", "Where every number came from", blocks)


def versions() -> str:
    """Return the versions of the programs that make this page."""
    parts = [f"Python {platform.python_version()}"]
    for name in ("neurosim", "numpy", "torch", "matplotlib"):
        try:
            parts.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            continue
    return ", ".join(parts)


def _files(artefacts: Artefacts) -> Table:
    rows = []
    for artefact in artefacts.everything:
        for name, digest in files_of(artefact).items():
            rows.append([f"{artefact.name}/{name}", artefact.kind, digest])
        for path, digest in _sources(artefact):
            rows.append([path, f"source of {artefact.kind} {artefact.name}", digest])
    return Table(
        "Files and their SHA-256",
        ["file", "of", "SHA-256"],
        rows,
        words=True,
        folded=len(rows) > 40,
        note="A number on this page is from these files; the same sums, the same numbers.",
    )


def _sources(artefact: Artefact) -> list[tuple[str, str]]:
    """Return path and SHA-256 of an artefact's sources."""
    meta = artefact.meta
    named = list(meta.get("sources") or [])
    for key in ("source", "simulator", "controller"):
        named += [meta[key]] if isinstance(meta.get(key), dict) else []
    return [
        (str(entry.get("path") or entry.get("name") or entry.get("dataset") or ""), entry["sha256"])
        for entry in named
        if isinstance(entry.get("sha256"), str)
    ]


def _settings(artefact: Artefact) -> list[list[str]]:
    # A trial is a recording, too: robot, camera and sessions are in the recording's JSON.
    meta = {**artefact.recording, **artefact.meta}
    rows: list[list[str]] = []
    for key, value in meta.items():
        if key not in _CONTENT:
            _flatten(key, value, rows)
    return rows


def _flatten(name: str, value: Any, rows: list[list[str]], depth: int = 0) -> None:
    if isinstance(value, Mapping) and value and depth < 2:
        for key, part in value.items():
            if key not in _CONTENT:
                _flatten(f"{name}: {key}", part, rows, depth + 1)
        return
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    if text in ("null", "{}", "[]"):
        return
    if len(text) > _LONGEST:
        text = f"{text[:_LONGEST]} ... ({len(text)} characters in the file)"
    rows.append([name, text])
