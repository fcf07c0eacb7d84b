"""README and docs say what is so: their examples run, their links lead somewhere, their commands exist.

Every fenced block of Python or shell runs, in the order of its page, in a folder that looks like the
repository's root. A block after `<!-- not tested: why -->` does not.
"""

from __future__ import annotations

import ast
import doctest
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from ded_bench.cli.commands import parser
from ded_bench.methods.registry import METHODS
from ded_bench.problem.case import REPOSITORY

PAGES = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").glob("*.md"))]
#: Languages of blocks that run; those of data, trees and formulas are shown only.
RUN, SHOWN = ("python", "sh", "console"), ("text", "json", "csv", "toml")
BLOCK = re.compile(
    r"(?:<!-- not tested: (?P<why>.*?) -->\n+)?^```(?P<kind>\S*)\n(?P<text>.*?)^```$", re.M | re.S
)
LINK = re.compile(r"!?\[[^]]*\]\((?!https?:)([^)#]+)")
#: Blocks that are too long or need another machine: the exception.
MOST_SKIPPED = 6


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
    """A folder with the repository's problems and reference run, and `ded-bench` on the path.

    Of the schedules only those of one instance are there: to simulate all of them takes more than a minute.
    """
    reference, run = (place / "results" / "9bus-reference" for place in (REPOSITORY, tmp_path))
    run.mkdir(parents=True)
    (tmp_path / "problems").symlink_to(REPOSITORY / "problems")
    for entry in reference.iterdir():
        if entry.name != "schedules":
            (run / entry.name).symlink_to(entry)
    for schedule in reference.glob("schedules/**/9bus-0001.csv.gz"):
        kept = run / schedule.relative_to(reference)
        kept.parent.mkdir(parents=True)
        kept.symlink_to(schedule)
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
    """Run a script, which must succeed; returns what it prints."""
    command = ["bash", "-euo", "pipefail", "-c", text]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, f"{text}\n{done.stdout}\n{done.stderr}"
    return done.stdout


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
        if block.why_not or block.kind not in RUN:
            continue
        if block.kind == "python":
            code = compile("\n" * block.line + block.text, str(page), "exec")
            exec(code, namespace)
        elif block.kind == "sh":
            run_shell(block.text)
        else:
            run_console(block.text)
    assert not list((REPOSITORY / "results" / "9bus-reference").glob("*.lock"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_block_has_a_language(page: Path) -> None:
    """A block that nobody named would not be tested; each fence opens or closes one."""
    found = blocks(page)
    assert {block.kind for block in found} <= {*RUN, *SHOWN}
    assert 2 * len(found) == len(re.findall(r"^```", page.read_text(encoding="utf-8"), re.M))
    for block in found:
        if block.kind == "python":
            ast.parse(block.text)  # those that do not run, too


def test_few_blocks_are_left_out_each_for_a_reason() -> None:
    skipped = [block for page in PAGES for block in blocks(page) if block.why_not]
    runnable = [block for page in PAGES for block in blocks(page) if block.kind in RUN]
    assert len(skipped) <= min(MOST_SKIPPED, len(runnable) // 2)
    assert all(len(block.why_not.split()) >= 3 for block in skipped)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    """Pages and pictures inside the repository."""
    for target in LINK.findall(page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_and_options_exist(page: Path) -> None:
    """Also in blocks that do not run and within sentences."""
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


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_named_exist(page: Path) -> None:
    """Modules of ours that a page names in code style."""
    text = page.read_text(encoding="utf-8")
    for name in re.findall(r"`((?:ded_bench/)?[a-z_]+/[a-z_/]+\.py)`", text):
        assert (REPOSITORY / "ded_bench" / name.removeprefix("ded_bench/")).is_file(), name


def test_methods_are_documented() -> None:
    """README and the model page name every registered method."""
    for page in PAGES:
        if page.name in ("README.md", "model.md"):
            text = page.read_text(encoding="utf-8")
            assert [name for name in METHODS if f"`{name}`" not in text] == [], page.name
