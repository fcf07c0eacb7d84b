"""Commands as a user gives them."""

from __future__ import annotations

import pytest

from ded_bench.cli import main


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Run a command that must end with code 2 and one line; return the line."""
    try:
        code = main([str(a) for a in arguments])
    except SystemExit as stop:
        code = stop.code
    out, err = capsys.readouterr()
    assert code == 2
    assert out == ""
    assert err.count("\n") == 1, err
    return err


SOLVE = ("solve", "--method", "ded", "--regime", "NO")
