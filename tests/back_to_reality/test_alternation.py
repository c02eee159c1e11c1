"""The whole alternation, in a world without legs."""

import signal

import numpy as np
import pytest
import torch
from hill_climber import HillClimber
from ideal_simulator import SlippingWheels
from sliding_block import Block, Push, Slide, reality_of

from neurosim.back_to_reality import (
    Alternation,
    Journal,
    Simulated,
    Tracked,
    settings_named,
)
from neurosim.back_to_reality.adapt import (
    HEADING_LENGTH,
    Compared,
    agreement,
    discrepancy,
    paths_apart,
    similar,
)
from neurosim.back_to_reality.evaluations import Evaluation, Evaluations
from neurosim.base.errors import FileError, UserError
from neurosim.evolution.bits import BitSettings, decode, encode
from neurosim.evolution.optimisers import OPTIMISERS
from neurosim.loop.journal import read_trials

START = np.array([0.5, 0.5])
SMALL = {"generations": 15, "adapt_generations": 25, "candidates": 12, "policy_steps": 1}


def simulated():
    return Simulated(Block(), Slide(), Push())


def alternation(path, settings, **others):
    trials = Journal(reality_of(), path)
    return Alternation(simulated(), trials, START, settings, progress=False, **others)


def test_the_simulator_gives_what_was_worked_out_by_hand():
    """Mass 1, friction 0.1: pushed by 0.5 twice it goes 0.8 ahead, and 0.35 to the side."""
    model = simulated()
    assert model.fitness(START[None], model.as_is) == pytest.approx([0.8 - 0.35])
    heavy = np.array([model.parameters[0].fraction(2.0), model.parameters[1].fraction(0.2)])
    assert model.values(heavy) == pytest.approx([2.0, 0.2])
    expected = [reality_of()(START), reality_of()(np.array([0.9, 0.2]))]
    genes = np.stack([START, [0.9, 0.2]])
    assert model.over(genes, np.stack([heavy])) == pytest.approx(np.array([expected]))


def test_discrepancy_and_choice_of_similar_ones_by_hand():
    result = discrepancy(np.array([[1.0, 2.0], [4.0, 6.0]]), np.array([1.0, 2.0]))
    assert result == pytest.approx([0.0, 5.0])
    simulated_, real = np.array([1.0, 0.5, 0.4, 0.0]), np.array([0.9, 0.1, 0.4, 0.0])
    assert similar(simulated_, real, 2).tolist() == [0, 2]
    # A controller that fails in both is similar, but comes last.
    assert similar(simulated_, real, 3).tolist() == [0, 1, 2]


def test_agreement_by_hand():
    class Given(Simulated):
        def __init__(self):
            pass

        def fitness(self, genes, parameters):
            return genes[:, 0] + parameters[0]

    compared = Compared(Given(), np.array([[1.0], [2.0], [3.0]]), np.array([1.0, 2.0, 5.0]))
    result = agreement(compared, np.array([[0.0], [2.0]]), np.array([[0.0]]))
    assert result["before"]["norm"] == pytest.approx(3**0.5)
    assert result["after"]["norm"] == pytest.approx(2.0)
    assert result["after"]["median"] == 0.0
    assert result["after"]["rms"] == pytest.approx((4 / 3) ** 0.5)
    assert result["after"]["rank"] == pytest.approx(1.0)
    assert "poses" not in result["after"]


def path(*poses):
    return np.array(poses, float)


