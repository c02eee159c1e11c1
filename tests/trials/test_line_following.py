"""Light sensors from recording to drive: recorded, learned, used in evolution and in a drive."""

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

import neurosim as ns
from neurosim.base.errors import FileError, UserError
from neurosim.cli.main import cli
from neurosim.controllers import read_controller
from neurosim.lab import VirtualRig
from neurosim.recording.commands import RandomCommands
from neurosim.recording.record import Rig, record
from neurosim.recording.settings import Guard, RecordSettings
from neurosim.trials.trial import run_trial
from tracking.datasets.dataset import Dataset, build
from tracking.datasets.recordings import Recording

SIZE = (320, 240)
TASK = ns.make_task("follow-line", seconds=3.0, laps=0.05)
POSITION = Guard(by="position")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Forty commands are too few to learn a board, but suffice to run every stage."""
    folder = tmp_path_factory.mktemp("line")
    with VirtualRig(2, noise_seed=3, camera_size=SIZE, around=TASK.place) as rig:
        optics = rig.camera.optics
        optics.calibration.write(folder / "calibration.json")
        record(
            folder / "recording",
            Rig.of_lab(rig),
            RandomCommands(seed=1),
            RecordSettings(40, POSITION, readings=True),
            calibration=folder / "calibration.json",
        )
    build([folder / "recording"], folder / "dataset")
    ns.train(folder / "dataset", folder / "simulator", members=1, noise=False, progress=False)
    return folder


@pytest.mark.slow
def test_readings_are_kept_all_the_time(made):
    recording = Recording(made / "recording")
    seen = recording.observations()
    assert seen.names == ("line_left", "line_right")
    assert recording.meta["settings"]["readings"] is True
    assert recording.meta["settings"]["guard"]["by"] == "position"
    # A pair of readings takes two round trips of 40 ms.
    driven = sum(
        line.duration for line in recording.commands().itertuples() if line.kind == "command"
    )
    assert len(seen.time) > 5 * driven * 0.8
    sent = {line.command for line in recording.commands().itertuples() if line.kind == "command"}
    assert set(seen.command) - {-1} <= sent
    # It drives over the line and is not stopped by it.
    assert (seen.readings.min(axis=0) < 0.3).all()


@pytest.mark.slow
def test_a_dataset_says_where_readings_were_taken(made):
    dataset = Dataset.read(made / "dataset")
    assert json.loads((made / "dataset" / "dataset.json").read_text())["readings"] > 300
    table = dataset.readings
    assert dataset.split()[0].readings is table
    # From the lab's own board: the true position of the left sensor when it was read.
    with VirtualRig(2, noise_seed=3, camera=False, around=TASK.place) as rig:
        light = []
        for row in table.itertuples():
            rig.lab.place(row.x, row.y, row.theta)
            light.append(rig.lab.body.reflected_light(0))
    off = table["line_left"].to_numpy() - light
    assert np.abs(np.median(off)) < 0.01
    assert np.sqrt(np.mean(off**2)) < 0.4 * table["line_left"].std()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda text: text.replace("omega", "spin", 1), "expected the columns recording"),
        (lambda text: text.rsplit("\n", 2)[0] + "\n", "cut short"),
        (lambda text: text.replace("\n", "\nx,", 1), "readings.csv"),
    ],
)
@pytest.mark.slow
def test_damaged_readings_are_refused(made, tmp_path, change, words):
    Dataset.read(made / "dataset").write(tmp_path / "d")
    path = tmp_path / "d" / "readings.csv"
    path.write_text(change(path.read_text()))
    with pytest.raises(FileError, match=words):
        Dataset.read(tmp_path / "d")


@pytest.mark.slow
def test_a_network_is_evolved_in_what_was_learned_and_drives_the_robot(made, tmp_path):
    simulator = ns.load(made / "simulator")
    assert simulator.reading_names == ("line_left", "line_right")
    about = simulator.meta["readings"]
    assert [one["name"] for one in about["sensors"]] == ["line_left", "line_right"]
    network = ns.make_controller("network", simulator, TASK, scale=40.0)
    best = ns.evolve(
        simulator, TASK, network, generations=2, seed=1, out=tmp_path / "c", progress=False
    )[0]
    assert best.controller.inputs == ("line_left", "line_right")
    with VirtualRig(2, noise_seed=9, start=TASK.start, camera_size=SIZE, around=TASK.place) as rig:
        report = run_trial(
            tmp_path / "c",
            tmp_path / "t",
            Rig.of_lab(rig),
            calibration=made / "calibration.json",
            guard=Guard("end", by="position"),
        )
    assert report["ended_early"] is False
    assert report["actual"]["seen_by"] == "camera"
    assert len(report["commands"]) == 15
    seen = Recording(tmp_path / "t").observations()
    genes = best.genes.reshape(2, 3)
    wanted = 40 * np.tanh(seen.readings[:15] @ genes[:, :2].T + genes[:, 2])
    np.testing.assert_allclose([command[:2] for command in report["commands"]], wanted, atol=1e-6)


@pytest.mark.slow
def test_a_thymio_follows_a_line_with_its_ground_sensors(made, tmp_path):
    task = ns.make_task("follow-line", seconds=30.0, laps=0.3)
    simulator = ns.load(made / "simulator")
    network = ns.make_controller("network", simulator, task, scale=80.0)
    ns.evolve(simulator, task, network, generations=1, out=tmp_path / "any", progress=False)
    # By hand: the wheel on the side that sees the bright board turns faster, towards the line.
    by_hand = np.array([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0]]).ravel()
    replace(read_controller(tmp_path / "any"), genes=by_hand).write(tmp_path / "c")
    words = f"run {tmp_path / 'c'} --robot virtual-thymio --guard-by position -o {tmp_path / 't'}"
    words += f" --camera-size 320x240 --calibration {made / 'calibration.json'}"
    result = CliRunner().invoke(cli, words.split(), catch_exceptions=False)
    assert result.exit_code == 0, result.output
    report = json.loads((tmp_path / "t" / "trial.json").read_text())
    assert report["actual"]["completes"] is True, report["actual"]["fitness"]
    assert {"line_left", "line_right", "sensor_0"} <= set(
        Recording(tmp_path / "t").observations().names
    )


@pytest.mark.slow
def test_without_sensors_it_is_another_simulator(made, tmp_path):
    plain = ns.train(
        made / "dataset", tmp_path / "s", members=1, noise=False, sensors=False, progress=False
    )
    assert plain.reading_names == ()
    assert "readings" not in plain.meta
    with pytest.raises(UserError, match="line_left"):
        ns.evaluate(plain, TASK, ns.make_controller("network", inputs=("line_left",)))


def test_what_cannot_guard_is_refused(tmp_path):
    with VirtualRig(2, camera=False) as rig:
        args = (tmp_path / "r", Rig(rig.robot), RandomCommands())
        with pytest.raises(UserError, match="needs the robot's position"):
            record(*args, RecordSettings(3, POSITION))
    assert not (tmp_path / "r").exists()


def test_the_options_are_there():
    for command, options in {
        "record": ("--readings", "--guard-by", "--place "),
        "run": ("--guard-by",),
        "train": ("--sensors",),
    }.items():
        message = CliRunner().invoke(cli, [command, "--help"]).output
        assert all(option in message for option in options), message
    message = CliRunner().invoke(cli, ["evolve", "--task", "follow-line", "--help"]).output
    assert all(option in message for option in ("--laps", "--within", "--direction", "--place"))
