"""On a real robot: the UTIAS/MRCLAM recording."""

import pytest

from neurosim.training import evaluate, train
from tracking.datasets.mrclam import import_mrclam


@pytest.mark.slow
@pytest.mark.parametrize("settings", [{"trainer": "ga", "generations": 200}, {"members": 1}])
def test_a_learned_simulator_beats_the_ideal_unicycle(tmp_path, shared_data, settings):
    import_mrclam(shared_data / "utias", tmp_path / "d")
    train(tmp_path / "d", tmp_path / "s", progress=False, **settings)
    table = evaluate(tmp_path / "s", tmp_path / "d")
    assert table["rows"] == 113
    ours, ideal = (
        [each_result[name]["mean_absolute_error"] for name in ("dx", "dy", "dtheta")]
        for each_result in (table["errors"], table["baseline"]["errors"])
    )
    assert sum(a / b for a, b in zip(ours, ideal, strict=True)) / 3 < 0.85
