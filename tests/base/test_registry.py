"""Things by name: ours, a script's, and those of other packages."""

import importlib.metadata
import math

import pytest

from neurosim.base import registry
from neurosim.base.errors import UserError
from neurosim.base.registry import Registry


@pytest.fixture
def shapes(monkeypatch):
    """Return a registry of shapes; two other packages offer one each."""
    points = [
        importlib.metadata.EntryPoint("turn", "math:tau", "some.shapes"),
        importlib.metadata.EntryPoint("root", "math:sqrt", "some.shapes"),
        importlib.metadata.EntryPoint("broken", "no_such_package:Shape", "some.shapes"),
        importlib.metadata.EntryPoint("empty", "math:no_such_shape", "some.shapes"),
        importlib.metadata.EntryPoint("other", "math:pi", "some.colours"),
    ]

    def entry_points(*, group):
        return [point for point in points if point.group == group]

    monkeypatch.setattr(importlib.metadata, "entry_points", entry_points)
    monkeypatch.setattr(registry, "entry_points", entry_points)
    return Registry("shape", "some.shapes", {"half": "math:pi", "base": "collections:abc.Sized"})


def test_ours_are_imported_when_they_are_asked_for(shapes):
    assert shapes.get("half") is math.pi
    from collections.abc import Sized

    assert shapes.get("base") is Sized


def test_a_script_registers_by_one_call_or_as_a_decorator(shapes):
    assert shapes.register("round", 1.5) == 1.5
    assert shapes.get("round") == 1.5

    @shapes.register("pair")
    def pair(a, b=2):
        return a, b

    assert shapes.get("pair") is pair
    assert shapes.make("pair", {"a": 1}) == (1, 2)
    # A second call replaces the first, so that a notebook's cell can be run again.
    shapes.register("round", 2.5)
    assert shapes.get("round") == 2.5


def test_other_packages_offer_theirs_by_entry_points(shapes):
    assert shapes.get("turn") is math.tau
    assert shapes.names() == ["half", "base", "broken", "empty", "root", "turn"]
    # A script's entry has precedence over an installed package's.
    shapes.register("turn", 1)
    assert shapes.get("turn") == 1
    assert shapes.names().count("turn") == 1


def test_what_is_made_takes_settings(shapes):
    assert shapes.make("half", {}) is math.pi
    with pytest.raises(UserError, match=r"the shape half does not take these settings \('a'\)"):
        shapes.make("half", {"a": 1})
    shapes.register("pair", lambda a: a)
    with pytest.raises(UserError, match="the shape pair has no setting 'b'; it has a"):
        shapes.make("pair", {"b": 1})


def test_an_unknown_name_is_named_beside_those_that_there_are(shapes):
    with pytest.raises(
        UserError, match="there is no shape 'oval'; choose from half, base, broken, "
    ):
        shapes.get("oval")
    with pytest.raises(UserError, match="none is registered"):
        Registry("shape", "no.shapes", {}).get("oval")


@pytest.mark.parametrize("name", ["broken", "empty"])
def test_a_package_that_does_not_load_is_named(shapes, name):
    with pytest.raises(UserError, match=f"the shape '{name}' .* does not load: .*no_such_"):
        shapes.get(name)


def test_our_names_are_taken(shapes):
    with pytest.raises(UserError, match="'half' is taken by neurosim's own shape"):
        shapes.register("half", 1)
    assert shapes.get("half") is math.pi
