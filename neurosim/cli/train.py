"""``neurosim train`` and ``neurosim evaluate``: dataset -> simulator, and its errors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from neurosim.cli._common import emit, json_option, next_step, seed_option, tensorboard_option
from neurosim.cli._options import SettingsCommand, choice_options, settings_options
from neurosim.cli._types import PATH

#: Fraction of the variance of the motion below which commands explain almost nothing.
_EXPLAINED = 0.2


@click.command(cls=SettingsCommand)
@click.argument("dataset", type=PATH)
@click.option("-o", "--out", type=PATH, required=True, help="Folder of the new simulator.")
@choice_options(
    "--trainer",
    "neurosim.training.trainers.registry:TRAINERS",
    default="combined",
    help=(
        "The trainer. combined fits a drive model, and a Gaussian process to its errors. ga, the "
        "paper's genetic algorithm, evolves the weights of three networks."
    ),
    of=lambda trainer: trainer.settings_type,
)
@settings_options("options", "neurosim.training.train:train", only=("device", "sensors"))
@tensorboard_option
@seed_option
@json_option
def train(
    dataset: Path,
    out: Path,
    trainer: str,
    trainer_options: dict[str, Any],
    options: dict[str, Any],
    tensorboard: Path | None,
    seed: int,
    as_json: bool,
) -> None:
    """Train a simulator from DATASET; its last fifth in time is held out."""
    from neurosim.training.train import train as train_

    simulator = train_(
        dataset, out, trainer=trainer, seed=seed, tensorboard=tensorboard, **options,
        **trainer_options,
    )  # fmt: skip
    errors = simulator.meta["test_errors"]
    coverage, window = simulator.meta["test_coverage"], simulator.meta["test_window"]
    repeated = simulator.meta["training"]["repeated_rows"]
    readings = simulator.meta.get("readings")
    if repeated:
        click.echo(
            f"neurosim: {repeated} of the rows of {dataset} are exact copies of others and count "
            "once; was something recorded or imported twice?",
            err=True,
        )
    explained = simulator.meta["test_explained"]
    if max(explained["dx"], explained["dtheta"]) < _EXPLAINED:
        click.echo(
            "neurosim: the commands explain almost nothing of the held-out motion: are these the "
            "commands of this robot, and do their times fit those of the poses?",
            err=True,
        )
    result = {
        "simulator": str(out),
        "repeated_rows": repeated,
        "test_window": window,
        "test_errors": errors,
        "test_explained": explained,
        "test_coverage": coverage,
        **({"readings": readings} if readings else {}),
        **simulator.meta["wall_clock"],
    }
    emit(
        result,
        as_json,
        f"{out}: mean absolute error on the held-out fifth{_windows_in_words(window)}: "
        f"{_in_words(errors)} "
        f"({result['training_seconds']:.0f} s).{_coverage_in_words(coverage)}\n"
        + _sensors_in_words(readings)
        + next_step(*_next(simulator.command_names, dataset, out)),
    )


def _next(command_names: tuple[str, ...], dataset: Path, out: Path) -> tuple[Any, ...]:
    if command_names[-1] == "duration":
        return "evolve", out, "--task", "nine-rectangles", "-o", "CONTROLLER"
    return "evaluate", out, dataset


def _in_words(errors: dict[str, Any]) -> str:
    return ", ".join(
        f"{name} {error['mean_absolute_error']:.2f} {error['unit']}"
        for name, error in errors.items()
    )


def _windows_in_words(window: float | None) -> str:
    return "" if window is None else f", in windows of {window:g} s"


def _coverage_in_words(coverage: dict[str, dict[str, float]] | None) -> str:
    if coverage is None:
        return ""
    rows = [
        f"{name} " + ", ".join(f"{100 * fraction:.0f}" for fraction in fractions.values())
        for name, fractions in coverage.items()
    ]
    levels = ", ".join(f"{100 * float(level):.0f}" for level in next(iter(coverage.values())))
    return f"\nIts {levels} % intervals hold, in %: {'; '.join(rows)}."


def _sensors_in_words(readings: dict[str, Any] | None) -> str:
    words = ""
    for one in (readings or {}).get("sensors", ()):
        if one["flat"]:
            words += f"{one['name']} saw nothing on the board.\n"
            continue
        words += (
            f"{one['name']}, {100 * one['ahead']:.1f} cm ahead and {100 * one['aside']:.1f} cm to "
            f"the left: root mean square error {one['rms_error']:.3f} of readings that differ by "
            f"{one['rms']:.3f}.\n"
        )
    return words


@click.command()
@click.argument("simulator", type=PATH)
@click.argument("dataset", type=PATH)
@click.option("--all-rows", is_flag=True, help="Also use the rows of the training.")
@json_option
def evaluate(simulator: Path, dataset: Path, all_rows: bool, as_json: bool) -> None:
    """Print the errors of SIMULATOR on rows of DATASET, next to those of the paper.

    It is Table 2 of Pretorius et al. (2009). The rows are those held out of training.
    """
    from neurosim.training.evaluate import evaluate as evaluate_

    result = evaluate_(simulator, dataset, held_out_only=not all_rows)
    emit(result, as_json, lambda: _table_2(result))


#: As the paper orders and names them.
_ROWS = (("dtheta", "change in angle"), ("dx", "change in y (dx)"), ("dy", "change in x (-dy)"))


def _table_2(result: dict[str, Any]) -> str:
    windows = _windows_in_words(result["window"])
    lines = [f"{result['rows']} rows: {result['which']}{windows}", ""]
    columns = [("ours", result["errors"]), ("paper", result["paper"])]
    if result["baseline"]:
        columns.append(("unicycle", result["baseline"]["errors"]))
    head = "".join(f"{name + ' MSE':>16}{'error':>10}    " for name, _ in columns)
    lines.append(f"{'':20}{head}")
    for key, label in _ROWS:
        cells = "".join(
            f"{table[key]['mse']:>16.3f}{table[key]['mean_absolute_error']:>10.3f} "
            f"{table[key]['unit']:3}"
            for _, table in columns
        )
        lines.append(f"{label:20}{cells}")
    lines += ["", "MSE in the square of the error's unit; error: mean absolute error."]
    if result["baseline"]:
        lines.append(f"unicycle: {result['baseline']['description']}.")
    if result["coverage"]:
        lines.append(_coverage_in_words(result["coverage"]).strip())
    return "\n".join(lines)
