"""The trainers, by name."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from neurosim.base.errors import UserError
from neurosim.training.base import Trainer
from neurosim.training.trainers.exponents import ExponentsTrainer
from neurosim.training.trainers.ga import GaTrainer
from neurosim.training.trainers.gradient import GradientTrainer

TRAINERS: dict[str, type[Trainer]] = {
    "exponents": ExponentsTrainer,
    "ga": GaTrainer,
    "gradient": GradientTrainer,
}

#: The name of the trainer that is used if nobody says otherwise.
DEFAULT = "exponents"


def trainer_class(name: str) -> type[Trainer]:
    """Return the trainer of this name.

    Raises:
        UserError: if there is none.
    """
    try:
        return TRAINERS[name]
    except KeyError:
        raise UserError(f"no trainer {name!r}; there are {', '.join(TRAINERS)}") from None


def trainer_settings(name: str, options: dict[str, Any]) -> Any:
    """Return a trainer's settings, its defaults with some of them replaced.

    Raises:
        UserError: if it has no such setting, or the value cannot be.
    """
    kind = trainer_class(name).settings_type
    known = [field.name for field in fields(kind)]
    for option in options:
        if option not in known:
            raise UserError(
                f"trainer {name!r} has no setting {option!r}; it has {', '.join(known)}"
            )
    try:
        return kind(**options)
    except (TypeError, ValueError) as error:
        raise UserError(f"trainer {name!r} cannot be set so: {error}") from None
