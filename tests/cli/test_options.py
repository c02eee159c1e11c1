"""Options made from settings classes, drivers and functions; only those of the chosen object."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click
import pytest
from click.testing import CliRunner

from neurosim.base.declared import Count, Metres, Seconds, Turn
from neurosim.base.errors import UserError
from neurosim.base.registry import Registry
from neurosim.cli._common import resume_option
from neurosim.cli._options import (
    SettingsCommand,
    choice_options,
    given_options,
    parameters,
    settings_options,
)
from neurosim.cli._types import Real

if TYPE_CHECKING:
    from somewhere import Thing


@dataclass(frozen=True)
class Walk:
    """A task.

    Attributes:
        steps: how many steps. More is slower.
        pace: of a step,
            ``metres`` per second; see :class:`some.where.Thing`.
        side: which one.
        goals: x and y of each.
        span: both ends.
        reach, width: sizes, m.
        thing: no option can stand for it.
    """

    steps: Count = 10
    pace: float = 1.5
    side: Literal["left", "right"] = "left"
    goals: tuple[tuple[float, float], ...] = ((0.5, 0.0),)
    span: tuple[Seconds, Seconds] = (0.5, 3.0)
    reach: Metres = 0.25
    width: float | None = None
    thing: Thing | None = None
    names: list[str] = field(default_factory=lambda: ["a", "b"])


class Swim:
    """Another task.

    Args:
        depth: how deep, m.
        steps: of the arms.
        slow: whether it is slow.
        log: where to write.
    """

    def __init__(self, depth: float, steps: int = 3, *, slow: bool = False, log: Path | str = ""):
        pass


TASKS = Registry("task", "neurosim.none", {})
TASKS.register("walk", Walk)
TASKS.register("swim", Swim)


def command(begun=None):
    @click.command("go", cls=SettingsCommand, begun=begun)
    @click.argument("place", type=click.Path(path_type=Path))
    @choice_options("--task", TASKS, default="walk", help="What to do.", units={"reach": "cm"})
    @settings_options(
        "more",
        lambda chosen: Walk(steps=99) if chosen["task"] == "swim" else None,
        by_choice=True,
        only=("steps", "pace"),
        names={"pace": "speed"},
    )
    @click.option("--log", default="none")
    @resume_option
    def go(place, task, task_options, more, log, resume):
        commanded = {"task": task, "options": task_options, "more": more, "log": log}
        click.echo(json.dumps({**commanded, "given": given_options()}, default=str))

    return go


def run(*words, begun=None):
    done = CliRunner().invoke(command(begun), [*words], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


def help_of(*words):
    return " ".join(CliRunner().invoke(command(), [*words, "--help"]).stdout.split())


def test_name_type_default_and_help_are_those_of_the_settings():
    by_name = {each.name: each for each in parameters(Walk)}
    assert list(by_name) == ["steps", "pace", "side", "goals", "span", "reach", "width", "names"]
    assert by_name["steps"].help == "How many steps."
    assert by_name["pace"].help == "Of a step, metres per second; see Thing."
    assert by_name["reach"].help == by_name["width"].help == "Sizes, m."
    assert (by_name["steps"].default, by_name["names"].default) == (10, ["a", "b"])
    assert {each.name: each.default for each in parameters(Walk(steps=7))}["steps"] == 7
    assert [each.name for each in parameters(Swim)] == ["depth", "steps", "slow", "log"]
    assert parameters(Swim)[0].help == "How deep, m."


def test_the_command_gets_what_was_given_and_nothing_else():
    assert run("here")["options"] == {}
    words = ["--steps", "4", "--side", "right", "--goals", "[[1, 2]]", "--names", "c,d,e"]
    options = run(*words, "here", "--reach", "30")["options"]
    assert options["reach"] == pytest.approx(0.3)
    assert options == {
        "steps": 4, "side": "right", "goals": [[1, 2]], "names": ["c", "d", "e"],
        "reach": options["reach"],
    }  # fmt: skip


def test_only_the_options_of_what_is_chosen_are_there():
    given = run("here", "--depth", "2", "--task", "swim", "--slow")
    assert given["options"] == {"depth": 2, "slow": True}
    shown, other = help_of(), help_of("--task", "swim")
    assert (
        "Options of --task walk: --steps INTEGER How many steps. [default: 10] [1<=x<=1000000]"
        in shown
    )
    assert "--side [left|right] Which one. [default: left]" in shown
    assert "--reach cm Sizes, cm. [default: 25] [0.01<=x<=100000]" in shown
    assert "--span LOW..HIGH Both ends. [default: 0.5..3] [0.001<=x<=100000]" in shown
    assert "--goals JSON X and y of each. [default: [[0.5, 0.0]]]" in shown
    # The others are named, without their explanations.
    assert "How deep" not in shown
    assert "How deep, m." in other
    assert "Which one" not in other
    assert shown.endswith(
        "Options of other choices: To read about them: go --task swim --help "
        "--task swim --depth, --slow, --task-log"
    )
    assert "--task walk --pace, --side, --goals, --span, --reach, --width, --names" in other
    assert "--task NAME What to do: swim, walk. [default: walk]" in shown
    assert "thing" not in shown


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--slow"], "--task walk has no option --slow: leave it out, or choose --task swim"),
        (["--task", "swim"], "--task swim needs --depth: how deep, m"),
        (["--task", "fly"], "there is no task 'fly'; choose from swim, walk"),
    ],
)
def test_what_does_not_go_together_is_said_in_a_sentence(words, message):
    with pytest.raises(UserError, match=f"^{message}$"):
        CliRunner().invoke(command(), ["here", *words], catch_exceptions=False)


@pytest.mark.parametrize(
    "words",
    [["--nonsense"], ["--steps", "x"], ["--reach", "nan"], ["--reach", "0"], ["--steps", "0"], []],
)
def test_what_makes_no_sense_is_a_usage_error(words):
    place = ["here"] if words else []
    assert CliRunner().invoke(command(), [*place, *words]).exit_code == 2


def test_an_option_of_the_same_name_as_another_is_named_after_its_choice():
    swim = ["here", "--task", "swim", "--depth", "1"]
    given = run(*swim, "--log", "mine", "--task-log", "its", "--speed", "2")
    assert given["log"] == "mine"
    assert given["options"] == {"depth": 1, "log": "its"}
    assert given["more"] == {"pace": 2}
    # Two groups that both have steps: the first one gets the short name.
    given = run(*swim, "--steps", "5", "--more-steps", "6")
    assert (given["options"]["steps"], given["more"]["steps"]) == (5, 6)
    assert "--more-steps INTEGER How many steps. [default: 99] [1<=x<=1000000]" in help_of(*swim)


def test_resume_takes_what_is_not_given_from_what_was_begun():
    kept = {}

    def begun(values):
        assert values["place"] == Path("here")
        return kept

    first = run("here", "--task", "swim", "--depth", "2", "--log", "mine", begun=begun)
    assert first["given"] == {"task": "swim", "depth": 2, "log": "mine"}
    kept.update(first["given"])
    again = run("--resume", "here", "--steps", "8", begun=begun)
    assert again["options"] == {"depth": 2, "steps": 8}
    assert again["given"] == {**first["given"], "steps": 8}
    kept.clear()
    kept.update({"side": "right", "goals": [[1, 2]], "reach": 0.3, "unknown": 1, "pace": None})
    again = run("here", "--resume", "--side", "left", begun=begun)
    assert again["options"] == {"side": "left", "goals": [[1, 2]], "reach": 0.3}
    assert run("here", "--reach", "90", begun=begun)["options"] == {"reach": 0.9}


def test_units_lead_to_si_exactly_as_code_does():
    assert Real(Metres, "mm").convert("2.7", None, None) == 2.7 / 1000
    assert Real(Turn, "degrees").convert("0.5", None, None) == math.radians(0.5)
    assert Real(Metres, "mm").convert(0.0027, None, None) == 0.0027
    assert Real(Metres, "mm").shown(0.003) == "3"


def test_a_package_that_cannot_be_imported_is_in_nobodys_way():
    class Broken(Registry):
        def get(self, name):
            if name == "broken":
                raise UserError("it does not load")
            return super().get(name)

    tasks = Broken("task", "neurosim.none", {})
    tasks.register("walk", Walk)
    tasks.register("broken", None)

    @click.command(cls=SettingsCommand)
    @choice_options("--task", tasks, default="walk", help="What.")
    def go(task, task_options):
        click.echo(task_options["steps"])

    assert CliRunner().invoke(go, ["--steps", "3"]).stdout == "3\n"
    with pytest.raises(UserError, match="does not load"):
        CliRunner().invoke(go, ["--task", "broken"], catch_exceptions=False)
