"""``dataset --from csv``: the page on own data from end to end, and what users get wrong."""

import json
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from neurosim.cli.main import cli, main
from tracking.datasets.dataset import Dataset

PAGE = Path(__file__).resolve().parents[2] / "docs" / "own-data.md"
QUICK = ("--trainer", "combined", "--members", "2")


def block(language, place=0):
    result = PAGE.read_text(encoding="utf-8").split(f"```{language}\n")[1 + place]
    return result.split("```")[0]


def neurosim(*words):
    """Run a command; return its JSON and its stderr without progress."""
    done = CliRunner().invoke(cli, [*map(str, words), "--json"])
    assert done.exit_code == 0, f"{done.output}{done.exception!r}"
    lines = done.stderr.splitlines(keepends=True)
    return json.loads(done.stdout), "".join(x for x in lines if not x.startswith("training: "))


@pytest.mark.slow
def test_the_pages_example_runs_from_log_to_report(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(block("python"), "own-data.md", "exec"), {})
    for line in block("sh").splitlines():
        command, *words = shlex.split(line)[1:]
        result, message = neurosim(command, *words, *(QUICK if command == "train" else ()))
        assert message == ""
        if command == "evaluate":
            errors = {
                name: error["mean_absolute_error"] for name, error in result["errors"].items()
            }
            ideal = {
                name: error["mean_absolute_error"]
                for name, error in result["baseline"]["errors"].items()
            }
            assert all(errors[name] < ideal[name] for name in errors)
    assert "dataset" in Path("report.html").read_text(encoding="utf-8")
    shown, same = Dataset.read("dataset"), Dataset.read("dataset-of-log")
    assert (shown.output_array() == same.output_array()).all()
    assert len(shown.within) > 6 * len(shown)


