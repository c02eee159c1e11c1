"""A whole run and its folder: written whole, resumed, refused."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
from sliding_block import Block, Push, Slide, reality_of

from neurosim.back_to_reality import settings_named
from neurosim.back_to_reality.run import back_to_reality, start_genes
from neurosim.base.errors import FileError, RobotError, UserError
from neurosim.controllers import CONTROLLERS, read_controller
from neurosim.controllers.gait import HAND_TUNED, Gait, genes_of
from neurosim.loop.journal import read_trials
from neurosim.reports import alternation
from neurosim.reports.report import write_report
from neurosim.reports.svg import drawing
from neurosim.tasks.registry import TASKS
from neurosim.trials.by_hand import ByHand

START = np.array([0.5, 0.5])
SMALL = settings_named(
    "paper", generations=8, adapt_generations=6, candidates=11, policy_steps=1, trials=2
)


class Real:
    """A block of the lab; it can break."""

    def __init__(self, breaks=None):
        self.fitness, self.breaks, self.made = reality_of(), breaks, 0

    def describe(self):
        return {"kind": "block", "virtual": True}

    def trial(self, genes, number):
        if number == self.breaks:
            raise RobotError("the block is gone")
        self.made += 1
        return self.fitness(genes)


@pytest.fixture(autouse=True)
def _registered(monkeypatch):
    monkeypatch.setitem(CONTROLLERS._registered, "push", Push)
    monkeypatch.setitem(TASKS._registered, "slide", Slide)


def run(out, reality, **others):
    settings = {"settings": SMALL, "seed": 3, "start": START, "progress": False, **others}
    return back_to_reality(Block(), Slide(), Push(), reality, out=out, **settings)


def test_a_search_that_is_not_installed_is_refused_before_any_trial(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "cma", None)
    reality = Real()
    for settings in (settings_named("better"), settings_named("paper", adapt="cma")):
        with pytest.raises(UserError, match=r"pip install 'neurosim\[cma\]'"):
            run(tmp_path / "out", reality, settings=settings)
    assert reality.made == 0
    assert list(tmp_path.iterdir()) == []


def test_the_folder_of_a_run(tmp_path):
    content = run(tmp_path / "out", Real())
    written = json.loads((tmp_path / "out" / "back-to-reality.json").read_text())
    assert written["best"] == content["best"]
    assert written["trials"] == len(read_trials(tmp_path / "out" / "trials.jsonl"))
    assert written["evaluations"] * 2 == written["trials"]
    assert written["reality"]["virtual"] is True
    assert [one["name"] for one in written["parameters"]] == ["mass", "friction"]
    saved = read_controller(tmp_path / "out" / "controller")
    assert reality_of()(saved.genes) == pytest.approx(written["best"]["fitness"])
    assert written["best"]["fitness"] > written["start"]["fitness"]
    assert not (tmp_path / "out.checkpoint").exists()
    assert not (tmp_path / "out" / "simulator").exists()  # this one cannot be written


def test_an_interrupted_run_goes_on_and_repeats_no_trial(tmp_path):
    whole = run(tmp_path / "whole", Real())
    with pytest.raises(RobotError, match="the block is gone"):
        run(tmp_path / "out", Real(breaks=30))
    assert not (tmp_path / "out").exists()
    kept = read_trials(tmp_path / "out.checkpoint" / "trials.jsonl")
    assert len(kept) == 30
    with pytest.raises(UserError, match="interrupted run"):
        run(tmp_path / "out", Real())
    with pytest.raises(UserError, match="begun with seed = 3, not 4"):
        run(tmp_path / "out", Real(), seed=4, resume=True)
    reality = Real()
    again = run(tmp_path / "out", reality, resume=True)
    assert reality.made == whole["trials"] - 30
    assert json.dumps(again, default=list) == json.dumps(whole, default=list)


def test_nothing_is_left_of_a_run_that_did_not_begin(tmp_path):
    with pytest.raises(RobotError):
        run(tmp_path / "out", Real(breaks=0))
    with pytest.raises(UserError, match="needs a person"):
        run(tmp_path / "out", ByHand(Push()))
    assert list(tmp_path.iterdir()) == []


def test_where_l2_came_to_is_tried_and_written_down(tmp_path):
    content = run(tmp_path / "out", Real())
    trials = read_trials(tmp_path / "out" / "trials.jsonl")
    ends = [row for row in trials if row["why"] == "cycle 1, L2, its end"]
    assert len(ends) == SMALL.trials
    assert len(content["cycles"][0]["L2"]["best"]) == SMALL.policy_steps + 1


def test_a_controller_that_could_not_be_read_again_is_refused_before_any_trial(
    tmp_path, monkeypatch
):
    monkeypatch.delitem(CONTROLLERS._registered, "push")
    reality = Real()
    with pytest.raises(UserError, match="so it cannot be read again: register its family first"):
        run(tmp_path / "out", reality)
    assert reality.made == 0
    assert list(tmp_path.iterdir()) == []


def test_another_simulator_is_not_gone_on_with(tmp_path):
    with pytest.raises(RobotError):
        run(tmp_path / "out", Real(breaks=20))
    for other in (Block(mass=1.1), Block(friction=0.2)):
        with pytest.raises(UserError, match=r"was begun with simulator\.parameters\.\w+\.value = "):
            back_to_reality(
                other, Slide(), Push(), Real(), out=tmp_path / "out", start=START, settings=SMALL,
                seed=3, resume=True, progress=False,
            )  # fmt: skip


class Written(Block):
    """A block that can be written."""

    def write(self, folder):
        folder.mkdir()


@pytest.mark.parametrize("compare", ["tracked", "recent"])
def test_one_simulator_is_written(tmp_path, compare):
    """It is the given or the adapted one, without the random ones around it."""
    settings = replace(SMALL, sets=3, compare=compare)
    back_to_reality(
        Written(), Slide(), Push(), Real(), out=tmp_path / "out", start=START, settings=settings,
        progress=False,
    )  # fmt: skip
    assert [path.name for path in (tmp_path / "out").glob("simulator*")] == ["simulator"]


def test_the_best_may_blow_up_in_the_simulator(tmp_path):
    class Bursts(Block):
        def step(self, state, command, generator=None):
            return super().step(state, command) * np.nan

    content = back_to_reality(
        Bursts(), Slide(), Push(), Real(), out=tmp_path / "out", start=START, settings=SMALL,
        progress=False,
    )  # fmt: skip
    assert content["best"]["fitness"] > 0.0
    saved = read_controller(tmp_path / "out" / "controller")
    assert saved.predicted["fitness"] == 0.0
    assert saved.predicted["poses"] == [[0.0, 0.0, 0.0]]


def test_something_that_stands_there_is_kept(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine")
    with pytest.raises(UserError, match="not empty"):
        run(tmp_path / "out", Real())
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.slow
def test_the_report_has_the_four_panels(tmp_path):
    run(tmp_path / "out", Real())
    summary = write_report([tmp_path / "out", tmp_path / "out" / "controller"], tmp_path / "a.html")
    assert "In reality the controller went from a fitness of" in summary["verdict"]
    assert summary["virtual"] is True
    page = (tmp_path / "a.html").read_text()
    for panel in ("(L1)", "(L2)", "(L3)", "Back in the adapted simulator"):
        assert panel in page
    assert "there was none" not in page
    assert "of the next round" in page


def test_negative_fitness_is_drawn():
    for lowest, expected in ((0.5, 0.0), (-2.0, -2.0)):
        with drawing(3.0, 2.0) as (_, axes):
            curves = {"best": [lowest, 3.0], "mean": [lowest, 2.0]}
            alternation._curves(axes, [curves], "L1", "fitness", "generation")
            assert axes.get_ylim()[0] <= expected
            assert (axes.get_ylim()[0] == 0.0) == (lowest > 0.0)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda d: d["best"].update(fitness="fast"), "best.fitness"),
        (lambda d: d["parameters"][1].pop("low"), r"parameters\[1\]"),
        (lambda d: d["cycles"][0]["L1"]["best"].pop(), r"cycles\[0\]\.L1"),
        (lambda d: d["cycles"][0]["L3"]["parameters"][0].pop("mass"), r"L3\.parameters"),
        (lambda d: d["cycles"][0]["L3"]["compared"].pop("after"), r"L3\.compared"),
        (lambda d: d["real"].append(None), "real"),
        (lambda d: d.pop("cycles"), "cycles"),
    ],
)
def test_the_report_refuses_a_damaged_file(tmp_path, change, field):
    run(tmp_path / "out", Real())
    path = tmp_path / "out" / "back-to-reality.json"
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
    with pytest.raises(FileError, match=f"back-to-reality.json, field '.*{field}"):
        write_report([tmp_path / "out"], tmp_path / "a.html")
    assert not (tmp_path / "a.html").exists()


def test_what_to_start_from(tmp_path):
    assert start_genes(Gait()).tolist() == genes_of(HAND_TUNED).tolist()
    head = {"format": "neurosim-parameters", "version": 1}
    path = tmp_path / "gait.json"
    path.write_text(json.dumps({**head, "parameters": {**HAND_TUNED, "turn": 0.3}}))
    assert Gait().named(start_genes(Gait(), path))["turn"] == pytest.approx(0.3)
    path.write_text(json.dumps({**head, "parameters": {**HAND_TUNED, "turn": 3}}))
    with pytest.raises(FileError, match=r"field 'parameters': the gait's turn is 3, outside of"):
        start_genes(Gait(), path)
    path.write_text(json.dumps({**head, "genes": [0.5] * 20}))
    assert start_genes(Gait(), path).tolist() == [0.5] * 20
    path.write_text(json.dumps({**head, "genes": [0.5] * 19}))
    with pytest.raises(FileError, match="expected 20 finite numbers"):
        start_genes(Gait(), path)
    path.write_text(json.dumps({**head, "genes": [0.5] * 19 + [1.5]}))
    with pytest.raises(UserError, match=r"gait\.json: a gene lies outside of 0 to 1"):
        start_genes(Gait(), path)
    path.write_text(json.dumps({**head, "parameters": ["fast"]}))
    with pytest.raises(FileError, match=r"gait\.json"):
        start_genes(Gait(), path)
    with pytest.raises(UserError, match="there is no hand-tuned push"):
        start_genes(Push())
    run(tmp_path / "out", Real())
    assert start_genes(Push(), tmp_path / "out" / "controller").shape == (2,)
    with pytest.raises(UserError, match="holds a push of 2 genes; expected a gait of 20"):
        start_genes(Gait(), tmp_path / "out" / "controller")
