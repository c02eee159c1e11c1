"""How controller and simulator are adapted to each other."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal

from neurosim.back_to_reality.genetic import BitSettings
from neurosim.back_to_reality.policy_gradient import PolicySettings
from neurosim.base.errors import UserError

SEARCHES = ("ga", "cma")
COMPARED = ("similar", "recent", "tracked")
_PAPER_GENETIC, _PAPER_POLICY = BitSettings(), PolicySettings()
_PAPER_ADAPT = BitSettings(population=20, first_mutation=0.2)


@dataclass(frozen=True)
class BackToRealitySettings:
    """Settings of the alternation; the defaults are those of Zagal et al. 2004, section 5, where
    the paper gives one.

    Attributes:
        cycles: How often L1, trials, L3 and L2 follow each other before the last L1.
        search: What searches controllers in the simulator (L1): ga, the paper's, or cma.
        generations: Generations of L1.
        later_generations: Generations of every L1 after the first; 0: as many as of the first.
        genetic: the genetic algorithm of L1; its population is that of cma, too.
        spread: With cma L1 begins to look so far from its start, as a share of the ranges.
        sets: So many parameter sets are kept, and controllers evolved over all of them; 1: the
            paper's one.
        prior: The first of several sets are drawn at random, so far from the simulator as it is:
            standard deviation, as a share of the ranges.
        caution: Over several sets an individual is worth the mean of its fitness less so many
            times the standard deviation.
        candidates: So many of the best of L1's generations are tried in reality.
        adapt: What adapts the simulator (L3): ga, the paper's, cma, or none.
        adapt_generations: Generations of L3.
        adapt_genetic: the genetic algorithm of L3; its population is that of cma, too.
        compared: L3 compares so many individuals.
        compare: Which these are: similar, those of the round with the most similar success in
            both, as the paper's ten, and who failed only where there are no others; recent, those
            that were tried last, failures included, and the best one; or tracked, the same, but
            if reality tracked none of them there is no L3.
        policy_steps: Steps of the policy gradient in reality (L2), and then its end is tried; 0:
            there is none. The paper goes on until it converges.
        policy: the policy gradient.
        confirm: A leader is tried in so many evaluations before it is believed, and learned from;
            1: it is believed at once.
        finalists: With confirm, so many evaluations at most after each round of trials.
        trials: Trials in reality that are one evaluation.
        budget: No more evaluations in reality than this; 0: there is no limit.
    """

    cycles: int = 1
    search: Literal["ga", "cma"] = "ga"
    generations: int = 600
    later_generations: int = 0
    genetic: BitSettings = field(default=_PAPER_GENETIC)
    spread: float = 0.1
    sets: int = 1
    prior: float = 0.15
    caution: float = 0.0
    candidates: int = 15
    adapt: Literal["ga", "cma", "none"] = "ga"
    adapt_generations: int = 45
    adapt_genetic: BitSettings = field(default=_PAPER_ADAPT)
    compared: int = 10
    compare: Literal["similar", "recent", "tracked"] = "similar"
    policy_steps: int = 3
    policy: PolicySettings = field(default=_PAPER_POLICY)
    confirm: int = 1
    finalists: int = 3
    trials: int = 3
    budget: int = 0

    def __post_init__(self) -> None:
        for name in (
            "cycles", "generations", "sets", "candidates", "adapt_generations", "compared",
            "trials", "confirm", "finalists",
        ):  # fmt: skip
            if getattr(self, name) < 1:
                raise UserError(f"{name} must be at least 1, not {getattr(self, name)}")
        for name in ("later_generations", "policy_steps", "budget", "caution", "prior"):
            if getattr(self, name) < 0:
                raise UserError(f"{name} must not be negative, not {getattr(self, name)}")
        if self.search not in SEARCHES:
            raise UserError(f"search is one of {', '.join(SEARCHES)}, not {self.search!r}")
        if self.adapt not in (*SEARCHES, "none"):
            raise UserError(f"adapt is ga, cma or none, not {self.adapt!r}")
        if self.compare not in COMPARED:
            raise UserError(f"compare is one of {', '.join(COMPARED)}, not {self.compare!r}")
        if self.spared and 0 < self.budget <= 1 + self.spared:
            raise UserError(
                f"a budget of {self.budget} leaves nothing to try: the start is an evaluation, and "
                f"{self.spared} are kept to confirm the best ones (finalists)"
            )
        if not 0.0 < self.spread <= 1.0:
            raise UserError(f"spread is a share of the ranges, 0 to 1, not {self.spread:g}")

    @property
    def spared(self) -> int:
        """How many evaluations are kept to confirm the best ones."""
        return self.finalists if self.confirm > 1 else 0


#: Our choices beside the paper's, by which it is compared with itself.
BETTER: dict[str, Any] = {
    "cycles": 7,
    "search": "cma",
    "generations": 30,
    "later_generations": 20,
    "spread": 0.1,
    "sets": 6,
    "caution": 1.0,
    "candidates": 16,
    "adapt": "cma",
    "adapt_generations": 8,
    "adapt_genetic": BitSettings(population=12),
    "compared": 20,
    "compare": "tracked",
    "policy_steps": 0,
    "confirm": 3,
    "finalists": 4,
    "budget": 120,
}


def settings_named(name: str, **changes: Any) -> BackToRealitySettings:
    """Return settings by name, ``paper`` or ``better``, and some changed.

    Raises:
        UserError: if there are none of this name, or a value is wrong.
    """
    if name not in ("paper", "better"):
        raise UserError(f"there are the settings paper and better, not {name!r}")
    return replace(BackToRealitySettings(), **{**(BETTER if name == "better" else {}), **changes})
