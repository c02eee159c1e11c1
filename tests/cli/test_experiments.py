"""``neurosim pipeline``: its file, stages that are done once, and stages that are repeated."""

import csv
import json
import os
import shutil
import signal
import tomllib
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from patience import PATIENCE, wait_until
from processes import ended_by, neurosim, started

from neurosim.base.errors import FileError, UserError
from neurosim.cli._stages import MAKES, Made, experiment_of
from neurosim.cli.main import cli
from neurosim.lab import VirtualRig
from tracking.datasets.dataset import Dataset
from tracking.datasets.recordings import Recording

ROOT = Path(__file__).resolve().parents[2]


def pipeline(*words):
    """Run the command; return its JSON, and its messages on stderr."""
    done = CliRunner().invoke(cli, ["pipeline", *map(str, words), "--json"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout), done.stderr


def write(path, text, rows=20):
    """Write an experiment and the rows of its dataset."""
    path.write_text(text)
    numbers = np.random.default_rng(rows).uniform(-1, 1, (rows, 5)).round(3)
    lines = [",".join(map(str, [*row, 1.0])) for row in numbers]
    text = "\n".join(["left,right,dx,dy,dtheta,duration", *lines, ""])
    path.with_name("moves.csv").write_text(text)


MOVES = """
seed = 3

[dataset]
from = "csv"
rows = true
columns = {left = "left", right = "right", dx = "dx", dy = "dy", dtheta = "dtheta"}
recordings = ["moves.csv"]

[copy]
command = "dataset"
from = "csv"
rows = true
recordings = ["dataset/dataset.csv"]
columns = "left,right,duration,dx,dy,dtheta"
length = "m"
"""


@pytest.mark.slow
def test_the_example(tmp_path):
    file, out = ROOT / "examples" / "sweep.toml", tmp_path / "out"
    first, output = pipeline(file, "-o", out)
    assert output.count("$ neurosim train ") == 1
    assert output.count("$ neurosim evolve ") == 4
    table = list(csv.DictReader((out / "summary.csv").open()))
    swept = [(row["seed"], row["evolve.commands"]) for row in table]
    assert swept == [("0", "6"), ("0", "12"), ("1", "6"), ("1", "12")]
    for row, point in zip(table, first["points"], strict=True):
        stages = point["stages"]
        saved = json.loads((Path(stages["evolve"]["out"]) / "controller.json").read_text())
        assert saved["evolution"]["seed"] == int(row["seed"])
        assert len(saved["commands"]) == int(row["evolve.commands"])
        assert float(row["evolve:fitness"]) == saved["predicted"]["fitness"]
        assert stages["train"]["out"] == str(out / "train")
        name = f"seed={row['seed']},evolve.commands={row['evolve.commands']}"
        assert stages["report"]["out"] == str(out / name / "report.html")
        assert float(row["evaluate:errors.dx.mse"]) == stages["train"]["result"]["test_errors"][
            "dx"]["mse"]  # fmt: skip
    log = (out / "pipeline.jsonl").read_bytes()
    again, output = pipeline(file, "-o", out)
    assert "$ neurosim" not in output
    assert (out / "pipeline.jsonl").read_bytes() == log
    assert [point["stages"]["evolve"]["result"] for point in again["points"]] == [
        point["stages"]["evolve"]["result"] for point in first["points"]
    ]
    shown = CliRunner().invoke(cli, ["pipeline", str(file), "-o", str(out)]).stdout.splitlines()
    head = [line for line in shown if "evolve:fitness" in line]
    assert head[0].split() == [
        "seed", "evolve.commands", "evolve:commands", "evolve:fitness", "evolve:completes",
    ]  # fmt: skip


SWEEP = """
[sweep]
seed = [0, 1, 2]

[simulator]
command = "train"
dataset = "DATA"
trainer = "ga"
generations = 1
population = 10
seed = 5

[evolve]
task = "nine-rectangles"
generations = 1
population = 10
runs = 1
"""


@pytest.mark.slow
def test_combinations_that_run_at_once_give_the_same(tmp_path):
    file = tmp_path / "sweep.toml"
    file.write_text(SWEEP.replace("DATA", str(ROOT / "data" / "reference")))
    expected, _ = pipeline(file, "-o", tmp_path / "one")
    result, messages = pipeline(file, "-o", tmp_path / "three", "--at-once", "3")
    # The stage that all three share is done once; the others wait for it.
    assert messages.count("$ neurosim train") == messages.count("simulator: done in") == 1
    assert messages.count("simulator: done before") == 2
    assert messages.count("evolve: done in") == 3
    for one, other in zip(expected["points"], result["points"], strict=True):
        assert one["sweep"] == other["sweep"]
        for name in ("simulator", "evolve"):
            first, second = (point["stages"][name]["result"] for point in (one, other))
            assert first
            assert set(first) == set(second)
            assert {key: first[key] for key in first if key in ("fitness", "test_errors")} == {
                key: second[key] for key in first if key in ("fitness", "test_errors")
            }
    again, messages = pipeline(file, "-o", tmp_path / "three", "--at-once", "2")
    assert "$ neurosim" not in messages
    assert all(one["done_before"] for point in again["points"] for one in point["stages"].values())


@pytest.mark.slow
def test_an_error_of_one_of_several_names_its_stage(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("damaged").mkdir()
    Path("damaged/dataset.json").write_text("{")
    Path("bad.toml").write_text(SWEEP.replace("DATA", "damaged"))
    with pytest.raises(FileError, match=r"^bad.toml, field 'simulator': .*dataset.json") as error:
        CliRunner().invoke(cli, ["pipeline", "bad.toml", "--at-once", "2"], catch_exceptions=False)
    assert "\n" not in str(error.value)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "killpg"), reason="needs process groups")
