"""Samples are written and read byte for byte, and an error names the mistake in a file."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from khepera_data import made_up

from neurosim.base.errors import FileError, UserError
from neurosim.simulators.tables.samples import Samples, as_evorobotpy2
from neurosim.simulators.tables.sensor_table import SensorTable, is_kind, kind_of, radius_of

TEXT = (
    "2 4 2 5 2.5 \r\n"
    "TURN 0\r\n0.000000 1.000000 \r\n0.003910 0.250000 \r\n0.1234567 0.5 \r\n1 0 \r\n"
    "TURN 1\r\n0.000978 0.000000 \r\n0.000000 0.000000 \r\n0.000000 0.100000 \r\n"
    "0.000000 0.000000 \r\nEND\r\n"
)


@pytest.mark.parametrize("name", ["wall", "cylinder"])
def test_published_files_byte_for_byte(name, shared_data, tmp_path):
    published = shared_data / "khepera" / f"khepera-{name}.sample"
    samples = Samples.read(published)
    assert samples.activations.shape == (20, 180, 8)
    assert (samples.first_distance, samples.distance_step) == (0.005, 0.002)
    samples.write(tmp_path / "again.sample")
    assert (tmp_path / "again.sample").read_bytes() == published.read_bytes()


@pytest.mark.parametrize("name", ["wall", "cylinder"])
def test_order_of_sensors_and_sense_of_rotation(name, shared_data):
    # Where each sensor looks: the mean of the angles at which it sees the object.
    published = shared_data / "khepera" / f"khepera-{name}.sample"
    samples = Samples.read(published).activations[3:12]
    turned = 2 * np.pi * np.arange(180) / 180
    seen = (samples**4 * np.exp(1j * turned)[:, None]).sum(axis=(0, 1))
    bearing = -np.degrees(np.angle(seen))  # to the robot's left, as it turned left itself
    manual = [90, 45, 10, -10, -45, -90, -170, 170]
    assert np.abs(bearing - manual).max() < 25
    assert (np.diff(bearing[:6]) < -20).all()  # 0 to 5 from left to right
    assert bearing[6] < 0 < bearing[7]  # 6 behind to the right, 7 to the left


@pytest.mark.parametrize("value", [-1e-9, 1.0000000000000002, np.nan])
def test_what_could_not_be_read_is_not_written(value, tmp_path):
    values = np.full((2, 4, 3), 0.5)
    values[1, 2, 0] = value
    with pytest.raises(ValueError, match="0 to 1"):
        Samples(values, 0.005, 0.002).write(tmp_path / "a.sample")
    assert not list(tmp_path.iterdir())


@settings(max_examples=30, deadline=None)
@given(
    values=arrays(float, (2, 4, 3), elements=st.floats(0, 1)),
    first=st.integers(0, 100),
    step=st.sampled_from([0.5, 1, 2, 2.5]),
)
def test_round_trip(values, first, step, tmp_path_factory):
    folder = tmp_path_factory.mktemp("samples")
    Samples(values, first / 1000, step / 1000).write(folder / "a.sample")
    read = Samples.read(folder / "a.sample")
    assert (read.activations == values).all()
    assert (read.first_distance, read.distance_step) == (first / 1000, step / 1000)
    read.write(folder / "b.sample")
    assert (folder / "a.sample").read_bytes() == (folder / "b.sample").read_bytes()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (TEXT.replace("2 4 2 5 2.5", "2 4 2 5"), "line 1: expected a header"),
        (TEXT.replace("2 4 2 5 2.5", "2 4 2 5 0"), "line 1: expected a header"),
        (TEXT.replace("2 4 2 5 2.5", "2 4 x 5 2"), "line 1: expected a header"),
        ("", "line 1: expected a header"),
        (TEXT[: TEXT.index("0.1234567")], "line 5: is cut short: expected 12 lines"),
        (TEXT[: TEXT.index("34567")], "line 5: is cut short: expected 12 lines"),
        (TEXT.removesuffix("END\r\n"), "line 12: is cut short"),
        (TEXT.replace("0.1234567 0.5 ", "0.1234567 "), "line 5: expected 2 activations"),
        (TEXT.replace("0.1234567", "0.12x"), "line 5: expected activations in 0 to 1"),
        (TEXT.replace("0.1234567", "nan"), "line 5: expected activations in 0 to 1"),
        (TEXT.replace("0.1234567", "1.5"), "line 5: expected activations in 0 to 1"),
        (TEXT.replace("TURN 1", "TURN 2"), "line 7: expected 'TURN 1', found 'TURN 2'"),
        (TEXT.replace("2 4 2", "2 4 1"), "line 1: expected a header"),
        (TEXT.replace("2 4 2", "2 4 3"), "is cut short: expected 17 lines"),
        (TEXT.replace("2 4 2", "2 5 2"), "is cut short: expected 14 lines"),
        (TEXT.replace("2 4 2", "1000 99999 99999"), "is cut short: expected 9999900002 lines"),
        (TEXT.replace("2 4 2", "2 3 2"), "line 1: expected a header"),
        (TEXT + "more\r\n", "line 13: continues after END"),
    ],
)
def test_what_is_wrong_is_named(text, message, tmp_path):
    path = tmp_path / "wall.sample"
    path.write_bytes(text.encode())
    with pytest.raises(FileError, match=message):
        Samples.read(path)


def test_good_text_is_read(tmp_path):
    (tmp_path / "a.sample").write_bytes(TEXT.encode())
    read = Samples.read(tmp_path / "a.sample")
    assert read.activations[0, 2].tolist() == [0.1234567, 0.5]
    assert read.distance_step == 0.0025


def test_no_file_and_no_text(tmp_path):
    with pytest.raises(FileError, match="no such file"):
        Samples.read(tmp_path / "none.sample")
    (tmp_path / "binary.sample").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FileError, match="is not text"):
        Samples.read(tmp_path / "binary.sample")


def test_mean_and_spread_of_repeats():
    wall = [Samples(np.full((2, 4, 8), v), 0.005, 0.002) for v in (0.1, 0.2, 0.3)]
    cylinder = [Samples(np.full((2, 4, 8), v), 0.005, 0.002) for v in (0.1, 0.1)]
    table = SensorTable.from_samples({"wall": wall, "cylinder": cylinder})
    assert table.mean[0] == pytest.approx(0.2)
    assert table.spread[0] == pytest.approx(0.1)
    assert table.spread[1] == pytest.approx(0.0)
    assert made_up().spread is None
    assert made_up().ambient == pytest.approx(0.02, abs=0.005)


def test_tables_refuse_what_does_not_fit(tmp_path):
    one = Samples(np.zeros((2, 4, 8)), 0.005, 0.002)
    with pytest.raises(UserError, match="no samples of the cylinder"):
        SensorTable.from_samples({"wall": [one]})
    other = Samples(np.zeros((2, 5, 8)), 0.005, 0.002)
    with pytest.raises(UserError, match=r"8 sensors x 4 angles.*another 8 sensors x 5 angles"):
        SensorTable.from_samples({"wall": [one], "cylinder": [other]})
    mean = np.zeros((2, 3, 4, 8))
    mean[1, 2, 3, 7] = mean[1, 2, 3, 6] = np.nan
    with pytest.raises(UserError, match="2 holes in its readings, the first at the cylinder, 9 mm"):
        SensorTable(mean, None, 0.005, 0.002)
    with pytest.raises(FileError, match=r"a\.sample: no such file"):
        SensorTable.from_files([tmp_path / "a.sample"])
    one.write(tmp_path / "a.sample")
    with pytest.raises(UserError, match="name must contain wall, cylinder or light"):
        SensorTable.from_files([tmp_path / "a.sample"])


def test_samples_as_evorobotpy2_reads_them():
    """Worked by hand from its updateInfraredSensor: rows mirrored, cylinders 2 x first nearer."""
    rows = np.arange(2 * 6 * 4).reshape(6, 4, 2) / 100
    given = Samples(rows, 0.005, 0.002)
    wall, cylinder = (as_evorobotpy2(given, cylinder=which) for which in (False, True))
    # Row 0 stays straight ahead; 1 and 3 change places.
    assert wall.activations == pytest.approx(rows[:, [0, 3, 2, 1]])
    # At 5 mm from the rim it looks up (5 + 5) / 2 = row 5, which is the last.
    assert cylinder.activations[0] == pytest.approx(rows[5, [0, 3, 2, 1]])
    assert cylinder.activations[3] == pytest.approx(rows[5, [0, 3, 2, 1]])
    # Where the distances do not fall on rows, between them: (1 + 1) / 4 = row 0.5.
    between = as_evorobotpy2(Samples(rows, 0.001, 0.004), cylinder=True)
    assert between.activations[0] == pytest.approx((rows[0] + rows[1])[[0, 3, 2, 1]] / 2)


@pytest.mark.parametrize(
    ("stem", "kind", "radius"),
    [
        ("khepera-wall", "wall", 0.0),
        ("cylinder-2", "cylinder", 0.0275),
        ("round", "cylinder", 0.0275),
        ("khepera-scylinder", "cylinder-12.5mm", 0.0125),
        ("sround", "cylinder-12.5mm", 0.0125),
        ("cylinder-11.5mm-2", "cylinder-11.5mm", 0.0115),
        ("cylinder-27.5mm", "cylinder", 0.0275),
        ("khepera-light", "light", 0.0),
    ],
)
def test_a_files_name_says_which_kind_was_sampled(stem, kind, radius):
    assert kind_of(f"somewhere/{stem}.sample") == kind
    assert radius_of(kind) == pytest.approx(radius)
    assert is_kind(kind)


@pytest.mark.parametrize("name", ["wal", "cylinder-", "cylinder-0mm", "cylinder-27.5mm", "round"])
def test_other_names_are_no_kinds(name):
    assert not is_kind(name)


def test_kinds_are_in_order_whatever_order_they_are_given_in():
    one = Samples(np.zeros((2, 4, 8)), 0.005, 0.002)
    names = ("cylinder", "cylinder-12.5mm", "wall", "cylinder-30mm")
    table = SensorTable.from_samples({name: [one] for name in names})
    assert table.kinds == ("wall", "cylinder-12.5mm", "cylinder", "cylinder-30mm")
    assert table.radii == pytest.approx([0.0, 0.0125, 0.0275, 0.030])
    assert SensorTable.from_samples({"light": [one]}).kinds == ("light",)
