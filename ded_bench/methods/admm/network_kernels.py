"""The network along a trajectory of the generators' angles, compiled: electrical power, stiffness."""

from __future__ import annotations

import numpy as np

from ded_bench.plants.lossless.stepper import CompiledGrid, Indices, set_jacobian, solve_algebraic
from ded_bench.problem.case import Array
from ded_bench.problem.compiled import compiled

#: Mismatch of a power flow that is good enough here, pu.
MISMATCH = 1e-5
#: What a step has to leave of it: more than elsewhere, since steps are few and a new Jacobian takes many.
CONTRACTION = 0.3


@compiled
def follow_trajectory(
    grids: tuple[CompiledGrid, CompiledGrid],
    angles: Array,
    wanted: Array,
    inverse: Array,
    theta: Array,
    taken: Indices,
    f: Array,
    stiffness: Array,
) -> bool:
    """Electrical power of the generators along a trajectory of their angles, and its derivative.

    Args:
        grids: the network; the first solves for buses without machines, the second for generators and these.
        angles: of the generators at the power flows, (n_flows, n_gen), rad.
        wanted: injections at the other buses there, (n_flows, n_algebraic), pu.
        inverse: of the Jacobian of these buses somewhere near; is renewed, (n_algebraic, n_algebraic).
        theta: angles of all buses near the first ones, (n_bus,), rad.
        taken: at which power flows the derivative is taken; the first is one, (n_stiffness,).
        f: receives electrical powers of the generators, (n_flows, n_gen), pu.
        stiffness: receives ∂f/∂θ of the generators, (n_stiffness, n_gen, n_gen), pu/rad.

    Returns:
        Whether there is a solution all along; LinAlgError where a Jacobian is singular.
    """
    grid, whole = grids
    n, n_gen, at = len(grid.algebraic), angles.shape[1], 0
    angle, injection, before, change = theta.copy(), np.empty_like(theta), theta.copy(), np.zeros_like(theta)
    full = np.empty((n_gen + n, n_gen + n))
    for k in range(len(angles)):
        for i in range(n):
            bus = grid.algebraic[i]
            angle[bus] = before[bus] + change[bus]
        for g in range(n_gen):
            angle[grid.generators[g]] = angles[k, g]
        if not solve_algebraic(grid, wanted[k], inverse, angle, injection, CONTRACTION):
            return False
        if k > 0:
            change[:] = angle - before
        before[:] = angle
        for g in range(n_gen):
            f[k, g] = injection[grid.generators[g]]
        if at < len(taken) and taken[at] == k:
            set_jacobian(whole, angle, full)
            across = np.ascontiguousarray(full[n_gen:, :n_gen])
            inverse[:] = np.linalg.inv(np.ascontiguousarray(full[n_gen:, n_gen:]))
            moved = np.dot(inverse, across)
            stiffness[at] = full[:n_gen, :n_gen] - np.dot(np.ascontiguousarray(across.T), moved)
            at += 1
    return True