def test_ctrl_c_ends_all_that_run_at_once(tmp_path):
    file = tmp_path / "sweep.toml"
    text = SWEEP.replace("DATA", str(ROOT / "data" / "reference"))
    file.write_text(text.replace("generations = 1\npopulation = 10\nruns", "runs"))
    process = started("pipeline", file, "--at-once", "2", session=True)
    begun = [tmp_path / "sweep" / f"seed={seed}" / "evolve.checkpoint" for seed in (0, 1)]
    wait_until(lambda: all((one / "checkpoint.json").exists() for one in begun), "both evolutions")
    process.send_signal(signal.SIGINT)  # to this process alone, which has to end the others
    _, messages = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130, messages
    assert "Traceback" not in messages
    with pytest.raises(ProcessLookupError):
        wait_until(lambda: os.killpg(process.pid, 0), "the end of all")
    assert not (tmp_path / "sweep" / "seed=2").exists()


def outs(result):
    return {name: Path(one["out"]).name for name, one in result["points"][0]["stages"].items()}


def test_a_stage_is_done_again_if_it_or_its_input_changed(tmp_path):
    file = tmp_path / "moves.toml"
    write(file, MOVES)
    first, output = pipeline(file)
    assert (output.count("$ neurosim"), outs(first)) == (2, {"dataset": "dataset", "copy": "copy"})
    kept = (tmp_path / "moves" / "dataset" / "dataset.csv").read_bytes()
    # An option that only the second stage has.
    write(file, MOVES.replace('length = "m"', 'length = "cm"'))
    second, output = pipeline(file)
    assert "dataset: done before" in output
    assert outs(second) == {"dataset": "dataset", "copy": "copy-2"}
    # The file that the first one reads.
    write(file, MOVES, rows=25)
    third, _ = pipeline(file)
    assert outs(third) == {"dataset": "dataset-2", "copy": "copy-3"}
    assert len(Dataset.read(tmp_path / "moves" / "copy-3")) == 25
    assert (tmp_path / "moves" / "dataset" / "dataset.csv").read_bytes() == kept
    # As it was at first: nothing is done.
    write(file, MOVES)
    last, output = pipeline(file)
    assert "$ neurosim" not in output
    assert outs(last) == outs(first)
    # An output that is gone is made again.
    shutil.rmtree(tmp_path / "moves" / "copy")
    _, output = pipeline(file)
    assert output.count("$ neurosim") == 1
    assert (tmp_path / "moves" / "copy" / "dataset.csv").exists()


