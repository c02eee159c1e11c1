"""The trials' part of the page: Figures 6 and 7, and the growth of errors over the commands."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import counted
from neurosim.base.statistics import wilson
from neurosim.reports import charts
from neurosim.reports.artefacts import Artefacts, Trial
from neurosim.reports.controllers import unknown_tasks
from neurosim.reports.course import Paths, Scene, course
from neurosim.reports.film import film
from neurosim.reports.page import Block, Picture, Row, Section, Table, Text

#: Largest number of trials that are drawn one by one.
MOST_DRAWN = 24


def courses(artefacts: Artefacts) -> Section:
    """Write the section with the predicted and the actual path of every trial."""
    trials = artefacts.trials
    blocks: list[Block] = []
    if not trials:
        text = "Not shown: the predicted and the actual path. "
        blocks.append(Text(text + "Add the folder of a trial to see it.", missing=True))
    else:
        pictures = [
            _course(trial, artefacts, f"c{place}", len(trials) > 1)
            for place, trial in enumerate(trials[:MOST_DRAWN])
        ]
        blocks += unknown_tasks(trials)
        blocks.append(pictures[0] if len(pictures) == 1 else Row(pictures))
        if len(trials) > MOST_DRAWN:
            blocks.append(Text(f"The first {MOST_DRAWN} of {len(trials)} trials are drawn."))
        if len(trials) > 1:
            blocks += [_rates(trials), _each(trials)]
        blocks += _commands(trials)
    return Section("course", "Trials: predicted and actual path", blocks)


def growth(artefacts: Artefacts) -> Section | None:
    """Write the section on the growth of plans' errors over the commands.

    None without trials of plans.
    """
    if artefacts.trials and not any(trial.by_command for trial in artefacts.trials):
        return None
    trials = [trial for trial in artefacts.trials if not np.isnan(trial.errors).all()]
    blocks: list[Block] = []
    if not trials:
        text = "Not shown: how the error grows from command to command. "
        blocks.append(Text(text + "Add the folder of a trial to see it.", missing=True))
    else:
        position = [100 * trial.errors[:, 0] for trial in trials]
        heading = [np.degrees(trial.errors[:, 1]) for trial in trials]
        many = f"{len(trials)} trials; each thin, their median bold" if len(trials) > 1 else ""
        blocks.append(
            Row(
                [
                    _fan(position, "position error (cm)", many, "gp"),
                    _fan(heading, "heading error (deg)", many, "gh"),
                ]
            )
        )
        if len(trials) > 1:  # a single trial has its errors next to its commands
            blocks.append(_growth_table(position, heading))
        blocks.append(
            Text(
                "A plan is driven in open loop: the error after a command includes all errors "
                "before it."
            )
        )
        if any(trial.meta.get("replanned") for trial in trials):
            blocks.append(
                Text(
                    "A replanned plan was predicted again for each command, from the robot's "
                    "tracked pose: errors do not add up."
                )
            )
    return Section("growth", "How the error grows from command to command", blocks)


def pooled(trials: Sequence[Trial], column: int) -> NDArray:
    """Return the errors of all tracked commands: column 0 in m, column 1 in rad."""
    if not trials:
        return np.empty(0)
    errors = np.concatenate([trial.errors[:, column] for trial in trials])
    return errors[~np.isnan(errors)]


def final(trials: Sequence[Trial], column: int) -> NDArray:
    """Return the errors after the last command of all trials in which the robot was seen then."""
    ends = np.array([trial.errors[-1, column] for trial in trials if len(trial.errors)])
    return ends[~np.isnan(ends)]


def label(trial: Trial) -> str:
    """Return the title of a trial: its folder's name, with the parent's if that is not unique."""
    parent = trial.path.resolve().parent.name
    return f"{parent}/{trial.name}" if trial.name == "trial" and parent else trial.name


def _course(trial: Trial, artefacts: Artefacts, prefix: str, small: bool) -> Picture:
    meta, actual = trial.meta, trial.meta["actual"]
    sides = {"predicted": len(trial.predicted), "actual": len(actual.get("path") or [])}
    which = " and ".join(name for name, count in sides.items() if count) or "no known"
    count = len(meta["commands"])
    words = f"{label(trial)}: {which} path, {counted(count, 'command')}; {_outcome(trial)}"
    scene = Scene.of(trial.task, artefacts.place_of(trial), trial.board)
    still = course(scene, Paths.of_trial(meta), words, prefix, small=small)
    moving = film(artefacts, trial)
    caption = (
        f"{words}. Fitness {_figure(meta['predicted'].get('fitness'))} predicted, "
        f"{_figure(meta['actual'].get('fitness'))} actual."
    )
    offset = _placed(meta.get("start"))
    if offset:
        caption += f" {offset}"
    if meta.get("ended_early"):
        caption += " The drive ended early: the robot was stopped before its last command."
    if actual.get("cut_error") is not None:
        away = actual["cut_error"]
        caption += (
            f" Where it was stopped it was {100 * away['position']:.1f} cm and "
            f"{math.degrees(abs(away['heading'])):.1f} degrees from the prediction."
        )
    guard = meta.get("guard")
    if guard is not None and guard["predicted"] != guard["driven"]:
        caption += " The guard was on in " + (
            "the drive, not in the prediction." if guard["driven"] else "the prediction alone."
        )
    if actual.get("seen_by") == "counters":
        caption += " Its path is that of its own counters."
    if meta.get("deadlines") is not None:
        late = meta["deadlines"]
        caption += (
            f" Of {late['steps']} commands {late['missed']} were late, "
            f"the worst by {1000 * late['worst_late_s']:.0f} ms."
        )
    if meta["virtual"]:
        caption += " Virtual lab."
    if moving is not None and len(moving.samples):
        caption += f" Grey: {len(moving.samples)} samples of the drive in the simulator."
    played = None if moving is None else moving.as_json(*still.origin, still.scale)
    return Picture(still.svg, caption, film=played)


def _outcome(trial: Trial) -> str:
    reason = trial.meta["actual"].get("reason")
    if trial.completes:
        return "completed"
    return f"not completed: the robot {reason}" if reason else "not completed"


def _placed(start: Any) -> str:
    if not start or not start.get("planned") or not start.get("actual"):
        return ""
    (x, y, heading), (planned_x, planned_y, planned_heading) = start["actual"], start["planned"]
    distance = 100 * math.hypot(x - planned_x, y - planned_y)
    turned = math.degrees(abs(math.remainder(heading - planned_heading, math.tau)))
    return f"The robot stood {distance:.1f} cm and {turned:.1f} deg from the planned start."


def _rates(trials: Sequence[Trial]) -> Table:
    groups: dict[str, list[Trial]] = {}
    for trial in trials:
        length, kind = trial.meta.get("plan_length"), trial.meta.get("kind", "plan")
        groups.setdefault(kind if length is None else f"{kind}, {length} commands", []).append(
            trial
        )
    if len(groups) > 1:
        groups["all"] = list(trials)
    rows = []
    for name, group in groups.items():
        done = sum(trial.completes for trial in group)
        chances = [trial.meta["predicted"].get("probability") for trial in group]
        known = [chance for chance in chances if chance is not None]
        foreseen = f"{sum(known) / len(known):.0%}" if known else "not known"
        low, high = wilson(done, len(group))
        rows.append(
            [
                name, str(len(group)), foreseen, str(done), f"{done / len(group):.0%}",
                f"{low:.0%} to {high:.0%}", _mean(100 * pooled(group, 0), "cm"),
                _median(100 * final(group, 0), "cm"), _median(np.degrees(final(group, 1)), "deg"),
            ]
        )  # fmt: skip
    return Table(
        "How often the task was completed",
        [
            "controllers", "trials", "predicted probability", "completed", "rate", "95 % interval",
            "error, mean over commands", "error at the end, median",
            "heading error at the end, median",
        ],
        rows,
        note="Commands are those of a plan, null ones included. The interval is Wilson's.",
    )  # fmt: skip


def _each(trials: Sequence[Trial]) -> Table:
    late = any(trial.meta.get("deadlines") is not None for trial in trials)
    rows = [
        [
            label(trial), str(len(trial.meta["commands"])), "yes" if trial.completes else "no",
            *([trial.meta["actual"].get("reason") or "-"] if late else []),
            _figure(trial.meta["predicted"].get("fitness")),
            _figure(trial.meta["actual"].get("fitness")), _mean(100 * pooled([trial], 0), "cm"),
            _mean(100 * final([trial], 0), "cm"), _mean(np.degrees(final([trial], 1)), "deg"),
            *([_late(trial)] if late else []),
        ]
        for trial in trials
    ]  # fmt: skip
    head = [
        "trial", "commands", "completed", *(["the robot"] if late else []), "fitness predicted",
        "fitness actual", "error, mean over commands", "error at the end",
        "heading error at the end", *(["commands sent late"] if late else []),
    ]  # fmt: skip
    return Table("Every trial", head, rows, folded=len(rows) > 12)


def _late(trial: Trial) -> str:
    late = trial.meta.get("deadlines")
    return "-" if late is None else f"{late['missed']} of {late['steps']}"


def _commands(trials: Sequence[Trial]) -> list[Block]:
    tables: list[Block] = []
    for trial in [trial for trial in trials if trial.by_command][:MOST_DRAWN]:
        columns = trial.meta["columns"]
        head = [
            "command", *(f"{one['name']} ({one['unit']})" for one in columns),
            "predicted x, y (m)", "predicted heading (deg)", "actual x, y (m)",
            "actual heading (deg)", "error (cm)", "heading error (deg)",
        ]  # fmt: skip
        rows = []
        poses = zip(trial.predicted[1:], trial.meta["actual"]["poses"][1:], strict=True)
        both = zip(trial.meta["commands"], poses, trial.errors, strict=False)
        for number, (command, (predicted, actual), error) in enumerate(both, start=1):
            rows.append(
                [
                    str(number),
                    *(
                        f"{value:.1f}" if one["unit"] == "%" else f"{value:.2f}"
                        for value, one in zip(command, columns, strict=False)
                    ),
                    *_pose(predicted), *_pose(actual, predicted[2]),
                    *("not seen" if math.isnan(error[0]) else text for text in (
                        f"{100 * error[0]:.1f}", f"{math.degrees(error[1]):.1f}",
                    )),
                ]
            )  # fmt: skip
        caption = f"{label(trial)}: commands, and the poses they led to"
        rows += _rest(trial)
        tables.append(Table(caption, head, rows, folded=len(trials) > 1))
    return tables


def _rest(trial: Trial) -> list[list[str]]:
    """Return the row of the pose at rest; empty if it is unknown."""
    predicted, actual = (trial.meta[part].get("rest") for part in ("predicted", "actual"))
    if predicted is None:
        return []
    row = [
        "at rest",
        *("" for _ in trial.meta["columns"]),
        *_pose(predicted),
        *_pose(actual, predicted[2]),
    ]
    if actual is None:
        return [[*row, "not seen", "not seen"]]
    away = 100 * math.dist(actual[:2], predicted[:2])
    turned = math.degrees(abs(math.remainder(actual[2] - predicted[2], math.tau)))
    return [[*row, f"{away:.1f}", f"{turned:.1f}"]]


def _pose(pose: Any, near: float | None = None) -> tuple[str, str]:
    """Return position and heading in words, with the heading's whole turns nearest to ``near``."""
    if pose is None:
        return "not seen", "not seen"
    heading = pose[2]
    if near is not None:  # a track's first heading is known up to whole turns only
        heading = near + math.remainder(heading - near, math.tau)
    return f"{pose[0]:.3f}, {pose[1]:.3f}", f"{math.degrees(heading):.1f}"


