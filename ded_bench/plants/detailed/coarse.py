"""An island of the detailed plant in coarse steps: exponentials of the equations linearised at nominal.

With A the Jacobian at the nominal point, N(x) what rates are beyond A x and their linear answer to loads, and
r the exact linear answer to set-points and loads over a step h,

    x⁺ = exp(A h) x + h φ_1 (3 N - N⁻) / 2 + r,

N⁻ being that of the step before (Adams-Bashforth behind the exponential of what is linear; Hochbruck and
Ostermann, Acta Numerica 2010, have others of order 2). N is small and changes slowly, so that a step may be
a hundred times that of an exact simulation. For planning, never for judging.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.linalg import expm

from ded_bench.files.errors import InputError
from ded_bench.plants.detailed import machine_arrays as at
from ded_bench.plants.detailed.equations import (
    CompiledNetwork,
    LoadSlopes,
    machine_rates,
    mean_angle,
    renew,
    solve_voltages,
    sources,
)
from ded_bench.plants.detailed.machine_arrays import MachineArrays
from ded_bench.plants.detailed.power_system import DetailedState, PowerSystem, interleaved
from ded_bench.plants.detailed.start import start
from ded_bench.plants.plant import SimulationError
from ded_bench.problem.compiled import compiled, copy_row
from ded_bench.problem.quantities import Array, Array32, Indices

if TYPE_CHECKING:
    from ded_bench.problem.instance import Instance

#: Voltages are solved for less sharply than where schedules are judged, pu, in at most so many steps.
CHANGE, STEPS = 1e-4, 30
#: Step of differences of loads, pu.
DIFFERENCE = 1e-6
#: Loads are linear between so many points of a step.
PARTS = 2
#: States that rates do not depend on linearly.
CURVED = (at.DELTA, at.E1Q, at.E1D, at.E2D, at.E2Q)


class CoarseMaps(NamedTuple):
    """One step; deviations from the nominal point of the states that move."""

    moving: Indices  # places of these states in a flat state array, (n,)
    seen: Indices  # those of them whose rates are not linear, (n_seen,)
    curved: Indices  # of the states that move, those that N depends on, (n_curved,)
    onward: Array | Array32  # exp(A h), and h φ_1 of what is seen, (n, n + n_seen)
    slopes: Array | Array32  # A, (n_seen, n_curved), 1/s
    by_load: Array  # of rates by loads drawn, (n_seen, n_load)
    x: Array  # nominal states, (N_STATES, n_machine)
    v: Array  # nominal voltages, (2 n_port,), pu
    drawn: Array  # nominal loads, (n_load,), pu
    load: LoadSlopes  # at nominal voltages
    p_ref: Array  # nominal references of governors, (n_machine,), pu
    held: Array  # answer to what secondary control holds, (n,)
    gain: float  # of secondary control, pu/rad
    period: int  # steps from one of its times to the next


class CoarseStart(NamedTuple):
    """What an instance says, whatever the set-points."""

    x: Array  # states at t = 0, (N_STATES, n_machine)
    v_ref: Array  # exciters' references, (n_machine,), pu
    drawn: Array  # loads at the points, (n_steps + 1, n_load), pu
    by_drawn: Array  # linear answer of rates to them, (n_steps + 1, n_seen)
    push: Array | Array32  # linear answer to loads, and to governors' offsets, over each step, (n_steps, n)
    held: float  # what secondary control holds at t = 0, pu
    first: int  # step at which it acts next


@dataclass(frozen=True)
class CoarsePlant:
    """An island of one case in steps of `spacing_s`; deviations have double precision, or single.

    Raises:
        InputError: secondary control acts between steps.
    """

    system: PowerSystem
    spacing_s: float
    single: bool = False

    @property
    def _number(self) -> type[np.floating[Any]]:
        return np.float32 if self.single else np.float64

    @functools.cached_property
    def _linear(self) -> tuple[Array, Array, Array]:
        """A, and the slopes of rates by governors' references and by loads drawn."""
        system, (x, v, drawn, p_ref, v_ref) = self.system, self._nominal
        n, network = len(system.data), system.compiled_network
        a = system.slopes(x, v.view(np.complex128), system.network.nominal().p_drawn).rates
        by_reference, by_load = np.zeros((len(a), n)), np.empty((len(a), len(drawn)))
        for i in range(n):
            by_reference[np.flatnonzero(system.moving == at.GATE * n + i), i] = system.data.rate_g[i]
        load, source = LoadSlopes(np.empty((len(drawn), 4)), np.empty((len(v), len(v)))), np.empty(len(v))
        sources(system.data, x, source)
        for j, one in enumerate(np.eye(len(drawn))):
            rates = np.empty((2, *x.shape))
            for moved, found in zip((drawn + DIFFERENCE * one, drawn - DIFFERENCE * one), rates, strict=True):
                there = v.copy()
                renew(network, moved, v, load)
                solve_voltages(network, moved, source, load, there, STEPS)
                machine_rates(system.data, x, there, p_ref, v_ref, found, np.empty(n))
            by_load[:, j] = ((rates[0] - rates[1]) / (2.0 * DIFFERENCE)).ravel()[system.moving]
        return a, by_reference, by_load

    @functools.cached_property
    def _nominal(self) -> tuple[Array, Array, Array, Array, Array]:
        """States, voltages, loads drawn, references of governors and of exciters."""
        system = self.system
        point = system.network.nominal()
        x, v_ref = system.equilibrium(point)
        mean = float(system.data.inertia @ x[at.DELTA])
        x[at.DELTA] -= mean
        v = interleaved(point.voltage * np.exp(-1j * mean))
        return x, v, point.p_drawn[: system.network.n_load_port].copy(), point.power.real.copy(), v_ref

    def _holds(self, duration: float) -> tuple[Array, Array, Array]:
        """exp(A dt), dt φ_1 and dt φ_2: the first row of blocks of one exponential."""
        n = len(self._linear[0])
        blocks = np.zeros((3 * n, 3 * n))
        blocks[:n, :n] = self._linear[0] * duration
        blocks[: 2 * n, n:] += np.eye(2 * n)
        f, first, second = np.hsplit(expm(blocks)[:n], 3)
        return f, duration * first, duration * second

    @functools.cached_property
    def maps(self) -> CoarseMaps:
        """One step."""
        system, (a, by_reference, by_load) = self.system, self._linear
        f, first, _ = self._holds(self.spacing_s)
        seen = np.flatnonzero(np.abs(by_load).max(axis=1) > 0.0)
        curved = np.flatnonzero(np.isin(system.moving // len(system.data), CURVED))
        x, v, drawn, p_ref, _ = self._nominal
        load = LoadSlopes(np.empty((len(drawn), 4)), np.empty((len(v), len(v))))
        renew(system.compiled_network, drawn, v, load)
        agc, period, gain = self.system.case.agc, 2**40, 0.0
        if agc is not None:
            period, gain = round(agc.period_s / self.spacing_s), agc.k
            if abs(period * self.spacing_s - agc.period_s) > 1e-9:
                problem = f"acts between steps of {self.spacing_s:g} s"
                raise InputError(f"case {self.system.case.id}", "plant.agc", problem)
        return CoarseMaps(
            system.moving,
            seen,
            curved,
            np.ascontiguousarray(np.hstack([f, first[:, seen]]), dtype=self._number),
            np.ascontiguousarray(a[np.ix_(seen, curved)], dtype=self._number),
            np.ascontiguousarray(by_load[seen]),
            *(x, v, drawn, load, p_ref),
            first @ by_reference @ self.system.shares,
            gain,
            period,
        )

    @functools.cached_property
    def _inputs(self) -> tuple[Array, Array]:
        """h φ_1 and h φ_2 of all governors' references, (n, n_machine)."""
        _, first, second = self._holds(self.spacing_s)
        by_reference = self._linear[1]
        return (first @ by_reference).astype(self._number), (second @ by_reference).astype(self._number)

    @functools.cached_property
    def _load_answer(self) -> Array:
        """What loads at all parts of a step add to the state, ((PARTS + 1) n_load, n)."""
        f, first, second = self._holds(self.spacing_s / PARTS)
        by_load, after = self._linear[2], np.eye(len(f))
        answer = np.zeros((PARTS + 1, by_load.shape[1], len(f)))
        for part in range(PARTS - 1, -1, -1):
            answer[part] += (after @ (first - second) @ by_load).T
            answer[part + 1] += (after @ second @ by_load).T
            after = after @ f
        return answer.reshape(-1, len(f)).astype(self._number)

    def begin(self, instance: Instance, state: DetailedState | None = None) -> CoarseStart:
        """What an instance says, from its own state at t = 0 or another.

        Raises:
            InputError, SimulationError: see `start`.
        """
        system, maps = self.system, self.maps
        state = start(system, instance) if state is None else state
        n = round(instance.horizon_s / self.spacing_s)
        times = np.linspace(0.0, instance.horizon_s, n * PARTS + 1)
        drawn = system.p_drawn(instance.p_load(system.case, times))
        drawn = np.ascontiguousarray(drawn[:, : len(maps.drawn)])
        change = (drawn - maps.drawn).astype(self._number)
        windows = np.lib.stride_tricks.sliding_window_view(change, PARTS + 1, axis=0)[::PARTS]
        push = windows.swapaxes(1, 2).reshape(n, -1) @ self._load_answer
        push += self._inputs[0] @ (state.offset - maps.p_ref).astype(self._number)
        first = round(state.next_s / self.spacing_s) if system.case.agc is not None else maps.period
        at_points = drawn[::PARTS].copy()
        by_drawn = (at_points - maps.drawn) @ maps.by_load.T
        return CoarseStart(state.x, state.v_ref, at_points, by_drawn, push, state.held, first)

    def follow(self, begun: CoarseStart, p_set: Array, linear: bool = False) -> tuple[Array, Array]:
        """Frequencies and delivered powers at the points, (n_points, n_gen), rad/s and pu.

        Args:
            begun: the instance.
            p_set: set-points at the points, (n_points, n_gen), pu; linear between them.
            linear: N stays what it is at t = 0.

        Raises:
            SimulationError: the network has no voltages any more.
        """
        system, machines = self.system, self.system.scheduled
        first, second = (part[:, machines].T for part in self._inputs)
        level, change = (part.astype(self._number) for part in (p_set[:-1], np.diff(p_set, axis=0)))
        push = begun.push + level @ first + change @ second
        states = np.empty((len(p_set), *begun.x.shape))
        network = system.compiled_network if linear else system.compiled_network._replace(change=CHANGE)
        if advance(system.data, network, self.maps, begun, push, linear, states) < len(states):
            raise SimulationError("the network has no voltages any more")
        omega = states[:, at.SPEED, machines] * system.data.omega_0[machines]
        return omega, self.system.turbines(states)[:, machines]

    def response(self, p_set: Array, agc: bool = True) -> tuple[Array, Array]:
        """The linear answer from rest to changes of set-points.

        Args:
            p_set: at the points, (n_points, n_gen, n_changes), pu.
            agc: with secondary control.

        Returns:
            Frequencies, (n_points, n_gen, n_changes), rad/s; delivered powers likewise, pu.
        """
        maps, data, machines = self.maps, self.system.data, self.system.scheduled
        n, n_changes = len(maps.moving), p_set.shape[2]
        first, second = (part[:, machines] for part in self._inputs)
        x, held = np.zeros((n, n_changes)), np.zeros(n_changes)
        states = np.zeros((n_changes, *maps.x.shape))
        omega, delivered = np.empty(p_set.shape), np.empty(p_set.shape)
        for k in range(len(p_set)):
            states.reshape(n_changes, -1)[:, maps.moving] = x.T
            omega[k] = (states[:, at.SPEED, machines] * data.omega_0[machines]).T
            delivered[k] = self.system.turbines(states)[:, machines].T
            if agc and k and k % maps.period == 0:
                held = -maps.gain * (states[:, at.DELTA] @ data.inertia)
            after = p_set[min(k + 1, len(p_set) - 1)]
            x = maps.onward[:, :n] @ x + np.outer(maps.held, held)
            x += first @ p_set[k] + second @ (after - p_set[k])
        return omega, delivered


@compiled
def advance(
    data: MachineArrays,
    network: CompiledNetwork,
    maps: CoarseMaps,
    begun: CoarseStart,
    push: Array | Array32,
    linear: bool,
    states: Array,
) -> int:
    """Integrate; `states` receives those at all points, (n_steps + 1, N_STATES, n_machine).

    Returns:
        The number of points computed: less than all where the network's equations have no solution.
    """
    n, n_seen, n_machine = len(maps.moving), len(maps.seen), begun.x.shape[1]
    state, rates, p_e = begun.x.copy(), np.zeros_like(begun.x), np.empty(n_machine)
    flat, changing, nominal = state.ravel(), rates.ravel(), maps.x.ravel()
    source, v = np.empty(len(maps.v)), maps.v.copy()
    last = v.copy()
    both, bent = np.zeros(n + n_seen, maps.onward.dtype), np.empty(len(maps.curved), maps.onward.dtype)
    sloped, after = np.empty(n_seen, maps.onward.dtype), np.empty(n, maps.onward.dtype)
    before, held = np.zeros(n_seen), begun.held
    for i in range(n):
        both[i] = flat[maps.moving[i]] - nominal[maps.moving[i]]
        flat[maps.moving[i]] = nominal[maps.moving[i]]
    for k in range(len(states)):
        now = states[k].ravel()
        copy_row(flat, now)
        for i in range(n):
            now[maps.moving[i]] = nominal[maps.moving[i]] + both[i]
        for i in range(len(bent)):  # rates are linear in all others, which stay nominal here
            bent[i] = both[maps.curved[i]]
            flat[maps.moving[maps.curved[i]]] = nominal[maps.moving[maps.curved[i]]] + bent[i]
        if k + 1 == len(states):
            break
        if k >= begun.first and (k - begun.first) % maps.period == 0:
            held = -maps.gain * mean_angle(data, state)
        if k == 0 or not linear:
            sources(data, state, source)
            for i in range(2 * len(maps.drawn)):
                last[i], v[i] = v[i], 2.0 * v[i] - last[i] if k > 1 else v[i]
            if solve_voltages(network, begun.drawn[k], source, maps.load, v, STEPS) > STEPS:
                return k
            machine_rates(data, state, v, maps.p_ref, begun.v_ref, rates, p_e)
            np.dot(maps.slopes, bent, sloped)
            for i in range(n_seen):
                new = changing[maps.moving[maps.seen[i]]] - sloped[i] - begun.by_drawn[k, i]
                both[n + i] = 1.5 * new - 0.5 * before[i] if k else new
                before[i] = new
        np.dot(maps.onward, both, after)
        for i in range(n):
            both[i] = after[i] + push[k, i] + held * maps.held[i]
    return len(states)
