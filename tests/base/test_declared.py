"""Declared types: values that are errors, their messages, and the range of every setting."""

from __future__ import annotations

import math
import typing
from dataclasses import dataclass, fields
from typing import Annotated, Literal

import numpy as np
import pytest
from msgspec import Meta

from neurosim.base.declared import (
    Checked,
    Count,
    Fraction,
    Mismatch,
    Number,
    Percent,
    bounded,
    checks,
    convert,
    hints_of,
)
from neurosim.base.errors import UserError
from neurosim.cli._options import SettingsCommand, _or_none
from neurosim.cli.main import cli


@dataclass(frozen=True)
class Inner:
    gap: Percent
    number: Count | None = None


@dataclass(frozen=True)
class Outer:
    by_name: dict[str, Inner]
    each: list[Inner | None] = ()
    rows: list[tuple[Number, Number] | None] | None = None


@dataclass(frozen=True)
class Settings(Checked):
    number: Count = 1
    speed: Annotated[float, Meta(gt=0, le=2)] = 1.0
    word: Literal["a", "b"] = "a"
    pair: tuple[Fraction, Fraction] = (0.0, 1.0)
    maybe: Fraction | None = None
    anything: object = None


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"number": 0}, "number: expected a whole number from 1 to 1,000,000, found 0"),
        ({"number": 1.5}, "number: expected a whole number from 1 to 1,000,000, found 1.5"),
        ({"number": True}, "number: expected a whole number from 1 to 1,000,000, found True"),
        ({"speed": math.nan}, "speed: expected a number above 0, up to 2, found nan"),
        ({"speed": "1"}, "speed: expected a number above 0, up to 2, found '1'"),
        ({"word": "c"}, "word: expected one of 'a', 'b', found 'c'"),
        ({"pair": (0.5, -1)}, "pair[1]: expected a number from 0 to 1, found -1"),
        ({"pair": (0.5,)}, "pair: expected a list of 2 numbers, found [0.5]"),
        ({"maybe": 2}, "maybe: expected a number from 0 to 1, found 2"),
    ],
)
def test_settings_are_checked_as_they_are_made(given, message):
    with pytest.raises(UserError) as error:
        Settings(**given)
    assert str(error.value) == message


def test_numbers_of_numpy_are_numbers():
    assert Settings(np.int64(3), np.float64(0.5), pair=[np.float32(0.5), 1]).number == 3


@pytest.mark.parametrize(
    ("value", "field", "what"),
    [
        ({}, "by_name", "is missing"),
        ({"by_name": {"a": {"gap": 1}, "b": {}}}, "by_name.b.gap", "is missing"),
        (
            {"by_name": {"a": {"gap": 1, "number": 0}}},
            "by_name.a.number",
            "expected a whole number from 1 to 1,000,000, found 0",
        ),
        (
            {"by_name": {}, "each": [None, {"gap": 5}, {"gap": 200}]},
            "each[2].gap",
            "expected a number from 0.1 to 100, found 200",
        ),
        (
            {"by_name": {}, "rows": [None, [1]]},
            "rows[1]",
            "expected a list of 2 numbers, found [1]",
        ),
        ({"by_name": 3}, "by_name", "expected an object, found 3"),
        ([], "", "expected an object, found []"),
    ],
)
def test_a_mismatch_names_the_place(value, field, what):
    with pytest.raises(Mismatch) as error:
        convert(value, Outer)
    assert (error.value.field, error.value.what) == (field, what)


def test_arguments_are_checked():
    @checks
    def go(steps: Count, far: Number = 0.0, *, name: str = "") -> float:
        return steps * far

    assert go(2, 3.0) == 6.0
    with pytest.raises(UserError, match="steps: expected a whole number"):
        go(0)
    with pytest.raises(UserError, match=r"far: .* found inf"):
        go(1, far=math.inf)


def declared():
    """Return every class of settings from which options are made."""
    results = {}
    for command in cli.commands.values():
        groups = command._groups if isinstance(command, SettingsCommand) else []
        default = {}
        for group in groups:
            if group.option is not None:
                default[group.chooser] = group.default_name(default)
        for chosen in [default, *(command._alternatives(default) if groups else ())]:
            for group in groups:
                source = group.chosen_by(chosen)
                source = source if isinstance(source, type) else type(source)
                if issubclass(source, Checked) and _or_none(group.options, chosen):
                    results[source.__name__] = source
    return results


@pytest.mark.parametrize(("name", "kind"), declared().items(), ids=declared())
def test_no_settings_take_a_number_that_cannot_be(name, kind):
    needed = {
        "Network": {"inputs": ("a",)},
        "Recurrent": {"inputs": ("a",)},
        "Rounds": {"commands": 200},
    }
    given, hints = needed.get(name, {}), hints_of(kind)
    made = kind(**given)
    tried = 0
    for one in fields(made):
        bare, _ = bounded(hints[one.name])
        pair = typing.get_origin(bare) is tuple and bounded(typing.get_args(bare)[0])[0] is float
        if bare not in (int, float) and not pair:
            continue
        tried += 1
        for value in (math.nan, math.inf, -math.inf, 1e308, -1e308, 2**67):
            wrong = (value,) * len(typing.get_args(bare)) if pair else value
            with pytest.raises(UserError, match=rf"^{one.name}\b"):
                kind(**{**given, one.name: wrong})
    assert tried or name == "Network"
