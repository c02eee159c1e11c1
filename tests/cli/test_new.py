"""Folders that ``neurosim new`` makes: each works at once, and its own test passes."""

import json
import re

import pytest
from click.testing import CliRunner
from processes import finished, neurosim, process

from neurosim.base.errors import UserError
from neurosim.cli.main import cli
from neurosim.templates import TEMPLATES, make_from_template

NAMES = {"robot": "e-puck2", "task": "there-and-back", "simulator": "ideal", "controller": "seeker"}
FILES = {
    "robot": {"driver.py", "e_puck2_fake.py", "test_e_puck2.py", "README.md"},
    "task": {"task.py", "test_there_and_back.py", "README.md"},
    "simulator": {"simulator.py", "simulator.json", "test_ideal.py", "README.md"},
    "controller": {"controller.py", "test_seeker.py", "README.md"},
}


def run(folder, module, *words):
    """Run a module as ``python -m`` does."""
    program = f"import runpy\nrunpy.run_module({module!r}, run_name='__main__', alter_sys=True)"
    done = finished(process(program, *words, cwd=folder))
    return done.returncode, done.stdout, done.stderr


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Make a folder of each kind by the command, and return the folder of all."""
    folder = tmp_path_factory.mktemp("new")
    for kind, name in NAMES.items():
        words = ["new", kind, name, "--folder", str(folder / name), "--json"]
        done = CliRunner().invoke(cli, words, catch_exceptions=False)
        files = {path.name for path in (folder / name).iterdir()}
        assert {*map(str, (folder / name).iterdir())} == set(json.loads(done.stdout)["files"])
        assert files == FILES[kind]
    return folder


def test_there_is_a_template_of_each_kind(made):
    assert set(NAMES) == set(TEMPLATES)
    for path in made.rglob("*.*"):
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"my.thing", text, re.IGNORECASE), path
        assert NAMES["robot"] in (made / NAMES["robot"] / "README.md").read_text()


@pytest.mark.slow
def test_the_code_is_formatted_and_clean(made):
    ruff = ["ruff"]
    chosen = ["--select", "E,F,W,B,UP,SIM,RUF", "--ignore", "RUF043", "--line-length", "100"]
    code, message, _ = run(made, *ruff, "check", "--isolated", *chosen, ".")
    assert code == 0, message
    code, message, _ = run(
        made, *ruff, "format", "--isolated", "--line-length", "100", "--diff", "."
    )
    assert code == 0, message


@pytest.mark.slow
@pytest.mark.parametrize("kind", NAMES)
def test_its_own_test_passes(made, kind):
    code, message, _ = run(made, "pytest", "-q", "-p", "no:cacheprovider", NAMES[kind])
    assert code == 0, message
    assert re.search(r"^[2-9] passed", message, re.MULTILINE)


@pytest.mark.slow
def test_the_robot_is_tried_at_once(made):
    name = NAMES["robot"]
    plugin = ["--plugin", f"{name}/driver.py"]
    done = neurosim(*plugin, "check-robot", "--robot", name, "--json", cwd=made)
    content = {one["what"]: one["verdict"] for one in json.loads(done.stdout)["findings"]}
    assert content.pop("battery") == "unknown"
    assert set(content.values()) == {"good"}
    assert "self-stopping" in content
    recorded = ["--commands", "2", "--durations", "0.2..0.3", "--camera", "none"]
    words = ["record", "recording", "--robot", name, *recorded, "--at-line", "ignore"]
    neurosim(*plugin, *words, cwd=made)
    assert "v,omega" in (made / "recording" / "commands.csv").read_text()


@pytest.mark.slow
def test_task_simulator_and_controller_are_evolved_at_once(made):
    task, simulator, controller = (NAMES[kind] for kind in ("task", "simulator", "controller"))
    plugins = [f"{task}/task.py", f"{simulator}/simulator.py", f"{controller}/controller.py"]
    words = [word for path in plugins for word in ("--plugin", path)]
    words += ["evolve", simulator, "--generations", "3", "--runs", "1"]
    for name, others in [
        ("plan", ["--task", task, "--metres", "0.2"]),
        ("seeks", ["--task", "go-to", "--controller", controller]),
    ]:
        neurosim(*words, *others, "-o", name, cwd=made)
        assert json.loads((made / name / "controller.json").read_text())["predicted"]


@pytest.mark.parametrize(
    ("kind", "name", "says"),
    [
        ("robot", "nxt", "the name 'nxt' is taken by neurosim's own robot"),
        ("task", "go-to", "taken by neurosim's own task"),
        ("robot", "My Robot", "give lower-case letters and digits"),
        ("robot", "../elsewhere", "give lower-case letters and digits"),
        ("task", "class", "cannot be the name of a task"),
    ],
)
def test_names_that_cannot_be(tmp_path, kind, name, says):
    with pytest.raises(UserError, match=says):
        make_from_template(kind, name, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_what_stands_there_is_not_overwritten(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "driver.py").write_text("mine")
    with pytest.raises(UserError, match="is not empty"):
        make_from_template("robot", "mine", tmp_path / "mine")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["driver.py"]
