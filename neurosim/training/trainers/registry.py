"""The trainers, by name."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from neurosim.base.errors import UserError, check_names
from neurosim.base.registry import Registry
from neurosim.training.base import Trainer

#: Classes by name, see :class:`~neurosim.training.base.Trainer`.
TRAINERS = Registry(
    "trainer",
    "neurosim.trainers",
    {
        "combined": "neurosim.training.trainers.combined:CombinedTrainer",
        "ga": "neurosim.training.trainers.ga:GaTrainer",
    },
)

#: Name of the default trainer.
DEFAULT = "combined"


def trainer_class(name: str) -> type[Trainer]:
    """Return the trainer of this name.

    Raises:
        UserError: if the name is unknown.
    """
    return TRAINERS.get(name)


def trainer_settings(name: str, options: dict[str, Any]) -> Any:
    """Return a trainer's settings, its defaults with some of them replaced.

    Raises:
        UserError: if a setting is unknown, or a value is invalid.
    """
    kind = trainer_class(name).settings_type
    known = [field.name for field in fields(kind)]
    check_names(f"trainer {name!r}", options, known)
    try:
        return kind(**options)
    except (TypeError, ValueError) as error:
        raise UserError(f"trainer {name!r} has invalid settings: {error}") from None
