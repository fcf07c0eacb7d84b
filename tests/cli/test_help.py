"""What the command line says of itself."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

import ded_bench
from ded_bench.cli import main
from ded_bench.methods import plugin
from ded_bench.methods.options import described
from ded_bench.methods.registry import METHODS


def test_the_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["--version"])
    assert stop.value.code == 0
    assert capsys.readouterr().out == f"ded-bench {ded_bench.__version__}\n"
    assert ded_bench.__version__.count(".") == 2


def test_methods_are_listed_with_their_options(monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Those of other packages too; one that cannot be imported says so, and the list goes on."""
    targets = {"flat": "tests.strange_methods:prepare", "gone": "no.such.module:solve"}
    monkeypatch.setattr(plugin, "installed", lambda: targets)
    assert main(["methods"]) == 0
    text = capsys.readouterr().out
    for name in ("flat", "gone", *METHODS):
        assert name in text
    for method in METHODS.values():
        assert all(option in text for option, _, _ in described(method.options))
    assert "cannot be used" in text


@pytest.mark.parametrize("arguments", [("online", "--help"), ("cases",)])
def test_a_reader_that_leaves_early_sees_no_traceback(arguments: tuple[str, ...]) -> None:
    """As in `ded-bench online --help | head -1`."""
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as pipe:
        command = [sys.executable, "-m", "ded_bench", *arguments]
        done = subprocess.run(command, stdout=pipe, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode in (0, 1)  # argparse itself passes over what it cannot write
    assert done.stderr == ""


def test_windows_is_told_plainly() -> None:
    code = "import sys; sys.platform = 'win32'; import ded_bench.cli"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "needs Linux or macOS" in done.stderr
