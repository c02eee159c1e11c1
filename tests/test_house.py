"""A room imports from floors below it only; the ground floor's rooms know nothing of each other."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

FLOORS = {
    "neurosim.base": 0,
    "neurosim.evolution": 1,
    "neurosim.networks": 1,
    "neurosim.robots": 1,
    "tracking": 1,
    "neurosim.controllers": 2,
    "neurosim.simulators": 2,
    "neurosim.recording": 3,
    "neurosim.sampling": 3,
    "neurosim.lab": 3,
    "neurosim.tasks": 3,
    "neurosim.training": 4,
    "neurosim.evolve": 4,
    "neurosim.trials": 5,
    "neurosim.reports": 6,
    "neurosim.watch": 6,
    "neurosim.cli": 6,
    "neurosim.__main__": 6,
}


def room_of(module: str) -> str | None:
    return next((room for room in FLOORS if module == room or module.startswith(room + ".")), None)


def sources():
    for folder in ("neurosim", "tracking"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            yield module.removesuffix(".__init__"), path


def imports(path: Path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            for alias in node.names:
                yield f"{node.module}.{alias.name}"


@pytest.mark.parametrize(("module", "path"), list(sources()), ids=lambda x: str(x))
def test_imports_go_down(module, path):
    room = room_of(module)
    if module == "neurosim":
        return
    assert room is not None, f"{module} stands in no room"
    for name in imports(path):
        other = room_of(name)
        if other is None or other == room:
            continue
        same_floor_ok = FLOORS[room] >= 2 and FLOORS[other] == FLOORS[room]
        assert FLOORS[other] < FLOORS[room] or same_floor_ok, f"{module} imports {name}"
