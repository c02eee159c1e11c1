"""The simulator's part of the page: Table 2, Figures 3 to 5, the learning curve."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from neurosim.reports import charts
from neurosim.reports.artefacts import Artefact, Artefacts
from neurosim.reports.page import Block, Picture, Row, Section, Table, Text
from neurosim.reports.predictions import HeldOut, dataset_of, held_out
from neurosim.training.evaluate import PAPER, READABLE, UNITS, Compared

#: Outputs in the paper's order, with the paper's words for them.
OUTPUTS = {
    "dtheta": "change in angle",
    "dx": "change in y-coordinate (our dx, forward)",
    "dy": "change in x-coordinate (our -dy, to the right)",
}
AXES = {
    "dtheta": "change in angle (deg)",
    "dx": "dx, forward (cm)",
    "dy": "dy, to the left (cm)",
}
_FIGURES = {"dtheta": "Figure 3", "dx": "Figure 4", "dy": "Figure 5"}
SHOWN = 50


def test(artefacts: Artefacts) -> dict[int, HeldOut]:
    """Return predictions of held-out commands, by the simulator's index in ``artefacts``."""
    results = {}
    for place, simulator in _learned(artefacts):
        pair = dataset_of(simulator, artefacts.datasets)
        if pair is not None:
            results[place] = held_out(simulator, *pair)
    return results


def section(artefacts: Artefacts, tests: Mapping[int, HeldOut]) -> Section:
    """Write the section on the simulators' predictions of held-out rows."""
    blocks: list[Block] = []
    learned = _learned(artefacts)
    if not learned:
        blocks.append(_missing("how well held-out rows are predicted", "a simulator"))
    else:
        blocks += _table(artefacts, tests)
        for place, simulator in learned:
            if place in tests:
                whose = f" ({simulator.name})" if len(learned) > 1 else ""
                blocks += _figures(tests[place].compared, f"s{place}", whose)
        if len(tests) < len(learned):
            blocks.append(
                _missing(
                    "predicted against actual values of held-out commands",
                    "the dataset that the simulator was trained on",
                )
            )
    return Section("accuracy", "How well held-out rows are predicted", blocks)


def learning(artefacts: Artefacts) -> Section | None:
    """Write the section on the training of simulators; None without any."""
    pictures = []
    for place, simulator in _learned(artefacts):
        lines = history(simulator.meta)
        if lines:
            pictures.append(_learning_curve(simulator, lines, f"l{place}"))
    if not _learned(artefacts):
        return None
    blocks: list[Block] = [Row(pictures)] if pictures else []
    if not pictures:
        blocks.append(Text("The simulator's folder holds no history of its training.", True))
    for _, simulator in _learned(artefacts):
        if simulator.meta.get("composition"):
            blocks += _composition(simulator)
    return Section("learning", "How the simulator was learned", blocks)


def _composition(simulator: Artefact) -> list[Block]:
    """Return tables of a simulator's parts: laws of its actuators, and the corrections of these."""
    made = simulator.meta["composition"]
    laws = list(dict.fromkeys(law for each in made["actuators"].values() for law in each))
    actuators = [
        [name, *(f"{each[law]:.3g}" if law in each else "-" for law in laws)]
        for name, each in made["actuators"].items()
    ]
    learned = [[AXES[name], f"{made['process'][name]:.0%}"] for name in READABLE]
    words = (
        f"{simulator.name}: laws of the actuators (lag and stick in s, rate in 1/s, speeds as "
        f"fractions of the usual one at full command); a command is "
        f"answered after {1000 * made['delay']:.0f} ms"
    )
    if any(made.get("drift", ())):
        ahead, aside = made["drift"]
        words += f"; the loss of speed in curves has a lag of {ahead:.2g} s, drift of {aside:.2g} s"
    if made.get("floor"):
        words += (
            f"; the slip differs by {made['floor']['sd']:.1%} of the motion (standard deviation) "
            "from place to place on the board"
        )
    return [
        Table(
            words, ["actuator", *(law.replace("_", " ") for law in laws)], actuators, folded=True
        ),
        Table(
            f"{simulator.name}: weights of a Gaussian process of {made['kernel_units']} units, "
            "which corrects the drive model",
            ["output", "weight of the process"],
            learned,
            folded=True,
        ),
    ]


def others(artefacts: Artefacts) -> Section | None:
    """Write the section on simulators that no other section shows; None if there are none."""
    rows = []
    for one in artefacts.simulators:
        if not (one.learned or one.sampled):
            simulator = one.content
            members = f"{simulator.members} members" if simulator.members > 1 else ""
            parts = [part for part in ("noise" if simulator.has_noise else "", members) if part]
            rows.append(
                [
                    one.name,
                    str(one.meta["kind"]),
                    ", ".join(simulator.command_names),
                    ", ".join(simulator.reading_names) or "-",
                    ", ".join(parts) or "-",
                ]
            )
    head = ["simulator", "kind", "commands", "sensors", "uncertainty"]
    table = Table("Inputs and outputs", head, rows, words=True)
    return Section("simulators", "Other simulators", [table]) if rows else None


