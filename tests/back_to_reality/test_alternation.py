"""The whole alternation, in a world without legs."""

import signal

import numpy as np
import pytest
import torch
from ideal_simulator import SlippingWheels
from sliding_block import Block, Push, Slide, reality_of

from neurosim.back_to_reality import (
    Alternation,
    Interrupted,
    Simulated,
    Tracked,
    Trials,
    settings_named,
)
from neurosim.back_to_reality.adapt import (
    HEADING_LENGTH,
    NOWHERE,
    Compared,
    agreement,
    discrepancy,
    kept_sets,
    poses_apart,
    similar,
)
from neurosim.back_to_reality.climb import Climb, make_search
from neurosim.back_to_reality.evaluations import Evaluation, Evaluations
from neurosim.back_to_reality.genetic import BitSettings
from neurosim.back_to_reality.reality import read_trials
from neurosim.base.errors import UserError

START = np.array([0.5, 0.5])
SMALL = {"generations": 15, "adapt_generations": 25, "candidates": 12, "policy_steps": 1}


def simulated():
    return Simulated(Block(), Slide(), Push())


def alternation(path, settings, **others):
    trials = Trials(reality_of(), path)
    return Alternation(simulated(), trials, START, settings, progress=False, **others)


def test_the_simulator_gives_what_was_worked_out_by_hand():
    """Mass 1, friction 0.1: pushed by 0.5 twice it goes 0.8 ahead, and 0.35 to the side."""
    model = simulated()
    assert model.fitness(START[None], model.as_is) == pytest.approx([0.8 - 0.35])
    heavy = np.array([model.parameters[0].share(2.0), model.parameters[1].share(0.2)])
    assert model.values(heavy) == pytest.approx([2.0, 0.2])
    expected = [reality_of()(START), reality_of()(np.array([0.9, 0.2]))]
    genes = np.stack([START, [0.9, 0.2]])
    assert model.over(genes, np.stack([heavy])) == pytest.approx(np.array([expected]))


def test_discrepancy_and_choice_of_similar_ones_by_hand():
    found = discrepancy(np.array([[1.0, 2.0], [4.0, 6.0]]), np.array([1.0, 2.0]))
    assert found == pytest.approx([0.0, 5.0])
    simulated_, real = np.array([1.0, 0.5, 0.4, 0.2]), np.array([0.9, 0.1, 0.4, 0.0])
    assert similar(simulated_, real, 2).tolist() == [0, 2]
    assert similar(simulated_, real, 3).tolist() == [0, 1, 2]  # the failure comes last


def test_agreement_by_hand():
    class Given:
        def fitness(self, genes, parameters):
            return genes[:, 0] + parameters[0]

    compared = Compared(Given(), np.array([[1.0], [2.0], [3.0]]), np.array([1.0, 2.0, 5.0]))
    found = agreement(compared, np.array([1.0]), np.array([0.0]))
    assert found["before"]["norm"] == pytest.approx(3**0.5)
    assert found["after"]["norm"] == pytest.approx(2.0)
    assert found["after"]["median"] == 0.0
    assert found["after"]["rms"] == pytest.approx((4 / 3) ** 0.5)
    assert found["after"]["rank"] == pytest.approx(1.0)
    assert "poses" not in found["after"]


def test_poses_apart_by_hand():
    real = np.array([[0.0, 0.0, 0.1], [1.0, 1.0, 6.2], [np.nan] * 3])
    near = np.array([[0.3, 0.4, 0.1], [1.0, 1.0, 6.2 - 2 * np.pi + 1.0], [9.0, 9.0, 9.0]])
    # 0.5 m of the first, a radian of the second, and the third was not seen.
    assert poses_apart(near, real) == pytest.approx(((0.25 + HEADING_LENGTH**2) / 2) ** 0.5)
    assert poses_apart(np.full((3, 3), np.nan), real) == NOWHERE
    # One that is lacking weighs as much as one that is far away, and hides no other.
    fell = np.array([[0.3, 0.4, 0.1], [np.nan] * 3, [np.nan] * 3])
    assert poses_apart(fell, real) == pytest.approx(((0.25 + NOWHERE**2) / 2) ** 0.5)


