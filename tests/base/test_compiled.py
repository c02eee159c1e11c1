import os
import subprocess
import sys
import time
from pathlib import Path

import filelock
import pytest

from neurosim.base import compiled


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """Return a function that says where compiled functions of a source are kept."""
    source, home = tmp_path / "source", tmp_path / "home"
    source.mkdir()
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", str(home))

    def where():
        compiled.keep_compiled(source)
        return Path(os.environ["NUMBA_CACHE_DIR"])

    return where


def test_compiled_functions_are_kept_beside_the_source(kept, tmp_path):
    folder = kept()
    assert folder.parent == tmp_path / "source" / "__pycache__"
    assert kept() == folder  # as a process that this one starts


def test_or_in_the_users_cache_or_in_a_folder_of_the_process(kept, tmp_path, monkeypatch):
    (tmp_path / "source" / "__pycache__").touch()
    assert kept().parent == tmp_path / "home" / ".cache"
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.setenv("HOME", str(tmp_path / "source" / "__pycache__"))
    folder = kept()
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.rmdir()


def test_the_folder_is_named_when_numba_is_imported_and_not_before():
    program = (
        "import os, neurosim\nprint(os.environ.get('NUMBA_CACHE_DIR'))\n"
        "import numba.core.config\nprint(numba.core.config.CACHE_DIR)\n"
        "from neurosim.base.compiled import compiled_ahead\nprint(compiled_ahead().parent)"
    )
    env = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    done = subprocess.run([sys.executable, "-c", program], env=env, capture_output=True, text=True)
    before, used, ahead = done.stdout.splitlines()
    assert before == "None"
    assert Path(used).name.startswith("neurosim-compiled-")
    assert used == ahead


@pytest.mark.slow
def test_an_edited_function_that_a_compiled_one_calls_is_compiled_anew(tmp_path):
    (tmp_path / "callee.py").write_text(
        "import numba\n\n@numba.njit\ndef f(x):\n    return x + 1\n"
    )
    (tmp_path / "caller.py").write_text(
        "import numba\nfrom callee import f\n\n"
        "@numba.njit(cache=True)\ndef g(x):\n    return 10 * f(x)\n"
    )
    program = (
        "from pathlib import Path\nfrom neurosim.base.compiled import keep_compiled\n"
        f"keep_compiled(Path({str(tmp_path)!r}))\n"
        "from caller import g\nprint(g(1), sum(g.stats.cache_hits.values()))"
    )
    env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    env["PYTHONPATH"] = os.pathsep.join([str(tmp_path), *sys.path])

    def ran():
        command = [sys.executable, "-c", program]
        return subprocess.run(command, env=env, capture_output=True, text=True, check=True).stdout

    assert ran().split() == ["20", "0"]
    assert ran().split() == ["20", "1"]
    callee = tmp_path / "callee.py"
    callee.write_text(callee.read_text().replace("x + 1", "x + 2"))
    assert ran().split() == ["30", "0"]


@pytest.mark.slow
def test_of_two_processes_that_need_a_function_one_compiles_it(tmp_path):
    program = (
        "import sys, numba\n"
        "from numba.core import event\n"
        "from neurosim.base.compiled import njit\n"
        "@njit\ndef f(x):\n    return x + 1\n"
        "class Begins(event.Listener):\n"
        "    def on_start(self, event):\n"
        "        print('compiles', flush=True), sys.stdin.readline()\n"
        "    def on_end(self, event):\n        pass\n"
        "numba.njit(lambda x: x)(1)\n"  # what Numba does once before it compiles
        "event.register('numba:compile', Begins())\n"
        "print('needs it', flush=True)\n"
        "print(f(1), flush=True)\n"
    )
    source = tmp_path / "program.py"
    source.write_text(program)
    env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    env["PYTHONPATH"] = os.pathsep.join(sys.path)
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "env": env}
    with subprocess.Popen([sys.executable, source], **pipes) as first:
        lines = [first.stdout.readline() for _ in range(2)]
        with subprocess.Popen([sys.executable, source], **pipes) as second:
            assert second.stdout.readline() == "needs it\n"
            second.stdin.close()
            time.sleep(0.5)
            first.stdin.close()
            lines += first.stdout.readlines()
            assert second.stdout.readlines() == ["2\n"]
    assert lines == ["needs it\n", "compiles\n", "2\n"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="Windows has no fork")
def test_a_forked_process_compiles_too():
    f = compiled.njit(lambda x: x + 1)
    child = os.fork()
    if child == 0:
        code = 1
        try:
            code = f(1)
        finally:
            os._exit(code)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 2
    assert f(1) == 2


@pytest.mark.parametrize("error", [NotImplementedError, TimeoutError])
def test_where_a_lock_cannot_be_had_each_process_compiles(monkeypatch, error):
    class Lock:
        def __init__(self, path, timeout):
            assert 10 < timeout < 600

        def __enter__(self):
            raise error

        def __exit__(self, *error):
            raise AssertionError

    monkeypatch.setattr(filelock, "FileLock", Lock)
    assert compiled.njit(lambda x: x + 1)(1) == 2
