"""Packages import from the layers below only, and no imports form a circle."""

import ast
import re
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

#: From the bottom up. Packages of one layer do not import each other. ``neurosim`` itself is the
#: public interface; ``neurosim.testing`` has checks for other packages.
LAYERS = (
    {"neurosim.base"},
    {"neurosim.robots", "neurosim.networks", "neurosim.evolution", "tracking"},
    {"neurosim.simulators", "neurosim.controllers"},
    {"neurosim.tasks", "neurosim.recording", "neurosim.sampling", "neurosim.lab"},
    {"neurosim.loop", "neurosim.training"},
    {"neurosim.trials"},
    {
        "neurosim.back_to_reality",
        "neurosim.envs",
        "neurosim.reports",
        "neurosim.templates",
        "neurosim.watch",
    },
    {"neurosim", "neurosim.testing"},
    {"neurosim.cli"},
    {"neurosim.__main__"},
)
LAYER_OF = {package: number for number, layer in enumerate(LAYERS) for package in layer}
LOOSE = {"neurosim.__main__", "neurosim.testing"}  # modules that belong to no package

#: An entry of a registry that is not loaded yet: "neurosim.robots.nxt:NXT".
LAZY = re.compile(r"((?:neurosim|tracking)(?:\.\w+)*):[\w.]+")


def modules_in(root: Path) -> dict[str, Path]:
    """Return the file of every module, by dotted name."""
    results = {}
    for folder in ("neurosim", "tracking"):
        for path in sorted((root / folder).rglob("*.py")):
            name = ".".join(path.relative_to(root).with_suffix("").parts)
            results[name.removesuffix(".__init__")] = path
    return results


def package_of(module: str) -> str:
    """Return the package of a layer that a module belongs to, or its own first two names."""
    first, *rest = module.split(".")
    return first if first in LAYER_OF and first != "neurosim" else ".".join([first, *rest[:1]])


def imports_of(source: str) -> set[str]:
    """Return the modules that a module imports, including imports in functions and for annotations.

    The packages around an imported module, whose ``__init__`` runs by itself, do not count.
    """
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            each = {f"{node.module}.{alias.name}" for alias in node.names}
            names |= {name if name in MODULES else node.module for name in each}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            names |= {result[1]} if (result := LAZY.fullmatch(node.value)) else set()
    return names & MODULES.keys()


MODULES = modules_in(ROOT)
# A registry may name something of its own module.
IMPORTS = {name: imports_of(path.read_text("utf-8")) - {name} for name, path in MODULES.items()}


@pytest.mark.parametrize("module", MODULES)
def test_imports_are_of_layers_below(module):
    package = package_of(module)
    assert package in LAYER_OF, f"{module} is in no package of a layer"
    others = {package_of(name): name for name in IMPORTS[module] if package_of(name) != package}
    wrong = [name for other, name in others.items() if LAYER_OF[other] >= LAYER_OF[package]]
    assert not wrong, f"{module} imports {wrong}, of its own layer or of one above"


def test_no_module_is_outside_of_the_packages():
    top = {path.stem for path in (ROOT / "neurosim").glob("*.py")}
    assert {f"neurosim.{name}" for name in top - {"__init__"}} <= LOOSE


def test_the_table_for_contributors_is_this_one():
    table, layer = {}, None
    for line in (ROOT / "CONTRIBUTING.md").read_text("utf-8").splitlines():
        if row := re.match(r"\| (\d*) *\| `([\w/]+?)/(?:__init__\.py)?` \|", line):
            layer = int(row[1]) if row[1] else layer
            table[row[2].replace("/", ".")] = layer
    there = {package_of(module) for module in MODULES} - LOOSE
    assert table == {package: LAYER_OF[package] for package in there}


def test_no_imports_form_a_circle():
    try:
        TopologicalSorter(IMPORTS).prepare()
    except CycleError as error:
        pytest.fail(" imports ".join(reversed(error.args[1])))


def test_every_way_to_import_is_seen():
    source = """
import neurosim.base.files as files
from neurosim.robots import base, robot_factory
from typing import TYPE_CHECKING
if TYPE_CHECKING:
    from neurosim.base.errors import UserError
KINDS = {"nxt": "neurosim.robots.nxt.driver:NXT.of", "no": "neurosim.robots.nxt.link is no entry"}
def later():
    import tracking.poses
"""
    assert imports_of(source) == {
        "neurosim.base.files",
        "neurosim.robots",
        "neurosim.robots.base",
        "neurosim.base.errors",
        "neurosim.robots.nxt.driver",
        "tracking.poses",
    }
