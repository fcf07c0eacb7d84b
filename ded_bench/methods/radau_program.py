"""Full DED by collocation: the equations of one element in CasADi, for all elements and instances of a case.

Time is cut into elements, from one grid point to another. Within an element θ and ω of the generators are
cubic polynomials that meet the swing equations at three Radau points, and generator powers are linear;
all other angles and P_s are given at the points.
"""

from __future__ import annotations

import math

import casadi
import numpy as np
from numpy.typing import NDArray

from ded_bench.methods.knots import knot_weights
from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.ipopt import make_ipopt

#: Collocation points of the Radau IIA method with three stages, as fractions of an element, and the
#: weights of its quadrature (Hairer and Wanner, Solving Ordinary Differential Equations II, IV.5).
POINTS = (0.4 - 6**0.5 / 10, 0.4 + 6**0.5 / 10, 1.0)
WEIGHTS = ((16 - 6**0.5) / 36, (16 + 6**0.5) / 36, 1 / 9)
#: Weights of a cubic's values at 0 and the points that give its slopes at the points, (4, 3).
SLOPES, _, _ = casadi.collocation_coeff(POINTS)
#: Where else in an element frequencies are bounded: halfway between the points.
BETWEEN = ((POINTS[0] + POINTS[1]) / 2, (POINTS[1] + POINTS[2]) / 2)


def lagrange(c: float) -> list[float]:
    """Weights of a cubic's values at 0 and the collocation points that give its value at `c`."""
    nodes = (0.0, *POINTS)
    return [math.prod((c - b) / (a - b) for b in nodes if b != a) for a in nodes]


def element_points(ends: NDArray[np.int_]) -> Array:
    """The points of elements that end there, in steps of the grid: 0, then three in each, (n_points,)."""
    return np.append(0.0, ends[:-1, None] + np.outer(np.diff(ends), POINTS))


def point_weights(ends: NDArray[np.int_]) -> Array:
    """How much each point counts in the sum over the grid points: half of the ends, and all between."""
    weight = np.append(0.5, np.outer(np.diff(ends), WEIGHTS))
    weight[-1] += 0.5
    return weight


def interpolated(course: Array, at: Array) -> Array:
    """What is given at all grid points, (n_grid, n), at places between them, (n_places, n): linear."""
    return np.stack([np.interp(at, np.arange(len(course)), column) for column in course.T], axis=1)


