"""The house has floors, and imports only point down; no name is taken twice; no module knows a grid."""

from __future__ import annotations

import ast
import configparser
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import ded_bench
from ded_bench.problem.case import SHIPPED_CASES, Case

PACKAGE = Path(ded_bench.__file__).parent
FLOORS = (
    *("files", "problem", "plants", "solvers", "results", "surrogates", "methods", "run", "analysis"),
    *("report", "learning", "gym", "cli"),
)
#: Twelve hexadecimal digits or more.
FINGERPRINT = re.compile(r"\b[0-9a-f]{12,}\b")
#: What the ground floors may use besides Python's own library: no solver, no model builder, no torch.
GROUND_LIBRARIES = {"ded_bench", "numpy", "scipy", "pandas", "pydantic", "safetensors", "numba"}
GROUND_LIBRARIES |= {"threadpoolctl"}
#: May differentiate with CasADi, which brings solvers, too: nothing that simulates or scores imports it.
SYMBOLIC = "ded_bench.plants.detailed.symbolic"


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


def test_imports_point_down():
    """A floor uses those below it and itself."""
    for module, path in MODULES.items():
        assert climbs(path.read_text(encoding="utf-8"), module, path.name == "__init__.py") == [], module


@pytest.mark.parametrize(
    ("source", "climbing"),
    [
        ("import ded_bench.methods.ded", True),
        ("from ..surrogates import koopman", True),
        ("from ded_bench import score", True),
        ("def late():\n    from ded_bench.cli import main", True),
        ("from . import network\nfrom ..problem.case import Case\nimport numpy", False),
        ("from ded_bench.problem import case\nfrom ded_bench import __version__", False),
    ],
)
def test_the_check_sees_climbing_imports(source, climbing):
    """Absolute, relative, of modules and of names, at any depth."""
    assert bool(climbs(source, "ded_bench.plants.plant")) == climbing


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
        if floor_of(name) in map(FLOORS.index, ("files", "problem", "plants")):
            roots = {
                used.partition(".")[0] for used in imports(ast.parse(path.read_text("utf-8")), name, False)
            }
            allowed = GROUND_LIBRARIES | ({"casadi"} if name == SYMBOLIC else set())
            assert roots - set(sys.stdlib_module_names) <= allowed, name


def test_no_two_modules_share_a_name() -> None:
    """One thing, one name."""
    names = [path.stem for path in MODULES.values() if path.stem != "__init__"]
    assert {name for name in names if names.count(name) > 1} == set()


def test_no_class_name_stands_for_more_than_one_thing() -> None:
    """Every method has its own `Options`, as the registry asks; all other names are of one class each."""
    homes: dict[str, list[str]] = {}
    for module, path in MODULES.items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef) and node.name != "Options":
                homes.setdefault(node.name.lstrip("_"), []).append(module)
    assert {name: where for name, where in homes.items() if len(where) > 1} == {}


def numbers_of(data: object) -> Iterator[float]:
    """Absolute values of all numbers in JSON data that have at least three digits."""
    if isinstance(data, dict | list):
        for value in data.values() if isinstance(data, dict) else data:
            yield from numbers_of(value)
    elif isinstance(data, int | float):
        digits = f"{abs(data):.15e}".partition("e")[0].replace(".", "").rstrip("0")
        if len(digits) >= 3:
            yield abs(float(data))


class Particulars:
    """What names one case: its buses, regimes, numbers with three digits or more."""

    def __init__(self, folder: Path) -> None:
        case = Case.load(folder)
        self.name = case.id
        self.buses = {bus.id for bus in case.buses}
        self.regimes = re.compile(rf"\b(?:{'|'.join(map(re.escape, case.regimes))})\b")
        files = ("case.json", "paper.json")
        self.numbers = {n for name in files for n in numbers_of(json.loads((folder / name).read_text()))}


def particular(source: str, case: Particulars) -> list[str | float]:
    """Literals of code (not docstrings) that are about one case.

    These are its name, a bus, a regime, a number of its files, and whatever looks like a fingerprint.
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
    digits = "|".join(sorted(bus for bus in case.buses if bus.isdigit()))
    naming = re.compile(rf"(?:[A-Za-z]+_)?(?:{digits})")
    letters = {bus for bus in case.buses if not bus.isdigit()}
    found: list[str | float] = []
    for node in ast.walk(tree):
        if not isinstance(node, ast.Constant) or id(node) in docstrings:
            continue
        value = node.value
        if (isinstance(value, float) and abs(value) in case.numbers) or (
            isinstance(value, str)
            and (
                case.name in value
                or naming.fullmatch(value)
                or (value in letters and id(node) in keys)
                or case.regimes.search(value)
                or FINGERPRINT.search(value)
            )
        ):
            found.append(value)
    return found


@pytest.fixture(scope="module")
def nine() -> Particulars:
    return Particulars(SHIPPED_CASES / "9bus")


def test_nothing_knows_the_nine_buses(nine: Particulars):
    """A new grid is one case.json; only the command line may name the shipped case, as a default."""
    found = {name: particular(path.read_text(encoding="utf-8"), nine) for name, path in MODULES.items()}
    arguments = found.pop("ded_bench.cli.arguments")
    assert {name: values for name, values in found.items() if values} == {}
    assert set(arguments) == {nine.name}


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ('cost["s"]', ["s"]),
        ('bus == "s"', ["s"]),
        ('p = {"2": 1.6}', ["2"]),
        ('columns = ["t", "P_2", "omega_3"]', ["P_2", "omega_3"]),
        ('Case.load("9bus")', ["9bus"]),
        ('path = f"problems/9bus/{name}"', ["problems/9bus/"]),
        ('for regime in ("NO", "TO"): help("of NO, TO")', ["NO", "TO", "of NO, TO"]),
        ('if case.fingerprint == "a0fa08e05e5d": pass', ["a0fa08e05e5d"]),
        ("most = -1.63", [1.63]),
        ("paper = 32.34", [32.34]),
        ('"""About 9bus and bus 2."""\nplot(marker="s")\nx["start"], 2, "t", "P_12", "#000000", 0.5', []),
        ('"TOO", "NOT", "defaced", "123456789012"', ["123456789012"]),
    ],
)
def test_the_check_sees_what_is_particular(nine: Particulars, source, found):
    """Keys, comparisons, column names, paths, regimes, numbers and fingerprints; not markers or colours."""
    assert particular(source, nine) == found


def test_every_package_is_installed() -> None:
    """A folder that setup.cfg does not name would be missing from the wheel, but not from a checkout."""
    setup = configparser.ConfigParser()
    setup.read(PACKAGE.parent / "setup.cfg", encoding="utf-8")
    named = set(setup["options"]["packages"].split())
    ours = {
        ".".join(("ded_bench", *p.parent.relative_to(PACKAGE).parts)) for p in PACKAGE.rglob("__init__.py")
    }
    assert named - ours == {"ded_bench._problems", "ded_bench._reference_runs"}
    assert ours <= named
