"""What is kept of compiled functions is of use as long as no compiled source changes."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from ded_bench.plants.lossless.algebraic import solve_angles
from ded_bench.problem.compiled import _Announced, sources_stamp

CALLED = "@compiled\ndef called(x):\n    return x + 1\n"
CALLS = "from called import called\n@compiled\ndef calls(x):\n    return called(x)\n"


def stamp(folder: Path, called: str = CALLED, plain: str = "x = 1\n") -> str:
    """The stamp of a package in which a compiled function calls one of another file."""
    folder.mkdir()
    for name, text in (("called", called), ("calls", CALLS), ("plain", plain)):
        (folder / f"{name}.py").write_text(text)
    return sources_stamp(folder)


def test_a_change_in_any_compiled_file_counts(tmp_path: Path) -> None:
    """Of a function that is called from another file, too; files that compile nothing do not count."""
    first = stamp(tmp_path / "first")
    assert stamp(tmp_path / "same") == first
    assert stamp(tmp_path / "plain", plain="x = 2\n") == first
    assert stamp(tmp_path / "other", called=CALLED.replace("1", "2")) != first


def test_the_cache_of_a_function_has_the_stamp() -> None:
    assert solve_angles._cache._cache_file._version == sources_stamp()


def test_a_person_is_told_once_what_is_waited_for(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    """At a terminal; a log is not."""
    for is_terminal, lines in ((False, 0), (True, 1)):
        monkeypatch.setattr(sys.stderr, "isatty", lambda is_terminal=is_terminal: is_terminal)
        announced = _Announced()
        for _ in range(2):
            announced.on_start(None)
        assert capsys.readouterr().err.count("compiling, once after installing") == lines
