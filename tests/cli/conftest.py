"""Fixtures of all tests of the command line."""

import math
import sys

import pytest
from cli_pipeline import pipeline

from neurosim.cli.main import main

__all__ = ["pipeline", "refused"]


@pytest.fixture
def refused(tmp_path, monkeypatch, capsys):
    """Run a command that must fail in the folder of the test; return its one sentence."""
    monkeypatch.chdir(tmp_path)
    # Slow commands print their progress on stderr, too; only the one sentence is checked.
    monkeypatch.setattr("neurosim.base.progress.LINE_EVERY", math.inf)

    def files() -> list[str]:
        """Return all paths but Python's bytecode of a plug-in."""
        return sorted(str(path) for path in tmp_path.rglob("*") if "__pycache__" not in path.parts)

    def run(*words) -> str:
        before = files()
        monkeypatch.setattr(sys, "argv", ["neurosim", *map(str, words)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as stop:
            main()
        out, message = capsys.readouterr()
        assert stop.value.code == 1
        assert out == ""
        assert message.startswith("neurosim: ")
        assert message.count("\n") == 1, message
        assert "Traceback" not in message
        assert files() == before
        return message

    return run