def test_the_pages_files_are_read(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("moves.csv").write_text(block("csv", 1))
    (words,) = [shlex.split(line)[1:] for line in block("sh", 1).splitlines()]
    result, message = neurosim(*words)
    assert (result["rows"], result["within"]) == (2, 0)
    assert message == "warning: 2 rows; neurosim train needs at least 20\n"
    dataset = Dataset.read("dataset")
    names = ["prev_vx", "prev_vy", "prev_w", "vx", "vy", "w", "duration"]
    units = ["m/s", "m/s", "rad/s", "m/s", "m/s", "rad/s", "s"]
    assert [(each["name"], each["unit"]) for each in dataset.meta["inputs"]] == list(
        zip(names, units, strict=True)
    )
    # The second command goes sideways, seen from a robot that looks along 0.75 rad.
    ahead = np.array([np.cos(0.75), np.sin(0.75)]) @ [-0.07, 0.21]
    assert dataset.output_array()[1] == pytest.approx([ahead, 0.2014, 0.01], abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("names", [("thrust",), ("vx", "vy", "w"), ("a", "b", "c", "d")])
def test_any_commands_can_be_learned_and_reported(tmp_path, monkeypatch, names):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(len(names))
    lines = [" ".join(["#", *names, "duration", "dx", "dy", "dtheta"])]
    for _ in range(60):
        command, duration = rng.uniform(-1, 1, len(names)).round(2), round(rng.uniform(0.5, 2), 2)
        moved = np.resize(command, 3) * (0.3, 0.2, 1.0) * duration + rng.normal(0, 0.002, 3)
        lines.append(" ".join(map(str, [*command, duration, *moved.round(5)])))
    Path("moves.txt").write_text("\n".join(lines) + "\n")
    result, _ = neurosim(
        "dataset", "--from", "csv", "moves.txt", "-o", "d", "--columns", ",".join(names)
    )
    assert result["rows"] == 60
    neurosim("train", "d", "-o", "s", *QUICK)
    assert neurosim("evaluate", "s", "d")[0]["baseline"] is None
    neurosim("report", "d", "s", "-o", "page.html")
    assert f"prev_{names[0]}" in Path("page.html").read_text(encoding="utf-8")


LOG = "time,x,y,heading,v,w\n" + "".join(
    f"{0.1 * n:.1f},{0.01 * n:.2f},0,0,0.{1 + n // 10},0\n" for n in range(60)
)
ROWS = "a,duration,dx,dy,dtheta\n" + "".join(f"{n},1,0.1,0,{n}\n" for n in range(30))


@pytest.fixture
def refused(refused):
    """Import a file with this text, which must fail; return the one sentence."""

    def run(text, *words) -> str:
        Path("my.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
        return refused("dataset", "--from", "csv", "my.csv", "-o", "d", *words)

    return run


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (
            "1.0,0.10",
            "one,0.10",
            "line 12, field 'time': expected a number such as 0.25, found 'one'",
        ),
        (
            "1.0,0.10",
            ",0.10",
            "line 12, field 'time': expected a number such as 0.25, found ''",
        ),
        (
            "1.0,0.10",
            "1.0,far",
            "field 'x': expected a number such as 0.25 or nothing, found 'far'",
        ),
        (
            "1.0,0.10",
            "1.0,inf",
            "field 'x': expected a number such as 0.25 or nothing, found 'inf'",
        ),
        (
            "1.0,0.10",
            "1.0,1e308",
            "field 'x': expected a number such as 0.25 or nothing, found '1e308'",
        ),
        (
            ",0.2,0\n",
            ",nan,0\n",
            "line 12, field 'v': expected a number such as 0.25, found 'nan'",
        ),
        ("1.0,0.10", "1.0", "line 12: expected 6 fields (time, x, y, heading, v, w), found 5"),
        ("1.0,0.10", "1,0,0,10", "found 8; a number has a decimal point, not a comma"),
        ("heading", "yaw", "line 1, field 'heading': there is no such column; found time, x, y, "),
        (",v,w", ",x,w", "line 1: which columns are the command? found time, x, y, heading, x, w"),
        ("time,x,", "time,y,", "line 1, field 'x': there is no such column"),
        (",heading,", ",heading,heading,", "expected 7 fields"),
        ("time,x,y,heading,v,w\n", "", "found numbers; write one above them"),
        ("time,x,y,heading", "a,b,c,d", "expected a log with time, x, y, heading, or a line for"),
    ],
)
def test_what_is_wrong_in_a_log_is_named(refused, old, new, says):
    assert old in LOG
    message = refused(LOG.replace(old, new, 1))
    assert "my.csv" in message
    assert says in message


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "my.csv, line 1: is empty; expected a line with the names of the columns"),
        ("\n\n", "is empty"),
        ("time,x,y,heading,v,w\n", "holds the names of columns and no line of numbers"),
        ("time,x,y,heading,v,w\n0,0,0,0,0,0\n", "holds 1 sample; a log needs two or more"),
        (b"\xff\xfet\0i\0m\0e\0", "is not text; save it as CSV in UTF-8"),
        (b"PK\3\4\0\0time,x", "is not text; save it as CSV in UTF-8"),
        ("time,x,y,heading,v,w\n" + "0,,,,0,0\n1,,,,0,0\n", "no line has a pose"),
        (
            LOG.replace(",", ";").replace(".", ","),
            "line 2, field 'time': expected a number such as 0.25",
        ),
    ],
)
def test_files_that_are_none(refused, text, says):
    assert says in refused(text)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--columns", "time=t"), "field 't': there is no such column (time); found time, x"),
        (("--columns", "v=speed"), "field 'speed': there is no such column (v)"),
        (("--columns", "v,w,time,dx=x"), "dx is not a column of a file that is a log"),
        (("--columns", "v,prev_v=w"), "a log contains the command before each command"),
        (("--columns", "command=v"), "a command cannot be called command"),
        (("--units", "u=m/s"), "a unit is given for u, which is not a command; commands are v, w"),
        (("--from-rest",), "a log contains the command before"),
        (("--frame", "world"), "--frame world is for files of rows with dx, dy"),
        (("--shortest", 4), "the shortest piece (4 s) is longer than the longest one (3 s)"),
        (("--time", "ms"), "no command is held for 0.5 s"),
        (
            ("--shortest", 1.5),
            "no command is held for 1.5 s: name the columns of the sent commands",
        ),
        (
            ("--longest-gap", 0.05),
            "samples are 0.1 s apart, more than --longest-gap 0.05",
        ),
        (("--rows",), "field 'duration': there is no such column; found time"),
        (("my.csv",), "my.csv is named twice"),
        (("--mixed",), "--mixed is for --from recording, not csv"),
    ],
)
def test_options_that_do_not_fit_a_log(refused, words, says):
    assert says in refused(LOG, *words)


