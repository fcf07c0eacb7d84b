"""Tables of before there were options, read with the names of today."""

from __future__ import annotations

from pathlib import Path

import pytest

from ded_bench.results.legacy import renamed
from ded_bench.results.rows import Results


@pytest.mark.parametrize(
    ("method", "settings", "now"),
    [
        ("ed", "default", ("ed", "default", "")),
        ("ed", "10s", ("ed", "every=10", "")),
        ("ded", "accelerated", ("ded", "accelerated=on", "")),
        ("ded-slp", "100ms", ("ded-slp", "knot_s=0.1", "")),
        ("ded-ko", "default-koopman-paper", ("ded-ko", "default", "koopman-paper")),
        ("ded-ko-knots", "real-time-trajectory", ("ded-rti", "default", "trajectory")),
        ("ded-dpc-refined", "default", ("ded-dpc", "refine=200", "")),
        ("ded-dpc-refined", "steps25", ("ded-dpc", "refine=25", "")),
        ("ded-dpc-shared", "default-trajectory", ("ded-admm", "default", "trajectory")),
        ("ded-dpc-shared-refined", "default", ("ded-admm", "iterations=80", "")),
        ("theirs", "fast", ("theirs", "fast", "")),
    ],
)
def test_every_row_has_a_name_of_today(method: str, settings: str, now: tuple[str, str, str]) -> None:
    assert renamed(method, settings) == now


def test_an_old_table_is_read_and_added_to(tmp_path: Path) -> None:
    header = "instance,split,regime,method,settings,status,case,model,policy,code\n"
    line = "a,test,TO,ded-dpc-shared,default,Policy,9bus,,ded-dpc-shared@f00,beef\n"
    (tmp_path / "results.csv").write_text(header + line)
    results = Results(tmp_path)
    (row,) = results.rows.values()
    found = row.method, row.policy, row.plant, row.method_version
    assert found == ("ded-admm", "ded-admm@f00", "lossless", 1)
    results.add([row])
    assert list(Results(tmp_path).rows.values()) == [row]
