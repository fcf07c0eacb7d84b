"""A split of a case's instances, and linear models along a trajectory, as NumPy arrays."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ded_bench.files.errors import InputError
from ded_bench.methods.knots import control_times
from ded_bench.plants.plant import Plant, plant_of, servable, simulate
from ded_bench.plants.time_varying import TimeVarying
from ded_bench.problem.benchmark import SplitName, select_split
from ded_bench.problem.case import Array, Case, Indices
from ded_bench.problem.instance import BETWEEN, Instance
from ded_bench.problem.schedule import Schedule, as_schedule
from ded_bench.surrogates.koopman import hat_functions


@dataclass(frozen=True, eq=False)
class SplitArrays:
    """Instances of one case, as arrays whose first axis is the instance; units are those of the files."""

    case: Case
    instances: tuple[Instance, ...]
    t: Array  # (n_t,), s
    load: Array  # injections at t, (n, n_t, n_load), pu
    cost: Array  # of the generators, (n, n_gen), per pu and point of time
    cost_slack: Array  # per pu and point of time, (n,); 0 on an island
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
        InputError: there is no such case or split, a file is missing or wrong, the limit is negative, or a
            time is not within the case's horizon.
    """
    chosen = select_split(case, split, limit, servable)
    own, instances = chosen.case, tuple(instance for instance, _ in chosen.instances)
    horizon_s = own.sampling.horizon_s
    t = own.knot_times(horizon_s) if times is None else np.asarray(times, dtype=np.float64)
    if t.ndim != 1 or not ((t >= 0.0) & (t <= horizon_s + 1e-9)).all():
        raise InputError("times", "", f"must be a row of numbers from 0 to {horizon_s:g}")
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


#: Slopes are those of intervals of this length, s: gradients are then right to a ten-thousandth.
INTERVAL_S = 0.1


@dataclass(frozen=True, eq=False)
class CondensedMap:
    """ω ≈ omega + d_omega · (P - p) and P_s ≈ p_slack + d_p_slack · (P - p), P being a schedule's powers."""

    t: Array  # (n_t,), s
    p: Array  # of the schedule along whose trajectory it holds, (n_knots, n_gen), pu
    omega: Array  # of that trajectory, (n_t, n_gen), rad/s
    p_slack: Array  # (n_t,), pu
    d_omega: Array  # (n_t, n_gen, n_knots, n_gen), rad/s per pu
    d_p_slack: Array  # (n_t, n_knots, n_gen), pu per pu


def linearise(
    case: Case,
    instance: Instance,
    schedule: Schedule,
    plant: str | Plant | None = None,
    interval_s: float = INTERVAL_S,
) -> TimeVarying:
    """Simulate a schedule and linearise the plant along it: x⁺ = f x + g u + h Δu from point to point.

    Args:
        case, instance, schedule, plant: as for `simulate`.
        interval_s: between knots of the model, s; more lie at the schedule's rows and where AGC acts.

    Raises:
        SimulationError: the plant cannot follow the schedule.
        InputError: as `simulate`.
    """
    chosen, schedule = plant_of(case, plant), as_schedule(schedule, case)
    trajectory = simulate(case, instance, schedule, chosen)
    return chosen.linearise_along(trajectory, model_points(case, instance, schedule, interval_s))


def condense(
    case: Case,
    instance: Instance,
    schedule: Schedule,
    plant: str | Plant | None = None,
    interval_s: float = INTERVAL_S,
) -> CondensedMap:
    """The linear map from a schedule's powers to frequencies and the slack's power, along its trajectory.

    Args:
        case, instance, schedule, plant, interval_s: as for `linearise`; the knots are the map's times.

    Raises:
        SimulationError: the plant cannot follow the schedule.
        InputError: as `simulate`.
    """
    schedule = as_schedule(schedule, case)
    model = linearise(case, instance, schedule, plant, interval_s)
    t, n_gen = instance.grid[model.points], len(case.generators)
    hats = hat_functions(t, schedule.t)
    # Columns: the knot, then the generator, of which one is moved.
    moved = np.einsum("jk,gi->jgki", hats, np.eye(n_gen)).reshape(len(hats), n_gen, -1)
    states, shape = model.states(moved), (len(schedule.t), n_gen)
    at = np.append(np.arange(len(model.lengths)), len(model.lengths) - 1)  # the last point is of the last
    d_slack = np.array([model.slack[j] @ x for j, x in zip(at, states, strict=True)])
    return CondensedMap(
        t=t,
        p=schedule.p,
        omega=model.omega[model.points],
        p_slack=model.p_slack[model.points],
        d_omega=states[:, model.speed].reshape(-1, n_gen, *shape),
        d_p_slack=d_slack.reshape(-1, *shape),
    )


def model_points(case: Case, instance: Instance, schedule: Schedule, interval_s: float) -> Indices:
    """Grid points of a model's knots, strictly increasing from the first to the last.

    Raises:
        InputError: the interval is no length of time.
    """
    if not interval_s > 0.0:
        raise InputError("interval_s", "", f"must be above 0, not {interval_s}")
    dt_s, last = instance.dt_s, instance.steps
    times = np.arange(0.0, instance.horizon_s, interval_s), schedule.t, control_times(case, instance)
    places = np.concatenate(times) / dt_s  # a row between grid points is a bend at both of them
    both = np.concatenate([np.floor(places + BETWEEN), np.ceil(places - BETWEEN), [last]]).astype(np.intp)
    return np.unique(np.clip(both, 0, last))
