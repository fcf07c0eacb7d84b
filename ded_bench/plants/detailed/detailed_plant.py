"""The plant `detailed`: machines with exciters, stabilisers and governors on the AC network.

Either the machine at `slack_machine_bus` keeps its speed (infinite slack), or every machine is finite and
scheduled (island), with secondary control (AGC) where the case has it. Set-points are the references of the
governors; what turbines deliver follows. Loads draw constant power at any voltage. The equations are in
`symbolic`.
"""

from __future__ import annotations

import functools
import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ded_bench.files.errors import InputError
from ded_bench.plants.detailed.machine_arrays import DELTA
from ded_bench.plants.detailed.power_system import DetailedRun, DetailedState, PowerSystem, linearised
from ded_bench.plants.detailed.start import corrected, initial_point, start
from ded_bench.plants.detailed.static_dispatch import StaticDispatch
from ded_bench.plants.plant import NominalPoint, Piece, SimulationError, copied
from ded_bench.plants.time_varying import TimeVarying
from ded_bench.problem.case import Case
from ded_bench.problem.instance import AgcState, Instance, State
from ded_bench.problem.quantities import Array, Indices
from ded_bench.problem.sampling import rounded
from ded_bench.problem.schedule import Trajectory

if TYPE_CHECKING:
    from ded_bench.plants.detailed.detailed_stepper import SecondaryControl

#: Longest step times the fastest mode: Kutta's method is stable up to 2.78.
STEP_BY_MODE = 2.0
#: Longest step of an exact simulation, s: frequencies of shipped grids are then exact to 1e-8 Hz.
LONGEST_S = 0.01
#: Voltages are solved for less sharply where a linearisation follows, pu.
PLANNING_CHANGE = 1e-8
#: Least t2 of an inverted governor, s: at zero, set-points would have impulses.
LEAST_LEAD_S = 0.1


