"""Full DED by collocation as arrays: sparse linear rows, and sines of the lines' angle differences.

Time is cut into elements, from one grid point to another. Within an element θ and ω of the generators are
cubic polynomials that meet the swing equations at three Radau points, and generator powers are linear;
all other angles and P_s are given at the points.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.sine_program import SineNumbers, SineProgram

Indices = NDArray[np.intp]
#: Rows, columns and values of entries of a matrix, arrays that NumPy can broadcast to one shape.
Entries = tuple[Indices, Indices, Array]
#: Collocation points of the Radau IIA method with three stages, as fractions of an element, and the
#: weights of its quadrature (Hairer and Wanner, Solving Ordinary Differential Equations II, IV.5).
POINTS = (0.4 - 6**0.5 / 10, 0.4 + 6**0.5 / 10, 1.0)
WEIGHTS = ((16 - 6**0.5) / 36, (16 + 6**0.5) / 36, 1 / 9)
#: Where else in an element frequencies are bounded: halfway between the points.
BETWEEN = ((POINTS[0] + POINTS[1]) / 2, (POINTS[1] + POINTS[2]) / 2)


def lagrange(c: float) -> list[float]:
    """Weights of a cubic's values at 0 and the collocation points that give its value at `c`."""
    nodes = (0.0, *POINTS)
    return [math.prod((c - b) / (a - b) for b in nodes if b != a) for a in nodes]


def differentiation() -> Array:
    """Weights of a cubic's values at 0 and the points that give its slopes at the points, shape (3, 4)."""
    powers = np.arange(4)
    values = np.power.outer((0.0, *POINTS), powers)
    slopes = powers * np.power.outer(POINTS, np.maximum(powers - 1, 0))
    return np.asarray(slopes @ np.linalg.inv(values))


