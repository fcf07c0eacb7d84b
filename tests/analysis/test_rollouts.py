"""Rollout errors of every surrogate."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from ded_bench.analysis.rollouts import all_rollouts, rollout_errors
from ded_bench.methods import ed
from ded_bench.plants.plant import plant_of
from ded_bench.problem.case import Case
from ded_bench.problem.sampling import KOOPMAN_SEED, sample_instance
from ded_bench.problem.schedule import Schedule
from ded_bench.results.rows import Results, Row
from ded_bench.surrogates.find import AlongTrajectory
from ded_bench.surrogates.identification_data import trajectories
from ded_bench.surrogates.linear import nominal_model


def test_all_kinds_of_schedules_have_rows(threebus: Case, quiet_instance, tmp_path: Path) -> None:
    """A quiet instance held at its equilibrium is one of them: there the linear model is exact."""
    results, regime = Results(tmp_path), next(iter(threebus.regimes))
    instance = quiet_instance(threebus, horizon_s=1.0)
    power = instance.p_initial(threebus)
    schedule = Schedule(np.array([0.0, 1.0]), np.array([power, power]))
    row = Row(instance.id, "test", regime, "ded-slp", "default", "Optimal", case=threebus.id)
    results.keep(row, schedule, threebus)
    models = [nominal_model(threebus), AlongTrajectory(plant_of(threebus))]
    table = all_rollouts(threebus, results, [instance], models, ("ded-radau", "ded-slp"), drawn=1)
    kinds = ["tracking", "static dispatch", f"DED (SLP), {regime}"]
    assert table["schedules"].to_list() == [kind for kind in kinds for _ in models]
    assert table["model"].to_list() == ["linear", "trajectory"] * 3
    assert (table["n"] == 1).all()
    assert (table["max |Δω| (Hz)"].iloc[-2:] < 1e-9).all()
    written = pd.read_csv(tmp_path / "koopman" / "rollouts.errors.csv")
    pd.testing.assert_frame_equal(written, table, check_exact=True)


def test_trajectory_is_nearly_exact_where_it_was_linearised() -> None:
    case = Case.load("two-area")
    instance = sample_instance(case, KOOPMAN_SEED, 7)
    schedule = ed.dispatch(case, instance, 1.0)
    data = trajectories(case, [instance], [schedule], ["static dispatch"])
    along = rollout_errors(case, AlongTrajectory(plant_of(case)), data)
    linear = rollout_errors(case, nominal_model(case), data)
    assert along.omega_hz[0] < 0.2 * linear.omega_hz[0]
    assert along.p_slack[0] < 0.2 * linear.p_slack[0]