class RadauProgram:
    """The program of one case and number of elements; `arguments` makes it that of an instance.

    Columns: θ, ω and P of the generators at t = 0, fixed; then of each element, at each point, the angles of
    all other buses, P_s up and down, θ and ω; at its end P. So an element sees one stretch of columns, whose
    first and last are the state at its start and end. Rows of an element: at each point

        Σ_k d_jk θ_k / h - ω_j = 0
        M Σ_k d_jk ω_k / h + D ω_j - P_j + f(θ_j) = 0             (the paper's swing equation)
        f(θ_j) = L_j at the other buses,   P_s,up - P_s,down - f_s(θ_j) = 0

    then ramps, and ω between the points. h is the element's length, s; d_jk differentiate the cubic.
    """

    def __init__(self, case: Case, elements: int, limit_s: float | None = None) -> None:
        self.case, self.network = case, Network(case)
        n_gen, n_point = len(case.generators), len(POINTS)
        self._cuts = np.cumsum([0, len(self.network.algebraic), 2, n_gen, n_gen]).tolist()
        width = n_point * self._cuts[-1] + n_gen
        initial, columns = np.split(np.arange(3 * n_gen + elements * width), [3 * n_gen])
        columns = columns.reshape(elements, width)
        points = columns[:, :-n_gen].reshape(elements, n_point, -1)
        self.angle, self.slack, self.theta, self.omega = np.split(points, self._cuts[1:-1], axis=2)
        self.initial, self.p_gen = initial, np.vstack([initial[-n_gen:], columns[:, -n_gen:]])
        #: IPOPT; each solve starts from its own arguments.
        self.solver = self._make(np.hstack([columns[:, :1] - 3 * n_gen + initial, columns]), limit_s)

    def _element(self) -> tuple[casadi.SX, casadi.SX, casadi.SX]:
        """One element: the columns that it sees, its length, s, and its rows."""
        network, n_gen, n_point = self.network, len(self.case.generators), len(POINTS)
        state, h = casadi.SX.sym("state", n_gen, 3), casadi.SX.sym("h")
        points, p_end = casadi.SX.sym("points", self._cuts[-1], n_point), casadi.SX.sym("p_end", n_gen)
        angle, slack, theta, omega = casadi.vertsplit(points, self._cuts)
        generators, others, lines = network.generators.tolist(), network.algebraic.tolist(), network.incidence
        angles = casadi.SX.zeros(network.n_bus, n_point)
        angles[generators, :], angles[others, :] = theta, angle
        f = lines.T @ (np.diag(network.coupling) @ casadi.sin(lines @ angles))
        all_theta, all_omega = casadi.horzcat(state[:, 0], theta), casadi.horzcat(state[:, 1], omega)
        p_start, rise = state[:, 2], p_end - state[:, 2]
        force = p_start + rise @ casadi.DM(POINTS).T - np.diag(network.d) @ omega - f[generators, :]
        rows = casadi.veccat(
            all_theta @ SLOPES / h - omega,
            np.diag(network.m) @ all_omega @ SLOPES / h - force,
            f[others, :],
            slack[0, :] - slack[1, :] - f[network.slack, :],
            rise / h,
            all_omega @ np.transpose([lagrange(c) for c in BETWEEN]),
        )
        return casadi.veccat(state, points, p_end), h, rows

    def _make(self, seen: NDArray[np.intp], limit_s: float | None) -> casadi.Function:
        """IPOPT on all elements, each of which sees those columns, (elements, n_seen).

        Derivatives are put together from those of one element. CasADi would find the same by colouring the
        whole, and a solve would take a third longer.
        """
        (own, h, rows), elements, n = self._element(), len(seen), int(seen[-1, -1]) + 1
        lam = casadi.SX.sym("lam", rows.shape[0])
        derivatives = [casadi.jacobian(rows, own), casadi.hessian(casadi.dot(lam, rows), own)[0]]
        element = casadi.Function("element", [own, h, lam], [rows, *derivatives])
        x, lengths, cost = (casadi.MX.sym(*each) for each in (("x", n), ("h", 1, elements), ("c", n + 1)))
        lam_f, lam_g = casadi.MX.sym("lam_f"), casadi.MX.sym("lam_g", rows.shape[0], elements)
        pick = casadi.DM.ones(casadi.Sparsity.triplet(seen.size, n, range(seen.size), seen.ravel().tolist()))
        stretches = casadi.reshape(pick @ x, own.shape[0], elements)
        diagonal = [casadi.diagcat(*[element.sparsity_out(i)] * elements) for i in (1, 2)]
        g, slopes, _ = element.map(elements)(stretches, lengths, 0)
        _, _, curvatures = element.map(elements)(stretches, lengths, lam_g)
        jacobian = casadi.sparsity_cast(slopes, diagonal[0]) @ pick
        hessian = casadi.triu(pick.T @ casadi.sparsity_cast(curvatures, diagonal[1]) @ pick)
        g, p, names = casadi.vec(g), casadi.veccat(lengths, cost), ["x", "p", "lam_f", "lam_g"]
        # Names of functions, arguments and results are those that CasADi expects.
        known = {
            "jac_g": casadi.Function("nlp_jac_g", [x, p], [g, jacobian], names[:2], ["g", "jac_g_x"]),
            "hess_lag": casadi.Function(
                "nlp_hess_l", [x, p, lam_f, casadi.vec(lam_g)], [hessian], names, ["triu_hess_gamma_x_x"]
            ),
        }
        nlp = {"x": x, "p": p, "f": casadi.dot(cost, casadi.vertcat(x, 1)), "g": g}
        return make_ipopt(nlp, {"min_refinement_steps": 0}, limit_s, known)  # as in `ded`

    def arguments(self, instance: Instance, regime: str, ends: NDArray[np.int_]) -> dict[str, Array]:
        """The program of one instance; it starts from the state at t = 0 over the whole horizon.

        Args:
            instance: costs, loads, the state at t = 0.
            regime: whose frequency bound.
            ends: grid indices of the element ends, shape (elements + 1,).

        Returns:
            What IPOPT is given: bounds of columns and rows, parameters, first x.

        Raises:
            SimulationError: the loads cannot be served at t = 0.
        """
        case, network, n, elements = self.case, self.network, self.p_gen[-1, -1] + 1, len(ends) - 1
        angles, p_initial = network.initial_angles(instance), instance.p_initial(case)
        p_slack, bound = float(network.injections(angles)[network.slack]), case.omega_bound(regime)
        lower, upper, start, cost = (np.full(n, v) for v in (-np.inf, np.inf, 0.0, 0.0))
        lower[self.omega], upper[self.omega] = -bound, bound
        lower[self.p_gen], upper[self.p_gen] = case.p_min, case.p_max
        lower[self.slack] = 0.0
        start[self.theta], start[self.angle] = angles[network.generators], angles[network.algebraic]
        start[self.p_gen] = p_initial
        start[self.slack] = max(p_slack, 0.0), max(-p_slack, 0.0)
        state = np.concatenate([angles[network.generators], instance.omega_initial(case), p_initial])
        lower[self.initial] = upper[self.initial] = start[self.initial] = state
        # The sum over the grid points, exact for generator powers, by quadrature for |P_s|.
        steps, weight = np.diff(ends), instance.cost_slack(case) * point_weights(ends)
        cost[self.p_gen] = np.outer(knot_weights(steps), instance.cost_gen(case))
        cost[self.slack] = weight[1:].reshape(elements, -1, 1)
        # Between grid points loads are taken linear, by everyone.
        load = network.load_injections(interpolated(instance.p_load(case), element_points(ends)[1:]))
        dynamics, slack = np.zeros((elements, 2 * self.omega[0].size)), np.zeros((elements, len(POINTS)))
        right = np.hstack([dynamics, load.reshape(elements, -1), slack])
        limit = np.tile(np.append(case.ramp, np.full(len(BETWEEN) * len(case.ramp), bound)), (elements, 1))
        return {
            "x0": start,
            "lbx": lower,
            "ubx": upper,
            "lbg": np.hstack([right, -limit]).ravel(),
            "ubg": np.hstack([right, limit]).ravel(),
            "p": np.concatenate([steps * instance.dt_s, cost, [weight[0] * abs(p_slack)]]),
        }

    def schedule(self, x: Array, instance: Instance, ends: NDArray[np.int_]) -> Schedule:
        """The generator powers of a solution, with one row per element end.

        IPOPT relaxes bounds by 1e-8 of their size; powers are put back, which makes no ramp steeper. P_0 is
        given, wherever it lies.
        """
        p = np.clip(x[self.p_gen], self.case.p_min, self.case.p_max)
        p[0] = instance.p_initial(self.case)
        return Schedule(instance.grid[ends], p)