class RadauProgram:
    """The program of one case and number of elements; `numbers` makes it that of an instance.

    Columns: P_0, fixed; then of each element, at each point, θ and ω of the generators, all other angles, and
    P_s up and down; at its end the generator powers. Rows of an element: at each point

        Σ_k d_jk θ_k / h - ω_j = 0
        M Σ_k d_jk ω_k / h + D ω_j - P_j + f(θ_j) = 0             (the paper's swing equation)
        f(θ_j) = L_j at the other buses,   P_s,up - P_s,down - f_s(θ_j) = 0

    then ramps, and ω between the points. h is the element's length, s; d_jk differentiate the cubic. The
    state at t = 0 stands on the right-hand side.
    """

    def __init__(self, case: Case, elements: int) -> None:
        self.case, self.network = case, Network(case)
        n_gen, n_alg, n_point = len(case.generators), len(self.network.algebraic), len(POINTS)
        width = 2 * n_gen + n_alg + 2
        initial, columns = np.split(np.arange(n_gen + elements * (n_point * width + n_gen)), [n_gen])
        columns = columns.reshape(elements, -1)
        points = columns[:, : n_point * width].reshape(elements, n_point, width)
        self.theta, self.omega, self.angle, up, down = np.split(
            points, [n_gen, 2 * n_gen, 2 * n_gen + n_alg, width - 1], axis=2
        )
        self.slack = np.concatenate([up, down], axis=2)
        self.p_gen = np.vstack([initial, columns[:, n_point * width :]])  # (elements + 1, n_gen)
        height = width - 1
        rows = np.arange(elements * (n_point * height + (1 + len(BETWEEN)) * n_gen)).reshape(elements, -1)
        at_points = rows[:, : n_point * height].reshape(elements, n_point, height)
        self._eq_angle, self._eq_swing, self._eq_load, self._eq_slack = np.split(
            at_points, [n_gen, 2 * n_gen, 2 * n_gen + n_alg], axis=2
        )
        self._ramp = rows[:, n_point * height : n_point * height + n_gen]
        self._between = rows[:, n_point * height + n_gen :].reshape(elements, len(BETWEEN), n_gen)
        self._shape = rows.size, n_gen + columns.size
        outer, inner = self._sines()
        self.program = SineProgram(outer, inner, {"min_refinement_steps": 0})  # as in `ded`

    def _sines(self) -> tuple[sp.csc_matrix, sp.csc_matrix]:
        """C and D: f at all buses from the sines of the lines' angle differences."""
        network, (elements, n_point, _) = self.network, self.theta.shape
        line = np.arange(elements * n_point * len(network.coupling)).reshape(elements, n_point, -1)
        column = np.full((elements, n_point, network.n_bus), -1)  # -1: the slack's angle is zero
        column[:, :, network.generators] = self.theta
        column[:, :, network.algebraic] = self.angle
        row = np.zeros_like(column)
        row[:, :, network.generators] = self._eq_swing
        row[:, :, network.algebraic] = self._eq_load
        row[:, :, [network.slack]] = self._eq_slack
        sign = np.where(np.arange(network.n_bus) == network.slack, -1.0, 1.0)
        inner: list[Entries] = []
        outer: list[Entries] = []
        for end, direction in zip(network.ends.T, (1.0, -1.0), strict=True):
            angle = column[:, :, end]
            moves = angle >= 0
            inner.append((line[moves], angle[moves], np.array(direction)))
            outer.append((row[:, :, end], line, direction * network.coupling * sign[end]))
        return _matrix(outer, (self._shape[0], line.size)), _matrix(inner, (line.size, self._shape[1]))

    def _linear(self, length: Array) -> sp.csc_matrix:
        """A for elements of these lengths, shape (elements,), s."""
        m, d, one, h = self.network.m, self.network.d, np.array(1.0), length[:, None]
        entries: list[Entries] = []

        def state(row: Indices, variable: Indices, weights: list[Array]) -> None:
            """Weights of a variable at an element's start, which is the last point before, and its points."""
            entries.append((row[1:], variable[:-1, -1], np.broadcast_to(weights[0], row.shape)[1:]))
            entries.extend((row, variable[:, k], weight) for k, weight in enumerate(weights[1:]))

        for j, (c, slopes) in enumerate(zip(POINTS, differentiation(), strict=True)):
            state(self._eq_angle[:, j], self.theta, [slope / h for slope in slopes])
            entries.append((self._eq_angle[:, j], self.omega[:, j], -one))
            state(self._eq_swing[:, j], self.omega, [m * slope / h for slope in slopes])
            entries.append((self._eq_swing[:, j], self.omega[:, j], d))
            entries.append((self._eq_swing[:, j], self.p_gen[1:], np.array(-c)))
            entries.append((self._eq_swing[:, j], self.p_gen[:-1], np.array(c - 1)))
        for i, c in enumerate(BETWEEN):
            state(self._between[:, i], self.omega, [np.array(weight) for weight in lagrange(c)])
        entries.append((self._eq_slack, self.slack[:, :, :1], one))
        entries.append((self._eq_slack, self.slack[:, :, 1:], -one))
        entries.append((self._ramp, self.p_gen[1:], 1 / h))
        entries.append((self._ramp, self.p_gen[:-1], -1 / h))
        return _matrix(entries, self._shape)

    def numbers(self, instance: Instance, regime: str, ends: NDArray[np.int_]) -> SineNumbers:
        """The program of one instance; it starts from the state at t = 0 over the whole horizon.

        Args:
            instance: costs, loads, the state at t = 0.
            regime: whose frequency bound.
            ends: grid indices of the element ends, shape (elements + 1,).

        Raises:
            SimulationError: the loads cannot be served at t = 0.
        """
        case, network = self.case, self.network
        steps = np.diff(ends).astype(float)
        angles, p_initial = network.initial_angles(instance), instance.p_initial(case)
        p_slack, bound = float(network.injections(angles)[network.slack]), case.omega_bound(regime)
        row_lower, row_upper = self._right(instance, bound, steps * instance.dt_s, angles)
        lower, upper, start, cost = (np.full(self._shape[1], v) for v in (-np.inf, np.inf, 0.0, 0.0))
        lower[self.omega], upper[self.omega] = -bound, bound
        lower[self.p_gen], upper[self.p_gen] = case.p_min, case.p_max
        lower[self.p_gen[0]] = upper[self.p_gen[0]] = p_initial
        lower[self.slack] = 0.0
        start[self.theta], start[self.angle] = angles[network.generators], angles[network.algebraic]
        start[self.p_gen] = p_initial
        start[self.slack] = max(p_slack, 0.0), max(-p_slack, 0.0)
        # The paper's sum over the grid points: half of what is at an element's ends and all between, which is
        # exact for generator powers; for |P_s| it is the number of steps times the mean by quadrature.
        cost_gen, cost_slack = instance.cost_gen(case), instance.cost_slack(case)
        ends_at = np.concatenate([[1.0], steps, [1.0]])  # the first and the last point count in full
        cost[self.p_gen] = np.outer((ends_at[:-1] + ends_at[1:]) / 2, cost_gen)
        weights = np.outer(steps, WEIGHTS)
        weights[-1, -1] += 0.5
        cost[self.slack] = cost_slack * weights[:, :, None]
        constant = cost_slack * abs(p_slack) / 2
        a = self._linear(steps * instance.dt_s)
        return SineNumbers(a, row_lower, row_upper, lower, upper, cost, constant, start)

    def _right(self, instance: Instance, bound: float, length: Array, angles: Array) -> tuple[Array, Array]:
        """Bounds of the rows: loads, limits, and what is known at t = 0."""
        case, network, slopes = self.case, self.network, differentiation()
        theta, omega = angles[network.generators], instance.omega_initial(case)
        right = np.zeros(self._shape[0])
        right[self._eq_angle[0]] = -slopes[:, :1] / length[0] * theta
        right[self._eq_swing[0]] = -slopes[:, :1] / length[0] * network.m * omega
        times = np.cumsum(length)[:, None] + np.outer(length, np.array(POINTS) - 1)
        # Between grid points loads are taken linear, by everyone.
        loads = [np.interp(times, instance.grid, column) for column in instance.p_load(case).T]
        right[self._eq_load] = network.load_injections(np.stack(loads, axis=-1))
        right[self._between[0]] = [-lagrange(c)[0] * omega for c in BETWEEN]
        margin = np.zeros_like(right)
        margin[self._ramp] = case.ramp
        margin[self._between] = bound
        return right - margin, right + margin

    def schedule(self, x: Array, instance: Instance, ends: NDArray[np.int_]) -> Schedule:
        """The generator powers of a solution, with one row per element end.

        IPOPT relaxes bounds by 1e-8 of their size; powers are put back, which makes no ramp steeper.
        """
        p_gen = np.clip(x[self.p_gen], self.case.p_min, self.case.p_max)
        return Schedule(t=instance.grid[ends], p=p_gen)


def _matrix(entries: Iterable[Entries], shape: tuple[int, int]) -> sp.csc_matrix:
    """A sparse matrix whose pattern does not depend on its values; what falls on one place adds up."""
    parts = [[part.ravel() for part in np.broadcast_arrays(*entry)] for entry in entries]
    rows, columns, values = (np.concatenate([part[i] for part in parts]) for i in range(3))
    matrix = sp.csc_matrix((values, (rows, columns)), shape=shape)
    matrix.sort_indices()
    return matrix
