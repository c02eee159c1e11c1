"""How large the source is: files, lines of code, and files from a command to the kernels.

A line of code is one that is not blank, a comment or part of a docstring. The path consists of the
files on the stack when ``neurosim evolve`` enters the compiled loop, and of the kernels.

    python benchmarks/size.py
    python benchmarks/size.py --json
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import inspect
import io
import json
import sys
import tempfile
import tokenize
import traceback
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("neurosim", "tracking", "tests", "benchmarks")
SILENT = {
    *(tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE),
    *(tokenize.INDENT, tokenize.DEDENT, tokenize.ENCODING, tokenize.ENDMARKER),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    sizes = {}
    for package in PACKAGES:
        files = sorted((ROOT / package).rglob("*.py"))
        sizes[package] = {"files": len(files), "code": sum(code_of(path) for path in files)}
    path = files_to_kernel()
    if options.json:
        print(json.dumps({"packages": sizes, "path": path}))
        return
    for package, size in sizes.items():
        print(f"{package:12} {size['files']:5} files {size['code']:7,} lines of code")
    source = sum(sizes[package]["code"] for package in PACKAGES[:2])
    print(f"{'source':12} {source:19,} lines of code\n\n{len(path)} files from command to kernel:")
    print("\n".join(f"  {name}" for name in path))


def code_of(path: Path) -> int:
    """Return how many lines of a file are code."""
    text = path.read_text()
    described = set()
    for node in ast.walk(ast.parse(text)):
        body = getattr(node, "body", None)
        if isinstance(body, list) and body and isinstance(body[0], ast.Expr):
            first = body[0]
            if isinstance(first.value, ast.Constant) and isinstance(first.value.value, str):
                described |= set(range(first.lineno, first.end_lineno + 1))
    lines = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in SILENT:
            lines |= set(range(token.start[0], token.end[0] + 1))
    return len(lines - described)


def files_to_kernel() -> list[str]:
    """Return the files of ours on the stack where `neurosim evolve` enters the compiled loop."""
    from closed_loop import motion_network

    from neurosim.cli.main import main as command
    from neurosim.simulators import engine
    from neurosim.simulators.motion.files import write_motion
    from neurosim.simulators.motion.kernels import MotionModel

    own, files = engine.functions_of(motion_network().compiled()), []

    def entered(*given: Any) -> None:
        if not files:
            places = [Path(frame.filename) for frame in traceback.extract_stack()[:-1]]
            ours = [str(p.relative_to(ROOT)) for p in places if (ROOT / "neurosim") in p.parents]
            files.extend(dict.fromkeys([*ours, inspect.getfile(own.step.py_func)]))
        own.drive(*given)

    engine._FUNCTIONS[MotionModel] = own._replace(drive=entered)
    with tempfile.TemporaryDirectory() as name, contextlib.redirect_stdout(io.StringIO()):
        folder = Path(name) / "simulator"
        folder.mkdir()
        write_motion(motion_network(), folder)
        words = ["evolve", folder, "-o", Path(name) / "plan", "--generations", "1", "--runs", "1"]
        sys.argv = ["neurosim", *map(str, words)]
        with contextlib.suppress(SystemExit):
            command()
    files[-1] = str(Path(files[-1]).relative_to(ROOT))
    return files


if __name__ == "__main__":
    main()
