"""What no lifted model can do: a lower bound of the rollout error of all of them, whatever their observables.

A time-invariant lifted model, ψ_k+1 = K (ψ_k - B P_k) + B P_k + G (P_k+1 - P_k) with (ω, P_s) among its
observables, answers by the sum of what x_0 does, through ψ_0, and of what the inputs do. Let two instances a
and b exchange their input increments: with y(i, j) the answer of instance i to the increments of j,

    y(a, a) - y(a, b) - y(b, a) + y(b, b) = 0

for every such model, of any dimension, with any observables, trained in any way. Where the grid's own answers
leave D instead of zero, the errors of a model's four rollouts leave -D: their mean is at least |D| / 4, at
every instant and in every norm.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd

from ded_bench.evaluate.rollouts import Errors, rollout_errors, table_row
from ded_bench.koopman.data import KINDS, Trajectories, trajectories
from ded_bench.koopman.surrogates import Surrogate
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import KOOPMAN_SEED, sample_instances
from ded_bench.problem.schedule import Schedule
from ded_bench.truth.servable import servable
from ded_bench.truth.simulate import SimulationError

#: The bound's name among models.
ANY = "any lifted (at least)"
#: Beside the models: the table of `exchange_table`.
EXCHANGED = "exchanged"
#: First of the draws of seed KOOPMAN_SEED that are exchanged; identification and held-out ones lie before.
FIRST = 2_000_000


def exchange_table(case: Case, surrogates: Sequence[Surrogate], pairs: int) -> pd.DataFrame:
    """Errors of surrogates, and the bound of all lifted models, on pairs that exchange their increments.

    The columns are those of `rollouts.rollout_table`; n counts rollouts.

    Args:
        case: the grid.
        surrogates: models to compare with the bound, on the same trajectories.
        pairs: how many for each kind of schedule; one that the grid cannot follow is left out.
    """
    rows = []
    for kind in KINDS:
        bounds, errors = [], []
        for data in _exchanged(case, kind, pairs):
            bounds.append(least_errors(data))
            errors.append([rollout_errors(case, surrogate, data) for surrogate in surrogates])
        if bounds:
            named = f"{kind}, exchanged"
            rows.append(table_row(ANY, named, _joined(bounds)))
            found = zip(surrogates, zip(*errors, strict=True), strict=True)
            rows += [table_row(surrogate.kind, named, _joined(parts)) for surrogate, parts in found]
    return pd.DataFrame(rows)


def least_errors(data: Trajectories) -> Errors:
    """The bound for each of four rollouts y(a, a), y(a, b), y(b, a), y(b, b), |D| / 4."""
    y = data.outputs
    rest = (y[:, 0] - y[:, 1] - y[:, 2] + y[:, 3]) / 4.0
    omega = np.abs(rest[:, :-1]).max() / (2 * np.pi)
    return Errors(np.full(4, omega), np.full(4, np.sqrt(np.square(rest[:, -1]).mean())))


def _exchanged(case: Case, kind: str, pairs: int) -> Iterator[Trajectories]:
    """Four trajectories at a time: two instances, each with its own input increments and the other's."""
    drawn = list(sample_instances(case, KOOPMAN_SEED, 2 * pairs, FIRST, servable))
    for i in range(pairs):
        pair, increments = drawn[2 * i : 2 * i + 2], []
        for j, instance in enumerate(pair):
            rng = np.random.default_rng(np.random.SeedSequence([KOOPMAN_SEED, FIRST + 2 * i + j, 1]))
            p_gen = KINDS[kind](case, instance, rng)
            increments.append(p_gen - p_gen[0])
        instances = [_with_ramps_of(case, own, other) for own in pair for other in pair]
        schedules = [
            Schedule(own.grid, own.p_initial(case) + increment) for own in pair for increment in increments
        ]
        try:
            yield trajectories(case, instances, schedules, [kind] * 4)
        except SimulationError:
            continue


def _with_ramps_of(case: Case, own: Instance, other: Instance) -> Instance:
    """An instance whose loads start as they do and ramp as another's."""
    initial = zip(case.loads, own.p_load(case, np.zeros(1))[0].tolist(), strict=True)
    load = {bus: other.load[bus].model_copy(update={"initial": value}) for bus, value in initial}
    return own.model_copy(update={"load": load})


def _joined(parts: Sequence[Errors]) -> Errors:
    return Errors(*(np.concatenate(column) for column in zip(*parts, strict=True)))
