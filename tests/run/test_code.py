"""Which code made a row: what an answer depends on counts, what it does not depend on does not."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest

from ded_bench.methods.registry import METHODS, Method
from ded_bench.run import code
from ded_bench.run.code import code_of, code_of_method, content_of, imports_of


@pytest.mark.parametrize(
    ("source", "same"),
    [
        ('"""Another."""\nx = 1  # why\n\n\ndef f(a):\n    """Doc."""\n    return a + 1\n', True),
        ("x = (1)\ndef f(a): return a + 1", True),
        ("x = 1\ndef f(a):\n    return a + 2", False),
        ("x = 1.0\ndef f(a):\n    return a + 1", False),
        ("x = 1\ndef f(b):\n    return b + 1", False),
        ("x = 1\ndef f(a):\n    'Doc.'\n    'no doc'\n    return a + 1", False),
    ],
)
def test_only_what_runs_counts(source: str, same: bool) -> None:
    assert (content_of(source) == content_of("x = 1\ndef f(a):\n    return a + 1")) is same


def test_imports_are_those_that_run() -> None:
    source = """
import a.b
from c import d
from . import near
from ..far import further
if TYPE_CHECKING:
    import unseen
def late():
    from e import f
"""
    found = set(imports_of(source, "own.package"))
    wanted = {"a.b", "c", "c.d", "own.package", "own.package.near", "own.far", "own.far.further", "e", "e.f"}
    assert found == wanted


def test_the_scorers_code_is_not_a_methods() -> None:
    scorer = code_of("ded_bench.truth.score")
    assert re.fullmatch("[0-9a-f]{12}", scorer)
    codes = {name: code_of_method(method, "default") for name, method in METHODS.items()}
    assert len({*codes.values(), scorer}) == len(codes) + 1


def test_a_change_reaches_what_depends_on_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`low` is used by `high` through `middle`; `aside` by nobody."""
    package = tmp_path / "ded_bench"
    package.mkdir()
    sources = {
        "low": "x = 1",
        "middle": "from ded_bench import low",
        "high": "import numpy\ndef f():\n    from ded_bench.middle import low",
        "aside": "y = 1",
    }
    for name, source in sources.items():
        (package / f"{name}.py").write_text(source)
    monkeypatch.setattr(code, "_PACKAGE", package)

    def codes() -> dict[str, str]:
        for cached in (code_of, code._module, code._path):
            cached.cache_clear()
        return {name: code_of(f"ded_bench.{name}") for name in sources}

    before = codes()
    (package / "low.py").write_text("x = 2  # two")
    after = codes()
    assert {name for name in sources if before[name] != after[name]} == {"low", "middle", "high"}
    (package / "low.py").write_text('"""Now described."""\n\nx = 1')
    assert codes() == before
    for cached in (code_of, code._module, code._path):
        cached.cache_clear()


def modules_of(module: str) -> set[str]:
    """A module and all of the package that it imports, however far."""
    found: set[str] = set()
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting += code._module(name)[1]
    return {name.removeprefix("ded_bench.") for name in found}


@pytest.mark.parametrize(
    ("method", "settings", "foreign"),
    [
        ("ed", "default", r"truth|koopman|solvers\.(?!status)|methods\.d"),
        (
            "ded",
            "default",
            r"koopman|truth\.(?!network|integrator)|methods\.(?!(ded|memory|solution|solver_answer)$)",
        ),
        ("ded-radau", "default", r"koopman|truth\.(?!network|integrator)|methods\.(ded$|ded_radau_model)"),
        ("ded-slp", "default", r"\.ac_|koopman\.(?!trajectory)|methods\.ded_(?!slp$)"),
        ("ded-slp", "100ms", r"\.ac_"),
        ("ded-ko", "default", r"methods\.(ded$|ded_slp|ded_radau|dpc)"),
        ("ded-dpc-paper", "default", r"koopman|methods\.dpc_paper\..*(training|loss|network)|methods\.dpc\."),
        ("ded-dpc", "default", r"koopman\.(surrogates|trajectory|identify)|training|loss|policy_network"),
    ],
)
def test_an_answer_depends_on_nothing_else(method: str, settings: str, foreign: str) -> None:
    """What a method does not use, another of its settings does not either, does not change its code."""
    used = modules_of(METHODS[method].module_of(settings))
    assert [name for name in sorted(used) if re.search(foreign, name)] == []


def test_settings_name_the_module_that_answers() -> None:
    ded, slp = METHODS["ded"], METHODS["ded-slp"]
    assert ded.module_of("default") == ded.module_of("executable") == "ded_bench.methods.ded"
    assert ded.module_of("start-ko") == ded.module_of("start-ko-linear") == "ded_bench.methods.ded_start"
    assert slp.module_of("ac") != slp.module_of("accurate") == slp.module_of("100ms")
    assert len({code_of_method(ded, slug) for slug in ded.settings}) == 3


@pytest.mark.parametrize("method", [method for method in METHODS.values() if method.elsewhere])
def test_modules_offer_the_settings_that_are_theirs(method: Method) -> None:
    own, slugs = importlib.import_module(method.module).SETTINGS, [slug for slug, _ in method.elsewhere]
    assert set(method.settings) == {*own, *slugs}
    assert not {*own} & {*slugs}
    for module in {module for _, module in method.elsewhere}:
        theirs = {slug for slug, name in method.elsewhere if name == module}
        assert set(importlib.import_module(module).SETTINGS) == theirs
