"""Finding out how small an input must be to do nothing: a motor's dead band."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from neurosim.training.base import PursuitSettings
from neurosim.training.pursuit import Pursuit

#: Dead zones tried, as shares of an input's largest magnitude.
_TRIED = (0.0, 0.03, 0.05, 0.07, 0.09, 0.11, 0.13)
#: A dead zone must lessen the cross-validation score by this share to be believed.
_BELIEVED = 0.05
_UNITS = 8


def find_dead_zone(
    names: Sequence[str], x: Tensor, target: Tensor, settings: PursuitSettings, floor: float
) -> Tensor:
    """Return the dead zone of each input, [I], that a small network predicts a target best with.

    Only inputs that take both signs can have one, and an input has that of its predecessor
    (``left`` and ``prev_left`` are the same motor): first one for all is sought, then each for
    itself about that.

    Args:
        names: of the inputs.
        x: scaled inputs, [N, I].
        target: [N].
        settings: of the search; it is shortened.
        floor: the smallest magnitude of an input in a product unit.
    """
    quick = replace(settings, candidates=200, refine_every=_UNITS, reweigh_at=(), patience=_UNITS)
    both = (x.amin(0) < 0) & (x.amax(0) > 0)
    groups = {
        name: torch.tensor([n.removeprefix("prev_") == name for n in names], device=x.device)
        for name, signed in zip(names, both.tolist(), strict=True)
        if signed and not name.startswith("prev_")
    }
    zone = torch.zeros_like(x[0])
    best = none = _score(x, target, zone, quick, floor)
    together = sum(groups.values(), torch.zeros_like(both))
    for group in (together, *groups.values()):
        for size in _TRIED:
            tried = torch.where(group.bool(), size, zone)
            # What no row distinguishes needs no fit.
            if torch.equal(tried, zone) or (size > 0 and not _matters(x, tried)):
                continue
            score = _score(x, target, tried, quick, floor)
            if score < best * (1.0 - _BELIEVED / 5):
                best, zone = score, tried
        if group is together and not zone.any():
            break
    return zone if best < none * (1.0 - _BELIEVED) else torch.zeros_like(zone)


def _matters(x: Tensor, zone: Tensor) -> bool:
    return bool(((x.abs() < zone) & (x != 0)).any())


def _score(
    x: Tensor, target: Tensor, zone: Tensor, settings: PursuitSettings, floor: float
) -> float:
    x = torch.where(x.abs() < zone, 0.0, x)
    generator = torch.Generator(x.device).manual_seed(0)
    factor = torch.ones_like(target)[None, None]
    scaled = (target / target.square().mean().sqrt().clamp(min=1e-12))[None]
    search = Pursuit(x, factor, scaled, settings, _UNITS, generator, floor)
    while not search.finished:
        search.grow()
    search.settle()
    return search.score()
