"""The examples run, and do what they say; training is shortened."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

import ded_bench
from ded_bench.problem.case import REPOSITORY, Case
from ded_bench.problem.sampling import sample_instance

EXAMPLES = REPOSITORY / "examples"


def test_the_tour(tmp_path: Path) -> None:
    """Static dispatch breaks the tight bound, the other methods keep it, and a figure shows it."""
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, EXAMPLES / "tour.py"]
    subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, check=True)
    table = pd.read_csv(tmp_path / "results" / "tour" / "table.csv")
    feasible = table.groupby("method")["feasible"].all()
    assert feasible.to_dict() == {"ed": False, "ded-dpc": True, "ded-ko-knots": True, "ded-slp": True}
    assert (tmp_path / "results" / "tour" / "schedules.png").stat().st_size > 10_000


def test_dispatch_with_foresight(ninebus: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    """It keeps bounds, ramps and P_0, and costs no more than static dispatch would without them."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import lookahead_dispatch

    instance = sample_instance(ninebus, 1_500_000, 0)
    schedule = lookahead_dispatch.solve(instance, "NO", ninebus)
    verdict = ded_bench.score(instance, schedule, "NO")
    assert max(verdict.ramp_violation, verdict.bound_violation, verdict.initial_violation) < 1e-8


def run_example(code: str, folder: Path) -> None:
    """Run code beside the examples, in a process of its own: other packages warn."""
    environment = os.environ | {"PYTHONPATH": f"{REPOSITORY}{os.pathsep}{EXAMPLES}", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_policies_learn_through_the_plant(tmp_path: Path) -> None:
    """Whatever they have learned in a few steps, they keep bounds, ramps and P_0."""
    code = """
import importlib
import ded_bench
from ded_bench.problem.sampling import sample_instance
case = ded_bench.Case.load("9bus")
instance = sample_instance(case, 1_500_000, 0)
allowed = {"learned_policy": 1e-8, "neuromancer_policy": 1e-8, "optimisation_layer": 1e-6}  # its solver's
for name, most in allowed.items():
    example = importlib.import_module(name)
    example.train("9bus", "NO", steps=2, batch=4)
    verdict = ded_bench.score(instance, example.solve(instance, "NO", case), "NO")
    worst = max(verdict.ramp_violation, verdict.bound_violation, verdict.initial_violation)
    assert worst < most, (name, verdict)
"""
    run_example(code, tmp_path)


def test_model_predictive_control(tmp_path: Path) -> None:
    """It keeps every limit in TO, within a per cent of the linear programs' cost; and plans in the loop."""
    code = """
import ded_bench, do_mpc_dispatch
from ded_bench.problem.sampling import sample_instance, sample_scenario
from ded_bench.run.online.loop import LoopOptions, run_loop
from ded_bench.run.online.loop import Planned
case = ded_bench.Case.load("9bus")
instance = sample_instance(case, 1_500_000, 0)
mine = do_mpc_dispatch.solve(instance, "TO", case)
theirs = ded_bench.solve(instance, "ded-slp", "TO").schedule
verdict, other = (ded_bench.score(instance, s, "TO") for s in (mine, theirs))
assert verdict.feasible, verdict
assert verdict.objective < 1.01 * other.objective, (verdict, other)
scenario = sample_scenario(case, 0, 0, duration_s=1.0)
ask = lambda i, _: Planned(do_mpc_dispatch.solve(i, "TO", case))
assert len(run_loop(case, scenario, ask, LoopOptions()).answers) == 1
"""
    run_example(code, tmp_path)


def test_an_agent_is_trained_and_answers(tmp_path: Path) -> None:
    """What is written is the network that Stable-Baselines3 trained; ours keeps every limit of power."""
    code = """
import ded_bench, numpy as np, trained_agent
from pathlib import Path
from ded_bench.problem.sampling import sample_instance
mine = Path("mine.safetensors")
agent, env = trained_agent.train(480, mine)
seen = env.get_original_obs()[0]
theirs, _ = agent.predict(env.normalize_obs(seen), deterministic=True)
assert np.allclose(trained_agent.act(seen, mine), theirs, atol=1e-4)  # 32 bits, scales folded in
case = ded_bench.Case.load("two-area")
instance = sample_instance(case, 1_500_000, 0)
for file in (mine, trained_agent.FILE):
    verdict = ded_bench.score(instance, trained_agent.solve(instance, "TO", case, file), "TO")
    assert max(verdict.ramp_violation, verdict.bound_violation, verdict.initial_violation) < 1e-8, verdict
"""
    run_example(code, tmp_path)
