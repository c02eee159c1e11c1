"""Every number that an option takes has a range: all options of all commands, found by the test."""

from __future__ import annotations

import math

import click
import pytest
from click.testing import CliRunner

from neurosim.base.errors import UserError
from neurosim.cli._options import SettingsCommand
from neurosim.cli._types import UNDECLARED, Listed, Numbers
from neurosim.cli.main import cli

#: Values that no quantity of this program can have.
IMPOSSIBLE = ("nan", "inf", "-inf", "1e308", "-1e308", str(2**67), str(-(2**67)), "1e20")
#: Values that few quantities can have.
UNUSUAL = ("-1", "0", "1e-320", "1e-9")


def numbers_of(kind):
    """Return the types of the numbers in an option."""
    if isinstance(kind, click.Tuple):
        return [number for part in kind.types for number in numbers_of(part)]
    if isinstance(kind, Listed):
        return numbers_of(kind.kind)
    if isinstance(kind, Numbers):
        return [kind.part]
    ours = (click.types.IntParamType, click.types.FloatParamType)
    return [kind] if isinstance(kind, ours) else []


def options_of(command):
    """Give each option of a command with the words that choose the object to which it belongs."""
    yield from (((), each) for each in command.params)
    if not isinstance(command, SettingsCommand):
        return
    default = {}
    for group in command._groups:
        if group.option is not None:
            default[group.chooser] = group.default_name(default)
    for chosen in [default, *command._alternatives(default)]:
        words = [
            word
            for group in command._groups
            if group.option is not None and chosen[group.chooser] != default[group.chooser]
            for word in (group.option, chosen[group.chooser])
        ]
        context = command.make_context("x", [*words], resilient_parsing=True)
        yield from ((tuple(words), each) for each in command.get_params(context))


def commands(group=cli, path=()):
    for name, command in group.commands.items():
        if isinstance(command, click.Group):
            yield from commands(command, (*path, name))
        else:
            yield (*path, name), command


def numeric():
    results = {}
    for path, command in commands():
        for words, option in options_of(command):
            kinds = numbers_of(option.type) if isinstance(option, click.Option) else []
            if kinds:
                ends = tuple((kind.min, kind.max) for kind in kinds if hasattr(kind, "max"))
                results.setdefault((path, option.opts[0], ends), (words, option, command))
    return [(path, *rest) for (path, _, _), rest in results.items()]


NUMERIC = numeric()


def test_there_are_many():
    assert len(NUMERIC) > 200
    assert {path[0] for path, *_ in NUMERIC} >= {"record", "evolve", "lab", "run", "calibrate"}


def name_of(case):
    path, words, option, _ = case
    return " ".join((*path, *words, option.opts[0]))


@pytest.mark.parametrize("case", NUMERIC, ids=map(name_of, NUMERIC))
def test_a_number_has_a_range_that_help_shows_and_that_holds(case):
    *_, option, command = case
    ctx = click.Context(command)
    _, shown = option.get_help_record(ctx)
    for kind in numbers_of(option.type):
        low, high = kind.min, kind.max
        assert low is not None
        assert high is not None
        assert (low, high) != (UNDECLARED.ge, UNDECLARED.le), "declare its range"
        assert kind._describe_range() in shown
    for value in IMPOSSIBLE:
        with pytest.raises(click.BadParameter):
            option.type_cast_value(ctx, typed(option, value))
    for value in UNUSUAL:
        try:
            made = option.type_cast_value(ctx, typed(option, value))
        except click.BadParameter:
            continue
        assert all(math.isfinite(number) for number in flat(made))


def typed(option, value):
    """Return a value as it comes from the command line, in every place of the option."""
    kind = option.type
    if isinstance(kind, Numbers):
        value = kind.between.join([value] * (kind.name.count(kind.between) + 1))
    if isinstance(kind, click.Tuple):
        value = (value,) * len(kind.types)
    elif option.nargs > 1:
        value = (value,) * option.nargs
    return (value,) if option.multiple else value


def flat(value):
    if isinstance(value, tuple | list):
        return [number for part in value for number in flat(part)]
    return [value]


@pytest.mark.parametrize("value", ["nan", "1e308"])
@pytest.mark.slow
def test_an_impossible_number_ends_a_command_in_a_sentence_and_nothing_is_written(
    value, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    for path, words, option, command in NUMERIC:
        given = typed(option, value)
        given = given[0] if option.multiple else given
        given = [*given] if isinstance(given, tuple) else [given]
        places = ["place" for each in command.params if isinstance(each, click.Argument)]
        needed = [word for each in command.params if isinstance(each, click.Option) and
                  each.required for word in (each.opts[-1], "out")]  # fmt: skip
        line = [*path, *places, *needed, *words, option.opts[0], *given]
        done = CliRunner().invoke(cli, line)
        assert isinstance(done.exception, SystemExit | UserError), (line, done.exception)
        assert done.exit_code != 0
        if isinstance(done.exception, SystemExit):
            last = done.stderr.strip().splitlines()[-1]
            assert last.startswith("Error: Invalid value for"), (line, done.stderr)
    assert not list(tmp_path.iterdir())
