"""What is built from this folder installs and runs elsewhere."""

import importlib.util
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


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
    assert not any(name.startswith(("tests/", "benchmarks/")) for name in names)
    target = tmp_path / "elsewhere"
    subprocess.run([*pip, "install", "--no-deps", "--target", str(target), str(wheel)], check=True)
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
    found = subprocess.run(
        [sys.executable, "-c", where],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(target)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert found.stdout.startswith(str(target))
