"""Full DED on the detailed plant: its equations collocated by Pyomo.DAE at Radau's points.

Elements end where set-points may bend, where loads do and where secondary control acts, so that everything
within one is smooth. Secondary control is algebra: what it holds after a time of its own follows from the
rotor angles there. The program stands for itself: it knows no linearisation.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pyomo.dae as dae
import pyomo.environ as pyo

from ded_bench.methods.ded import Expressions, by_time, eliminated
from ded_bench.methods.ed import first_schedules, static_dispatch
from ded_bench.methods.knots import case_knots, divided, knot_points, power_limits, transfer_room
from ded_bench.methods.radau_program import POINTS, element_points, interpolated, lagrange, point_weights
from ded_bench.plants.detailed.detailed_plant import DetailedPlant
from ded_bench.plants.detailed.machine_arrays import DELTA, SPEED
from ded_bench.plants.detailed.power_system import DetailedState
from ded_bench.plants.detailed.symbolic import Equations, plant_equations
from ded_bench.plants.plant import SimulationError, simulate
from ded_bench.problem.case import Array, Indices
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.linear_program import assign

#: Where else in an element frequencies are bounded, as fractions of it.
BETWEEN = tuple(i / 10 for i in range(1, 10))
#: The equations' elementary functions for arrays of Pyomo's expressions.
PYOMO = SimpleNamespace(**{name: np.frompyfunc(getattr(pyo, name), 1, 1) for name in ("sin", "cos", "sqrt")})


class Mesh(NamedTuple):
    """Where an instance's program has points: 0, then three in every element, the last at its end."""

    knots: Indices  # grid points of the set-points' knots, (n_knots,)
    acts: Indices  # grid points at which secondary control acts
    ends: Indices  # grid points of the element ends, (elements + 1,)


def mesh(plant: DetailedPlant, instance: Instance, state: DetailedState, longest_s: float) -> Mesh:
    """Points for elements of at most a given length, s, and at least one step of the grid."""
    knots = case_knots(plant.case, instance)
    control = plant.control(state, instance.dt_s)
    acts = np.arange(control.first, instance.steps, control.period)
    bends = np.unique([*knots, *acts, *knot_points(instance.kinks, instance.dt_s)])
    parts = np.ceil(np.diff(bends) * instance.dt_s / longest_s - 1e-9).astype(int)
    parts = np.clip(parts, 1, np.diff(bends))
    return Mesh(knots, acts, np.append(divided(bends, parts), instance.steps))


