"""The wheel that is built from this folder installs and runs elsewhere."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
HOSTED = sorted((ROOT / ".github").rglob("*.yml"))


@pytest.mark.skipif(not HOSTED, reason="needs the source folder")
def test_workflows_run_commands_that_there_are():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = extras["optional-dependencies"]
    commands = []
    for path in HOSTED:
        if path.parent.name != "workflows":
            continue
        workflow = yaml.safe_load(path.read_text(encoding="utf-8"))
        assert {"name", "permissions", "jobs", True} == set(workflow) - {
            "concurrency"
        }  # True: "on"
        for name, job in workflow["jobs"].items():
            assert set(job.get("needs", "").split()) <= set(workflow["jobs"]), name
            assert job["timeout-minutes"] <= 90
            commands += [step["run"] for step in job["steps"] if "run" in step]
    made = [command.split()[1] for command in commands if command.startswith("make ")]
    assert sorted(made) == ["dist", "docs", "test", "test-extras"]
    assert set(made) <= targets
    named = re.findall(r"\.\[([a-z,]+)\]", " ".join(commands))
    assert named
    assert all(set(one.split(",")) <= set(extras) for one in named)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "large"),
    [
        ([], "torch numba pandas cv2 scipy"),
        (["--help"], "torch numba pandas cv2 scipy"),
        (["dataset", "--help"], "torch numba pandas cv2 scipy"),
        (["report", "--help"], "torch numba pandas cv2 scipy"),
        # These import the robots of the virtual lab, whose body is compiled.
        (["check-robot", "--help"], "torch"),
        (["record", "--help"], "torch"),
        (["sample", "--help"], "torch"),
    ],
)
def test_help_does_not_wait_for_large_libraries(words, large):
    program = (
        "import sys\n"
        "from neurosim.__main__ import main\n"
        f"sys.argv[1:] = {words}\n"
        "try:\n    main()\n"
        "except SystemExit:\n    pass\n"
        f"print('large:', *({set(large.split())} & set(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert "Usage: " in done.stdout + done.stderr
    assert done.stdout.splitlines()[-1].split() == ["large:"], done.stdout


@pytest.mark.skipif(not HOSTED, reason="needs the source folder")
def test_the_citation_and_the_changelog_are_of_this_version():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == version
    newest = re.search(r"^## (.+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert newest is not None
    assert newest.group(1).split()[0] == version


def test_forms_for_issues_have_what_a_host_asks_for():
    forms = [path for path in HOSTED if path.parent.name == "ISSUE_TEMPLATE"]
    assert forms or not HOSTED
    for path in forms:
        form = yaml.safe_load(path.read_text(encoding="utf-8"))
        assert {"name", "description", "body"} <= set(form)
        assert all(one["attributes"]["label"] for one in form["body"])


@pytest.mark.skipif(not (ROOT / "pyproject.toml").exists(), reason="needs the source folder")
def test_torch_is_a_range_and_what_is_installed_is_pinned():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    given = {one.name: one for one in map(Requirement, project["dependencies"])}
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = [Requirement(one) for line in lines if (one := line.partition("#")[0].strip())]
    assert [pin.name for pin in pins] == ["torch"]
    for pin in pins:
        (exactly,) = pin.specifier
        assert exactly.operator == "=="
        assert given[pin.name].specifier.contains(exactly.version)
        assert not any(one.operator == "==" for one in given[pin.name].specifier)
    installing = 0
    for path in (ROOT / "Makefile", ROOT / "docs" / "pipeline.md", *HOSTED):
        for line in re.findall("pip install.*", path.read_text(encoding="utf-8")):
            if "pyusb" not in line:
                assert "constraints.txt" in line, f"{path}: {line}"
                installing += path.name == "Makefile"
    assert installing == 1
    # Every other line of the Makefile that installs something uses this one.
    recipes = re.findall(r"^\t\$\(INSTALL\) -e", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert len(recipes) == 3


@pytest.mark.slow
@pytest.mark.skipif(
    not (ROOT / "pyproject.toml").exists() or importlib.util.find_spec("setuptools") is None,
    reason="needs the source folder and setuptools",
)
def test_a_wheel_installs_and_runs_elsewhere(tmp_path):
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    # A copy, so that the build leaves nothing behind in the source folder.
    source = tmp_path / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in ("neurosim", "tracking"):
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / name, source / name, ignore=ignored)
    wheels = tmp_path / "wheels"
    subprocess.run(
        [*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", str(wheels), str(source)],
        check=True,
    )
    (wheel,) = wheels.glob("neurosim-*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert any(name.endswith("page.html") for name in names)
    assert any(name.endswith("/LICENSE") for name in names)
    assert {"neurosim/py.typed", "tracking/py.typed"} <= set(names)
    assert "neurosim/templates/robot/driver.py.txt" in names
    assert not any(name.startswith(("tests/", "benchmarks/")) for name in names)
    target = tmp_path / "elsewhere"
    pins = ["-c", str(ROOT / "constraints.txt")]
    subprocess.run(
        [*pip, "install", *pins, "--no-deps", "--target", str(target), str(wheel)], check=True
    )
    done = subprocess.run(
        [sys.executable, "-m", "neurosim", "lab", "photographs", "p", "--count", "3"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(target)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert (tmp_path / "p" / "points.csv").exists(), done.stderr
    where = "import neurosim, sys; print(neurosim.__file__)"
    finished = subprocess.run(
        [sys.executable, "-c", where],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(target)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert finished.stdout.startswith(str(target))
