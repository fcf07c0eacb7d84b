"""Rollout errors of every surrogate, and the bound that no lifted model can fall below."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from ded_bench.evaluate import lifted_bound
from ded_bench.evaluate.lifted_bound import ANY, exchange_table, least_errors
from ded_bench.analysis.rollouts import all_rollouts, rollout_errors, rollout_table
from ded_bench.surrogates.identification_data import sample_trajectories, trajectories
from ded_bench.surrogates.identify import predict
from ded_bench.surrogates.linear import nominal_model
from ded_bench.surrogates.find import AlongTrajectory
from ded_bench.methods import ed
from ded_bench.problem.case import Case
from ded_bench.problem.sampling import KOOPMAN_SEED, sample_instance
from ded_bench.problem.schedule import Schedule
from ded_bench.results.rows import Key, Results
from ded_bench.plants.lossless.network import Network


def test_all_kinds_of_schedules_have_rows(threebus: Case, quiet_instance, tmp_path: Path) -> None:
    """A quiet instance held at its equilibrium is one of them: there the linear model is exact."""
    results, regime = Results(tmp_path), next(iter(threebus.regimes))
    instance = quiet_instance(threebus, horizon_s=1.0)
    power = instance.p_initial(threebus)
    schedule = Schedule(np.array([0.0, 1.0]), np.array([power, power]))
    schedule.write(results.schedule_path(Key(instance.id, regime, "ded-slp", "default")), threebus.generators)
    models = [nominal_model(threebus), AlongTrajectory(threebus)]
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
    along = rollout_errors(case, AlongTrajectory(case), data)
    linear = rollout_errors(case, nominal_model(case), data)
    assert along.omega_hz[0] < 0.2 * linear.omega_hz[0]
    assert along.p_slack[0] < 0.2 * linear.p_slack[0]


def test_errors_are_those_of_one_rollout_after_another(
    threebus: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, model = sample_trajectories(threebus, seed=2, count=3), nominal_model(threebus)
    monkeypatch.setattr("ded_bench.analysis.rollouts.AT_A_TIME", 2)
    errors = rollout_errors(threebus, model, data)
    error = predict(model, Network(threebus), data) - data.outputs
    np.testing.assert_allclose(
        errors.omega_hz, abs(error[..., :-1]).max(axis=(0, 2)) / (2 * np.pi), rtol=1e-6
    )
    np.testing.assert_allclose(errors.p_slack, np.sqrt((error[..., -1] ** 2).mean(axis=0)), rtol=1e-6)


def test_the_bound_is_zero_for_a_lifted_model_and_holds_on_the_grid(threebus: Case) -> None:
    """Four answers of a lifted model cancel; those of the grid do not: lifted models err by that."""
    model, network = nominal_model(threebus), Network(threebus)
    for kind in ("tracking", "load ramps"):
        data = next(lifted_bound._exchanged(threebus, kind, 1))
        own = predict(model, network, data)
        answered = dataclasses.replace(data, omega=own[..., :-1], p_slack=own[..., -1])
        assert least_errors(answered).omega_hz.max() < 1e-10
        bound, errors = least_errors(data), rollout_errors(threebus, model, data)
        assert 1e-8 < bound.omega_hz.mean() < errors.omega_hz.mean()
        assert 1e-8 < bound.p_slack.mean() < errors.p_slack.mean()
        assert bound.omega_hz.max() < errors.omega_hz.max()


def test_the_bound_stands_beside_the_models(threebus: Case) -> None:
    table = exchange_table(threebus, [nominal_model(threebus)], pairs=1)
    assert table["model"].to_list() == [ANY, "linear"] * 5
    assert (table["n"] == 4).all()
    columns = rollout_table(threebus, [nominal_model(threebus)], sample_trajectories(threebus, 1, 1)).columns
    assert list(table.columns) == list(columns)
