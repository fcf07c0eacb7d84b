"""A grid that nobody has seen before goes the whole road, from its case.json to the report."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from ded_bench.cli import main

METHODS = ("ed", "ded", "ded-radau", "ded-slp", "ded-ko", "ded-ko-knots")
HORIZON = 3.0


def grid(machines: int, seed: int) -> dict[str, Any]:
    """So many machines and a slack, each with a load, on a ring with a chord; numbers are drawn.

    Machines have an inertia of 2 to 6 s on 100 MVA, and d/m = 0.3 1/s.
    """
    rng = np.random.default_rng(seed)

    def draw(low: float, high: float) -> float:
        return round(float(rng.uniform(low, high)), 4)

    gen, load = [f"g{i}" for i in range(machines)], [f"l{i}" for i in range(machines)]
    around = ["infeed", *load, "middle"]
    ties = [*zip(around, [*around[1:], around[0]], strict=True), ("middle", load[0])]
    buses: list[dict[str, Any]] = [{"id": "infeed", "kind": "slack", "v": 1.02}]
    buses += [
        {"id": bus, "kind": "load", "v": draw(0.98, 1.02), "p_nominal": -draw(0.7, 1.3)} for bus in load
    ]
    buses += [{"id": "middle", "kind": "junction", "v": 1.0}]
    buses += [{"id": bus, "kind": "generator", "v": draw(1.0, 1.05)} for bus in gen]
    inertia = [draw(0.01, 0.03) for _ in gen]
    return {
        "schema": "ded-bench/case/2",
        "id": "strange",
        "f0_hz": 60.0,
        "buses": buses,
        "lines": [{"from": a, "to": b, "r": draw(0.0, 0.01), "x": draw(0.05, 0.15)} for a, b in ties]
        + [{"from": a, "to": b, "r": 0.0, "x": draw(0.1, 0.2)} for a, b in zip(gen, load, strict=True)],
        "machines": {
            bus: {"m": m, "d": 0.3 * m, "p_nominal": 0.8, "p_min": 0.4, "p_max": 1.2}
            for bus, m in zip(gen, inertia, strict=True)
        },
        "ramp_pu_per_s": 0.05,
        "regimes": {"NO": {"omega_hz": 0.05}, "TO": {"omega_hz": 0.005}},
        "sampling": {
            "horizon_s": HORIZON,
            "dt_s": 0.01,
            "load_relative": 0.1,
            "start_s": [0.0, HORIZON],
            "duration_s": [1.0, 2.0],
            "rate_relative_per_s": [0.002, 0.01],
            "rate_zero_probability": 0.15,
            "perturbation": [0.0, 1.0],
            "omega_rad_per_s": [-0.004, 0.004],
            "cost": [0.0, 1.0],
        },
        "knots": 21,
    }


def run(*arguments: object) -> None:
    assert main([str(argument) for argument in arguments]) == 0


@pytest.mark.usefixtures("inline")
def test_the_whole_road(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of as many machines as no shipped case has."""
    machines = 4
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "strange"
    folder.mkdir()
    (folder / "case.json").write_text(json.dumps(grid(machines, seed=machines)))
    run("cases", folder, "--count", 5)
    assert "largest angle across a line" in capsys.readouterr().out
    run("instances", "--case", folder, "--count", 3, "--test", 1)
    run("train-ko", "--case", folder, "--count", 6)
    run("solve", "--case", folder, "--method", ",".join(METHODS))
    run("solve", "--case", folder, "--method", "ded-ko,ded-ko-knots", "--model", "trajectory")
    run("score", "--results", Path("results") / "strange", "--case", folder)
    run("report", "--case", folder)
    rows = pd.read_csv(tmp_path / "results" / "strange" / "results.csv")
    assert len(rows) == 2 * (len(METHODS) + 2)
    assert rows["error"].isna().all()
    assert rows["objective"].notna().all()
    assert set(rows["status"]) <= {"Optimal", "Feasible"}
    strict = rows[rows["method"] == "ded-slp"]["feasible_strict"]
    assert strict.all()
    report = (tmp_path / "results" / "strange" / "report.md").read_text(encoding="utf-8")
    assert f"{2 * machines + 2} buses, {machines} generators" in report