class TrackedBlock:
    """A block that is seen after its first step only; its fitness says nothing."""

    def __init__(self, mass, friction, steps=2):
        self.block, self.steps = Block(mass, friction), steps

    def trial(self, genes, number):
        start = torch.zeros(1, 3, dtype=torch.float64)
        end = self.block.step(start, torch.from_numpy(genes[None]))
        return Tracked(0.0, np.concatenate([end.numpy(), np.full((self.steps - 1, 3), np.nan)]))


@pytest.mark.parametrize("compare", ["similar", "recent", "tracked"])
def test_poses_are_compared_where_they_were_tracked(tmp_path, compare):
    settings = settings_named(
        "paper", compare=compare, adapt_genetic=BitSettings(20, mutation=0.02), **SMALL
    )
    trials = Trials(TrackedBlock(2.0, 0.2), tmp_path / "trials.jsonl", each=1)
    found = Alternation(simulated(), trials, START, settings, seed=3, progress=False).run()
    adapted = found.cycles[0]["L3"]
    assert adapted["compared"]["after"]["poses"] < 0.25 * adapted["compared"]["before"]["poses"]
    assert adapted["held_out"]["after"]["poses"] < 0.5 * adapted["held_out"]["before"]["poses"]
    assert adapted["history"]["best"][-1] >= adapted["compared"]["after"]["poses"] - 1e-12


@pytest.mark.parametrize("compare", ["recent", "tracked"])
def test_lost_trials_do_not_keep_the_others_from_being_compared(tmp_path, compare):
    class Lost(TrackedBlock):
        def trial(self, genes, number):
            found = super().trial(genes, number)
            return 0.0 if number in (5, 15) else found  # one of each round

    trials = Trials(Lost(2.0, 0.2), tmp_path / "trials.jsonl", each=1)
    settings = settings_named("paper", **SMALL, compare=compare, compared=20)
    found = Alternation(simulated(), trials, START, settings, seed=3, progress=False).run()
    adapted = found.cycles[0]["L3"]
    for group in ("compared", "held_out"):
        assert adapted[group]["after"]["poses"] < adapted[group]["before"]["poses"]


def test_fitness_alone_adapts_nothing_where_poses_are_asked_for(tmp_path):
    settings = settings_named("paper", **SMALL, compare="tracked")
    found = alternation(tmp_path / "trials.jsonl", settings).run()
    assert len(found.cycles) == 2
    assert not any("L3" in cycle for cycle in found.cycles)
    assert (found.sets == simulated().as_is).all()


def test_other_poses_than_the_simulator_gives_are_refused(tmp_path):
    trials = Trials(TrackedBlock(2.0, 0.2, steps=3), tmp_path / "trials.jsonl", each=1)
    run = Alternation(
        simulated(), trials, START, settings_named("paper", **SMALL), seed=3, progress=False
    )
    with pytest.raises(UserError, match="tracked 3 poses a trial, and the simulator gives 2"):
        run.run()


@pytest.mark.parametrize("search", ["ga", "cma"])
def test_it_finds_the_parameters_of_reality_and_a_better_controller(tmp_path, search):
    if search == "cma":
        pytest.importorskip("cma")
    settings = settings_named(
        "paper", search=search, adapt=search, adapt_genetic=BitSettings(20, mutation=0.02), **SMALL
    )
    found = alternation(tmp_path / "trials.jsonl", settings).run()
    assert found.start == pytest.approx(reality_of()(START))
    assert found.fitness > found.start + 0.3
    assert found.fitness == pytest.approx(reality_of()(found.genes))
    compared = found.cycles[0]["L3"]["compared"]
    assert compared["individuals"] == 10
    assert compared["after"]["norm"] < 0.25 * compared["before"]["norm"]
    held_out = found.cycles[0]["L3"]["held_out"]
    assert held_out["after"]["rms"] < 0.5 * held_out["before"]["rms"]
    assert {"left_out", "neighbours"} <= set(found.cycles[0]["L3"])
    # A start, 12 candidates, 13 policies, where they lead, and 12 candidates; none counts twice.
    assert 20 < len(found.record) == len(found.record.latest()) <= 1 + 12 + 13 + 1 + 12
    assert found.evaluations <= 38  # policies of two genes repeat each other
    assert len(read_trials(tmp_path / "trials.jsonl")) == found.trials


