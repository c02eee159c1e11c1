"""Damaged files given to the commands that read them: a part of benchmarks/fuzz.py."""

import json
import random
import shutil

import pytest
from fuzz import TARGETS, case, make
from mutations import damage

#: Commands that learn, evolve or compile take seconds, and only the benchmark runs them.
QUICK = ("dataset", "build-tables", "report dataset", "view arena.json", "evaluate paper")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made")
    make(folder, lab=False)
    return folder


def targets(*lines):
    return [one for one in TARGETS if not one.lab and one.line.startswith(lines)]


def attack(made, scratch, chosen, cases, seed):
    faults = []
    for number in range(cases):
        result = case(made, scratch, chosen, seed, number)
        if result["fault"]:
            faults.append((number, result))
    assert not faults


@pytest.mark.slow
def test_a_few_damaged_files(made, tmp_path):
    attack(made, tmp_path, targets(*QUICK), 60, seed=1)


@pytest.mark.slow
def test_damaged_files_of_every_kind(made, tmp_path):
    attack(made, tmp_path, targets(""), 75, seed=2)


EVOLVE = "evolve simulator -o out --generations 2 --runs 1 --population 10 --commands 3 "
AVOID = "evolve tables --task obstacle-avoidance -o out --generations 1 --population 10 --steps 6 "


@pytest.mark.slow
@pytest.mark.parametrize(
    "line",
    [
        *(EVOLVE + "--final-draws 4 " + words for words in (
            "--eta 0", "--eta 1000", "--penalty 1e-320", "--mutation-scale 1000",
            "--placing 1e-320 0", "--seed 2147483647", "--longest-arc 1e-4", "--width 1000",
            "--task go-to --radius 0 --begin 1000 -1000 1000",
        )),
        *(AVOID + "--starts 2 --final-draws 4 " + words for words in (
            "--enough -1", "--parents 0", "--duration 0.001", "--seed 2147483647",
        )),
        "plan-check plan simulator --draws 1 --placing 1e6 360",
        "dataset --from csv log.csv -o out --shortest 0.001 --longest 100000",
        "train dataset -o out --members 1 --part-weight 1e-6 --most-parts 1 --centres 1",
    ],
)  # fmt: skip
def test_numbers_at_the_ends_of_their_ranges_work(made, tmp_path, line):
    from fuzz import call

    for name in ("simulator", "tables", "plan", "dataset"):
        shutil.copytree(made / name, tmp_path / name)
    shutil.copy(made / "log.csv", tmp_path)
    code, message, fault = call(line.split(), tmp_path)
    assert (code, fault) == (0, ""), message


@pytest.mark.slow
@pytest.mark.parametrize(
    "text",
    [
        '{"a": ' + "9" * 5000 + "}",
        '{"a": 9223372036854775808}',
        '{"a": 1e999}',
        '{"a": NaN}',
        "[" * 100_000,
        '{"a":' * 50_000,
        '{"a": 1, "a": 2}',
        "\x00",
        "",
    ],
    ids=["digits", "integer", "float", "nan", "brackets", "objects", "twice", "zero", "empty"],
)
@pytest.mark.parametrize("line", ["evaluate simulator dataset", "view tables --controller net"])
def test_json_that_nothing_can_work_with(made, tmp_path, text, line):
    target = targets(line)[0]
    for name in (*target.reads, *target.needs):
        shutil.copytree(made / name, tmp_path / name)
    path = next((tmp_path / target.reads[0]).glob("*.json"))
    path.write_text(text)
    from fuzz import call

    code, message, fault = call(target.line.split(), tmp_path)
    assert (code, fault) == (1, "")
    assert message.count("\n") == 1
    assert path.name in message


def test_a_mutation_changes_the_file_and_says_how(tmp_path):
    """Without a change in the file there is no attack."""
    path = tmp_path / "x.json"
    whole = json.dumps({"format": "x", "a": [1, 2, 3], "b": {"c": "d"}})
    changed = 0
    for seed in range(200):
        path.write_text(whole)
        assert damage(path, random.Random(seed)).startswith("x.json: ")
        there = path.is_file() and not path.is_symlink()
        changed += not there or path.read_bytes() != whole.encode()
        if path.is_dir():
            path.rmdir()
        path.unlink(missing_ok=True)
    assert changed > 180
