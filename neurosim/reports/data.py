"""The dataset's part of the page: rows, commands that were left out, and the effect of cutting."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from neurosim.reports import charts
from neurosim.reports.accuracy import AXES
from neurosim.reports.artefacts import Artefact, Artefacts
from neurosim.reports.page import Block, Picture, Row, Section, Table, Text
from neurosim.training.evaluate import READABLE, UNITS
from tracking.datasets.dataset import MOTOR_INPUTS, Dataset

_MARKERS = ("front", "rear")


def section(artefacts: Artefacts) -> Section:
    """Write the section on the training data."""
    blocks: list[Block] = []
    for place, artefact in enumerate(artefacts.datasets):
        dataset = artefact.content
        blocks += _rows(artefact, dataset)
        blocks += _timing(artefact)
        blocks += _colours(artefact)
        blocks.append(_histograms(artefact, dataset, f"d{place}"))
        if artefact.meta.get("cutting"):
            blocks += _cutting(artefact.name, artefact.meta["cutting"])
    if not artefacts.datasets:
        text = "Not shown: rows, rows that were left out, and the displacements. "
        blocks.append(Text(text + "Add the folder of a dataset to see it.", missing=True))
    return Section("dataset", "The dataset", blocks)


def _rows(artefact: Artefact, dataset: Dataset) -> list[Block]:
    left_out = {reason: count for reason, count in artefact.meta["left_out"].items() if count}
    total = sum(left_out.values())
    moving = np.hypot(*dataset.output_array()[:, :2].T)
    moving = moving[moving > 0.01]
    text = (
        f"{artefact.name}: {len(dataset)} usable rows, one per command, with the inputs "
        f"{', '.join(dataset.inputs)}; {total} commands were left out."
    )
    if len(dataset.within):
        text += f" {len(dataset.within)} poses at instants within commands are there, too."
    if moving.size:
        text += (
            f" Commands that move the robot by more than 1 cm displace it by "
            f"{100 * moving.mean():.1f} cm on average"
        )
        text += " (about 25 cm in the paper)." if dataset.inputs == tuple(MOTOR_INPUTS) else "."
    blocks: list[Block] = [Text(text)]
    blocks += [Text(f"Warning: {warning}.") for warning in artefact.meta.get("warnings", ())]
    if left_out:
        meaning = artefact.meta.get("reasons", {})
        rows = [
            [
                f"{reason}: {meaning[reason]}" if reason in meaning else reason,
                str(count),
                f"{count / (total + len(dataset)):.1%}",
            ]
            for reason, count in left_out.items()
        ]
        blocks.append(
            Table(
                f"{artefact.name}: commands left out, by reason",
                ["reason", "commands", "of all"],
                rows,
            )
        )
    return blocks


def _histograms(artefact: Artefact, dataset: Dataset, prefix: str) -> Row:
    pictures = []
    for name, values in zip(dataset.outputs, dataset.output_array().T, strict=True):
        readable = READABLE[name] * values
        words = (
            f"{AXES[name]} of {len(values)} commands: mean {readable.mean():.1f}, standard "
            f"deviation {readable.std():.1f}, from {readable.min():.1f} to {readable.max():.1f} "
            f"{UNITS[name]}"
        )
        svg = charts.histogram(readable, AXES[name], words, f"{prefix}{name}")
        pictures.append(Picture(svg, f"{artefact.name}: {words}."))
    return Row(pictures)


def _timing(artefact: Artefact) -> list[Block]:
    """Write the alignment of the clocks and the delays of the motors, session by session."""
    sessions: dict[tuple[str, int], dict[str, Mapping[str, Any]]] = {}
    for kind in ("clocks", "motor_delays"):
        for entry in artefact.meta.get(kind, ()):
            sessions.setdefault((entry["recording"], entry["session"]), {})[kind] = entry
    if not sessions:
        return []
    rows = []
    for (recording, session), known in sessions.items():
        clock, delay = known.get("clocks"), known.get("motor_delays")
        joined = drift = late = lag = corrected = "not known"
        if clock is not None:
            by = f"{len(clock['flashes'])} flashes" if clock["flashes"] else "the motion"
            joined = f"{by}, +- {1000 * clock.get('sd', 0.0):.1f} ms"
            drift = f"{1e6 * clock['drift']:.0f} +- {1e6 * clock.get('drift_sd', 0.0):.0f} ppm"
        if delay is not None:
            late = f"{1000 * delay['delay']:.0f} +- {1000 * delay['sd']:.0f} ms"
            lag = f"{1000 * delay['lag']:.0f} ms"
            corrected = "yes" if delay["corrected"] else "no"
        rows.append([f"{recording}, {session}", joined, drift, late, lag, corrected])
    head = ["session", "clock by", "drift", "motors answered after", "their lag", "corrected"]
    note = (
        "Standard deviations. The delay is from a command's time on the robot's clock until the "
        "wheels began to answer; where corrected, displacements count from there."
    )
    return [Table(f"{artefact.name}: clocks and delays", head, rows, note=note)]


def _colours(artefact: Artefact) -> list[Block]:
    """Write the markers' colours as the camera saw them, session by session."""
    rows = [
        [
            f"{seen['recording']}, {seen['session']}",
            *("{colour}: {rgb}, {confidence:.0%}".format_map(seen[m]) for m in _MARKERS),
            "; ".join(sorted(filter(None, {seen[m].get("reason") for m in _MARKERS}))) or "-",
        ]
        for seen in artefact.meta.get("markers", ())
        if all("confidence" in seen.get(m, {}) for m in _MARKERS)
    ]
    if not rows:
        return []
    head = ["session", "front, confidence", "rear, confidence", "reason against it"]
    title = f"{artefact.name}: the markers' colours as the camera saw them"
    return [Table(title, head, rows, words=True)]


def _cutting(name: str, cutting: Mapping[str, Any]) -> list[Block]:
    kinds = {
        "random": "random speeds",
        "equal": "equal speeds, straight",
        "stop": "stop",
    }
    by_kind = [
        [kinds.get(kind, kind), *_fates(counts)] for kind, counts in cutting["by_class"].items()
    ]
    by_duration = [
        [f"{entry['from']:g} to {entry['to']:g} s", *_fates(entry)]
        for entry in cutting.get("by_duration", ())
    ]
    reach = cutting.get("equal_reach", {})
    note = "A command is cut when a light sensor meets the board's perimeter line."
    if "ratio" in reach and "ratio_first" in reach:
        note += (
            f" Straight commands that were completed reach {reach['ratio']:.1%} as far (speed "
            "times duration, on average) as those that were sampled; without sending cut commands "
            f"again it would be {reach['ratio_first']:.1%}."
        )
    head = ["sent", "cut", "completed", "fraction cut"]
    tables: list[Block] = [
        Table(f"{name}: effect of cutting at the lines", ["commands", *head], by_kind, note=note)
    ]
    if by_duration:
        caption = f"{name}: commands cut, by planned duration"
        tables.append(Table(caption, ["duration", *head], by_duration))
    return tables


def _fates(counts: Mapping[str, Any]) -> list[str]:
    sent = counts["sent"]
    return [
        str(sent),
        str(counts["cut"]),
        str(counts["completed"]),
        f"{counts['cut'] / sent:.1%}" if sent else "none sent",
    ]