def test_our_choices_keep_several_sets_and_confirm_finalists(tmp_path):
    pytest.importorskip("cma")
    settings = settings_named(
        "better", cycles=2, generations=6, later_generations=4, candidates=5,
        compare="recent", adapt_generations=5,
    )  # fmt: skip
    found = alternation(tmp_path / "trials.jsonl", settings).run()
    assert found.sets.shape == (settings.sets, 2) == (6, 2)
    apart = found.sets[:, None] - found.sets[None]
    assert (np.sqrt((apart**2).mean(-1))[~np.eye(6, dtype=bool)] >= 0.05 - 1e-9).all()
    whys = [row["why"] for row in read_trials(tmp_path / "trials.jsonl")]
    assert whys.count("confirm") % 3 == 0
    assert found.record.leader().count == settings.confirm == 3
    assert found.fitness == found.record.leader().fitness > found.start


def test_a_leader_is_believed_once_it_was_tried_often_enough():
    record = Evaluations()
    record.add(np.array([[0.1], [0.2], [0.3]]), np.array([1.0, 5.0, 3.0]))
    assert record.believed(2).fitness == 5.0  # nobody was
    record.all.append(Evaluation(np.array([0.2]), 2.6, 2))
    assert record.leader().fitness == 3.0
    assert record.believed(2).fitness == 2.6
    record.all.append(Evaluation(np.array([0.3]), 2.8, 2))
    assert record.believed(2).genes.tolist() == [0.3]
    assert record.believed(2, 4).genes.tolist() == [0.2]
    assert record.believed(1, 1).fitness == 1.0
    assert len(record.latest()) == 3


def test_a_lucky_controller_is_found_out(tmp_path):
    """Every first evaluation of a bad push is lucky, no other one is."""
    real, seen = reality_of(), {}

    def lucky(genes):
        seen[genes.tobytes()] = seen.get(genes.tobytes(), 0) + 1
        return 5.0 if genes[0] < 0.6 and seen[genes.tobytes()] <= 3 else real(genes)

    settings = settings_named("paper", **SMALL | {"policy_steps": 0}, confirm=3, finalists=60)
    trials = Trials(lucky, tmp_path / "trials.jsonl")
    found = Alternation(simulated(), trials, START, settings, progress=False).run()
    assert found.record.leader().count == 3
    assert found.fitness < 5.0


def test_the_budget_is_kept(tmp_path):
    settings = settings_named("paper", **SMALL, budget=20)
    found = alternation(tmp_path / "trials.jsonl", settings).run()
    assert found.evaluations <= 20
    assert len(found.record) == 20
    early, late = found.record.believed(1, 5), found.record.believed(1, 20)
    assert early.fitness <= late.fitness == found.fitness


def test_without_adapting_the_simulator_stays_as_it_is(tmp_path):
    settings = settings_named("paper", **SMALL | {"adapt": "none"})
    found = alternation(tmp_path / "trials.jsonl", settings).run()
    assert (found.sets == simulated().as_is).all()


