"""Tables of robots that are no Khepera."""

import numpy as np
import pytest
from khepera_data import made_up

from neurosim.base.errors import UserError
from neurosim.sampling import build_tables
from neurosim.simulators.tables.samples import Samples


def samples(folder, sensors):
    """Write samples of a robot with so many sensors, evenly around it."""
    table, paths = made_up(), []
    for place, name in enumerate(("wall", "cylinder")):
        mean = np.resize(table.mean[place], (*table.mean.shape[1:3], sensors))
        paths.append(folder / f"{name}.sample")
        Samples(np.clip(mean, 0, 1), 0.005, 0.005).write(paths[-1])
    return paths


def test_the_radius_of_a_robot_that_is_no_khepera_must_be_said(tmp_path):
    paths = samples(tmp_path, 24)
    with pytest.raises(UserError, match=r"with 24 sensors it is no Khepera: give its radius \(--r"):
        build_tables(paths)
    assert build_tables(paths, radius=0.085).radius == 0.085
    with pytest.raises(UserError, match="radius: expected a number"):
        build_tables(paths, radius=-1.0)


def test_that_of_a_khepera_need_not(tmp_path):
    paths = samples(tmp_path, 8)
    assert build_tables(paths).radius == 0.0275
    assert build_tables(paths, radius=0.03).radius == 0.03


@pytest.mark.parametrize("end", [b"\r\n", b"\n"])
def test_samples_keep_their_line_ends(tmp_path, end):
    path = samples(tmp_path, 8)[0]
    before = path.read_bytes().replace(b"\r\n", end)
    path.write_bytes(before)
    Samples.read(path).write(tmp_path / "again.sample")
    assert (tmp_path / "again.sample").read_bytes() == before


def test_tables_in_the_convention_of_evorobotpy2(tmp_path):
    paths = samples(tmp_path, 8)
    own, other = build_tables(paths), build_tables(paths, convention="evorobotpy2")
    # The same files, read with rows the other way round: sensors look to the other side.
    assert other.bearings == pytest.approx(-own.bearings, abs=1e-9)
    assert other.meta["convention"] == "evorobotpy2"
    # Samples are 5 mm apart and begin at 5 mm: a cylinder is seen as two rows farther away.
    wall, cylinder = own.sensors.mean[:, :, 0], other.sensors.mean[1, :, 0]
    assert other.sensors.mean[0, :, 0] == pytest.approx(wall[0])
    assert cylinder[:-2] == pytest.approx(wall[1, 2:])
