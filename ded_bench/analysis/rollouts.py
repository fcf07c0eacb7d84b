"""Errors of surrogates over whole rollouts, by kind of schedule."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from ded_bench.analysis.reference import DEFAULT
from ded_bench.analysis.summary import title
from ded_bench.files.strict import write_atomically
from ded_bench.methods import ed
from ded_bench.methods.knots import knot_points
from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.results.rows import Results
from ded_bench.surrogates.find import AlongTrajectory, Surrogate
from ded_bench.surrogates.identification_data import Trajectories, trajectories
from ded_bench.surrogates.identify import held_out, predict
from ded_bench.surrogates.instance_model import model_along
from ded_bench.surrogates.koopman import Koopman

#: Trajectories whose rollouts are judged together: all would fill the memory on large grids.
AT_A_TIME = 10
#: Beside the models: the table of `ded-bench rollouts`.
ROLLOUTS = "rollouts"


class Errors(NamedTuple):
    """Of one rollout each, shape (batch,)."""

    omega_hz: Array  # largest |Δω| over generators and time
    p_slack: Array  # root mean square of ΔP_s over time, pu


def rollout_errors(case: Case, surrogate: Surrogate, data: Trajectories) -> Errors:
    """A surrogate's errors under the inputs of trajectories, over all their grid points."""
    network, n_gen, parts = Network(case), len(case.generators), []
    for first in range(0, len(data.kinds), AT_A_TIME):
        part = data.take(slice(first, first + AT_A_TIME))
        if isinstance(surrogate, Koopman):
            predicted = predict(surrogate, network, part)
        else:
            predicted = _predict_along(case, surrogate, part)
        error = predicted - part.outputs
        omega = np.abs(error[..., :n_gen]).max(axis=(0, 2)) / (2 * np.pi)
        parts.append((omega, np.sqrt(np.square(error[..., n_gen]).mean(axis=0))))
    return Errors(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def rollout_table(case: Case, surrogates: Sequence[Surrogate], data: Trajectories) -> pd.DataFrame:
    """Rollout errors by model and kind of schedule: |Δω| in Hz, ΔP_s in pu."""
    rows = []
    for surrogate in surrogates:
        errors = rollout_errors(case, surrogate, data)
        for kind in dict.fromkeys(data.kinds):
            chosen = np.array([k == kind for k in data.kinds])
            rows.append(
                table_row(surrogate.kind, kind, Errors(errors.omega_hz[chosen], errors.p_slack[chosen]))
            )
    return pd.DataFrame(rows)


def table_row(model: str, schedules: str, errors: Errors) -> dict[str, str | float]:
    """One row of a table of rollout errors."""
    return {
        "model": model,
        "schedules": schedules,
        "n": len(errors.omega_hz),
        "mean max |Δω| (Hz)": errors.omega_hz.mean(),
        "max |Δω| (Hz)": errors.omega_hz.max(),
        "mean RMS ΔP_s (pu)": errors.p_slack.mean(),
    }


def all_rollouts(
    case: Case,
    results: Results,
    instances: Sequence[Instance],
    surrogates: Sequence[Surrogate],
    optimal: Sequence[str],
    drawn: int,
) -> pd.DataFrame:
    """Errors under drawn schedules, under the static dispatch, and under optimal ones of a results folder.

    The table is written beside the models. Draws are those that `identify` has not seen.

    Args:
        case: the grid.
        results: gives the optimal schedules that it keeps.
        instances: those whose optimal schedules count.
        surrogates: the models to compare.
        optimal: methods, with their default settings.
        drawn: how many draws.

    Raises:
        InputError: a kept schedule cannot be read.
    """
    draws = held_out(case, count=drawn)
    static = [ed.dispatch(case, instance, 1.0) for instance in draws.instances]
    tables = [rollout_table(case, surrogates, draws)]
    tables.append(
        rollout_table(
            case,
            surrogates,
            trajectories(case, list(draws.instances), static, ["static dispatch"] * len(static)),
        )
    )
    for method in optimal:
        for regime in case.regimes:
            wanted = case.id, regime, method, DEFAULT
            rows = [r for r in results.rows.values() if (r.case, r.regime, r.method, r.settings) == wanted]
            kept = {row.instance: row for row in rows if results.has_schedule(row)}
            there = [instance for instance in instances if instance.id in kept]
            if there:
                schedules = [results.schedule(kept[i.id], case, i) for i in there]
                kind = f"{title(method)}, {regime}"
                data = trajectories(case, there, schedules, [kind] * len(there))
                tables.append(rollout_table(case, surrogates, data))
    table = pd.concat(tables, ignore_index=True)
    write_atomically(results.paths.model_errors(ROLLOUTS), table.to_csv(index=False))
    return table


def _predict_along(case: Case, surrogate: AlongTrajectory, data: Trajectories) -> Array:
    """(ω, P_s) by the linearisation along each instance's static dispatch, as `ded-ko-knots` uses it."""
    n_gen, predicted = len(case.generators), np.empty_like(data.outputs)
    for i, instance in enumerate(data.instances):
        points = knot_points(case.knot_times(instance.horizon_s), instance.dt_s)
        p_gen = ed.dispatch(case, instance, 1.0).at(instance.grid[points])
        model = model_along(case, surrogate, instance, p_gen, points)
        predicted[:, i, :n_gen], predicted[:, i, n_gen] = model.rollout(data.inputs[:, i, :n_gen])
    return predicted