@pytest.mark.parametrize(
    ("old", "new", "words", "says"),
    [
        ("3,1,", "3,0,", (), "line 5, field 'duration': expected a number above 0"),
        ("3,1,", "3,-1,", (), "line 5, field 'duration': expected a number above 0"),
        ("duration", "lasted", (), "field 'duration': there is no such column; found a, lasted"),
        ("dtheta", "turn", (), "field 'dtheta': there is no such column"),
        (
            "a,d",
            "a,d",
            ("--columns", "a,prev_b=dx"),
            "prev_b is the command before, but its command has no column",
        ),
        ("a,d", "a,d", ("--columns", "a,prev_a=dx", "--from-rest"), "leave out --from-rest"),
        ("a,d", "a,d", ("--frame", "world"), "field 'heading0': there is no such column"),
        (
            "a,d",
            "a,d",
            ("--columns", "a,time=duration,dx=dx"),
            "time is not a column of a file with",
        ),
    ],
)
def test_what_is_wrong_in_rows_is_named(refused, old, new, words, says):
    assert old in ROWS
    words = words if "--columns" in words else ("--columns", "a", *words)
    assert says in refused(ROWS.replace(old, new, 1), *words, "--rows")


def test_all_rows_not_seen(refused):
    text = "a,duration,dx,dy,dtheta\n" + "1,1,,,\n" * 3
    assert "no usable command (left out: 3 not seen)" in refused(text, "--columns", "a")


def test_options_of_other_sources_are_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["neurosim", "dataset", "r", "-o", "d", "--angle", "deg"])
    with pytest.raises(SystemExit):
        main()
    assert "--angle is for --from csv, not recording" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words", [("--columns", "a=,b"), ("--units", "v"), ("--columns", "a=b,a=c")]
)
def test_pairs_that_are_none(tmp_path, words):
    done = CliRunner().invoke(cli, ["dataset", "--from", "csv", "x", "-o", "d", *words])
    assert done.exit_code == 2
    assert "expected NAME=" in done.stderr or "named twice" in done.stderr


def test_units_that_look_wrong_are_warned_of(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    moves = ("300,1,0.5,130,0,45\n", "280,0.9,0.5,121,0,40\n")
    rows = "v,w,duration,dx,dy,dtheta\n" + "".join(moves) * 15
    Path("rows.csv").write_text(rows)
    result, message = neurosim("dataset", "--from", "csv", "rows.csv", "-o", "d")
    assert "m/s: are --length m and --time s right?" in message
    assert "turns at 90 rad/s: are --angle rad and --time s right?" in message
    assert "the command v is up to 300 m/s: is that its unit?" in message
    assert len(result["warnings"]) == message.count("warning: ") == 3
    right = ("--length", "mm", "--angle", "deg", "--units", "v=mm/s")
    assert neurosim("dataset", "--from", "csv", "rows.csv", "-o", "e", *right)[1] == ""
    yaw = [170.0, 175.0, -180.0, -175.0] * 15
    text = LOG.splitlines()
    log = [text[0]] + [
        ",".join([*line.split(",")[:3], str(angle), *line.split(",")[4:]])
        for line, angle in zip(text[1:], yaw, strict=True)
    ]
    Path("log.csv").write_text("\n".join(log) + "\n")
    message = neurosim("dataset", "--from", "csv", "log.csv", "-o", "f")[1]
    assert "fit each other: they would with --angle deg" in message
