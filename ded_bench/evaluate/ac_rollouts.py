"""What models get wrong on the full AC network, under schedules that none of them has seen."""

from __future__ import annotations

import contextlib

import numpy as np
import pandas as pd

from ded_bench.evaluate.rollouts import Errors, table_row
from ded_bench.koopman.identified_swing import IdentifiedSwing
from ded_bench.koopman.identify_ac import HELD_OUT_FIRST, sample_ac
from ded_bench.koopman.linear import linear_model
from ded_bench.koopman.model import Koopman
from ded_bench.problem.ac_case import AcCase
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.truth.network import Network
from ded_bench.truth.simulate import SimulationError, Trajectory, simulate

#: Trajectories to judge on.
HELD_OUT = 12
#: What the table calls the swing equations on the lossless network, simulated: what `trajectory` is exact on.
LOSSLESS = "lossless simulation"
#: The schedules of a row.
DRAWN = "drawn, on AC"


def ac_rollout_table(
    case: Case, data: AcCase, model: Koopman | IdentifiedSwing, seed: int = 0
) -> pd.DataFrame:
    """Errors of a model beside those of two that know the lossless equations.

    Args:
        case: the grid.
        data: its AC data.
        model: identified with this seed. Trajectories that lead beyond its data do not count in its row.
        seed: see `sample_ac`.
    """
    instances, runs = sample_ac(case, data, seed, HELD_OUT, HELD_OUT_FIRST)
    n_gen, rows = len(case.generators), []
    for surrogate in (linear_model(case), model):
        if isinstance(surrogate, IdentifiedSwing):
            rows.append(_row(surrogate.kind, _swing_errors(surrogate, instances, runs)))
            continue
        errors = []
        for psi, run in zip(surrogate.initial(Network(case), instances), runs, strict=True):
            outputs = surrogate.rollout(psi, np.hstack([run.p_gen, run.p_load]))
            errors.append((outputs[:, :n_gen] - run.omega, outputs[:, n_gen] - run.p_slack))
        rows.append(_row(surrogate.kind, errors))
    others = [simulate(case, i, Schedule(run.t, run.p_gen)) for i, run in zip(instances, runs, strict=True)]
    pairs = zip(others, runs, strict=True)
    rows.append(_row(LOSSLESS, [(a.omega - b.omega, a.p_slack - b.p_slack) for a, b in pairs]))
    return pd.DataFrame(rows)


def _swing_errors(
    model: IdentifiedSwing, instances: list[Instance], runs: list[Trajectory]
) -> list[tuple[Array, Array]]:
    errors = []
    for instance, run in zip(instances, runs, strict=True):
        with contextlib.suppress(SimulationError):
            said = model.simulate(instance, Schedule(run.t, run.p_gen))
            errors.append((said.omega - run.omega, said.p_slack - run.p_slack))
    return errors


def _row(model: str, errors: list[tuple[Array, Array]]) -> dict[str, str | float]:
    if not errors:
        return table_row(model, DRAWN, Errors(*np.full((2, 1), np.nan))) | {"n": 0}
    largest = np.array([np.abs(omega).max() / (2 * np.pi) for omega, _ in errors])
    rms = np.array([np.sqrt(np.square(p_slack).mean()) for _, p_slack in errors])
    return table_row(model, DRAWN, Errors(largest, rms))