@dataclass(frozen=True)
class DetailedPlant:
    """The detailed plant of one case."""

    case: Case
    name: str = "detailed"

    def __post_init__(self) -> None:
        """Raise InputError unless the case's network and machines are there."""
        _ = self.case.detailed

    def __reduce__(self) -> tuple[type[DetailedPlant], tuple[Case]]:
        """Without what is made once."""
        return DetailedPlant, (self.case,)

    @property
    def fingerprint(self) -> str:
        """That of the case and of the files beside it."""
        parts = self.case.fingerprint + self.case.detailed.fingerprint
        return hashlib.sha256(parts.encode()).hexdigest()[:12]

    @functools.cached_property
    def system(self) -> PowerSystem:
        """Its equations, by the case's generators and loads."""
        return PowerSystem(self.case)

    @functools.cached_property
    def dispatcher(self) -> StaticDispatch:
        """Its static dispatch."""
        return StaticDispatch(self.system)

    def initial(self, instance: Instance, estimate: DetailedState | None = None) -> DetailedState:
        """See `Plant.initial`, `start` and `corrected`.

        Raises:
            InputError: powers and loads at t = 0 are not balanced.
        """
        if estimate is None or instance.initial.measured is None:
            return start(self.system, instance)
        return corrected(self.system, instance, estimate)

    def control(self, state: DetailedState, dt_s: float) -> SecondaryControl:
        """Secondary control by the points of a grid (see `Instance.check_case`)."""
        from ded_bench.plants.detailed.detailed_stepper import NEVER, SecondaryControl

        agc, shares = self.case.agc, self.system.shares
        if agc is None:
            return SecondaryControl(shares, 0.0, NEVER, 1)
        return SecondaryControl(shares, agc.k, round(state.next_s / dt_s), round(agc.period_s / dt_s))

    def advance(
        self, state: DetailedState, p_set: Array, p_load: Array, dt_s: float, exact: bool = True
    ) -> Piece:
        """See `Plant.advance`; `states` are a DetailedRun. On an island the slack's power is zero."""
        from ded_bench.plants.detailed import detailed_stepper as stepper  # and with it Numba

        n, control, system = len(p_set), self.control(state, dt_s), self.system
        network, p_drawn = system.compiled_network, system.network.p_drawn[: system.network.n_load_port]
        network = network if exact else network._replace(change=PLANNING_CHANGE)
        gen, load = system.scheduled, system.load_ports
        shapes = state.x.shape, state.v.shape, (), state.offset.shape, *(3 * [gen.shape]), load.shape
        *arrays, given, loads = (np.empty((n, *shape)) for shape in shapes)
        states = stepper.DetailedStates(*arrays)
        states.x[0], states.v[0], states.held[0] = state.x, state.v, state.held
        given[:], loads[:] = p_set, p_load
        inputs = stepper.PlantInputs(given, gen, state.offset, loads, load, p_drawn, state.v_ref, dt_s)
        needed = max(system.fastest * dt_s / STEP_BY_MODE, dt_s / LONGEST_S if exact else 1.0)
        steps = math.ceil(needed - 1e-9)
        try:
            carried = copied(state.carried) or stepper.carried_voltages(network, inputs, state.v)
            done = stepper.integrate_plant(system.data, network, inputs, control, steps, carried, states)
        except np.linalg.LinAlgError:
            done = 0
        if done < n or not np.isfinite(states.x[-1]).all():
            problem = "the network has no voltages any more" if done < n else "it loses its stability"
            raise SimulationError(f"the system cannot follow this schedule: {problem}")
        ahead = control.first - (n - 1)
        next_s, held = (ahead if ahead >= 0 else ahead % control.period) * dt_s, float(states.held[-1])
        x, v, p_set = states.x[-1], states.v[-1], p_set[-1]
        end = state._replace(x=x, v=v, held=held, next_s=next_s, p_set=p_set, carried=carried)
        p_slack = np.zeros(n) if system.island else states.p_e[:, system.network.balancing]
        run = DetailedRun(states, np.arange(control.first, n - 1, control.period), steps)
        return Piece(states.omega, states.p_gen, p_slack, run, end, states.held)

    def linearise_along(self, trajectory: Trajectory, points: Indices) -> TimeVarying:
        """See `Plant.linearise_along` and `linearised`.

        Raises:
            InputError: secondary control acts between knots.
        """
        return linearised(self.system, trajectory, points)

    def observed(self, state: DetailedState) -> State:
        """On islands everything that instance/2 can hold; else set-points and frequencies.

        Behind an infinite slack angles would be worse than none: turbines' powers, which are not told, or a
        planner's own network, hold others, and what it plans from would be far from any equilibrium.
        """
        from ded_bench.plants.detailed import equations  # and with it Numba

        (theta, omega, p_gen), mean = equations.observed(self.system.data, state.x, self.system.scheduled)
        if self.case.slack is not None:
            return State(None, omega, state.p_set)
        agc = None
        if self.case.agc is not None:
            agc = AgcState.model_construct(None, held_pu=state.held, integral_rad=mean, next_s=state.next_s)
        return State(theta, omega, state.p_set, p_gen, agc)

    def columns(self, states: DetailedRun) -> Mapping[str, Array]:
        """Voltages of all buses, rotor angles, secondary control.

        `v_<bus>` (pu); `delta_<machine>` (rad, relative to the slack's or the inertia-weighted mean); with
        secondary control `agc`, what it asks of all machines together (pu).
        """
        found, system = states.states, self.system
        network = system.network
        size = np.abs(found.v.view(np.complex128) @ network.spread.T)
        delta = found.x[:, DELTA] - (found.x[:, DELTA] @ system.data.inertia)[:, None]
        names = self.case.detailed.machines
        columns = {f"v_{bus}": column for bus, column in zip(network.buses, size.T, strict=True)}
        columns |= {f"delta_{name}": column for name, column in zip(names, delta.T, strict=True)}
        return columns | ({"agc": found.held} if self.case.agc is not None else {})

    def balanced(self, instance: Instance) -> Instance:
        """See `Plant.balanced`: on an island all machines take what powers and losses differ by, rounded."""
        if self.case.slack is not None:
            return instance
        p_load, start = instance.p_load(self.case, np.zeros(1))[0], instance.initial
        power = rounded(self.dispatcher.balanced(instance.p_initial(self.case), p_load).power)
        by_name = dict(zip(self.case.generators, power.tolist(), strict=True))
        return instance.model_copy(update={"initial": start.model_copy(update={"power": by_name})})

    def nominal(self) -> NominalPoint:
        """See `Plant.nominal`; phase shifts of transformers are part of angles across them."""
        system = self.system
        point = system.network.nominal()
        voltage = dict(zip(system.network.buses, system.network.spread @ point.voltage, strict=True))
        lines = self.case.detailed.network.lines
        across = np.angle([voltage[line.from_bus] / voltage[line.to_bus] for line in lines])
        slack = None if system.island else float(point.power.real[system.network.balancing])
        return NominalPoint(slack, float(np.degrees(np.abs(across).max())), system.modes(point))

    def static_dispatch(self, instance: Instance, times: Array) -> Array:
        """See `Plant.static_dispatch`: losses are balanced at the least cost."""
        return self.dispatcher.course(instance, times)

    def set_points_delivering(self, p_gen: Array, dt_s: float) -> Array:
        """See `Plant.set_points_delivering`: (1 + s t1)(1 + s t3) / (1 + s t2) of what turbines deliver.

        Where a slope changes, a set-point jumps by t1 t3 / t2 of the change.
        """
        data, machines = self.system.data, self.system.scheduled
        t1, t3 = 1.0 / data.rate_g[machines], 1.0 / data.rate_h[machines]
        t2 = np.maximum(data.reheat[machines] * t3, LEAST_LEAD_S)
        change = np.diff(p_gen, axis=0, append=p_gen[-1:])
        gate = p_gen + t1 * change / dt_s
        kept, lagging, mean = np.exp(-dt_s / t2), np.empty_like(gate), gate + change / 2
        lagging[0] = p_gen[0]
        for k in range(len(gate) - 1):
            lagging[k + 1] = mean[k] + kept * (lagging[k] - mean[k])
        return np.asarray(gate * (t3 / t2) + lagging * (1.0 - t3 / t2))

    def check_followed(self, instance: Instance) -> None:
        """See `Plant.check_followed`: on an island from kink to kink, simulated."""
        if self.case.slack is None:
            point = initial_point(self.system, instance)
            schedule = self.dispatcher.followed(instance, self.system.equilibrium(point).v_ref)
            inputs = schedule.at(instance.grid), instance.p_load(self.case)
            self.advance(self.initial(instance), *inputs, instance.dt_s, exact=False)

    def check_servable(self, instance: Instance, source: str) -> None:
        """See `Plant.check_servable`.

        Powers and loads at t = 0 must have a stable equilibrium, the static dispatch at 0, at each kink of a
        load and at the horizon a power flow.
        """
        system = self.system
        try:
            if not system.stable(initial_point(system, instance)):
                raise SimulationError("their equilibrium is not stable")
        except InputError as error:
            raise InputError(source, error.field, error.problem) from None
        except SimulationError as error:
            problem = f"initial loads and power cannot be served: {error}"
            raise InputError(source, "load, initial.power", problem) from None
        try:
            self.dispatcher.check_kinks(instance)
        except SimulationError as error:
            raise InputError(source, "load", str(error)) from None
