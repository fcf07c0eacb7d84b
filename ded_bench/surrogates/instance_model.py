"""The one form in which linear programs see every surrogate: a linear model of one instance, by knots."""

from __future__ import annotations

import numpy as np

from ded_bench.plants.lossless.network import Network
from ded_bench.plants.plant import PlantState
from ded_bench.plants.simulate import simulate
from ded_bench.plants.time_varying import Hold, Indices, TimeVarying, repeated
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.surrogates.find import Surrogate
from ded_bench.surrogates.koopman import Koopman


def model_along(
    case: Case,
    surrogate: Surrogate,
    instance: Instance,
    p_gen: Array,
    points: Indices,
    exact: bool = True,
    state: PlantState = None,
) -> TimeVarying:
    """The linear model of one instance by which a surrogate answers to schedules linear between knots.

    Args:
        case: the grid.
        surrogate: any kind. A lifted model's answers do not depend on `p_gen` but for round-off; the others
            are linearised along the simulation of it.
        instance: x_0 and the loads.
        p_gen: powers at the knots, shape (n_knots, n_gen), pu; `ded-ko` and its like take the static
            dispatch of every second.
        points: grid points of the knots, strictly increasing from 0 to the last, shape (n_knots,).
        exact: see `Plant.advance`.
        state: of the plant at t = 0; None: the instance's.

    Raises:
        SimulationError: the system cannot follow these powers.
        InputError: a lifted model was identified at another time step than the instance's.
    """
    if isinstance(surrogate, Koopman):
        surrogate.check_step(instance)
        return _lifted_along(case, surrogate, instance, p_gen, points)
    schedule, plant = Schedule(t=instance.grid[points], p=p_gen), surrogate.plant
    return plant.linearise_along(simulate(case, instance, schedule, plant, state, exact), points)


def _lifted_along(
    case: Case, model: Koopman, instance: Instance, p_gen: Array, points: Indices
) -> TimeVarying:
    """A lifted model around its own rollout: K, B and G are those of all intervals."""
    n_gen, lengths = len(case.generators), np.diff(points)
    psi = model.initial(Network(case), [instance])[0]
    steps = np.arange(points[-1] + 1)
    powers = np.stack([np.interp(steps, points, p) for p in p_gen.T], axis=1)
    outputs = model.rollout(psi, np.hstack([powers, instance.p_load(case)]))
    b, h = model.b[:, :n_gen], model.g[:, :n_gen]
    one = Hold(model.k[None], (b - model.k @ b)[None], h[None])
    kinds, kind = np.unique(lengths, return_inverse=True)
    over = [repeated(one, int(length)) for length in kinds]
    slack = np.zeros((1, len(psi)))
    slack[0, n_gen] = 1.0
    return TimeVarying(
        points=points,
        step=Hold(*(np.broadcast_to(part, (len(lengths), *part.shape[1:])) for part in one)),
        across=Hold(*(np.concatenate(parts)[kind] for parts in zip(*over, strict=True))),
        speed=slice(0, n_gen),
        slack=np.broadcast_to(slack, (len(lengths), len(psi))),
        omega=outputs[:, :n_gen],
        p_slack=outputs[:, n_gen],
        p_gen=p_gen,
    )
