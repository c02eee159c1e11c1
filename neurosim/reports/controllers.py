"""The controllers' part of the page: their evolution and their predictions."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from neurosim.base.errors import FileError, counted
from neurosim.base.files import sha256
from neurosim.loop.objectives import TIE
from neurosim.loop.unmet import Unmet
from neurosim.reports.artefacts import Artefact, Artefacts
from neurosim.reports.charts import ragged
from neurosim.reports.course import Paths, Scene, course, draw_scene, unit_of
from neurosim.reports.page import Block, Picture, Row, Section, Table, Text
from neurosim.reports.svg import INK, drawing, to_svg

#: Largest number of controllers that are drawn one by one.
MOST_DRAWN = 24
#: The value in histories for each objective other than the fitness.
_SHOWN = {
    "progress": "graded progress",
    "probability": f"probability of success + fitness / {1 / TIE:,.0f}",
}


def section(artefacts: Artefacts) -> Section | None:
    """Write the section on the controllers; None without any."""
    controllers = artefacts.controllers
    if not controllers:
        return None
    blocks: list[Block] = [
        _predictions(controllers),
        _tasks(controllers),
        *unknown_tasks(controllers),
    ]
    unmet = [(one.name, _unmet(one)) for one in controllers]
    blocks += [Text(f"{name}: {each}") for name, each in unmet if each and each.worse]
    pictures = [*_evolutions(controllers), *_paths(artefacts)]
    if pictures:
        blocks.append(Row(pictures))
    driven = [(one, drives) for one in controllers if (drives := trajectories(one))]
    blocks += [
        Row(
            [
                _trajectories(one, artefacts.place_of(one), f"tj{n}-{k}", k, drive)
                for k, drive in enumerate(drives)
            ]
        )
        for n, (one, drives) in enumerate(driven[:MOST_DRAWN])
    ]
    return Section("controllers", "The controllers", blocks)


def unknown_tasks(artefacts: Sequence[Artefact]) -> list[Text]:
    """Return a sentence on each task that is not registered here."""
    names = dict.fromkeys(one.meta["task"]["name"] for one in artefacts if one.task is None)
    return [
        Text(
            f"The task {name} is not registered on this computer, so its outline is not shown; "
            "install the package that offers it."
        )
        for name in names
    ]


def verdict(controllers: Sequence[Artefact]) -> str:
    """Return the simulators' predictions for controllers, in a sentence or two for each task."""
    sentences = []
    groups = by_task(controllers)
    for group in groups:
        fitness = [
            value for one in group if (value := one.meta["predicted"].get("fitness")) is not None
        ]
        if not fitness:
            continue
        task = group[0].task
        most = None if task is None else task.highest_fitness
        of = "" if most is None else f" of at most {most:.4g}"
        at = f"At {group[0].meta['task']['name']}, " if len(groups) > 1 else ""
        if len(fitness) == 1:
            text = f"{at}the controller reaches a fitness of {fitness[0]:.4g}{of} in the simulator"
            chance = group[0].meta["predicted"].get("probability")
            if chance is not None:
                text += f", and succeeds with a probability of {100 * chance:.0f} %"
        else:
            text = (
                f"{at}{len(fitness)} controllers reach a fitness of {np.mean(fitness):.4g}{of} in "
                f"the simulator on average ({min(fitness):.4g} to {max(fitness):.4g})"
            )
        sentences.append(f"{text[0].upper()}{text[1:]}.")
    changes = [change for one in controllers if (change := change_at_transfer(one)) is not None]
    if changes:
        sentences.append(
            "At the transfer to the robot the best of the population changed by "
            f"{100 * np.mean(changes):+.1f} % of its fitness{' on average' * (len(changes) > 1)}, "
            "in single trials of generations that follow each other."
        )
    drives = [drive for one in controllers for drive in trajectories(one)]
    if drives:
        apart = np.median([_apart(drive) for drive in drives])
        sentences.append(
            f"From the same start its path there is {100 * apart:.1f} cm off (median)."
        )
    return " ".join(sentences)


def by_task(controllers: Sequence[Artefact]) -> list[list[Artefact]]:
    """Return controllers in groups of the same task and settings."""
    groups: dict[str, list[Artefact]] = {}
    for one in controllers:
        groups.setdefault(_key(one), []).append(one)
    return list(groups.values())


def history(controller: Artefact) -> dict[str, Any]:
    """Return the history of a controller's generations from its file.

    ``best`` and ``mean`` of each; if they exist, ``robust_best`` and ``robust_mean`` of robust
    evolution, and ``transfer``, the number of generations before those on the robot.

    Raises:
        FileError: if the history is wrong.
    """
    recorded = controller.meta["evolution"].get("history", {})
    lines: dict[str, Any] = {}
    wrong = recorded.get("transfer", 0) > len(recorded.get("best", ()))
    for prefix in ("", "robust_"):
        names = [prefix + name for name in ("best", "mean") if recorded.get(prefix + name)]
        lines |= {name: np.array(recorded[name], float) for name in names}
        wrong |= len({len(recorded[name]) for name in names}) > 1 or names == [prefix + "mean"]
    if wrong:
        raise FileError(
            controller.json, "expected best and mean of every generation", field="evolution.history"
        )
    if "transfer" in recorded:
        lines["transfer"] = recorded["transfer"]
    return lines


