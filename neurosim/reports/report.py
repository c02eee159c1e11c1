"""The report: one HTML page on any mix of recordings, datasets, simulators, controllers, trials."""

from __future__ import annotations

import datetime
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neurosim.base.errors import UserError, counted
from neurosim.base.files import write_text
from neurosim.reports import (
    accuracy,
    alternation,
    certainty,
    controllers,
    data,
    provenance,
    reality,
    tables,
)
from neurosim.reports.artefacts import Artefacts, gather
from neurosim.reports.page import Page
from neurosim.reports.predictions import HeldOut
from neurosim.training.evaluate import UNITS


def write_report(folders: Sequence[str | Path], out: str | Path) -> dict[str, Any]:
    """Write one self-contained HTML page.

    Args:
        folders: any mix of recording, dataset, simulator, controller and trial folders,
            recognised by the JSON in them. A missing part is left out of the page; a line names the
            folder to add.
        out: the file, ``.html``; an older one is replaced.

    Returns:
        ``verdict`` (a sentence or two), ``virtual`` (whether data is from the virtual lab, None if
        unknown), and, if known, ``trials``, ``completed``,
        ``mean_position_error`` (m, over all commands), ``final_position_error`` (m, median over
        trials, after the last command), ``mean_heading_error``, ``final_heading_error`` (rad),
        ``controller_fitness`` (predicted; the mean over controllers of one task) and
        ``change_at_transfer`` (a fraction; the mean), ``missed_deadlines`` of trials' commands, and
        ``test`` {simulator: {output: {mse, mean_absolute_error}}} in cm and degrees.

    Raises:
        UserError: if no folder is given, or ``out`` is a folder or has another suffix.
        FileError: if a folder is of no known kind, or a file in one is missing or wrong.
    """
    out = Path(out)
    if out.is_dir():
        raise UserError(f"{out} is a folder; name an HTML file to write")
    if out.suffix.lower() not in (".html", ".htm"):
        raise UserError(f"{out}: a report is written as .html; name such a file")
    artefacts = gather(folders)
    tests = accuracy.test(artefacts)
    summary = summarise(artefacts, tests)
    sections = [
        reality.courses(artefacts) if artefacts.trials or artefacts.by_commands else None,
        reality.growth(artefacts) if artefacts.by_commands else None,
        alternation.section(artefacts),
        controllers.section(artefacts),
        tables.samples(artefacts),
        accuracy.section(artefacts, tests) if artefacts.by_commands else None,
        accuracy.others(artefacts),
        certainty.section(artefacts, tests),
        accuracy.learning(artefacts),
        data.section(artefacts) if artefacts.by_commands else None,
        provenance.section(artefacts),
    ]
    page = Page(
        title=_title(artefacts),
        verdict=summary["verdict"],
        good=_good(artefacts),
        virtual=bool(artefacts.virtual),
        figures=_key_figures(summary),
        sections=[section for section in sections if section is not None],
        footer=(
            f"Written {datetime.datetime.now().astimezone().isoformat(timespec='seconds')} "
            f"with {provenance.versions()}. To make it again: neurosim report "
            f"{shlex.join(map(str, [*folders, '-o', out]))}"
        ),
    )
    write_text(out, page.html())
    return summary


def summarise(artefacts: Artefacts, tests: Mapping[int, HeldOut]) -> dict[str, Any]:
    """Return the verdict and the key figures; see :func:`write_report`."""
    trials = artefacts.trials
    summary: dict[str, Any] = {"verdict": "", "virtual": artefacts.virtual}
    if trials:
        summary["trials"] = len(trials)
        summary["completed"] = sum(trial.completes for trial in trials)
        for column, what in enumerate(("position", "heading")):
            pooled, final = reality.pooled(trials, column), reality.final(trials, column)
            if pooled.size:
                summary[f"mean_{what}_error"] = float(pooled.mean())
            if final.size:
                summary[f"final_{what}_error"] = float(np.median(final))
    if tests:
        named = {artefacts.simulators[place].name: test.compared for place, test in tests.items()}
        summary["test"] = {name: compared.errors() for name, compared in named.items()}
        summary["tested_on"] = {name: compared.what for name, compared in named.items()}
    saved = artefacts.controllers
    fitness = [one.meta["predicted"].get("fitness") for one in saved]
    if saved and None not in fitness and len(controllers.by_task(saved)) == 1:
        summary["controller_fitness"] = float(np.mean(fitness))
    changes = [controllers.change_at_transfer(one) for one in saved]
    if any(change is not None for change in changes):
        summary["change_at_transfer"] = float(np.mean([c for c in changes if c is not None]))
    late = [trial.meta["deadlines"] for trial in trials if trial.meta.get("deadlines") is not None]
    if late:
        summary["missed_deadlines"] = sum(one["missed"] for one in late)
    summary["verdict"] = _verdict(artefacts, summary)
    return summary


