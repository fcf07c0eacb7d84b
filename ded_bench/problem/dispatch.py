"""Static economic dispatch by merit order, without a solver (the paper's P_opt)."""

from __future__ import annotations

import numpy as np

from ded_bench.problem.case import Array, Case


def merit_order(case: Case, cost_gen: Array, cost_slack: Array | float, p_load: Array) -> Array:
    """Solve min Σ c_i P_i + c_s |P_s| with Σ P = 0 and generator bounds, in closed form.

    Cheapest generators first, each raised while it is cheaper than the slack bus and the slack bus
    still delivers; the remainder is the slack's, of either sign.

    Args:
        case: gives the generator bounds.
        cost_gen: generator costs, shape (..., n_gen).
        cost_slack: slack cost, shape (...); infinite where no slack takes any power: generators then
            deliver the demand, or what they can.
        p_load: load injections, shape (..., n_load), pu.

    Returns:
        Generator powers in pu, shape (..., n_gen); leading dimensions broadcast.
    """
    demand = -np.asarray(p_load).sum(axis=-1)
    shape = np.broadcast_shapes(demand.shape, np.shape(cost_slack), np.shape(cost_gen)[:-1])
    cost = np.broadcast_to(cost_gen, (*shape, len(case.generators))).reshape(-1, len(case.generators))
    slack = np.broadcast_to(cost_slack, shape).reshape(-1, 1)
    residual = np.broadcast_to(demand - case.p_min.sum(), shape).reshape(-1, 1)
    row, order = np.arange(len(cost))[:, None], cost.argsort(axis=1, kind="stable")
    room = np.where(cost < slack, case.p_max - case.p_min, 0.0)[row, order]
    below = room.cumsum(axis=1) - room
    result = np.empty(cost.shape)
    result[row, order] = np.minimum(np.maximum(residual - below, 0.0), room)
    return (result + case.p_min).reshape(*shape, -1)
