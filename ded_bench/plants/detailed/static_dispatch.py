"""Static dispatch: on an island the cheapest powers that balance loads and losses on the AC power flow.

Marginal losses count: the balance is that of the power flow linearised at the powers found before, until they
stay. What the balancing machine of the power flow would have to add is what the powers are short of.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog

from ded_bench.plants.detailed.power_flow import Complex, OperatingPoint
from ded_bench.plants.detailed.power_system import PowerSystem
from ded_bench.plants.plant import SimulationError
from ded_bench.problem.case import Array, Case
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule

#: Balanced is what is short of less than this, pu; powers that move by less in a program stay.
BALANCED, STAYS = 1e-9, 1e-6
#: Programs, and Newton steps, after which there is no balance.
PROGRAMS, NEWTON_STEPS = 12, 12
#: Price of powers beyond transfers, in sums of all costs.
BEYOND = 100.0
#: Programs with marginal losses of their own.
RENEWED = 4
#: Time in which what rounding and the curvature of losses leave is made up, s.
SHORTEST_S = 0.01
#: What exciters may miss their references by, pu, and steps after which they find no voltages.
REGULATED, REGULATIONS = 1e-4, 30


@dataclass(frozen=True)
class Balance:
    """Powers of all machines and loads, beside what the network makes of them."""

    power: Array  # (n_gen,), pu
    point: OperatingPoint
    short: float  # what loads and losses take beyond the powers, pu
    slopes: Array  # of `short` by the powers, (n_gen,): about -1


@dataclass(frozen=True)
class StaticDispatch:
    """Dispatch of the generators of a case, beside what secondary control holds."""

    system: PowerSystem
    held_pu: float = 0.0  # delivered beyond the powers, by all machines together

    @property
    def case(self) -> Case:
        """Whose machines are dispatched."""
        return self.system.case

    def weigh(self, power: Array, p_load: Array, guess: Complex | None = None) -> Balance:
        """Solve the power flow and say what the powers are short of.

        Args:
            power: of the generators without what secondary control holds, (n_gen,), pu.
            p_load: load injections, (n_load,), pu; other loads are nominal.
            guess: voltages to start from; None: nominal.

        Raises:
            SimulationError: the power flow has no solution.
        """
        network = self.system.network
        machines = self.system.p_machine(power) + self.held_pu * self.system.shares
        point = network.power_flow(machines, self.system.p_drawn(p_load), guess)
        slopes = network.balance_slopes(point)
        slopes[network.balancing] = -1.0
        short = float(point.power.real[network.balancing] - machines[network.balancing])
        return Balance(power, point, short, slopes[self.system.scheduled])

    def cheapest(
        self, cost: Array, p_load: Array, start: Balance, reach: Array | None = None, rough: bool = False
    ) -> Balance:
        """Cheapest powers within limits and transfers that balance loads and losses.

        Args:
            cost: (n_gen,).
            p_load: load injections, (n_load,), pu.
            start: powers and voltages near these.
            reach: how far powers may be from those of the start, (n_gen,), pu; None: anywhere. Where none
                within reach balance the loads, or keep transfers, they come as near as they can.
            rough: one program is enough, whose powers may be short of the curvature of losses, and powers
                that are out of reach are an error.

        Raises:
            SimulationError: no powers within limits balance the loads.
        """
        case = self.case
        lower, upper = case.p_min, case.p_max
        if reach is not None:
            within = start.power - reach, start.power + reach
            lower, upper = np.clip(lower, *within), np.clip(upper, *within)
        found = self.weigh(np.clip(start.power, lower, upper), p_load, start.point.voltage)
        for number in range(PROGRAMS):
            if number == RENEWED:  # else two machines of equal marginal cost may change places for ever
                slopes = found.slopes
            if number >= RENEWED:
                found = dataclasses.replace(found, slopes=slopes)
            power = self._program(cost, p_load, found, lower, upper, strict=reach is None or rough)
            if power is None:
                if reach is None or rough:
                    break
                return self.weigh(upper if found.short > 0 else lower, p_load, found.point.voltage)
            moved = float(np.abs(power - found.power).max())
            found = self.weigh(power, p_load, found.point.voltage)
            if rough or (abs(found.short) < BALANCED and moved < STAYS):
                return found
        raise SimulationError("no powers within limits and transfers balance loads and losses")

    def _program(
        self, cost: Array, p_load: Array, near: Balance, lower: Array, upper: Array, strict: bool
    ) -> Array | None:
        """Cheapest powers with the balance linearised, (n_gen,), pu; None: there are none.

        Unless `strict`, what is beyond transfers has a price where they cannot be kept. Without transfers
        they are a merit order of cost per power that arrives: machines are raised one after another from
        their lower ends until loads and losses are met.
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
        room, balance = limit - by_load @ p_load, [float(need + arrives @ lower)]
        bounds = list(zip(lower.tolist(), upper.tolist(), strict=True))
        found = linprog(cost, by_machine, room, arrives[None], balance, bounds)
        if found.x is None and not strict:
            none, prices = np.zeros(len(room)), np.full(len(room), BEYOND * max(cost.sum(), 1.0))
            rows, right = np.hstack([by_machine, -np.eye(len(room))]), np.append(arrives, none)[None]
            bounds += [(0.0, None)] * len(room)
            found = linprog(np.append(cost, prices), rows, room, right, balance, bounds)
        return None if found.x is None else np.clip(found.x[: len(cost)], lower, upper)

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
            room = np.where(free, (case.p_max if found.short > 0 else case.p_min) - power, 0.0)
            part = found.short / max(-found.slopes @ room * np.sign(found.short), 1e-300)
            if not abs(part) <= 1.0:
                break
            power, voltage = power + abs(part) * room, found.point.voltage
        raise SimulationError("the powers cannot be balanced within limits and transfers")

    def course(self, instance: Instance, times: Array) -> Array:
        """Dispatch at one time after another, on an island within the ramp limits from the one before.

        Args:
            instance: gives costs, loads and the powers at t = 0.
            times: ascending from 0, (n,), s; on an island the powers at 0 are given. What secondary control
                holds then stays, and powers are the set-points beside it.

        Returns:
            Powers, (n, n_gen), pu. Behind an infinite machine they are a merit order.

        Raises:
            SimulationError: no powers within reach balance the loads.
        """
        cost, p_load = instance.cost_gen(self.case), instance.p_load(self.case, times)
        if self.case.slack is not None:
            return merit_order(self.case, cost, instance.cost_slack(self.case), p_load)
        beside = dataclasses.replace(self, held_pu=self._held(instance))
        found = beside.weigh(instance.p_initial(self.case), p_load[0])
        powers = [found.power]
        for k, apart in enumerate(np.diff(times).tolist()):
            found = beside.after(cost, p_load[k : k + 2], found, self.case.ramp * apart)
            powers.append(found.power)
        return np.array(powers)

    def after(self, cost: Array, p_load: Array, start: Balance, reach: Array, halvings: int = 4) -> Balance:
        """Dispatch after loads have changed from one to the other, (2, n_load); other arguments: `cheapest`.

        In two steps, each within half the reach, where one is too long for the power flow: before powers
        follow, a single machine takes what loads change by.
        """
        try:
            return self.cheapest(cost, p_load[1], start, reach)
        except SimulationError:
            if not halvings:
                raise
        middle = p_load.mean(axis=0)
        half = self.after(cost, np.stack([p_load[0], middle]), start, reach / 2, halvings - 1)
        return self.after(cost, np.stack([middle, p_load[1]]), half, reach / 2, halvings - 1)

    def _held(self, instance: Instance) -> float:
        """What secondary control holds from t = 0 on, pu; it may act at once."""
        agc, control = instance.initial.agc, self.case.agc
        if agc is None or control is None:
            return 0.0
        return -control.k * agc.integral_rad if agc.next_s == 0.0 else agc.held_pu

    def regulated(self, near: Balance, p_load: Array, v_ref: Array) -> OperatingPoint:
        """The power flow whose voltages at machines are what exciters make of their references.

        They fall with the field voltage that is needed: a network can carry less with them than with nominal
        ones. References that are missed move the voltages, until none is.

        Args:
            near: the powers, with nominal voltages at machines.
            p_load: load injections, (n_load,), pu.
            v_ref: (n_machine,), pu; a machine without exciter holds its voltage.

        Raises:
            SimulationError: there is none.
        """
        system = self.system
        network, point = system.network, near.point
        sizes, port = np.abs(point.voltage), network.machine_port
        machines, drawn = self.system.p_machine(near.power), self.system.p_drawn(p_load)
        for _ in range(REGULATIONS):
            missed = np.zeros_like(sizes)  # by the mean of machines at a bus, which share its reactive power
            np.add.at(missed, port, (v_ref - system.equilibrium(point).v_ref) / np.bincount(port)[port])
            if np.abs(missed).max() < REGULATED:
                return point
            sizes = np.abs(point.voltage) + missed
            point = network.power_flow(machines, drawn, point.voltage, sizes)
        raise SimulationError("exciters find no voltages")

    def check_kinks(self, instance: Instance) -> None:
        """Raise SimulationError unless it can serve the loads at 0, at every kink and at the horizon."""
        p_load = instance.p_load(self.case, instance.kinks)
        found = self.weigh(instance.p_initial(self.case), p_load[0])
        for t, load in zip(instance.kinks.tolist(), p_load, strict=True):
            try:
                found = self._unhurried(instance, load, found)
            except SimulationError as error:
                raise SimulationError(f"loads at t = {t:g} s cannot be served: {error}") from None

    def followed(self, instance: Instance, v_ref: Array) -> Schedule:
        """Dispatch from kink to kink within ramp limits on an island, by the rule of draws.

        With the exciters' references at t = 0 the unhurried dispatch must have an equilibrium at every kink
        and a stable one at the horizon.

        Args:
            instance: of the case.
            v_ref: exciters' references, (n_machine,), pu.

        Raises:
            SimulationError: it cannot serve the loads so.
        """
        times, cost = instance.kinks, instance.cost_gen(self.case)
        p_load = instance.p_load(self.case, times)
        found = following = self.weigh(instance.p_initial(self.case), p_load[0])
        powers = [found.power]
        for number, load in enumerate(p_load):
            found = self._unhurried(instance, load, found)
            point = self.regulated(found, load, v_ref)
            if number:
                reach = self.case.ramp * max(times[number] - times[number - 1], SHORTEST_S)
                following = self.cheapest(cost, load, following, reach, True)
                powers.append(following.power)
        if not self.system.stable(point):
            raise SimulationError("the equilibrium at the horizon is not stable")
        return Schedule(times, np.array(powers))

    def _unhurried(self, instance: Instance, p_load: Array, near: Balance) -> Balance:
        """Dispatch without ramp limits."""
        cost = instance.cost_gen(self.case)
        if self.case.slack is None:
            return self.cheapest(cost, p_load, near, rough=True)
        power = merit_order(self.case, cost, instance.cost_slack(self.case), p_load)
        return self.weigh(power, p_load, near.point.voltage)
