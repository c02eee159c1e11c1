"""Tables of robots other than the Khepera."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from khepera_data import made_up

from neurosim.base import se2
from neurosim.base.errors import UserError
from neurosim.base.files import write_csv
from neurosim.cli.main import cli
from neurosim.sampling import build_tables
from neurosim.simulators.tables.samples import Samples


def samples(folder, sensors):
    """Write samples of a robot with this number of sensors, evenly around it."""
    table, paths = made_up(), []
    for place, name in enumerate(("wall", "cylinder")):
        mean = np.resize(table.mean[place], (*table.mean.shape[1:3], sensors))
        paths.append(folder / f"{name}.sample")
        Samples(np.clip(mean, 0, 1), 0.005, 0.005).write(paths[-1])
    return paths


def test_the_radius_of_a_robot_that_is_no_khepera_must_be_said(tmp_path):
    paths = samples(tmp_path, 24)
    with pytest.raises(
        UserError, match=r"with 24 sensors it is not a Khepera: give its radius \(--r"
    ):
        build_tables(paths)
    assert build_tables(paths, radius=0.085).radius == 0.085
    # The paper's arena grows with the robot, here to twice the size: 1.2 x 0.7 m.
    x1, y1, x2, y2 = build_tables(paths, radius=0.055).place.bounds
    assert (x2 - x1, y2 - y1) == pytest.approx((1.2, 0.7))
    with pytest.raises(UserError, match="radius: expected a number"):
        build_tables(paths, radius=-1.0)


def test_that_of_a_khepera_need_not(tmp_path):
    paths = samples(tmp_path, 8)
    assert build_tables(paths).radius == 0.0275
    assert build_tables(paths, radius=0.03).radius == 0.03


def test_what_a_robot_is_taken_for_is_said_and_asked(tmp_path):
    paths = samples(tmp_path, 8)
    guessed = dict.fromkeys(("radius", "wheel_base", "full_speed"), "guessed")
    assert build_tables(paths).meta["body"] == guessed
    given = build_tables(paths, radius=0.085, full_speed=0.3)
    assert given.meta["body"] == {**guessed, "radius": "given", "full_speed": "given"}
    words = ["build-tables", *map(str, paths), "-o", str(tmp_path / "s")]
    output = CliRunner().invoke(cli, [*words, "--radius", "85"]).output
    assert (
        "radius 85.0 mm (given), 53.0 mm between its wheels (guessed), 100 mm/s at full" in output
    )
    assert "Is it a Khepera? If not, build again with its --wheel-base, --full-speed." in output
    motors = tmp_path / "motors.csv"
    simulator = build_tables(paths, wheel_base=0.14, full_speed=0.3)
    rows = [
        (left, right, 1.0, *se2.exp(simulator.motors.twist[i, j]))
        for i, left in enumerate(simulator.motors.levels)
        for j, right in enumerate(simulator.motors.levels)
    ]
    names = ("left", "right", "duration", "dx", "dy", "dtheta")
    write_csv(motors, dict(zip(names, np.array(rows).T, strict=True)))
    words = [*words[:-1], str(tmp_path / "t"), "--motors", str(motors), "--radius", "85", "--json"]
    body = json.loads(CliRunner().invoke(cli, words).stdout)["body"]
    assert (body["wheel_base"], body["full_speed"]) == pytest.approx((0.14, 0.3))
    assert body["from"] == {"radius": "given", "wheel_base": "sampled", "full_speed": "sampled"}


def test_objects_of_two_sizes_are_no_repeats(tmp_path):
    paths = samples(tmp_path, 8)
    cylinder = Samples.read(paths[1])
    for name, brightness in (("other-cylinder", 1.05), ("small-cylinder", 0.65)):
        mean = cylinder.activations[-1] + brightness * (
            cylinder.activations - cylinder.activations[-1]
        )
        Samples(mean, cylinder.first_distance, cylinder.distance_step).write(
            tmp_path / f"{name}.sample"
        )
    assert build_tables([*paths, tmp_path / "other-cylinder.sample"]).sensors.spread is None
    with pytest.raises(UserError, match="samples of the cylinder are not repeats of one object"):
        build_tables([*paths, tmp_path / "small-cylinder.sample"])


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
