"""A split of a case's instances as arrays."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ded_bench.plants.plant import servable
from ded_bench.problem.benchmark import SplitName, select_split
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance


@dataclass(frozen=True, eq=False)
class SplitArrays:
    """Instances of one case, as arrays whose first axis is the instance; units are those of the files."""

    case: Case
    instances: tuple[Instance, ...]
    t: Array  # (n_t,), s
    load: Array  # injections at t, (n, n_t, n_load), pu
    cost: Array  # of the generators, (n, n_gen)
    cost_slack: Array  # (n,); 0 on an island
    p_initial: Array  # (n, n_gen), pu
    omega_initial: Array  # (n, n_gen), rad/s

    def __len__(self) -> int:
        return len(self.instances)


def split_arrays(
    case: str | Path, split: SplitName = "train", limit: int | None = None, times: Array | None = None
) -> SplitArrays:
    """Read a split, in the order of its ids.

    Args:
        case: name of a shipped case, or a benchmark's folder.
        split: `train`, `test`, `validation` (drawn afresh) or `all`. Test instances are for scoring only.
        limit: only the first so many.
        times: at which loads are wanted, (n_t,), s; None: the case's knots.

    Raises:
        InputError: there is no such case or split, or a file is missing or wrong.
    """
    chosen = select_split(case, split, limit, servable)
    own, instances = chosen.case, tuple(instance for instance, _ in chosen.instances)
    t = own.knot_times(own.sampling.horizon_s) if times is None else np.asarray(times, dtype=np.float64)
    shapes = len(t), len(own.loads)
    return SplitArrays(
        own,
        instances,
        t,
        load=np.array([i.p_load(own, t) for i in instances]).reshape(-1, *shapes),
        cost=np.array([i.cost_gen(own) for i in instances]).reshape(-1, len(own.generators)),
        cost_slack=np.array([i.cost_slack(own) for i in instances]),
        p_initial=np.array([i.p_initial(own) for i in instances]).reshape(-1, len(own.generators)),
        omega_initial=np.array([i.omega_initial(own) for i in instances]).reshape(-1, len(own.generators)),
    )
