"""The house has floors, and imports only point down; modules stay small and know no particular grid."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import ded_bench
from ded_bench.problem.case import Case

PACKAGE = Path(ded_bench.__file__).parent
FLOORS = ("files", "problem", "truth", "koopman", "solvers", "methods", "run", "evaluate", "report", "cli")
MAX_LINES = 400
#: What the ground floors may use besides Python's own library: no solver, no model builder, no torch.
GROUND_LIBRARIES = {"ded_bench", "numpy", "scipy", "pandas", "pydantic", "safetensors", "numba"}


def modules() -> dict[str, Path]:
    """Every module of the package by its dotted name."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = ("ded_bench", *path.relative_to(PACKAGE).with_suffix("").parts)
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = modules()


def imports(tree: ast.Module, module: str, is_package: bool) -> Iterator[str]:
    """Dotted names of all modules that a module imports, wherever in it the import stands.

    `from a import b` counts as `a.b` too, since b may be a module.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                here = module.split(".") if is_package else module.split(".")[:-1]
                here = here[: len(here) - (node.level - 1)]
                base = ".".join([*here, base] if base else here)
            yield base
            yield from (f"{base}.{alias.name}" for alias in node.names)


def floor_of(module: str) -> int | None:
    """Height of a module's floor; -1 for the package itself, None for other libraries.

    What the package offers at its door (`from ded_bench import score`) is for its users: to the
    floors it is as high as can be, like `__main__`, which only starts the command line.
    """
    root, _, rest = module.partition(".")
    if root != "ded_bench":
        return None
    name = rest.partition(".")[0]
    if name in ("", "__version__"):
        return -1
    return FLOORS.index(name) if name in FLOORS else len(FLOORS)


def climbs(source: str, module: str, is_package: bool = False) -> list[str]:
    """Imports of a module that point to a higher floor; the package's door shows up to the methods."""
    own = FLOORS.index("methods") if module == "ded_bench" else floor_of(module)
    heights = {name: floor_of(name) for name in imports(ast.parse(source), module, is_package)}
    return sorted(name for name, height in heights.items() if height is not None and height > own)


def test_every_floor_is_there():
    """Else the tests below would check nothing; and nothing lies outside the floors."""
    assert {floor_of(name) for name in MODULES} >= set(range(len(FLOORS)))
    outside = {name for name in MODULES if floor_of(name) not in range(len(FLOORS))}
    assert outside == {"ded_bench", "ded_bench.__main__"}


@pytest.mark.parametrize("module", MODULES)
def test_imports_point_down(module):
    """A floor uses those below it and itself."""
    path = MODULES[module]
    assert climbs(path.read_text(encoding="utf-8"), module, path.name == "__init__.py") == []


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("import ded_bench.methods.ded", ["ded_bench.methods.ded"]),
        ("from ded_bench import run", ["ded_bench.run"]),
        ("from ded_bench.koopman.model import Koopman", ["ded_bench.koopman.model"]),
        ("from ..koopman import model", ["ded_bench.koopman"]),
        ("from .. import cli", ["ded_bench.cli"]),
        ("from ded_bench import score", ["ded_bench.score"]),
        ("def late():\n    from ded_bench.cli import main", ["ded_bench.cli"]),
        ("from . import network\nfrom ..problem.case import Case\nimport numpy", []),
        ("from ded_bench.problem import case\nfrom ded_bench import __version__", []),
    ],
)
def test_the_check_sees_climbing_imports(source, found):
    """Absolute, relative, of modules and of names, at any depth."""
    climbing = climbs(source, "ded_bench.truth.simulate")
    assert bool(climbing) == bool(found)
    assert set(found) <= set(climbing)


def test_modules_do_not_import_in_circles():
    """Within a floor, too, there is an order in which the modules can be read."""
    uses = {
        name: {
            other
            for other in imports(ast.parse(path.read_text("utf-8")), name, path.name == "__init__.py")
            if other in MODULES and other != name and not name.startswith(f"{other}.")
        }
        for name, path in MODULES.items()
    }
    while uses:
        readable = {name for name, needs in uses.items() if not needs & uses.keys()}
        assert readable, f"a circle among {sorted(uses)}"
        uses = {name: needs for name, needs in uses.items() if name not in readable}


def test_ground_floors_use_no_solver():
    """The scorer shares nothing with the methods: neither their modules nor their libraries."""
    for name, path in MODULES.items():
        if floor_of(name) in map(FLOORS.index, ("files", "problem", "truth")):
            roots = {
                used.partition(".")[0] for used in imports(ast.parse(path.read_text("utf-8")), name, False)
            }
            assert roots - set(sys.stdlib_module_names) <= GROUND_LIBRARIES, name


@pytest.mark.parametrize("module", MODULES)
def test_modules_stay_small(module):
    """What does not fit on a few screens is two things."""
    assert len(MODULES[module].read_text(encoding="utf-8").splitlines()) <= MAX_LINES


def particular(source: str, buses: set[str]) -> list[str]:
    """String literals of code (docstrings apart) that name the 9-bus case or one of its buses.

    Numbers as strings are always suspect; the slack's `s` is a common letter, and counts only as a
    key or in a comparison.
    """
    tree = ast.parse(source)
    docstrings = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    keys: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Subscript):
            keys.add(id(node.slice))
        elif isinstance(node, ast.Compare):
            keys |= {id(part) for part in (node.left, *node.comparators)}
        elif isinstance(node, ast.Dict):
            keys |= {id(key) for key in node.keys}
    numbers = "|".join(sorted(bus for bus in buses if bus.isdigit()))
    naming = re.compile(rf"(?:[A-Za-z]+_)?(?:{numbers})")
    letters = {bus for bus in buses if not bus.isdigit()}
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            text = node.value
            if "9bus" in text or naming.fullmatch(text) or (text in letters and id(node) in keys):
                found.append(text)
    return found


@pytest.mark.parametrize("module", MODULES)
def test_nothing_knows_the_nine_buses(module, ninebus: Case):
    """A new grid is one case.json; only the command line may name the shipped case, as a default."""
    source = MODULES[module].read_text(encoding="utf-8")
    found = particular(source, {bus.id for bus in ninebus.buses})
    if module == "ded_bench.cli.arguments":
        found = [text for text in found if "9bus" not in text]
    assert found == []


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ('cost["s"]', ["s"]),
        ('bus == "s"', ["s"]),
        ('p = {"2": 1.63}', ["2"]),
        ('columns = ["t", "P_2", "omega_3"]', ["P_2", "omega_3"]),
        ('Case.load("9bus")', ["9bus"]),
        ('path = f"problems/9bus/{name}"', ["problems/9bus/"]),
        ('"""About 9bus and bus 2."""\nplot(marker="s")\nx["start"], 2, "t", "P_12"', []),
    ],
)
def test_the_check_sees_bus_names(ninebus, source, found):
    """Keys, comparisons, column names and paths; not docstrings, markers or other numbers."""
    assert particular(source, {bus.id for bus in ninebus.buses}) == found