def _verdict(artefacts: Artefacts, summary: Mapping[str, Any]) -> str:
    trials, tried = artefacts.trials, bool(artefacts.trials)
    parts = []
    if tried:
        parts.append(_completed(artefacts))
        if any(trial.by_command for trial in trials):
            parts.append(_distance(summary, artefacts))
        parts.append(_deadlines(artefacts))
    elif "test" in summary:
        name, errors = next(iter(summary["test"].items()))
        error = {output: measured["mean_absolute_error"] for output, measured in errors.items()}
        parts.append(
            f"The simulator {name} predicts held-out {summary['tested_on'][name]} to within "
            f"{error['dx']:.2f} cm forward, {error['dy']:.2f} cm sideways and "
            f"{error['dtheta']:.2f} degrees on average."
        )
    parts.append(alternation.verdict(artefacts.alternations))
    if not tried:
        parts.append(controllers.verdict(artefacts.controllers))
        if artefacts.by_commands:
            parts.append("No trial was given: whether the robot completes the task is not known.")
        elif not (artefacts.controllers or artefacts.alternations):
            parts.append("No controller was given.")
    text = " ".join(part for part in parts if part)
    return f"{text} (Virtual lab.)" if artefacts.virtual else text


def _completed(artefacts: Artefacts) -> str:
    trials = artefacts.trials
    done = sum(trial.completes for trial in trials)
    predicted = [trial.meta["predicted"] for trial in trials]
    given = {one.get("probability") for one in predicted}
    chance = given.pop() if len(given) == 1 else None
    remark = "" if chance is None else f"; the simulator had given it {100 * chance:.0f} %"
    if len(trials) > 1:
        return f"The robot completed the task in {done} of {len(trials)} trials{remark}."
    if done:
        return f"The robot completed the task{remark}."
    if chance is None and predicted[0].get("completes"):
        remark = ", although the simulator predicted it"
    reason = trials[0].meta["actual"].get("reason")
    why = f": it {reason}" if reason else ""
    return f"The robot did not complete the task{remark}{why}."


def _deadlines(artefacts: Artefacts) -> str:
    late = [one for trial in artefacts.trials if (one := trial.meta.get("deadlines")) is not None]
    missed, steps = (sum(one[name] for one in late) for name in ("missed", "steps"))
    return f"Of {steps} commands {missed} were sent late." if missed else ""


def _distance(summary: Mapping[str, Any], artefacts: Artefacts) -> str:
    if "mean_position_error" not in summary:
        return "The camera did not see where it went, so how far it strayed is not known."
    text = (
        "After a command it was, on average over commands, "
        f"{100 * summary['mean_position_error']:.1f} cm and "
        f"{np.degrees(summary['mean_heading_error']):.1f} degrees from the prediction"
    )
    if "final_position_error" not in summary:
        if all(trial.meta.get("ended_early") for trial in artefacts.trials if trial.by_command):
            return f"{text}; the drive ended before its last command."
        return f"{text}; at the end it was not seen."
    several = " (median)" if summary["trials"] > 1 else ""
    return f"{text}; at the end, {100 * summary['final_position_error']:.1f} cm{several}."


def _good(artefacts: Artefacts) -> bool | None:
    trials = artefacts.trials
    return 2 * sum(trial.completes for trial in trials) > len(trials) if trials else None


def _title(artefacts: Artefacts) -> str:
    if artefacts.trials:
        names = dict.fromkeys(trial.meta["task"]["name"] for trial in artefacts.trials)
        tasks = ", ".join(names).replace("-", " ")
        count = len(artefacts.trials)
        return f"From a robot to a controller: {tasks}, {counted(count, 'trial')}"
    kinds = dict.fromkeys(artefact.kind for artefact in artefacts.everything)
    return f"From a robot to a controller: {', '.join(kinds)}"


def _key_figures(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    figures = []
    if "controller_fitness" in summary:
        figures.append((f"{summary['controller_fitness']:.4g}", "fitness in the simulator, mean"))
    if "change_at_transfer" in summary:
        change = f"{100 * summary['change_at_transfer']:+.1f} %"
        figures.append((change, "change of the best at the transfer, mean"))
    if "trials" in summary:
        figures.append((f"{summary['completed']} of {summary['trials']}", "trials completed"))
    if "missed_deadlines" in summary:
        figures.append((str(summary["missed_deadlines"]), "commands sent late"))
    several = ", median" if summary.get("trials", 0) > 1 else ""
    for key, name in (
        ("mean_position_error", "position error, mean over commands"),
        ("final_position_error", f"position error at the end{several}"),
    ):
        if key in summary:
            figures.append((f"{100 * summary[key]:.1f} cm", name))
    if "final_heading_error" in summary:
        degrees = np.degrees(summary["final_heading_error"])
        figures.append((f"{degrees:.1f} deg", f"heading error at the end{several}"))
    for name, errors in list(summary.get("test", {}).items())[:1]:
        tested_on = summary["tested_on"][name]
        for output, what in (("dx", "forward"), ("dy", "sideways"), ("dtheta", "angle")):
            value = f"{errors[output]['mean_absolute_error']:.3g} {UNITS[output]}"
            figures.append((value, f"error of held-out {tested_on}, {what}"))
    return figures
