"""Static dispatch of an island: cheapest powers that balance loads and losses on the AC power flow.

Marginal losses count: the balance is that of the power flow linearised at the powers found before, until they
stay. What the balancing machine of the power flow would have to add is what the powers are short of.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog

from ded_bench.files.errors import InputError
from ded_bench.plants.detailed.power_flow import Complex, OperatingPoint, PortNetwork
from ded_bench.plants.plant import SimulationError
from ded_bench.plants.time_varying import Indices
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import rounded

#: Balanced is what is short of less than this, pu; powers that move by less in a program stay.
BALANCED, STAYS = 1e-9, 1e-6
#: Programs, and Newton steps, after which there is no balance.
PROGRAMS, NEWTON_STEPS = 12, 12


@dataclass(frozen=True)
class Balance:
    """Powers of all machines and loads, beside what the network makes of them."""

    power: Array  # (n_gen,), pu
    point: OperatingPoint
    short: float  # what loads and losses take beyond the powers, pu
    slopes: Array  # of `short` by the powers, (n_gen,): about -1


@dataclass(frozen=True)
class StaticDispatch:
    """Dispatch of the machines of an island."""

    case: Case
    network: PortNetwork
    machines: Indices  # of the generators, (n_gen,)
    load_ports: Indices  # (n_load,)

    def weigh(self, power: Array, p_load: Array, guess: Complex | None = None) -> Balance:
        """Solve the power flow and say what the powers are short of.

        Args:
            power: of the generators, (n_gen,), pu.
            p_load: load injections, (n_load,), pu; other loads are nominal.
            guess: voltages to start from; None: nominal.

        Raises:
            SimulationError: the power flow has no solution.
        """
        machines, drawn = np.zeros(len(self.machines)), self.network.p_drawn.copy()
        machines[self.machines], drawn[self.load_ports] = power, -p_load
        point = self.network.power_flow(machines, drawn, guess)
        slopes, balancing = self.network.balance_slopes(point)[0], self.network.balancing
        slopes[balancing] = -1.0
        short = float(point.power.real[balancing] - machines[balancing])
        return Balance(power, point, short, slopes[self.machines])

    def cheapest(self, cost: Array, p_load: Array, start: Balance, reach: Array | None = None) -> Balance:
        """Cheapest powers within limits and transfers that balance loads and losses.

        Args:
            cost: (n_gen,).
            p_load: load injections, (n_load,), pu.
            start: powers and voltages near these.
            reach: how far powers may be from those of the start, (n_gen,), pu; None: anywhere.

        Raises:
            SimulationError: no powers within limits balance the loads.
        """
        case = self.case
        lower, upper = case.p_min, case.p_max
        if reach is not None:
            lower, upper = np.maximum(lower, start.power - reach), np.minimum(upper, start.power + reach)
        found = self.weigh(np.clip(start.power, lower, upper), p_load, start.point.voltage)
        for _ in range(PROGRAMS):
            power = self._program(cost, p_load, found, lower, upper)
            if power is None:
                break
            moved = float(np.abs(power - found.power).max())
            found = self.weigh(power, p_load, found.point.voltage)
            if abs(found.short) < BALANCED and moved < STAYS:
                return found
        raise SimulationError("no powers within limits and transfers balance loads and losses")

    def _program(self, cost: Array, p_load: Array, near: Balance, lower: Array, upper: Array) -> Array | None:
        """Cheapest powers with the balance linearised, (n_gen,), pu; None: there are none.

        Without transfers they are a merit order of cost per power that arrives: machines are raised one after
        another from their lower ends until loads and losses are met.
        """
        arrives = -near.slopes
        need = near.short + arrives @ (near.power - lower)
        order = np.argsort(cost / arrives, kind="stable")
        room = (arrives * (upper - lower))[order]
        raised = np.clip(need - (np.cumsum(room) - room), 0.0, room)
        if not 0.0 <= need <= room.sum():
            return None
        power = lower.copy()
        power[order] += raised / arrives[order]
        if not (self.case.transfer_excess(power, p_load) > 0.0).any():
            return np.minimum(power, upper)
        by_machine, by_load, limit = self.case.transfer_rows
        found = linprog(
            cost,
            A_ub=by_machine,
            b_ub=limit - by_load @ p_load,
            A_eq=arrives[None],
            b_eq=[float(need + arrives @ lower)],
            bounds=list(zip(lower.tolist(), upper.tolist(), strict=True)),
        )
        return None if found.x is None else np.clip(found.x, lower, upper)

    def balanced(self, power: Array, p_load: Array) -> Balance:
        """Powers near some given ones that balance loads and losses within limits and transfers.

        A group beyond its transfer is brought to it; all other machines take what is missing or too much,
        each by the same part of what it can move.

        Raises:
            SimulationError: there are none.
        """
        case, by_machine = self.case, self.case.transfer_rows[0]
        power = np.clip(power, case.p_min, case.p_max)
        free = np.ones(len(power), dtype=bool)
        for _ in range(1 + len(by_machine)):
            found = self._shared(power, free, p_load)
            excess = case.transfer_excess(found.power, p_load)
            beyond = np.flatnonzero(excess > BALANCED)
            if not beyond.size:
                return found
            group = by_machine[beyond[0]] > 0
            room = np.where(group, found.power - case.p_min, 0.0)
            if not excess[beyond[0]] <= room.sum():
                break
            power, free = found.power - room * excess[beyond[0]] / room.sum(), free & ~group
        raise SimulationError("the powers cannot be balanced within limits and transfers")

    def _shared(self, power: Array, free: Array, p_load: Array) -> Balance:
        """Move the free machines, each by the same part of what it can, until loads and losses are met."""
        case, voltage = self.case, None
        for _ in range(NEWTON_STEPS):
            found = self.weigh(power, p_load, voltage)
            if abs(found.short) < 1e-3 * BALANCED:
                return found
            room = (case.p_max if found.short > 0 else case.p_min) - power
            room = np.where(free, room, 0.0)
            part = found.short / max(-found.slopes @ room * np.sign(found.short), 1e-300)
            if not abs(part) <= 1.0:
                break
            power, voltage = power + abs(part) * room, found.point.voltage
        raise SimulationError("the powers cannot be balanced within limits and transfers")

    def course(self, instance: Instance, times: Array) -> Array:
        """Dispatch at one time after another, within the ramp limits from the one before; (n, n_gen), pu.

        Args:
            instance: gives costs, loads and the powers at t = 0, which are near balance.
            times: ascending from 0, (n,), s; the powers at 0 are given.

        Raises:
            SimulationError: no powers within reach balance the loads.
        """
        cost, p_load = instance.cost_gen(self.case), instance.p_load(self.case, times)
        found = self.weigh(instance.p_initial(self.case), p_load[0])
        powers = [found.power]
        for load, apart in zip(p_load[1:], np.diff(times).tolist(), strict=True):
            found = self.cheapest(cost, load, found, self.case.ramp * apart)
            powers.append(found.power)
        return np.array(powers)

    def drawn(self, instance: Instance) -> Instance:
        """An instance whose powers at t = 0 are balanced, rounded as the sampler does.

        Raises:
            SimulationError: there are none within limits.
        """
        p_load = instance.p_load(self.case, np.zeros(1))[0]
        power = self.balanced(instance.p_initial(self.case), p_load).power
        by_name = dict(zip(self.case.generators, rounded(power).tolist(), strict=True))
        return instance.model_copy(update={"initial": instance.initial.model_copy(update={"power": by_name})})

    def check_kinks(self, instance: Instance, source: str) -> None:
        """Raise InputError unless powers balance the loads at 0, at every kink and at the horizon."""
        cost, times = instance.cost_gen(self.case), instance.kinks
        p_load = instance.p_load(self.case, times)
        try:
            found = self.weigh(instance.p_initial(self.case), p_load[0])
        except SimulationError as error:
            problem = f"initial loads and powers cannot be served: {error}"
            raise InputError(source, "load, initial.power", problem) from None
        for t, load in zip(times.tolist(), p_load, strict=True):
            try:
                found = self.cheapest(cost, load, found)
            except SimulationError as error:
                raise InputError(source, "load", f"loads at t = {t:g} s cannot be served: {error}") from None