def _learned(artefacts: Artefacts) -> list[tuple[int, Artefact]]:
    """Return the simulators that were learned from a dataset, each with its index among all."""
    return [(place, one) for place, one in enumerate(artefacts.simulators) if one.learned]


def history(meta: Mapping[str, Any]) -> dict[str, tuple[list[float], list[float]]]:
    """Return the training history by output: generations, and mean squared errors in cm², deg²."""
    names = [column["name"] for column in meta["outputs"]]
    entries = meta.get("history") or []
    generations = [entry["generation"] for entry in entries]
    return {
        name: (generations, [READABLE[name] ** 2 * entry["mse"][place] for entry in entries])
        for place, name in enumerate(names)
        if entries
    }


def _table(artefacts: Artefacts, tests: Mapping[int, HeldOut]) -> list[Block]:
    groups = [("paper", 2)]
    rows = [[words, *_errors(name, PAPER[name])] for name, words in OUTPUTS.items()]
    notes = []
    for place, simulator in _learned(artefacts):
        if place in tests:
            table, how = tests[place].compared.errors(), f"tested on {tests[place].how}"
        elif simulator.meta.get("test_errors"):
            table, how = (
                simulator.meta["test_errors"],
                "tested when it was trained (simulator.json)",
            )
        else:
            continue
        groups.append((simulator.name, 2))
        notes.append(f"{simulator.name} was {how}.")
        for row, name in zip(rows, OUTPUTS, strict=True):
            row += _errors(name, table[name])
    for test_ in list(tests.values())[:1]:
        ideal = test_.compared.baseline_errors()
        if ideal is not None:
            groups.append((ideal["description"], 2))
            for row, name in zip(rows, OUTPUTS, strict=True):
                row += _errors(name, ideal["errors"][name])
    notes.append(
        "MSE, the mean squared error of equation 1, is in cm² and deg². The paper's figures are "
        "of another robot and other data (Pretorius et al. 2009, Table 2): they say what size of "
        "error that method led to, not which is better."
    )
    return [
        Table(
            "Table 2: errors on held-out rows",
            ["", *["MSE", "mean abs. error"] * len(groups)],
            rows,
            note=" ".join(notes),
            groups=groups,
        )
    ]


def _errors(name: str, errors: Mapping[str, Any]) -> list[str]:
    return [f"{errors['mse']:.3f}", _error(name, errors["mean_absolute_error"])]


def _figures(compared: Compared, prefix: str, whose: str) -> list[Block]:
    blocks: list[Block] = []
    shown = min(SHOWN, len(compared.actual))
    clouds = []
    for column, name in ((2, "dtheta"), (0, "dx"), (1, "dy")):
        actual = READABLE[name] * compared.actual[:, column]
        predicted = READABLE[name] * compared.predicted[:, column]
        error = float(np.mean(np.abs(predicted[:shown] - actual[:shown])))
        words = (
            f"{OUTPUTS[name]}, predicted and actual values of the first {shown} held-out "
            f"{compared.what}"
        )
        svg = charts.series(
            actual[:shown], predicted[:shown], compared.what, AXES[name],
            f"{words}; they differ by {error:.2f} {UNITS[name]} on average", f"{prefix}{name}",
        )  # fmt: skip
        caption = (
            f"As {_FIGURES[name]} of the paper{whose}: {words}; "
            f"mean absolute error of these {_error(name, error)}."
        )
        blocks.append(Picture(svg, caption, wide=True))
        cloud = charts.scatter(
            actual, predicted, AXES[name],
            f"{OUTPUTS[name]}: predicted over actual values of all held-out {compared.what}",
            f"{prefix}{name}all",
        )  # fmt: skip
        caption = f"All {len(actual)} held-out {compared.what}{whose}: {AXES[name]}."
        clouds.append(Picture(cloud, caption))
    return [*blocks, Row(clouds)]


def _learning_curve(simulator: Artefact, lines: Mapping[str, Any], prefix: str) -> Picture:
    training = simulator.meta.get("training", {})
    last = {name: errors[-1] for name, (_, errors) in lines.items()}
    generations = max(int(x[-1]) for x, _ in lines.values())
    labels = {f"{name} ({UNITS[name]}²)": line for name, line in lines.items()}
    svg = charts.curves(
        labels, "training MSE (cm², deg²)", f"training error over {generations} generations", prefix
    )
    end = ", ".join(f"{name} {value:.3g} {UNITS[name]}²" for name, value in last.items())
    details = [
        f"{what} {training[key]}"
        for key, what in (("trainer", "trainer"), ("seed", "seed"))
        if key in training
    ]
    seconds = simulator.meta.get("wall_clock", {}).get("training_seconds")
    if seconds is not None:
        details.append(f"{seconds:.0f} s")
    return Picture(
        svg,
        f"{simulator.name}: mean squared error on the training rows over {generations} "
        f"generations; at the end {end}{'; ' + ', '.join(details) if details else ''}.",
    )


def _error(name: str, value: float) -> str:
    return f"{value:.3f} {UNITS[name]}"


def _missing(what: str, add: str) -> Text:
    return Text(f"Not shown: {what}. Add the folder of {add} to see it.", missing=True)
