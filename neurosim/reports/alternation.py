"""The section on back to reality, Zagal et al. 2004."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from neurosim.base.errors import counted
from neurosim.reports.artefacts import Artefact, Artefacts
from neurosim.reports.page import Block, Picture, Section, Table
from neurosim.reports.svg import INK, drawing, to_svg

#: The groups of controllers for which L3's agreement is shown, in words.
_GROUPS = {
    "compared": "compared by L3",
    "left_out": "of the same round, left out",
    "held_out": "of the next round",
    "neighbours": "neighbours of the best (L2)",
}


def section(artefacts: Artefacts) -> Section | None:
    """Write the section on alternations; None without any."""
    blocks: list[Block] = []
    for place, one in enumerate(artefacts.alternations):
        blocks += [
            _figure_3(one, f"btr{place}"),
            _evaluations(one, f"btr-real{place}"),
            *([_agreement(one)] if any("L3" in cycle for cycle in one.meta["cycles"]) else []),
            _parameters(one),
        ]
        if one.meta["controller"].get("named"):
            blocks.append(_named(one))
    return Section("back-to-reality", "Back to reality", blocks) if blocks else None


def verdict(runs: Sequence[Artefact]) -> str:
    """Return the result of alternations in reality, a sentence for each."""
    sentences = []
    for one in runs:
        start, best = one.meta["start"]["fitness"], one.meta["best"]["fitness"]
        times = one.meta["best"].get("times_start")
        more = "" if times is None else f", {times:.2f} times that"
        sentences.append(
            f"In reality the controller went from a fitness of {start:.3g} to {best:.3g}{more}, "
            f"in {counted(one.meta['trials'], 'trial')}."
        )
    return " ".join(sentences)


def _figure_3(one: Artefact, prefix: str) -> Picture:
    """Draw the four panels of the paper's Figure 3."""
    cycles = one.meta["cycles"]
    label = (
        f"{one.name}: controllers in the simulator, its discrepancy from reality, learning in "
        "reality, and controllers in the adapted simulator"
    )
    with drawing(9.0, 5.6, nrows=2, ncols=2) as (figure, axes):
        first, *later = [cycle.get("L1", {}) for cycle in cycles] or [{}]
        _curves(axes[0, 0], [first], "Controllers in the simulator (L1)", "fitness", "generation")
        l3 = [cycle["L3"] for cycle in cycles if "L3" in cycle]
        tracked = any("poses" in one.get("compared", {}).get("after", {}) for one in l3)
        what = "difference of paths, m" if tracked else "norm"
        history = [one["history"] for one in l3]
        _curves(axes[0, 1], history, "Its discrepancy from reality (L3)", what, "generation")
        learned = [cycle["L2"] for cycle in cycles if "L2" in cycle]
        _curves(axes[1, 0], learned, "Learning in reality (L2)", "fitness", "step")
        back = f"Back in the {'adapted ' * bool(l3)}simulator (L1)"
        _curves(axes[1, 1], later, back, "fitness", "generation")
        svg = to_svg(figure, label, prefix)
    caption = (
        "As Figure 3 of Zagal et al. 2004: the best of each generation or step, and the mean "
        "(dashed); L2's last step is the policy that it came to. Where there were several cycles "
        "they follow each other, with a line between."
    )
    return Picture(svg, caption, wide=True)


def _curves(
    axes: Axes, runs: Sequence[Mapping[str, Any]], title: str, what: str, unit: str
) -> None:
    axes.set_title(title)
    axes.set(xlabel=unit, ylabel=what)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    begin = 0
    for run in runs:
        best = run.get("best", [])
        if not best:
            continue
        if begin:
            axes.axvline(begin + 0.5, color=INK["muted"], lw=0.7)
        number = begin + 1 + np.arange(len(best))
        marker = "o" if len(best) < 8 else None
        axes.plot(number, best, color=INK["predicted"], marker=marker, ms=3)
        axes.plot(number, run["mean"], color=INK["actual"], ls=(0, (5, 2)), marker=marker, ms=3)
        begin += len(best)
    if not begin:
        axes.text(0.5, 0.5, "there was none", transform=axes.transAxes, ha="center")
        return
    axes.set_xlim(0, begin + 1)
    _from_zero(axes)


def _from_zero(axes: Axes) -> None:
    """Begin the axis of fitness at 0, unless there are negative ones."""
    if axes.dataLim.ymin >= 0.0:
        axes.set_ylim(bottom=0)


def _evaluations(one: Artefact, prefix: str) -> Picture:
    """Draw every evaluation in reality, in their order."""
    real = np.array(one.meta["real"], float)
    number = 1 + np.arange(len(real))
    label = f"{one.name}: each evaluation in reality, and the accepted best"
    with drawing(9.0, 2.6) as (figure, axes):
        axes.plot(number, real, "o", ms=3, mew=0, color=INK["actual"])
        axes.plot(number, np.array(one.meta["believed"], float), color=INK["predicted"])
        axes.axhline(one.meta["start"]["fitness"], color=INK["muted"], lw=0.8)
        axes.set(xlabel="evaluation in reality", ylabel="fitness")
        _from_zero(axes)
        svg = to_svg(figure, label, prefix)
    trials = one.meta["settings"].get("trials", 1)
    return Picture(
        svg,
        f"{label}. An evaluation is {counted(trials, 'trial')}; a dot is the mean of all "
        "trials that its controller had till then. The grey line is what was started from.",
        wide=True,
    )


def _agreement(one: Artefact) -> Table:
    each = {
        f"cycle {number}, {words}": cycle["L3"][name]
        for number, cycle in enumerate(one.meta["cycles"], 1)
        for name, words in _GROUPS.items()
        if name in cycle.get("L3", {})
    }
    measures = {"norm": "norm", "median": "median", "rank": "rank correlation"}
    if any("poses" in agreement["after"] for agreement in each.values()):
        measures["poses"] = "difference of paths, m"
    rows = []
    for words, agreement in each.items():
        values = [agreement[when].get(name) for name in measures for when in ("before", "after")]
        cells = ["-" if value is None else f"{value:.3f}" for value in values]
        rows.append([words, str(agreement["individuals"]), *cells])
    return Table(
        f"{one.name}: fitness in the simulator against reality, before and after L3",
        ["controllers", "number", *("before", "after") * len(measures)],
        rows,
        groups=[("", 1), *((words, 2) for words in measures.values())],
        note="Norm and median of the absolute differences in fitness; rank correlation is "
        "Spearman's. Controllers of the next round and neighbours were not seen by L3. If the "
        "controllers were evolved in several random parameter sets, the fitness in the simulator "
        "is a mean over such sets.",
    )


def _parameters(one: Artefact) -> Table:
    adapted = [cycle["L3"]["parameters"][0] for cycle in one.meta["cycles"] if "L3" in cycle]
    rows = []
    for parameter in one.meta["parameters"]:
        name, unit = parameter["name"], parameter["unit"]
        rows.append(
            [
                f"{name}, {unit}" if unit else name,
                f"{parameter['low']:g} to {parameter['high']:g}",
                f"{parameter['before']:.3g}",
                *(f"{each[name]:.3g}" for each in adapted),
            ]
        )
    head = ["parameter", "bounds", "before", *(f"cycle {n + 1}" for n in range(len(adapted)))]
    return Table(f"{one.name}: parameters of the simulator", head, rows)


def _named(one: Artefact) -> Table:
    rows = [[name, f"{value:.4g}"] for name, value in one.meta["controller"]["named"].items()]
    return Table(f"{one.name}: the best controller", ["parameter", "value"], rows, folded=True)