def test_the_log_has_what_each_stage_was_done_with(tmp_path):
    file = tmp_path / "moves.toml"
    write(
        file,
        MOVES + '[photographs]\ncommand = "lab photographs"\ncount = 3\ncamera-size = "160x120"\n',
    )
    pipeline(file)
    rows = [json.loads(line) for line in (tmp_path / "moves" / "pipeline.jsonl").open()]
    assert rows[0] == {"format": "neurosim-pipeline", "version": 1}
    ended = {row["stage"]: row for row in rows[1:] if "seconds" in row}
    assert [row["stage"] for row in rows[1::2]] == ["dataset", "copy", "photographs"]
    assert ended["photographs"]["options"] == {"count": 3, "camera-size": "160x120", "seed": 3}
    assert ended["photographs"]["command"] == "lab photographs"
    source = ended["copy"]["inputs"]["recordings"]
    assert [one["path"] for one in source] == ["moves/dataset/dataset.csv"]
    assert len(source[0]["sha256"]) == len(ended["copy"]["sha256"]) == 64
    assert ended["dataset"]["result"]["rows"] == 20
    assert {row["neurosim"] for row in ended.values()} == {"0.1.0"}
    (tmp_path / "moves" / "pipeline.jsonl").write_text(
        json.dumps(rows[0]) + "\n" + json.dumps({**rows[1], "key": 3}) + "\n"
    )
    with pytest.raises(FileError, match=r"pipeline.jsonl, line 2, field 'key': expected text"):
        pipeline(file)


