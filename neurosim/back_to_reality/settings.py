"""How controller and simulator are adapted to each other."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

from msgspec import Meta

from neurosim.base.declared import Checked, Count, CountOrNone, Fraction
from neurosim.base.errors import UserError
from neurosim.evolution.bits import BitSettings
from neurosim.evolution.policy_gradient import PolicySettings

Compare = Literal["similar", "recent", "tracked"]
_PAPER_GENETIC, _PAPER_POLICY = BitSettings(), PolicySettings()
_PAPER_ADAPT = BitSettings(population=20, first_mutation=0.2)


@dataclass(frozen=True)
class BackToRealitySettings(Checked):
    """Settings of the alternation; the defaults are those of Zagal et al. 2004, section 5, where
    the paper gives one.

    Attributes:
        cycles: Cycles of L1, trials, L3 and L2; one more L1 follows the last.
        search: Optimiser that evolves controllers in the simulator (L1): ga, the paper's, cma, or
            one of your own.
        generations: Generations of the first L1.
        later_generations: Generations of each later L1; 0: as many as of the first.
        genetic: the genetic algorithm of L1; others take its population size.
        spread: Spread of the first population in L1, as a fraction of the ranges; not for ga.
        sets: Number of parameter sets of the simulator that each generation of L1 is judged in: the
            simulator itself, and random ones. The paper has 1.
        prior: Standard deviation of random parameter sets around the simulator's own, as a fraction
            of the ranges.
        caution: Number of standard deviations that are subtracted from the mean fitness over
            several sets.
        candidates: Number of L1's best controllers that are tried in reality in each cycle.
        adapt: Optimiser that adapts the simulator (L3): as search, or none.
        adapt_generations: Generations of L3.
        adapt_genetic: the genetic algorithm of L3; others take its population size.
        compared: Number of controllers that L3 compares.
        compare: Which controllers L3 compares. similar: those of this round whose fitness agrees
            best, failures last, as in the paper; recent: the last ones that were tried, failures
            included, and the best one; tracked: as recent, but there is no L3 unless reality
            tracked the robot.
        policy_steps: Number of steps of the policy gradient in reality (L2); the last policy is
            tried too. 0: no L2. The paper goes on until it converges.
        policy: the policy gradient.
        confirm: Number of evaluations after which the best controller is accepted; 1: at once.
        finalists: Most evaluations for confirming after each round.
        trials: Trials in reality of one evaluation.
        budget: Largest number of evaluations in reality; 0: no limit.
    """

    cycles: Count = 1
    search: str = "ga"
    generations: Count = 600
    later_generations: CountOrNone = 0
    genetic: BitSettings = field(default=_PAPER_GENETIC)
    spread: Annotated[float, Meta(ge=0.0001, le=1)] = 0.1
    sets: Count = 1
    prior: Fraction = 0.15
    caution: Annotated[float, Meta(ge=0, le=1000)] = 0.0
    candidates: Count = 15
    adapt: str = "ga"
    adapt_generations: Count = 45
    adapt_genetic: BitSettings = field(default=_PAPER_ADAPT)
    compared: Count = 10
    compare: Compare = "similar"
    policy_steps: CountOrNone = 3
    policy: PolicySettings = field(default=_PAPER_POLICY)
    confirm: Count = 1
    finalists: Count = 3
    trials: Count = 3
    budget: CountOrNone = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.spared and 0 < self.budget <= 1 + self.spared:
            raise UserError(
                f"a budget of {self.budget} is too small: the start takes 1 evaluation, and "
                f"{self.spared} are kept to confirm the best (finalists); give a larger budget"
            )

    @property
    def spared(self) -> int:
        """How many evaluations are kept to confirm the best ones."""
        return self.finalists if self.confirm > 1 else 0


#: neurosim's own choices, where they differ from the paper's.
BETTER: dict[str, Any] = {
    "cycles": 7,
    "search": "cma",
    "generations": 30,
    "later_generations": 20,
    "spread": 0.1,
    "sets": 6,
    "prior": 0.1,
    "caution": 1.0,
    "candidates": 16,
    "adapt": "cma",
    "adapt_generations": 15,
    "adapt_genetic": BitSettings(population=16),
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
        UserError: if the name is unknown, or a value is wrong.
    """
    if name not in ("paper", "better"):
        raise UserError(f"settings are paper or better, not {name!r}")
    return replace(BackToRealitySettings(), **{**(BETTER if name == "better" else {}), **changes})