def trajectories(controller: Artefact) -> list[dict[str, NDArray[np.float64]]]:
    """Return drives from the same starts, {"simulated", "robot"}: poses [T + 1, 3] each."""
    return [
        {side: np.array(drive[side], float).reshape(-1, 3) for side in ("simulated", "robot")}
        for drive in controller.meta["evolution"].get("trajectories", ())
    ]


def change_at_transfer(controller: Artefact) -> float | None:
    """Return the change of the population's best from simulator to robot, as a fraction of it."""
    lines = history(controller)
    transfer, best = lines.get("transfer"), lines.get("best", ())
    # Of a fitness that is not above 0 there is no fraction.
    if transfer is None or transfer >= len(best) or best[transfer - 1] <= 0:
        return None
    return float(best[transfer] / best[transfer - 1] - 1.0)


def _key(controller: Artefact) -> str:
    task = controller.meta["task"]
    return json.dumps([task["name"], task.get("settings")], sort_keys=True)


def _predictions(controllers: Sequence[Artefact]) -> Table:
    """Write the table of predicted figures, without empty columns."""
    columns: dict[str, Callable[[Artefact], str]] = {
        "kind": lambda one: one.content.kind,
        "size": _size,
        "fitness predicted": lambda one: _figure(one, "fitness"),
        "spread of a trial": lambda one: _figure(one, "spread"),
        "completes": _completes,
        "probability of success": _chance,
        "unlike what was recorded": _unsupported,
        "touches something in other arenas": _contacts,
        "samples drawn": lambda one: _figure(one, "draws"),
        "generations": _generations,
        "mean at transfer, at the end": _before_and_after,
        "fitness on the robot": _on_robot,
    }
    rows = [[one.name, *(column(one) for column in columns.values())] for one in controllers]
    shown = [0, *(k for k in range(1, len(columns) + 1) if any(row[k] for row in rows))]
    head = ["controller", *columns]
    return Table(
        "Controllers, as their simulators predict them",
        [head[k] for k in shown],
        [[row[k] or "-" for k in shown] for row in rows],
        note=(
            "Completes: whether the path that the simulator expects, without noise, does the "
            "task. Probability: over random samples. Unlike the data: commands that are not near "
            "any of the simulator's data; predictions of them are a guess."
        ),
    )


def _figure(controller: Artefact, name: str) -> str:
    value = controller.meta["predicted"].get(name)
    return "" if value is None else f"{value:,}" if isinstance(value, int) else f"{value:.4g}"


def _size(controller: Artefact) -> str:
    saved = controller.content
    if not saved.commands:
        return f"{len(saved.genes)} genes"
    null = len(saved.commands) - len(saved.given)
    return f"{counted(len(saved.given), 'command')}" + (f", {null} null" if null else "")


def _completes(controller: Artefact) -> str:
    completes = controller.meta["predicted"].get("completes")
    return "" if completes is None else "yes" if completes else "no"


def _chance(controller: Artefact) -> str:
    chance = controller.meta["predicted"].get("probability")
    return "" if chance is None else f"{chance:.1%}"


def _unsupported(controller: Artefact) -> str:
    fraction = controller.meta["predicted"].get("unsupported")
    return f"{fraction:.1%} of the time" if fraction else ""


def _contacts(controller: Artefact) -> str:
    unmet = _unmet(controller)
    return "" if unmet is None else f"{unmet.touched} of {unmet.drives} drives"


def _unmet(controller: Artefact) -> Unmet | None:
    unmet = controller.meta["predicted"].get("unmet")
    return None if unmet is None else Unmet(**unmet)


def _generations(controller: Artefact) -> str:
    lines = history(controller)
    counts = [str(len(lines[name])) for name in ("best", "robust_best") if name in lines]
    return " + ".join(counts) + (" robust" if "robust_best" in lines else "")


def _before_and_after(controller: Artefact) -> str:
    lines = history(controller)
    if "transfer" not in lines or "mean" not in lines:
        return ""
    return f"{lines['mean'][lines['transfer'] - 1]:.4g}, {lines['mean'][-1]:.4g}"


def _on_robot(controller: Artefact) -> str:
    fitness = controller.meta["evolution"].get("robot_fitness")
    if fitness is None:
        return ""
    return f"{fitness['mean']:.4g} +- {fitness['spread']:.2g}"


def _tasks(controllers: Sequence[Artefact]) -> Table:
    groups = by_task(controllers)
    rows = []
    for group in groups:
        task = group[0].meta["task"]
        settings = task.get("settings") or {}
        listed = ", ".join(f"{name} {json.dumps(value)}" for name, value in settings.items())
        rows.append([task["name"], listed or "-", ", ".join(one.name for one in group)])
    return Table("Their tasks", ["task", "settings", "controllers"], rows, words=True)