DRIVEN = """
[record]
commands = 6
camera-size = "320x240"
live = false
calibration = "calibration.json"

[track]

[dataset]
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Windows sends other signals")
def test_an_interrupted_recording_is_continued_and_tracked_in_place(tmp_path):
    with VirtualRig(0, camera_size=(320, 240)) as rig:
        optics = rig.camera.optics
        lens = optics.calibration
    lens.write(tmp_path / "calibration.json")
    (tmp_path / "drive.toml").write_text(DRIVEN)
    words = ["pipeline", "drive.toml"]
    log = "drive/record/commands.csv"
    ended = ended_by("SIGINT", words, log=log, count=3, word="command", cwd=tmp_path)
    assert ended.returncode == 130
    assert Recording(tmp_path / "drive" / "record").meta["complete"] is False
    done = neurosim(*words, cwd=tmp_path)
    assert "--resume" in done.stdout
    assert not (tmp_path / "drive" / "record-2").exists()
    recording = Recording(tmp_path / "drive" / "record")
    assert (recording.sessions, recording.is_tracked) == (2, True)
    assert len(Dataset.read(tmp_path / "drive" / "dataset")) >= 4
    again = neurosim(*words, cwd=tmp_path).stdout
    assert again.count("done before") == 3
    assert "$ neurosim" not in again


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[record]\ncomands = 3", "'record.comands': record has no such option; did you mean comm"),
        ("[record]\ncommands = 0", "'record.commands': 0 is not in the range"),
        ("[record]\ncommands = true", "'record.commands': expected a value, found true"),
        ('[record]\nguided = "yes"', "'record.guided': expected true or false, found 'yes'"),
        ("[record]\nresume = true", "'record.resume': is set by the pipeline"),
        ("[record]\nlive = true\nno-live = true", "'record.live': is the same as no-live"),
        ("[record]\ncamera-size = [640]", "'record.camera-size': '640': expected WIDTHxHEIGHT"),
        ('[record]\nrobot = "thymioo"', "'record': there is no robot 'thymioo'"),
        ("[trian]", "'trian': there is no command 'trian', and a table of another name needs the "
         "key command; did you mean train"),
        ('[a]\ncommand = "evolv"', "'a.command': there is no command 'evolv'; did you mean evolve"),
        ("[lab]", "'lab.command': lab needs one of nxt, khepera, lines, thymio, ros, photographs"),
        ("[train]", "'train.dataset': is missing: train needs one, and no stage before it makes"),
        ('[train]\ndataset = "d"', "'train.dataset': d is neither a file nor an earlier stage"),
        ('[train]\ndataset = "."\ntrainer = "ga"\ncentres = 3',
         "'train': --trainer ga has no option --centres: leave it out, or choose --trainer comb"),
        ('[record]\n[a]\ncommand = "record"\nout = "record"', "'a.out': another stage writes rec"),
        ('[record]\nout = "../x"', "'record.out': expected a name without a folder"),
        ("sede = 3\n[record]", "'sede': is not a key of a pipeline; .* did you mean seed"),
        ("seed = -1\n[record]", "'seed': expected a whole number from 0"),
        ("[sweep]\nseed = 3\n[record]", "'sweep.seed': expected a list, found 3"),
        ("[sweep]\nseed = [3, 3]\n[record]", "'sweep.seed': has a value twice"),
        ("[sweep]\ntrain.x = [1]\n[record]", "'sweep.train.x': is neither seed nor an option of"),
        ("[sweep]\nrecord.commands = [5, 0]\n[record]", "'record.commands': 0 is not in the range"),
        ("[record", "is not TOML .*Expected"),
        ("", "has no table; each stage needs one"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_before_anything_runs(text, says, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("e.toml").write_text(text)
    with pytest.raises(UserError, match=f"^e.toml.*{says}"):
        CliRunner().invoke(cli, ["pipeline", "e.toml"], catch_exceptions=False)
    assert [path.name for path in tmp_path.iterdir()] == ["e.toml"]


def test_an_error_of_a_stage_names_the_file_and_the_stage(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(Path("moves.toml"), MOVES)
    Path("moves.csv").write_text("left,right\n1,2\n")
    with pytest.raises(FileError, match=r"^moves.toml, field 'dataset': moves.csv"):
        CliRunner().invoke(cli, ["pipeline", "moves.toml"], catch_exceptions=False)
    write(Path("moves.toml"), MOVES)
    result, _ = pipeline("moves.toml")
    assert outs(result) == {"dataset": "dataset", "copy": "copy"}


def test_values_are_typed_as_on_the_command_line():
    tables = {
        "calibrate": {
            "photographs": ["."],
            "pattern": [9, 6],
            "point": [[1, 2, 3, 4], "5,6,7,8"],
            "corners": [[1, 2], [3, 4], [5, 6], [7, 8]],
            "square": 40.5,
        },
        "record": {"no-live": True, "readings": False, "calibration": "calibrate"},
        "dataset": {"windows": False},
        "train": {"members": 3},
        "evolve": {"robust": True, "placing": [3, 0.5]},
    }
    experiment = experiment_of(Path("e.toml"), tables, cli)
    made, lines = {}, {}
    for stage in experiment.at({}):
        name = stage.output()
        lines[stage.name] = stage.line(made, Path(name), Path()).words
        made[stage.name] = Made(Path(name), MAKES.get(" ".join(stage.words)))
    assert lines["calibrate"] == [
        ".", "--out=calibrate.json", "--pattern=9x6", "--square=40.5",
        "--point=1,2,3,4", "--point=5,6,7,8", "--corners", "1,2", "3,4", "5,6", "7,8",
    ]  # fmt: skip
    assert lines["record"] == ["record", "--calibration=calibrate.json", "--no-live"]
    assert lines["dataset"] == ["record", "--out=dataset", "--held"]
    assert lines["train"] == ["dataset", "--out=train", "--members=3"]
    assert "--robust" in lines["evolve"]
    place = lines["evolve"].index("--placing")
    assert lines["evolve"][place + 1 : place + 3] == ["3", "0.5"]


def test_the_pages_file_is_one():
    page = (ROOT / "docs" / "experiments.md").read_text(encoding="utf-8")
    blocks = [block.split("```")[0] for block in page.split("```toml\n")[1:]]
    assert len(blocks) == 2
    experiment = experiment_of(Path("e.toml"), tomllib.loads("\n".join(blocks)), cli)
    assert len(experiment.points()) == 6
    assert [stage.name for stage in experiment.stages][-2:] == ["run", "report"]
