"""Whether something is from the virtual lab."""

import pytest

from neurosim.base.provenance import is_virtual


@pytest.mark.parametrize(
    ("meta", "predicted"),
    [
        ({}, None),
        ({"virtual": True}, True),
        ({"virtual": False, "robot": {"virtual": True}}, False),
        ({"virtual_lab": {"robot_seed": 0}, "robot": {}}, True),
        ({"virtual_lab": None, "robot": {"kind": "nxt"}}, False),
        ({"virtual_lab": None, "robot": {"kind": "nxt", "virtual": True}}, True),
        ({"robots": [{"virtual": False}, {"virtual": True}]}, True),
        ({"robots": [{"kind": "nxt", "virtual": False}]}, False),
        # A name proves nothing: anybody may give a robot this name.
        ({"robot": {"name": "virtual"}}, None),
        ({"source": [{"path": "a"}, {"path": "b", "virtual": True}]}, True),
        ({"source": [{"path": "virtual.sample"}]}, None),
        ({"simulator": {"virtual": False}, "evolution": {"robot": {"virtual": True}}}, True),
        ({"camera": {"kind": "virtual roof camera"}}, True),
        ([{}, {"virtual": False}], False),
        (None, None),
    ],
)
def test_what_is_told_counts(meta, predicted):
    assert is_virtual(meta) is predicted
