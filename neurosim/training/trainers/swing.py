"""Finding out whether it matters by which angle the direction of motion changes, and which way."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from neurosim.simulators.motion.derived import Derived
from neurosim.simulators.motion.noise import CommandFeatures
from neurosim.training.base import PursuitSettings
from neurosim.training.trainers.pursuit import Pursuit

#: How far from a reversal, in half turns, what swings round may begin to do so the other way.
_TRIED = (-0.03, 0.03)
#: The score must fall by this share for the input to be believed.
_BELIEVED = 0.03
_UNITS = 16


def find_swing(
    columns: CommandFeatures,
    x: Tensor,
    target: Tensor,
    factor: Tensor,
    settings: PursuitSettings,
    floor: float,
) -> Derived:
    """Return a derived input, if a small network predicts a target better with it.

    Args:
        columns: of the inputs.
        x: scaled inputs, the dead zone applied, [N, I].
        target: [N].
        factor: of what is predicted in the target, [N].
        settings: of the search; it is shortened.
        floor: the smallest magnitude of an input in a product unit.
    """
    quick = replace(settings, refine_every=1, refine_steps=4, reweigh_at=(), patience=_UNITS)
    scaled = (target / target.square().mean().sqrt().clamp(min=1e-12))[None]

    def score(tried: Derived) -> float:
        generator = torch.Generator(x.device).manual_seed(0)
        given = tried.append(columns, x)
        search = Pursuit(given, factor[None, None], scaled, quick, _UNITS, generator, floor)
        while not search.finished:
            search.grow()
        search.settle()
        return search.score()

    tried = [Derived(swing) for swing in _TRIED]
    scores = [score(one) for one in tried]
    best = min(range(len(tried)), key=scores.__getitem__)
    return tried[best] if scores[best] < score(Derived()) * (1.0 - _BELIEVED) else Derived()