def _evolutions(controllers: Sequence[Artefact]) -> list[Picture]:
    """Draw fitness over generations, of controllers of the same task together."""
    pictures = []
    for prefix, words in (("", "Evolution"), ("robust_", "Robust evolution")):
        groups: dict[tuple[str, str], list[Artefact]] = {}
        for one in controllers:
            if prefix + "best" in history(one):
                groups.setdefault((_key(one), _shown(one, prefix)), []).append(one)
        for place, ((_, shown), group) in enumerate(groups.items()):
            whose = f" for {group[0].meta['task']['name']}" if len(groups) > 1 else ""
            pictures.append(_evolution(group, prefix, shown, words + whose, f"n{prefix}{place}"))
    return pictures


def _shown(controller: Artefact, prefix: str) -> str:
    """Describe a history in words."""
    settings = controller.meta["evolution"].get("settings")
    part = settings if isinstance(settings, dict) else {}
    if prefix:
        part = part.get("robust") if isinstance(part.get("robust"), dict) else {}
    return _SHOWN.get(str(part.get("objective")), "fitness")


def _evolution(group: Sequence[Artefact], prefix: str, shown: str, title: str, ids: str) -> Picture:
    every = [history(one) for one in group]
    transfers = [] if prefix else sorted({one["transfer"] for one in every if "transfer" in one})
    with drawing(6.2, 3.2) as (figure, axes):
        for name, label, ink in (("best", "best", "predicted"), ("mean", "mean", "third")):
            table = ragged([one[prefix + name] for one in every if prefix + name in one])
            if not table.size:
                continue
            number = np.arange(1, table.shape[1] + 1)
            for row in table if len(table) > 1 else ():
                axes.plot(number, row, color=INK[ink], lw=0.6, alpha=0.3)
            axes.plot(
                number, np.nanmean(table, axis=0), color=INK[ink], lw=1.8, label=label,
                marker="o" if len(number) == 1 else None,
            )  # fmt: skip
        for place, transfer in enumerate(transfers):
            axes.axvline(
                transfer + 0.5, color=INK["actual"], ls="--", lw=1.2,
                label=None if place else "onto the robot",
            )  # fmt: skip
        axes.set_xlabel("generation")
        axes.set_ylabel(shown)
        axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
        axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=3, borderaxespad=0)
        label = f"{title}: {shown} of the population's best and its mean over generations"
        svg = to_svg(figure, label, ids)
    runs = "" if len(group) == 1 else f", average of {len(group)} runs (each one thin)"
    after = f"; from generation {transfers[0] + 1} on the robot" if transfers else ""
    return Picture(svg, f"{label}{runs}{after}.")


def _paths(artefacts: Artefacts) -> list[Picture]:
    """Draw the expected paths of controllers without a trial on the page."""
    tried = {trial.meta["controller"].get("sha256") for trial in artefacts.trials}
    pictures = []
    for place, one in enumerate(artefacts.controllers):
        predicted = one.meta["predicted"]
        if not predicted.get("poses") or len(pictures) == MOST_DRAWN or sha256(one.json) in tried:
            continue
        words = f"{one.name}: the path that the simulator expects"
        scene = Scene.of(one.task, artefacts.place_of(one))
        paths = Paths(predicted["poses"], one.content.controller.open_loop, predicted.get("rest"))
        svg = course(scene, paths, words, f"p{place}").svg
        pictures.append(Picture(svg, f"{words}; no trial was given to compare it with."))
    return pictures


def _trajectories(
    controller: Artefact, place: Any, prefix: str, which: int, drive: dict[str, NDArray]
) -> Picture:
    scene = Scene.of(controller.task, place)
    points = np.concatenate([scene.corners(), *(path[:, :2] for path in drive.values())])
    low, high = points.min(axis=0), points.max(axis=0)
    scale, unit = unit_of(low, high)
    aspect = (high[1] - low[1]) / max(high[0] - low[0], 1e-3)
    with drawing(6.0, float(np.clip(5.4 * aspect, 2.0, 6.0)) + 0.7) as (figure, axes):
        draw_scene(axes, scene, scale)
        axes.grid(visible=not len(scene.corners()))
        for name, ink, style in (("simulated", "predicted", "--"), ("robot", "actual", "-")):
            x, y = scale * drive[name][:, :2].T
            axes.plot(x, y, color=INK[ink], ls=style, lw=1.4, label=name)
        x, y = scale * drive["robot"][0, :2]
        axes.plot(x, y, "o", ms=5, mfc=INK["paper"], mec=INK["ink"])
        axes.set(aspect="equal", xlabel=f"x, {unit}", ylabel=f"y, {unit}")
        axes.margins(0.03)
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, borderaxespad=0)
        label = f"{controller.name}: the same controller in the simulator and on the robot"
        svg = to_svg(figure, label, prefix)
    return Picture(
        svg, f"{label}, start {which + 1}, the circle: {100 * _apart(drive):.1f} cm apart, median."
    )


def _apart(drive: dict[str, NDArray]) -> float:
    """Return the median distance between simulator and robot, m."""
    count = min(map(len, drive.values()))
    off = drive["simulated"][:count, :2] - drive["robot"][:count, :2]
    return float(np.median(np.linalg.norm(off, axis=1)))
