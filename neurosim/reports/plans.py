"""The controllers' part of the page: what was evolved, and how."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from neurosim.reports import charts
from neurosim.reports.artefacts import Artefact, Artefacts
from neurosim.reports.course import course
from neurosim.reports.page import Block, Picture, Row, Section, Table

#: More plans than this are drawn no longer one by one.
MOST_DRAWN = 24


def section(artefacts: Artefacts) -> Section | None:
    """Write the section on the evolved plans; None without controllers."""
    if not artefacts.controllers:
        return None
    head = [
        "controller",
        "commands given",
        "null commands",
        "fitness predicted",
        "completes",
        "probability of completing",
    ]
    rows = []
    for controller in artefacts.controllers:
        commands = controller.meta["commands"]
        given = [command for command in commands if command is not None]
        predicted = controller.meta["predicted"]
        chance = predicted.get("probability")
        rows.append(
            [
                controller.name,
                str(len(given)),
                str(len(commands) - len(given)),
                _figure(predicted.get("fitness")),
                "yes" if predicted.get("completes") else "no",
                "not told" if chance is None else f"{chance:.1%}",
            ]
        )
    blocks: list[Block] = [Table("Plans, as the simulator predicts them", head, rows)]
    pictures = [*_evolution(artefacts.controllers)]
    if not artefacts.trials:
        drawn = artefacts.controllers[:MOST_DRAWN]
        pictures += [_course(controller, f"p{place}") for place, controller in enumerate(drawn)]
    if pictures:
        blocks.append(Row(pictures))
    return Section("plans", "The evolved plans", blocks)


def history(meta: Mapping[str, Any]) -> dict[str, list[float]]:
    """Return the fitness per generation that a controller's JSON holds: ``best``, ``mean``."""
    found = meta.get("evolution", {}).get("history") or {}
    return {name: found[name] for name in ("best", "mean") if found.get(name)}


def _evolution(controllers: Sequence[Artefact]) -> list[Picture]:
    histories = {
        controller.name: history(controller.meta)
        for controller in controllers
        if "best" in history(controller.meta)
    }
    if not histories:
        return []
    generations = max(len(lines["best"]) for lines in histories.values())
    words = f"fitness of the best plan so far over {generations} generations"
    if len(histories) > 1:
        lines = [lines["best"] for lines in histories.values()]
        svg = charts.fan(lines, "best fitness", words, "pf", x_axis="generation")
        more = f", {len(lines)} plans: each thin, their median bold"
    else:
        (only,) = histories.values()
        lines = {name: (range(1, len(line) + 1), line) for name, line in only.items()}
        svg = charts.curves(lines, "fitness", words, "pf", log=False)
        more = ", and the population's mean" if "mean" in only else ""
    return [
        Picture(
            svg,
            f"Evolution: {words}{more} (equation 2; 64 less a tenth per command "
            "that gains nothing completes the course).",
        )
    ]


def _course(controller: Artefact, prefix: str) -> Picture:
    predicted = controller.meta["predicted"]
    poses = predicted["poses"]
    words = f"{controller.name}: predicted path over the course"
    svg = course(
        controller.meta["task"], poses, [None] * len(poses), [], words, prefix,
        rest=predicted.get("rest"),
    )  # fmt: skip
    return Picture(svg, f"{words}; no trial was given to compare it with.")


def _figure(value: Any) -> str:
    return "unknown" if value is None else f"{value:.4g}"