def test_the_same_seed_gives_the_same_and_an_interruption_changes_nothing(tmp_path):
    settings = settings_named("paper", **SMALL)
    whole = alternation(tmp_path / "whole.jsonl", settings, seed=4).run()
    path, states = tmp_path / "cut.jsonl", []
    count = 0
    real = reality_of()

    def breaks(genes):
        nonlocal count
        count += 1
        if count == 50:
            raise KeyboardInterrupt
        return real(genes)

    with pytest.raises(KeyboardInterrupt):
        Alternation(
            simulated(), Trials(breaks, path), START, settings, seed=4, save=states.append,
            progress=False,
        ).run()  # fmt: skip
    assert len(read_trials(path)) == 49
    trials = Trials(real, path)
    model = simulated()
    again = Alternation(
        model, trials, START, settings, seed=4, state=states[-1], progress=False
    ).run()
    assert again.genes.tolist() == whole.genes.tolist()
    assert again.trials == whole.trials
    assert trials.made == whole.trials - 49
    assert again.cycles == whole.cycles


def test_ctrl_c_between_generations_saves_and_stops(tmp_path, monkeypatch):
    settings, states = settings_named("paper", **SMALL), []
    model = simulated()
    fitness = model.fitness

    def interrupted(genes, parameters):
        if model.tried == 60:
            signal.raise_signal(signal.SIGINT)
        return fitness(genes, parameters)

    monkeypatch.setattr(model, "fitness", interrupted)
    trials = Trials(reality_of(), tmp_path / "trials.jsonl")
    with pytest.raises(Interrupted):
        Alternation(model, trials, START, settings, save=states.append, progress=False).run()
    assert states[-1]["0.L1"].shape == (5, 15)


def test_a_search_is_gone_on_with_by_what_it_was_told():
    def hill(genes):
        return -np.linalg.norm(genes - 0.3, axis=1)

    for name in ("ga", "cma"):
        if name == "cma":
            pytest.importorskip("cma")
        made = [make_search(name, START, BitSettings(8), 0.1, 7) for _ in range(2)]
        whole = Climb(made[0], hill)
        for _ in range(6):
            whole.generation()
        again = Climb(made[1], hill, before=np.stack(whole.fitness[:4]))
        for _ in range(2):
            again.generation()
        np.testing.assert_array_equal(again.asked, whole.asked)
        assert again.history() == whole.history()
        with pytest.raises(ValueError, match="another search"):
            Climb(make_search(name, START, BitSettings(8), 0.1, 7), hill, before=np.zeros((1, 5)))


def test_kept_sets_differ():
    class Given:
        def __init__(self):
            self.sets = np.array([[0.5, 0.5], [0.51, 0.5], [0.9, 0.1], [0.1, 0.9]])

        def ask(self):
            return self.sets

        def tell(self, fitness):
            pass

    climb = Climb(Given(), lambda sets: np.array([-0.1, -0.2, -0.3, -0.4]))
    climb.generation()
    bad, good = (np.array([[0.3, 0.3]]), np.array([-1.0])), (np.array([[0.7, 0.7]]), np.zeros(1))
    assert kept_sets(climb, 3, *bad).tolist() == [[0.5, 0.5], [0.9, 0.1], [0.1, 0.9]]
    assert kept_sets(climb, 1, *bad).tolist() == [[0.5, 0.5]]
    assert kept_sets(climb, 2, *good).tolist() == [[0.7, 0.7], [0.5, 0.5]]


def test_what_does_not_fit_is_refused():
    with pytest.raises(UserError, match="has no parameters that could be adjusted"):
        Simulated(SlippingWheels(), Slide(), Push())
    with pytest.raises(UserError, match="outside of 0 to 1"):
        simulated().shares_of(np.array([0.5, 1.5]))
    with pytest.raises(UserError, match="expected 2 genes"):
        simulated().shares_of(np.array([0.5]))


@pytest.mark.parametrize(
    ("change", "said"),
    [({"search": "hill"}, "search is one of"), ({"adapt": "hill"}, "adapt is ga, cma or none"),
     ({"cycles": 0}, "cycles must be at least 1"), ({"spread": 0.0}, "spread is a share"),
     ({"compare": "all"}, "similar, recent, tracked"), ({"budget": -1}, "not be negative")],
)  # fmt: skip
def test_settings_that_cannot_be_are_refused(change, said):
    with pytest.raises(UserError, match=said):
        settings_named("paper", **change)
    with pytest.raises(UserError, match="paper and better"):
        settings_named("best")
