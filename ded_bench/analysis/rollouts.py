"""Errors of surrogates over whole rollouts, by kind of schedule."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from ded_bench.analysis.lines import title
from ded_bench.files.strict import write_atomically
from ded_bench.methods import ed
from ded_bench.methods.knots import case_knots
from ded_bench.methods.options import DEFAULT
from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.results.rows import Results
from ded_bench.surrogates.find import AlongTrajectory, Surrogate
from ded_bench.surrogates.identification_data import Trajectories, trajectories
from ded_bench.surrogates.identify import held_out, predict
from ded_bench.surrogates.instance_model import model_along
from ded_bench.surrogates.koopman import Koopman

#: Schedules of one method whose rollouts are judged together: all would fill the memory on large grids.
AT_A_TIME = 10
#: Beside the models: the table of `ded-bench rollouts`.
ROLLOUTS = "rollouts"


class Errors(NamedTuple):
    """Of one rollout each, shape (batch,)."""

    omega_hz: Array  # largest |Δω| over generators and time
    p_slack: Array  # root mean square of ΔP_s over time, pu


def rollout_errors(case: Case, surrogate: Surrogate, data: Trajectories) -> Errors:
    """A surrogate's errors under the inputs of trajectories, over all their grid points."""
    if isinstance(surrogate, Koopman):
        predicted = predict(surrogate, Network(case), data)
    else:
        predicted = _predict_along(case, surrogate, data)
    error, n_gen = predicted - data.outputs, len(case.generators)
    omega = np.abs(error[..., :n_gen]).max(axis=(0, 2)) / (2 * np.pi)
    return Errors(omega, np.sqrt(np.square(error[..., n_gen]).mean(axis=0)))


def rollout_table(case: Case, surrogates: Sequence[Surrogate], *parts: Trajectories) -> pd.DataFrame:
    """Rollout errors by kind of schedule and model: |Δω| in Hz, ΔP_s in pu."""
    return _table(case, surrogates, parts)


def _table(case: Case, surrogates: Sequence[Surrogate], parts: Iterable[Trajectories]) -> pd.DataFrame:
    rows = []
    for data in parts:
        for surrogate in surrogates:
            errors = rollout_errors(case, surrogate, data)._asdict()
            rows.append(pd.DataFrame({"schedules": data.kinds, "model": surrogate.kind} | errors))
    groups = pd.concat(rows).groupby(["schedules", "model"], sort=False)
    made = {
        "n": groups.size(),
        "mean max |Δω| (Hz)": groups["omega_hz"].mean(),
        "max |Δω| (Hz)": groups["omega_hz"].max(),
        "mean RMS ΔP_s (pu)": groups["p_slack"].mean(),
    }
    return pd.DataFrame(made).reset_index()[["model", "schedules", *made]]


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
    table = _table(case, surrogates, _parts(case, results, instances, optimal, drawn))
    write_atomically(results.paths.model_errors(ROLLOUTS), table.to_csv(index=False))
    return table


def _parts(
    case: Case, results: Results, instances: Sequence[Instance], optimal: Sequence[str], drawn: int
) -> Iterator[Trajectories]:
    """One after another, since all would fill the memory."""
    draws = held_out(case, count=drawn)
    yield draws
    static = [ed.dispatch(case, instance, 1.0) for instance in draws.instances]
    yield trajectories(case, list(draws.instances), static, ["static dispatch"] * len(static))
    known = {instance.id: instance for instance in instances}
    rows = [row for row in results.rows.values() if row.instance in known and row.settings == DEFAULT]
    for method in optimal:
        for regime in case.regimes:
            kept = [r for r in rows if (r.method, r.regime) == (method, regime) and results.has_schedule(r)]
            for some in (kept[i : i + AT_A_TIME] for i in range(0, len(kept), AT_A_TIME)):
                there = [known[row.instance] for row in some]
                schedules = [results.schedule(row, case, known[row.instance]) for row in some]
                yield trajectories(case, there, schedules, [f"{title(method)}, {regime}"] * len(some))


def _predict_along(case: Case, surrogate: AlongTrajectory, data: Trajectories) -> Array:
    """(ω, P_s) by the linearisation along each instance's static dispatch, as `ded-ko-knots` uses it."""
    n_gen, predicted = len(case.generators), np.empty_like(data.outputs)
    for i, instance in enumerate(data.instances):
        points = case_knots(case, instance)
        p_gen = ed.dispatch(case, instance, 1.0).at(instance.grid[points])
        model = model_along(case, surrogate, instance, p_gen, points)
        predicted[:, i, :n_gen], predicted[:, i, n_gen] = model.rollout(data.inputs[:, i, :n_gen])
    return predicted
