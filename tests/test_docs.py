"""README and docs say what is so: their examples run, their links lead somewhere, their commands exist.

Every fenced block of Python or shell runs, in the order of its page, in a folder that looks like the
repository's root. A block after `<!-- not tested: why -->` does not.
"""

from __future__ import annotations

import contextlib
import dataclasses
import doctest
import io
import itertools
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import pytest

from ded_bench.cli import main
from ded_bench.cli.commands import parser
from ded_bench.methods.registry import METHODS
from ded_bench.problem.case import REPOSITORY

REFERENCE = REPOSITORY / "results" / "9bus-reference"
PAGES = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").glob("*.md"))]
EXAMPLES = sorted((REPOSITORY / "examples").glob("*.py"))
LINKED = [*PAGES, *sorted((REPOSITORY / "studies").rglob("*.md"))]
BLOCK = re.compile(
    r"(?:<!-- not tested: (?P<why>.*?) -->\n+)?^```(?P<kind>\S*)\n(?P<text>.*?)^```$", re.M | re.S
)
PLAIN = re.compile(r"ded-bench [^|<>$&;]*")
LINK = re.compile(r"!?\[[^]]*\]\((?!https?:)([^)#]+)")


class Block(NamedTuple):
    """A fenced block of a page."""

    line: int
    kind: str
    text: str
    why_not: str  # empty: it runs


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    return [
        Block(text.count("\n", 0, m.start("text")), m["kind"], m["text"], m["why"] or "")
        for m in BLOCK.finditer(text)
    ]


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the repository's problems and reference run, and `ded-bench` on the path."""
    run = tmp_path / "results" / REFERENCE.name
    run.mkdir(parents=True)
    (tmp_path / "problems").symlink_to(REPOSITORY / "problems")
    for entry in REFERENCE.iterdir():
        (run / entry.name).symlink_to(entry)
    program = tmp_path / ".bin" / "ded-bench"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m ded_bench "$@"\n')
    program.chmod(0o755)
    bins = f"{program.parent}{os.pathsep}{Path(sys.executable).parent}"
    monkeypatch.setenv("PATH", f"{bins}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{REPOSITORY}")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))  # examples may write a module and import it
    return tmp_path


def run_shell(text: str) -> str:
    """Run a script, which must succeed; returns what it prints.

    Lines of it that are a command of `ded-bench` and no more run here, where all is imported already.
    """
    printed = io.StringIO()
    for is_ours, lines in itertools.groupby(text.replace("\\\n", "").splitlines(), PLAIN.fullmatch):
        if not is_ours:
            command = ["bash", "-euo", "pipefail", "-c", "\n".join(lines)]
            done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
            assert done.returncode == 0, f"{text}\n{done.stdout}\n{done.stderr}"
            printed.write(done.stdout)
            continue
        for line in lines:
            with contextlib.redirect_stdout(printed):
                assert not main(shlex.split(line, comments=True)[1:]), text
    return printed.getvalue()


def run_console(text: str) -> None:
    """Run each line after `$ ` and compare what it prints with what follows; `...` stands for anything."""
    options = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    for part in re.split(r"^\$ ", text, flags=re.M)[1:]:
        command, _, wanted = re.sub(r"\\\n", "", part).partition("\n")
        printed = run_shell(command)
        assert doctest.OutputChecker().check_output(wanted, printed, options), f"{command}\n{printed}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_examples_run(page: Path, root: Path) -> None:
    """In the order of the page, Python in one namespace, as a reader would."""
    namespace: dict[str, Any] = {"__name__": "__main__"}
    for block in blocks(page):
        if block.why_not:
            continue
        if block.kind == "python":
            code = compile("\n" * block.line + block.text, str(page), "exec")
            exec(code, namespace)
        elif block.kind == "sh":
            run_shell(block.text)
        elif block.kind == "console":
            run_console(block.text)


@pytest.mark.parametrize("page", LINKED, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_links_lead_somewhere(page: Path) -> None:
    """Pages and pictures inside the repository."""
    for target in LINK.findall(page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), target


@pytest.mark.parametrize("page", [*PAGES, *EXAMPLES], ids=lambda page: page.name)
def test_commands_and_options_exist(page: Path) -> None:
    """Also in blocks that do not run, within sentences and in what examples say of themselves."""
    commands = parser()._subparsers._group_actions[0].choices  # type: ignore[union-attr]
    text = re.sub(r"\\\n\s*", " ", page.read_text(encoding="utf-8"))
    for line in re.findall(r"ded-bench ([a-z][^\n`|]*)", text):
        name, *rest = line.split()
        if name not in commands:
            assert not re.match(r"[a-z]+-", name), line  # words may follow the name of the suite
            continue
        known = commands[name]._option_string_actions
        for option in (word for word in rest if word.startswith("--")):
            assert option.partition("=")[0] in known, line


def test_methods_are_documented() -> None:
    """Every method with committed rows has a line on their page, and every line there has all its options."""
    text = (REPOSITORY / "docs" / "methods.md").read_text(encoding="utf-8")
    lines = {line.split("`")[1]: line.split("|") for line in text.splitlines() if line.startswith("| `")}
    named = {name: cells for name, cells in lines.items() if name in METHODS}
    for name, cells in named.items():
        options = {field.name for field in dataclasses.fields(METHODS[name].options)}
        assert set(re.findall(r"`([a-z_]+)`", cells[3])) == options, name
    committed = set()
    for table in (REPOSITORY / "results").glob("*-reference/tables/objectives.csv"):
        committed |= set(pd.read_csv(table)["method"])
    assert committed <= set(named)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_pages_are_short(page: Path) -> None:
    """README has two screens, every other page one reader."""
    text = page.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 120 if page.name == "README.md" else len(text.split()) <= 1500