def test_paths_apart_by_hand():
    """Displacements of one step: 0.5 m apart, then a radian; of all two: 0.5 m and a radian."""
    nowhere = [np.nan] * 3
    real = path((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (2.0, 0.0, 6.2))
    near = path((0.0, 0.0, 0.0), (1.3, 0.4, 0.0), (2.3, 0.4, 6.2 - 2 * np.pi + 1.0))
    radian = HEADING_LENGTH**2
    one, two = ((0.25 + radian) / 2) ** 0.5, (0.25 + radian) ** 0.5
    assert paths_apart(near, real[None]) == pytest.approx((one + two / 2) / 2)
    assert paths_apart(real, np.stack([real, real])) == 0.0
    # Where it was not seen for a while nothing is compared but what is known on both sides.
    gap = path(real[0], nowhere, real[2])
    assert paths_apart(near, gap[None]) == pytest.approx(two / 2)
    # A single pose far from the start begins or ends no window that is known.
    late = np.concatenate([real[:1], np.full((9, 3), np.nan), real[2:]])
    assert paths_apart(np.zeros((11, 3)), late[None]) == 0.0
    # A robot that fell stands, whether in reality or in the simulator.
    fell = path(real[0], real[1], nowhere)
    stood = path(real[0], real[1], real[1])
    assert paths_apart(near, fell[None]) == paths_apart(near, stood[None])
    assert paths_apart(fell, near[None]) == paths_apart(stood, near[None])
    assert paths_apart(fell, fell[None]) == 0.0


def test_paths_are_compared_up_to_the_circle():
    """One ends at 2 m, and the other goes on; before that, they are 0.1 m apart a second."""
    real = np.zeros((41, 3))
    real[:, 0] = np.linspace(0.0, 4.0, 41)
    near = real * [0.9, 1.0, 1.0]
    real[21:] = np.nan
    assert paths_apart(near, real[None], 1, 2.0) == pytest.approx(0.01)
    assert paths_apart(near, real[None], 1) > 0.04  # as if it had fallen there
    fell = np.where(np.arange(41)[:, None] > 9, np.nan, real)
    assert paths_apart(near, fell[None], 1, 2.0) > 0.04


def test_windows_of_paths_count_by_their_length():
    """Twice the speed: 1 m in windows of 10 steps, and 4 m, divided by four, in those of 40."""
    slow = np.zeros((101, 3))
    slow[:, 0] = 0.1 * np.arange(101)
    assert paths_apart(slow * [2.0, 1.0, 1.0], slow[None], 10) == pytest.approx(1.0)


class Remembering(Simulated):
    """Remembers the individuals and the parameter sets of each call."""

    def __init__(self):
        super().__init__(Block(), Slide(), Push())
        self.asked = []

    def over(self, genes, sets):
        result = super().over(genes, sets)
        self.asked.append((genes, sets, result))
        return result

    def expected(self, genes, sets):
        return simulated().expected(genes, sets)  # no search asks for it


#: First populations are copies of what the search starts from.
COPIES = BitSettings(15, mutation=0.02, first_mutation=0.0)


def remembered(tmp_path, **changes):
    """Run the paper's settings at a small size; return what was asked, trials and the result."""
    model, path = Remembering(), tmp_path / "trials.jsonl"
    settings = settings_named("paper", **{**SMALL, "trials": 1, "genetic": COPIES, **changes})
    run = Alternation(
        model, Journal(reality_of(), path, each=1), START, settings, seed=5, progress=False
    )
    rolled_out = run.run()
    return model.asked, read_trials(path), rolled_out


def bits(fractions):
    return decode(encode(fractions, 8), 8)


def test_controllers_are_evolved_over_all_sets_with_caution(tmp_path):
    asked, _, parameters = remembered(tmp_path, sets=3, caution=2.0, prior=0.1, adapt="none")
    expected, others = [], set()
    for _, sets, fitness in asked:
        assert sets.shape == (3, 2)
        np.testing.assert_array_equal(sets[0], simulated().as_is)
        others.add(sets[1:].tobytes())
        expected.append((fitness.mean(axis=0) - 2.0 * fitness.std(axis=0)).max())
    assert len(others) == len(asked) > 1  # a generation cannot depend on those of another
    each = [best for cycle in parameters.cycles for best in cycle["L1"]["best"]]
    assert each == pytest.approx(expected)


def test_the_sets_are_spread_by_the_prior(tmp_path):
    asked, *_ = remembered(tmp_path, sets=300, prior=0.02, adapt="none", generations=1)
    sets = asked[0][1]
    assert (sets[1:] - simulated().as_is).std(axis=0) == pytest.approx(0.02, rel=0.15)


@pytest.mark.slow
@pytest.mark.parametrize(("sets", "prior"), [(2, 0.1), (2, 0.02), (1, 0.1)])
def test_a_prediction_is_the_mean_over_what_the_parameters_may_be(tmp_path, sets, prior):
    """Within four standard errors of the mean over many sets; with one set, of that alone."""
    _, rows, run = remembered(tmp_path, sets=sets, prior=prior, policy_steps=0)
    tried = np.array([row["genes"] for row in rows if row["why"] == "cycle 1, L1"])
    model, around = simulated(), np.random.default_rng(1).standard_normal((1000, 2))
    of_each = model.over(tried, np.clip(model.as_is + prior * around, 0.0, 1.0))
    predicted, as_is = run.cycles[0]["transfer"]["simulated"], model.fitness(tried, model.as_is)
    if sets == 1:
        assert predicted == as_is.tolist()
    else:
        away = np.abs(predicted - of_each.mean(axis=0)) / of_each.std(axis=0)
        assert away.max() < 4.0 / 16**0.5
        assert np.all(predicted != as_is)


def test_later_searches_begin_at_the_best_in_reality_and_have_their_own_length(tmp_path):
    asked, rows, parameters = remembered(tmp_path, cycles=2, later_generations=4, adapt="none")
    assert [len(cycle["L1"]["best"]) for cycle in parameters.cycles] == [15, 4, 4]
    done, best, begins = [], [], [0, 15, 19]
    for cycle in (1, 2, 3):
        best.append(max(done, key=lambda row: row["fitness"])["genes"] if done else START)
        done += [row for row in rows if row["why"].startswith((f"cycle {cycle}", "start"))]
    for begin, start in zip(begins, best, strict=True):
        np.testing.assert_allclose(asked[begin][0], np.tile(bits(np.array(start)), (15, 1)))
    # The second search begins at a result of L2.
    assert best[1] in [row["genes"] for row in rows if "1, L2" in row["why"]]


def test_candidates_are_of_generations_spread_over_the_search(tmp_path):
    genetic = BitSettings(15, mutation=0.05, first_mutation=0.3)
    asked, rows, _ = remembered(tmp_path, genetic=genetic, candidates=4)
    tried = [row["genes"] for row in rows if row["why"] == "cycle 1, L1"]
    firsts = [asked[n][0][asked[n][2][0].argmax()].tolist() for n in (14, 9, 5, 0)]
    assert len(set(map(tuple, firsts))) == 4
    assert tried == firsts


def test_l2_begins_at_the_best_in_reality(tmp_path):
    _, rows, _ = remembered(tmp_path, adapt="none")
    before = [row for row in rows if "L2" not in row["why"] and "cycle 2" not in row["why"]]
    best = max(before, key=lambda row: row["fitness"])["genes"]
    policies = np.array([row["genes"] for row in rows if row["why"] == "cycle 1, L2, step 1"])
    assert best != START.tolist()
    np.testing.assert_allclose((policies.max(axis=0) + policies.min(axis=0)) / 2.0, best)


@pytest.mark.slow
def test_recent_are_the_last_that_were_tried_and_the_best(tmp_path):
    _, rows, parameters = remembered(
        tmp_path, compare="recent", compared=6, policy_steps=0, cycles=2
    )
    by = {row["why"]: [] for row in rows}
    for row in rows:
        by[row["why"]].append(row["fitness"])
    till = by["start"] + by["cycle 1, L1"]
    for cycle in (1, 2):
        best = till.index(max(till))
        expected = [*[fitness for n, fitness in enumerate(till) if n != best][-5:], till[best]]
        assert parameters.cycles[cycle - 1]["L3"]["compared"]["real"] == expected
        till = till + by["cycle 2, L1"]


def test_l3_goes_on_from_the_adapted_simulator(tmp_path):
    genetic = BitSettings(12, mutation=0.02, first_mutation=0.0)
    asked, _, parameters = remembered(tmp_path, adapt_genetic=genetic, policy_steps=0, cycles=2)
    adapting = [n for n, (_, sets, _) in enumerate(asked) if len(sets) == 12]
    begins = [n for n in adapting if n - 1 not in adapting]
    named = [asked[n][1][0] for n in begins]
    model = simulated()
    first = parameters.cycles[0]["L3"]["parameters"][0]
    after = [one.fraction(first[one.name]) for one in model.parameters]
    for expected, at in zip([model.as_is, np.array(after)], named, strict=True):
        np.testing.assert_allclose(at, bits(expected))
    assert named[0].tolist() != named[1].tolist()


@pytest.mark.parametrize(("fraction", "works"), [(0.76, 1.0), (0.74, 0.0)])
def test_a_controller_works_in_both_if_it_is_alike_by_a_quarter_of_the_larger(
    tmp_path, fraction, works
):
    model = simulated()
    settings = settings_named("paper", **SMALL)

    def real(genes):
        return fraction * float(model.fitness(genes[None], model.as_is)[0])

    trials = Journal(real, tmp_path / "trials.jsonl", each=1)
    run_result = Alternation(model, trials, START, settings, progress=False).run()
    assert min(run_result.cycles[0]["transfer"]["real"]) > 0.0
    assert run_result.cycles[0]["transfer"]["works"] == works


def test_simulations_that_blow_up_are_failures():
    class Bursts(Block):
        def step(self, state, command, generator=None):
            return super().step(state, command) + torch.where(command[:, :1] > 0.8, np.nan, 0.0)

    model = Simulated(Bursts(), Slide(), Push())
    # Pushed by nothing it slides aside by the second gene.
    result = model.fitness(np.array([[0.9, 0.5], [0.5, 0.5], [0.0, 0.5]]), model.as_is)
    assert result == pytest.approx([-0.5, 0.45, -0.5])
    assert model.fitness(np.array([[0.9, 0.5], [0.5, 0.5]]), model.as_is)[0] == 0.0


def test_ranks_of_equal_ones_are_their_mean():
    class Given(Simulated):
        def __init__(self):
            pass

        def fitness(self, genes, parameters):
            return genes[:, 0]

    # Ranks 1.5, 1.5, 3, 4 and 1, 2, 3, 4: a covariance of 4.5 by the root of 4.5 times 5.
    compared = Compared(Given(), np.array([[1.0], [1.0], [2.0], [3.0]]), np.arange(4.0))
    out = agreement(compared, np.zeros((1, 1)), np.zeros((1, 1)))
    assert out["after"]["rank"] == pytest.approx((4.5 / 5.0) ** 0.5)


class TrackedBlock:
    """A block that is seen after its first step only; its fitness is unknown."""

    def __init__(self, mass, friction, steps=2):
        self.block, self.steps = Block(mass, friction), steps
        if steps == 1:
            self.filmed = 1  # the task has two

    def trial(self, genes, number):
        start = torch.zeros(1, 3, dtype=torch.float64)
        end = self.block.step(start, torch.from_numpy(genes[None]))
        return Tracked(0.0, np.concatenate([end.numpy(), np.full((self.steps - 1, 3), np.nan)]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("compare", "steps"), [("similar", 2), ("recent", 2), ("tracked", 2), ("tracked", 1)]
)
def test_poses_are_compared_where_they_were_tracked(tmp_path, compare, steps):
    settings = settings_named(
        "paper", compare=compare, adapt_genetic=BitSettings(20, mutation=0.02), **SMALL
    )
    trials = Journal(TrackedBlock(2.0, 0.2, steps), tmp_path / "trials.jsonl", each=1)
    run_result = Alternation(simulated(), trials, START, settings, seed=3, progress=False).run()
    adapted = run_result.cycles[0]["L3"]
    assert adapted["compared"]["after"]["poses"] < 0.25 * adapted["compared"]["before"]["poses"]
    assert adapted["held_out"]["after"]["poses"] < 0.5 * adapted["held_out"]["before"]["poses"]
    assert adapted["history"]["best"][-1] >= adapted["compared"]["after"]["poses"] - 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("compare", ["recent", "tracked"])
def test_lost_trials_do_not_keep_the_others_from_being_compared(tmp_path, compare):
    class Lost(TrackedBlock):
        def trial(self, genes, number):
            run_result = super().trial(genes, number)
            return 0.0 if number in (5, 15) else run_result  # one of each round

    trials = Journal(Lost(2.0, 0.2), tmp_path / "trials.jsonl", each=1)
    settings = settings_named("paper", **SMALL, compare=compare, compared=20)
    run_result = Alternation(simulated(), trials, START, settings, seed=3, progress=False).run()
    adapted = run_result.cycles[0]["L3"]
    for group in ("compared", "held_out"):
        assert adapted[group]["after"]["poses"] < adapted[group]["before"]["poses"]


def test_fitness_alone_adapts_nothing_where_poses_are_asked_for(tmp_path):
    settings = settings_named("paper", **SMALL, compare="tracked")
    run_result = alternation(tmp_path / "trials.jsonl", settings).run()
    assert len(run_result.cycles) == 2
    assert not any("L3" in cycle for cycle in run_result.cycles)
    assert (run_result.parameters == simulated().as_is).all()


def test_other_poses_than_the_simulator_gives_are_refused(tmp_path):
    path, messages = (
        tmp_path / "trials.jsonl",
        "tracked 3 poses in a trial; expected 2, one after each",
    )
    settings = settings_named("paper")
    trials = Journal(TrackedBlock(2.0, 0.2, steps=3), path, each=1)
    run = Alternation(simulated(), trials, START, settings, progress=False)
    with pytest.raises(UserError, match=messages):
        run.run()
    assert read_trials(path) == []
    Journal(TrackedBlock(2.0, 0.2, steps=3), path, each=1).evaluate(START[None], "before")
    with pytest.raises(FileError, match=f"line 2, field 'poses': reality {messages}"):
        Alternation(simulated(), Journal(TrackedBlock(2.0, 0.2), path), START, settings)


@pytest.mark.parametrize("search", ["ga", "cma"])
def test_it_finds_the_parameters_of_reality_and_a_better_controller(tmp_path, search):
    if search == "cma":
        pytest.importorskip("cma")
    settings = settings_named(
        "paper", search=search, adapt=search, adapt_genetic=BitSettings(20, mutation=0.02), **SMALL
    )
    run_result = alternation(tmp_path / "trials.jsonl", settings).run()
    assert run_result.start == pytest.approx(reality_of()(START))
    assert run_result.fitness > run_result.start + 0.3
    assert run_result.fitness == pytest.approx(reality_of()(run_result.genes))
    compared = run_result.cycles[0]["L3"]["compared"]
    assert compared["individuals"] == 10
    assert compared["after"]["norm"] < 0.25 * compared["before"]["norm"]
    held_out = run_result.cycles[0]["L3"]["held_out"]
    assert held_out["after"]["rms"] < 0.5 * held_out["before"]["rms"]
    assert {"left_out", "neighbours"} <= set(run_result.cycles[0]["L3"])
    # A start, 12 candidates, 13 policies, where they lead, and 12 candidates; none counts twice.
    assert 20 < len(run_result.record) == len(run_result.record.latest()) <= 1 + 12 + 13 + 1 + 12
    assert run_result.evaluations <= 38  # policies of two genes repeat each other
    assert len(read_trials(tmp_path / "trials.jsonl")) == run_result.trials


def test_our_choices_take_several_sets_and_confirm_finalists(tmp_path, monkeypatch):
    pytest.importorskip("cma")
    settings = settings_named(
        "better", cycles=2, generations=6, later_generations=4, candidates=5,
        compare="recent", adapt_generations=5,
    )  # fmt: skip
    seen, over = [], Simulated.over
    monkeypatch.setattr(
        Simulated, "over", lambda self, genes, sets: [seen.append(sets), over(self, genes, sets)][1]
    )
    run_result = alternation(tmp_path / "trials.jsonl", settings).run()
    last = [sets for sets in seen if len(sets) == settings.sets == 6][-1]
    # Around what L3 came to.
    adapted = run_result.cycles[1]["L3"]["parameters"][0]
    assert simulated().values(last[0]) == pytest.approx(list(adapted.values()))
    assert simulated().values(run_result.parameters) == pytest.approx(list(adapted.values()))
    apart = np.abs(last[1:] - last[0])
    assert apart.min() > 0.0
    assert apart.max() < 4.0 * settings.prior
    whys = [row["why"] for row in read_trials(tmp_path / "trials.jsonl")]
    assert whys.count("confirm") % 3 == 0
    assert run_result.record.leader().count == settings.confirm == 3
    assert run_result.fitness == run_result.record.leader().fitness > run_result.start


def test_a_leader_is_believed_once_it_was_tried_often_enough():
    record = Evaluations()
    record.add(np.array([[0.1], [0.2], [0.3]]), np.array([1.0, 5.0, 3.0]))
    assert record.believed(2).fitness == 5.0  # none was tried twice
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
    trials = Journal(lucky, tmp_path / "trials.jsonl")
    run_result = Alternation(simulated(), trials, START, settings, progress=False).run()
    assert run_result.record.leader().count == 3
    assert run_result.fitness < 5.0


@pytest.mark.parametrize(("finalists", "steps"), [(2, 0), (6, 0), (2, 1)])
def test_evaluations_are_spared_to_confirm_within_the_budget(tmp_path, finalists, steps):
    settings = settings_named(
        "paper", **SMALL | {"policy_steps": steps, "candidates": 17}, budget=20, confirm=4,
        finalists=finalists,
    )  # fmt: skip
    run_result = alternation(tmp_path / "trials.jsonl", settings).run()
    whys = [row["why"] for row in read_trials(tmp_path / "trials.jsonl")][::3]
    assert run_result.evaluations == len(whys) <= 20
    assert "confirm" in whys
    last = max(n for n, why in enumerate(whys) if why != "confirm")
    assert last < 20 - finalists
    assert run_result.record.leader().count > 1


def test_the_budget_is_kept(tmp_path):
    settings = settings_named("paper", **SMALL, budget=20)
    run_result = alternation(tmp_path / "trials.jsonl", settings).run()
    assert run_result.evaluations <= 20
    assert len(run_result.record) == 20
    early, late = run_result.record.believed(1, 5), run_result.record.believed(1, 20)
    assert early.fitness <= late.fitness == run_result.fitness


def test_without_adapting_the_simulator_stays_as_it_is(tmp_path):
    settings = settings_named("paper", **SMALL | {"adapt": "none"})
    run_result = alternation(tmp_path / "trials.jsonl", settings).run()
    assert (run_result.parameters == simulated().as_is).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ga", "cma", "own"])
def test_the_same_seed_gives_the_same_and_an_interruption_changes_nothing(
    tmp_path, name, monkeypatch
):
    if name == "cma":
        pytest.importorskip("cma")
    monkeypatch.setitem(OPTIMISERS._registered, "own", HillClimber)
    settings = settings_named("paper", search=name, adapt=name, **SMALL)
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
            simulated(), Journal(breaks, path), START, settings, seed=4, save=states.append,
            progress=False,
        ).run()  # fmt: skip
    assert len(read_trials(path)) == 49
    trials = Journal(real, path)
    model = simulated()
    again = Alternation(
        model, trials, START, settings, seed=4, state=states[-1], progress=False
    ).run()
    assert again.genes.tolist() == whole.genes.tolist()
    assert again.trials == whole.trials
    assert trials.made == whole.trials - 49
    assert again.cycles == whole.cycles


@pytest.mark.slow
@pytest.mark.parametrize("cut", [20, 40, 55, 70])
def test_an_interruption_changes_nothing_where_noisy_trials_are_tracked(tmp_path, cut):
    """Trials that confirm gaits after L3 are in the file when L3 is run again."""
    block = TrackedBlock(2.0, 0.2)

    def noisy(genes, number):
        at = block.trial(genes, number).poses
        at = at + 0.05 * np.random.default_rng([9, number]).standard_normal(at.shape)
        return Tracked(float(at[0, 0]), at)

    class Noisy:
        breaks = None

        def trial(self, genes, number):
            if number == self.breaks:
                raise KeyboardInterrupt
            return noisy(genes, number)

    settings = settings_named(
        "paper", **SMALL | {"policy_steps": 0}, cycles=3, compare="recent", sets=3, confirm=3,
        finalists=4, trials=1,
    )  # fmt: skip

    def run(path, reality, state=None):
        trials, states = Journal(reality, path, each=1), []
        runs = Alternation(
            simulated(), trials, START, settings, seed=2, state=state, save=states.append,
            progress=False,
        )  # fmt: skip
        try:
            return runs.run(), states
        except KeyboardInterrupt:
            return None, states

    whole, _ = run(tmp_path / "whole.jsonl", Noisy())
    broken = Noisy()
    broken.breaks = min(cut, whole.trials - 1)
    nothing, states = run(tmp_path / "cut.jsonl", broken)
    assert nothing is None
    again, _ = run(tmp_path / "cut.jsonl", Noisy(), states[-1])
    assert again.cycles == whole.cycles
    assert again.genes.tolist() == whole.genes.tolist()
    np.testing.assert_array_equal(again.parameters, whole.parameters)


def test_ctrl_c_between_generations_saves_and_stops(tmp_path, monkeypatch):
    settings, states = settings_named("paper", **SMALL), []
    model = simulated()
    fitness = model.fitness

    def interrupted(genes, parameters):
        if model.tried == 60:
            signal.raise_signal(signal.SIGINT)
        return fitness(genes, parameters)

    monkeypatch.setattr(model, "fitness", interrupted)
    trials = Journal(reality_of(), tmp_path / "trials.jsonl")
    with pytest.raises(KeyboardInterrupt):
        Alternation(model, trials, START, settings, save=states.append, progress=False).run()
    assert states[-1]["0.L1.fitness"].shape == (5, 15)


def test_cma_of_a_single_parameter_is_refused_before_any_trial(tmp_path):
    pytest.importorskip("cma")

    class Heavy(Block):
        @property
        def parameters(self):
            return super().parameters[:1]

    model = Simulated(Heavy(), Slide(), Push())
    with pytest.raises(UserError, match="at least two parameters: use ga"):
        Alternation(model, Journal(reality_of(), tmp_path / "a.jsonl"), START,
                    settings_named("paper", adapt="cma"))  # fmt: skip


def test_what_was_started_from_is_told_by_all_its_trials(tmp_path):
    """The first trial of the start is bad, and no candidate is better."""
    answers = iter([0.2, *[0.0] * 4, 0.9, 0.7])
    settings = settings_named(
        "paper", **SMALL | {"candidates": 4, "policy_steps": 0}, adapt="none", confirm=3, budget=8
    )
    trials = Journal(lambda genes: next(answers), tmp_path / "trials.jsonl", each=1)
    run_result = Alternation(simulated(), trials, START, settings, progress=False).run()
    assert run_result.genes.tolist() == START.tolist()
    assert run_result.start == run_result.fitness == pytest.approx(0.6)


def test_what_does_not_fit_is_refused():
    with pytest.raises(UserError, match="has no parameters that could be adjusted"):
        Simulated(SlippingWheels(), Slide(), Push())
    with pytest.raises(UserError, match="outside of 0 to 1"):
        simulated().fractions_of(np.array([0.5, 1.5]))
    with pytest.raises(UserError, match="expected 2 genes"):
        simulated().fractions_of(np.array([0.5]))


@pytest.mark.parametrize(
    ("change", "message"),
    [({"spread": 0.0}, "spread: .* found 0"),
     ({"compare": "all"}, "compare: .* 'similar', 'recent', 'tracked', found 'all'")],
)  # fmt: skip
def test_settings_that_cannot_be_are_refused(change, message):
    with pytest.raises(UserError, match=message):
        settings_named("paper", **change)
    with pytest.raises(UserError, match="paper or better"):
        settings_named("best")


@pytest.mark.parametrize("which", ["search", "adapt"])
def test_an_optimiser_that_does_not_suit_is_refused_before_any_trial(tmp_path, which, monkeypatch):
    class Keyed(HillClimber):
        hints = ("keys",)

    monkeypatch.setitem(OPTIMISERS._registered, "keyed", Keyed)
    for name, message in (
        ("hill", "there is no optimiser 'hill'"),
        ("keyed", "needs keys in addition"),
    ):
        with pytest.raises(UserError, match=message):
            alternation(tmp_path / "trials.jsonl", settings_named("paper", **{which: name}))
