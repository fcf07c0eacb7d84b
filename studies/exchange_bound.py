"""What no lifted model can do: a lower bound of the rollout error of all of them, whatever their observables.

    python studies/exchange_bound.py two-area 8

A time-invariant lifted model, ψ_k+1 = K (ψ_k - B P_k) + B P_k + G (P_k+1 - P_k) with (ω, P_s) among its
observables, answers by the sum of what x_0 does, through ψ_0, and of what the inputs do. Let two instances a
and b exchange their input increments: with y(i, j) the answer of instance i to the increments of j,

    y(a, a) - y(a, b) - y(b, a) + y(b, b) = 0

for every such model. Where the grid's own answers leave D instead of zero, the errors of a model's four
rollouts leave -D: their mean is at least |D| / 4, at every instant and in every norm.
"""

import sys
from collections.abc import Iterator

import numpy as np
import pandas as pd

from ded_bench import Case, Instance, Schedule, SimulationError, simulate
from ded_bench.plants.plant import servable
from ded_bench.problem.sampling import KOOPMAN_SEED, sample_instances
from ded_bench.surrogates.identify import KINDS

#: First of the draws that are exchanged; those of identification lie before.
FIRST = 2_000_000


def bounds(case: Case, kind: str, pairs: int) -> Iterator[float]:
    """The bound of the largest |Δω| in Hz, for each pair that the grid can follow."""
    drawn = list(sample_instances(case, KOOPMAN_SEED, 2 * pairs, FIRST, servable))
    for i in range(pairs):
        pair, increments = drawn[2 * i : 2 * i + 2], []
        for j, instance in enumerate(pair):
            rng = np.random.default_rng(np.random.SeedSequence([KOOPMAN_SEED, FIRST + 2 * i + j, 1]))
            p_gen = KINDS[kind](case, instance, rng)
            increments.append(p_gen - p_gen[0])
        try:
            y = [
                simulate(
                    with_ramps_of(case, own, other), Schedule(own.grid, own.p_initial(case) + increment), case
                ).omega
                for own in pair
                for other, increment in zip(pair, increments, strict=True)
            ]
        except SimulationError:
            continue
        yield float(np.abs(y[0] - y[1] - y[2] + y[3]).max()) / 4.0 / (2 * np.pi)


def with_ramps_of(case: Case, own: Instance, other: Instance) -> Instance:
    """An instance whose loads start as they do and ramp as another's."""
    initial = zip(case.loads, own.p_load(case, np.zeros(1))[0].tolist(), strict=True)
    load = {bus: other.load[bus].model_copy(update={"initial": value}) for bus, value in initial}
    return own.model_copy(update={"load": load})


if __name__ == "__main__":
    case, pairs = Case.load(sys.argv[1]), int(sys.argv[2])
    found = {kind: list(bounds(case, kind, pairs)) for kind in KINDS}
    rows = [(kind, len(values), 1e3 * np.mean(values)) for kind, values in found.items() if values]
    columns = ["schedules", "pairs", "any lifted model, at least (mHz)"]
    print(pd.DataFrame(rows, columns=columns).to_string(index=False))