def _fan(lines: Sequence[NDArray], axis: str, many: str, prefix: str) -> Picture:
    middle = charts.median(charts.ragged(lines))
    seen = np.flatnonzero(~np.isnan(middle))
    words = (
        f"{axis} after each command, from {middle[seen[0]]:.1f} after command {seen[0] + 1} "
        f"to {middle[seen[-1]]:.1f} after command {seen[-1] + 1}"
        f"{' (medians)' if many else ''}"
    )
    svg = charts.fan(lines, axis, words, prefix, x_axis="command")
    return Picture(svg, f"{words[0].upper()}{words[1:]}{'; ' + many if many else ''}.")


def _growth_table(position: Sequence[NDArray], heading: Sequence[NDArray]) -> Table:
    rows = []
    tables = charts.ragged(position), charts.ragged(heading)
    for number in range(tables[0].shape[1]):
        away, turned = (table[:, number][~np.isnan(table[:, number])] for table in tables)
        if not away.size:
            rows.append([str(number + 1), "0", *["not seen"] * 6])
            continue
        figures = [f(values) for values in (away, turned) for f in (np.median, np.mean, np.max)]
        rows.append([str(number + 1), str(len(away)), *(f"{value:.1f}" for value in figures)])
    head = ["after command", "trials in which it was seen"] + [
        f"{what}, {statistic} ({unit})"
        for what, unit in (("position", "cm"), ("heading", "deg"))
        for statistic in ("median", "mean", "largest")
    ]
    return Table("Distance between predicted and actual pose after each command", head, rows)


def _figure(value: Any) -> str:
    return "unknown" if value is None else f"{value:.4g}"


def _mean(values: NDArray, unit: str) -> str:
    return f"{values.mean():.1f} {unit}" if values.size else "not known"


def _median(values: NDArray, unit: str) -> str:
    return f"{np.median(values):.1f} {unit}" if values.size else "not known"
