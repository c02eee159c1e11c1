"""Declared shapes of JSON documents."""

import pytest

from neurosim.base.schema import Maybe, Mismatch, Rows, check

SHAPE = {
    "name": str,
    "size?": float,
    "poses": [Maybe(Rows(3))],
    "table?": Rows(None, 2),
    "counts?": {str: int},
    "either?": (str, int),
    "any?": object,
}
GOOD = {
    "name": "a",
    "size": 2,
    "poses": [[1, 2.5, 3], None],
    "table": [[1, 2], [3, 4]],
    "counts": {"x": 1},
    "either": 4,
    "any": [{}],
    "more": "is passed over",
}


def test_what_has_its_shape_passes():
    check(GOOD, SHAPE)
    check({"name": "a", "poses": [], "size": None}, SHAPE)


@pytest.mark.parametrize(
    ("changes", "field", "says"),
    [
        ({"name": 3}, "name", "expected text, found 3"),
        ({"size": "2"}, "size", "expected a number, found '2'"),
        ({"size": True}, "size", "expected a number, found True"),
        ({"size": float("nan")}, "size", "expected a number, found nan"),
        ({"poses": {}}, "poses", "expected a list, found {}"),
        ({"poses": [[1, 2]]}, "poses[0]", "expected a list of 3 numbers, found [1, 2]"),
        ({"poses": [None, [1, 2, "3"]]}, "poses[1][2]", "expected a number, found '3'"),
        ({"table": [[1, 2], 3]}, "table[1]", "expected a list of 2 numbers, found 3"),
        ({"table": 3}, "table", "expected a list of lists, found 3"),
        ({"counts": {"x": 1.5}}, "counts.x", "expected a whole number, found 1.5"),
        ({"counts": []}, "counts", "expected an object, found []"),
        ({"either": None, "any": None, "name": None}, "name", "expected text, found None"),
        ({"either": 1.5}, "either", "expected text or a whole number, found 1.5"),
    ],
)
def test_what_has_not_is_named(changes, field, says):
    with pytest.raises(Mismatch) as found:
        check({**GOOD, **changes}, SHAPE)
    assert (found.value.field, found.value.what) == (field, says)


def test_what_is_missing_is_named():
    with pytest.raises(Mismatch) as found:
        check({"a": {"poses": []}}, {"a": SHAPE})
    assert found.value.field == "a.name"
    assert found.value.what == "expected 'name' to be there, found ['poses']"


def test_gaps_are_allowed_where_they_are_declared():
    check([None, [1, 2]], Rows(None, 2, gaps=True))
    with pytest.raises(Mismatch):
        check([None, [1, 2]], Rows(None, 2))


def test_what_was_not_written_yet_may_have_tuples():
    check(
        {"poses": ((0.0, 1.0), (2.0, 3.0)), "names": ("a",)}, {"poses": Rows(2, 2), "names": [str]}
    )
    with pytest.raises(Mismatch, match="a list of 2 numbers"):
        check({"pose": (0.0,)}, {"pose": Rows(2)})
