"""``neurosim train`` and ``neurosim evaluate``: dataset -> simulator, and how good it is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from neurosim.base.checkpoint import Checkpoint
from neurosim.cli._common import (
    PATH,
    SHARE,
    Resumable,
    emit,
    given_options,
    json_option,
    next_step,
    seed_option,
)

_ACTIVATION = click.Choice(["linear", "tanh", "sigmoid"])


@click.command(cls=Resumable, begun=lambda values: Checkpoint(values["out"], "training").options())
@click.argument("dataset", type=PATH)
@click.option("-o", "--out", type=PATH, required=True, help="Folder of the new simulator.")
@click.option(
    "--trainer",
    default="exponents",
    show_default=True,
    help="exponents: the product units' exponents are searched for, the rest is solved for. "
    "ga: the paper's, every weight a gene. gradient: perceptrons, to compare with.",
)
@click.option(
    "--members",
    type=click.IntRange(min=1),
    help="Networks of each output in the ensemble.  [8; ga: 1]",
)
@click.option(
    "--noise/--no-noise",
    default=None,
    help="Learn a model of what cannot be foreseen.  [yes; ga: no]",
)
@click.option("--generations", type=click.IntRange(min=1), help="[default: the trainer's own]")
@click.option(
    "--product-units",
    type=click.IntRange(0, 1000),
    help="[default: the trainer's own; ga: 10]",
)
@click.option(
    "--summation-units",
    type=click.IntRange(0, 1000),
    help="[default: the trainer's own; ga: 10]",
)
@click.option("--hidden-activation", type=_ACTIVATION, default="linear", show_default=True)
@click.option("--output-activation", type=_ACTIVATION, default="linear", show_default=True)
@click.option("--population", type=click.IntRange(min=2), help="[ga: 250]")
@click.option("--tournament", type=click.IntRange(min=1), help="[ga: 50]")
@click.option("--crossover", type=SHARE, help="Probability.  [ga: 0.8]")
@click.option("--mutation", type=SHARE, help="Probability a gene.  [ga: 0.05]")
@click.option("--device", default="cpu", show_default=True, help="As PyTorch names it.")
@click.option(
    "--resume", is_flag=True, help="Go on with training that was interrupted, with its options."
)
@seed_option
@json_option
def train(
    dataset: Path,
    out: Path,
    trainer: str,
    members: int | None,
    noise: bool | None,
    generations: int | None,
    product_units: int | None,
    summation_units: int | None,
    hidden_activation: str,
    output_activation: str,
    device: str,
    resume: bool,
    seed: int,
    as_json: bool,
    **genetic: Any,
) -> None:
    """Train a simulator from DATASET; its last fifth in time is held out."""
    from neurosim.training.train import train as train_
    from neurosim.training.trainers.registry import trainer_class

    own = trainer_class(trainer).default_hidden
    hidden = (product_units, summation_units)
    simulator = train_(
        dataset,
        out,
        trainer=trainer,
        generations=generations,
        seed=seed,
        members=members,
        noise=noise,
        hidden=tuple(b if a is None else a for a, b in zip(hidden, own, strict=True)),
        activations=(hidden_activation, output_activation),
        settings={name: value for name, value in genetic.items() if value is not None},
        device=device,
        resume=resume,
        options=given_options(),
    )
    errors = simulator.meta["test_errors"]
    coverage = simulator.meta["test_coverage"]
    result = {
        "simulator": str(out),
        "test_errors": errors,
        "test_coverage": coverage,
        **simulator.meta["wall_clock"],
    }
    emit(
        result,
        as_json,
        f"{out}: mean absolute error on the held-out fifth: {_in_words(errors)} "
        f"({result['training_seconds']:.0f} s).{_coverage_in_words(coverage)}\n"
        + next_step(*_next(simulator.command_names, dataset, out)),
    )


def _next(command_names: tuple[str, ...], dataset: Path, out: Path) -> tuple[Any, ...]:
    if command_names == ("left", "right", "duration"):
        return "evolve", out, "--task", "nine-rectangles", "-o", "CONTROLLER"
    return "evaluate", out, dataset


def _in_words(errors: dict[str, Any]) -> str:
    return ", ".join(
        f"{name} {error['mean_absolute_error']:.2f} {error['unit']}"
        for name, error in errors.items()
    )


def _coverage_in_words(coverage: dict[str, dict[str, float]] | None) -> str:
    if coverage is None:
        return ""
    rows = [
        f"{name} " + ", ".join(f"{100 * share:.0f}" for share in shares.values())
        for name, shares in coverage.items()
    ]
    levels = ", ".join(f"{100 * float(level):.0f}" for level in next(iter(coverage.values())))
    return f"\nIts {levels} % intervals hold, in %: {'; '.join(rows)}."


@click.command()
@click.argument("simulator", type=PATH)
@click.argument("dataset", type=PATH)
@click.option("--all-rows", is_flag=True, help="Also the rows that training has seen.")
@json_option
def evaluate(simulator: Path, dataset: Path, all_rows: bool, as_json: bool) -> None:
    """Print Table 2 of Pretorius et al. (2009) for SIMULATOR on DATASET, beside the paper's."""
    from neurosim.training.evaluate import evaluate as evaluate_

    result = evaluate_(simulator, dataset, held_out_only=not all_rows)
    emit(result, as_json, lambda: _table_2(result))


#: As the paper orders and names them.
_ROWS = (("dtheta", "change in angle"), ("dx", "change in y (dx)"), ("dy", "change in x (-dy)"))


def _table_2(result: dict[str, Any]) -> str:
    lines = [f"{result['rows']} rows: {result['which']}", ""]
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