class DetailedProgram:
    """The program of one instance: `model` in Pyomo, and `schedule`, once it is solved.

    Speeds are in rad/s in it; voltages are in the frame of the mean rotor angle.
    In a frame of nominal frequency what all angles do together would turn them, and be nonlinear.
    """

    def __init__(
        self, plant: DetailedPlant, instance: Instance, regime: str, state: DetailedState, mesh: Mesh
    ) -> None:
        self.case, self.system, self.instance = plant.case, plant.system, instance
        self._state, self._mesh, self._places = state, mesh, element_points(mesh.ends)
        data = self.system.data
        self._moving = self.system.moving
        kinds, machines = np.divmod(self._moving, len(data))
        self._scale = np.where(kinds == SPEED, data.omega_0[machines], 1.0)
        self.model = m = pyo.ConcreteModel()
        m.t = dae.ContinuousSet(initialize=[float(t) for t in instance.grid[mesh.ends]])
        m.state, m.voltage = pyo.Set(initialize=self._moving.tolist()), pyo.RangeSet(0, len(state.v) - 1)
        m.x, m.v = pyo.Var(m.state, m.t), pyo.Var(m.voltage, m.t)
        m.x_rate = dae.DerivativeVar(m.x, wrt=m.t)
        scheme = {"wrt": m.t, "nfe": len(mesh.ends) - 1, "ncp": len(POINTS), "scheme": "LAGRANGE-RADAU"}
        pyo.TransformationFactory("dae.collocation").apply_to(m, **scheme)
        self._slopes = eliminated(m, m.x_rate)
        self._x, self._v = by_time(m.x, m.t), by_time(m.v, m.t)  # (n_points, n_moving or 2 n_port)
        m.gen, m.knot = pyo.RangeSet(0, len(self.case.generators) - 1), pyo.RangeSet(0, len(mesh.knots) - 1)
        m.p_set, m.held = pyo.Var(m.gen, m.knot), pyo.Var(pyo.RangeSet(0, len(mesh.acts)))
        self._p_set, self._held = by_time(m.p_set, m.knot), np.array(list(m.held.values()))
        self._speed = np.searchsorted(self._moving, SPEED * len(data) + self.system.scheduled)
        self._follow_plant(plant)
        self._limit_powers()
        self._limit_frequencies(regime)

    def _follow_plant(self, plant: DetailedPlant) -> None:
        """States, voltages and secondary control follow the plant; what turbines deliver is paid."""
        m, mesh, state, case, instance = self.model, self._mesh, self._state, self.case, self.instance
        data, weight, places = self.system.data, point_weights(mesh.ends), self._places
        for variable, value in zip(self._x[0], self._scale * state.x.flat[self._moving], strict=True):
            variable.fix(value)
        m.held[0].fix(state.held)
        drawn = interpolated(self.system.p_drawn(instance.p_load(case)), places)
        period = np.searchsorted(mesh.acts, places)  # what acts at an element's end is felt after it
        m.follows, m.balanced, m.secondary = (pyo.ConstraintList() for _ in range(3))
        cost_gen, cost_slack = instance.cost_gen(case), instance.cost_slack(case)
        m.p_slack = pyo.Var(m.t, [0, 1], bounds=(0, None), initialize=0.0)  # up and down
        begun = plant.advance(state, instance.p_initial(case)[None], instance.p_load(case)[:1], instance.dt_s)
        total = weight[0] * float(begun.p_gen[0] @ cost_gen + cost_slack * abs(begun.p_slack[0]))
        times, slow = list(m.t), self._slowness()
        for k in range(1, len(places)):
            found = self._equations(k, drawn[k], self._held[period[k]])
            rates = np.stack(found.rates).ravel()[self._moving] * self._scale
            for index, rate, scale in zip(self._moving.tolist(), rates, slow, strict=True):
                m.follows.add(scale * self._slopes[index, times[k]] == scale * rate)
            for off in np.concatenate(found.balance):
                m.balanced.add(off == 0.0)
            total += weight[k] * (cost_gen @ found.p_m[self.system.scheduled])
            if case.slack is not None:
                up, down = m.p_slack[times[k], 0], m.p_slack[times[k], 1]
                m.balanced.add(up - down == found.p_e[self.system.network.balancing])
                total += weight[k] * cost_slack * (up + down)
        gain = 0.0 if case.agc is None else case.agc.k
        for j, act in enumerate(mesh.acts, 1):
            angles = self._states(int(np.searchsorted(places, act)))[DELTA]
            m.secondary.add(self._held[j] == -gain * (data.inertia @ angles))
        m.cost_total = pyo.Objective(expr=total)

    def _slowness(self) -> list[float]:
        """What rows of fast states are multiplied by, so that IPOPT's filter sees all states alike, s."""
        drawn = self.system.p_drawn(self.instance.p_load(self.case, np.zeros(1)))[0]
        x, v = self._state.x.copy(), self._state.v.view(np.complex128)
        x[DELTA] -= self.system.data.inertia @ x[DELTA]
        rates = self.system.slopes(x, v, drawn).rates * (self._scale[:, None] / self._scale)
        return [float(value) for value in 1.0 / np.maximum(1.0, np.abs(rates).max(axis=1))]

    def _states(self, k: int) -> Expressions:
        """All states at a point, (N_STATES, n_machine)."""
        x = self._state.x.astype(object)
        x.flat[self._moving] = self._x[k] / self._scale
        return x

    def _equations(self, k: int, drawn: Array, held: Any) -> Equations:
        """The plant's equations at a point."""
        place, knots, system = self._places[k], self._mesh.knots, self.system
        j = max(int(np.searchsorted(knots, place)) - 1, 0)
        part = (place - knots[j]) / (knots[j + 1] - knots[j])
        p_ref = self._state.offset + np.array([share * held for share in self.system.shares], dtype=object)
        p_ref[self.system.scheduled] += (1 - part) * self._p_set[j] + part * self._p_set[j + 1]
        voltage, states = (self._v[k, 0::2], self._v[k, 1::2]), self._states(k)
        states[DELTA] -= system.data.inertia @ states[DELTA]
        inputs = p_ref, drawn, self._state.v_ref
        return plant_equations(system.data, system.network, list(states), voltage, inputs, PYOMO)

    def _limit_powers(self) -> None:
        """Limits of set-points, ramps, transfers."""
        m, case, instance = self.model, self.case, self.instance
        lengths = np.diff(self._mesh.knots)
        for variable, value in zip(self._p_set[0], instance.p_initial(case), strict=True):
            variable.fix(value)
        lower, upper = power_limits(case, instance, lengths)
        for variable, *limits in zip(self._p_set[1:].flat, lower.flat, upper.flat, strict=True):
            variable.setlb(limits[0])
            variable.setub(limits[1])
        m.ramps, m.transfers = pyo.ConstraintList(), pyo.ConstraintList()
        most = np.outer(lengths * instance.dt_s, case.ramp)
        for change, limit in zip(np.diff(self._p_set, axis=0).flat, most.flat, strict=True):
            m.ramps.add((-limit, change, limit))
        by_machine, _, _ = case.transfer_rows
        room = transfer_room(case, instance, self._mesh.knots)
        for total, limit in zip((self._p_set[1:] @ by_machine.T).flat, room.flat, strict=True):
            m.transfers.add(total <= limit)

    def _limit_frequencies(self, regime: str) -> None:
        """Bounds of the regime at the points, between them, and at the end."""
        m, bounds = self.model, self.case.bounds(regime)
        omega = self._x[:, self._speed]
        elements = len(self._mesh.ends) - 1
        nodes = omega[np.arange(elements)[:, None] * len(POINTS) + np.arange(len(POINTS) + 1)]
        between = np.einsum("cj,ejg->ecg", np.array([lagrange(c) for c in BETWEEN]), nodes)
        m.frequencies = pyo.ConstraintList()
        always = ~bounds.at_end
        for at, rows in (
            (omega[1:], always),
            (between.reshape(-1, omega.shape[1]), always),
            (omega[-1:], bounds.at_end),
        ):
            outputs = at @ bounds.matrix[rows].T
            limits = np.broadcast_to(bounds.limit[rows], outputs.shape)
            for output, limit in zip(outputs.flat, limits.flat, strict=True):
                m.frequencies.add((-limit, output, limit))

    def start(self) -> None:
        """Give every variable a first value: a simulation of the static dispatch, or of what can be followed.

        Where nothing can, everything rests.
        """
        case, instance, mesh, state = self.case, self.instance, self._mesh, self._state
        wanted = static_dispatch(case, instance).at(instance.grid[mesh.knots])
        wanted[0] = instance.p_initial(case)
        p_set, x, v, held = wanted, state.x[None], state.v[None], np.array([state.held])
        for candidate in first_schedules(case, instance, wanted, mesh.knots):
            schedule = Schedule(instance.grid[mesh.knots], candidate)
            try:
                states = simulate(case, instance, schedule, exact=False).states.states
            except SimulationError:
                continue
            p_set, x, v, held = candidate, states.x, states.v, states.held
            break
        x = x.reshape(len(x), -1)[:, self._moving] * self._scale
        for variables, values in ((self._x[1:], x), (self._v[1:], v)):
            assign(variables.ravel(), interpolated(values, self._places[1:]).ravel())
        assign(self._p_set[1:].ravel(), p_set[1:].ravel())
        assign(self._held[1:], held[np.minimum(mesh.acts, len(held) - 1)])

    def schedule(self) -> Schedule:
        """The set-points of the solved model; IPOPT keeps bounds to 1e-8 only, so they are put back."""
        p = np.array([[variable.value for variable in row] for row in self._p_set])
        p[1:] = np.clip(p[1:], *power_limits(self.case, self.instance, np.diff(self._mesh.knots)))
        return Schedule(self.instance.grid[self._mesh.knots], p)
