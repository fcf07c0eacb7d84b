"""The network along a trajectory, compiled: power flow, electrical power, stiffness.

Power flow and Kron reduction eliminate buses. A bus whose lines have weights w_i is a star; without it there
is a mesh of lines of weights w_i w_j / Σ w. Buses of few lines go first (minimum degree), so that networks of
hundreds of buses stay sparse.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from ded_bench.methods.admm.modal_kernels import Indices
from ded_bench.problem.case import Array
from ded_bench.problem.compiled import compiled

#: Mismatch of a power flow that is good enough here, pu, and the steps after which it is given up.
MISMATCH, STEPS = 1e-5, 60
#: The Jacobian is renewed where a step makes the mismatch smaller by less than this factor.
CONTRACTION = 0.3


class Lines(NamedTuple):
    """A lossless network."""

    ends: Indices  # (n_line, 2)
    coupling: Array  # (n_line,), pu
    generators: Indices  # buses, (n_gen,)
    loads: Indices  # buses, (n_load,)


class Elimination(NamedTuple):
    """A plan of elimination. An edge is named by its place in `neighbours`; each has one place."""

    buses: Indices  # in their order, (n,)
    first: Indices  # place of each bus's first edge, and one past the last, (n + 1,)
    kept: Indices  # place of its first edge to a bus that is kept; these come last, (n,)
    neighbours: Indices  # where edges lead, (n_edges,)
    fill: Indices  # edge of each mesh line, for pairs of edges the first of which leads to no kept bus
    of_line: Indices  # edge of each line, -1 between two kept buses, (n_line,)


def plan_elimination(ends: Indices, n_bus: int, kept: Iterable[int]) -> Elimination:
    """Order all buses but those that are kept, and say what lines that makes.

    Args:
        ends: of the lines, (n_line, 2).
        n_bus: how many buses there are.
        kept: those that stay.
    """
    linked: list[set[int]] = [set() for _ in range(n_bus)]
    for near, far in ends.tolist():
        linked[near].add(far)
        linked[far].add(near)
    stay = set(kept)
    left, buses, stars = set(range(n_bus)) - stay, [], []
    while left:
        bus = min(left, key=lambda one: (len(linked[one]), one))
        left.remove(bus)
        star = sorted(linked[bus], key=lambda one: (one in stay, one))
        buses.append(bus)
        stars.append(star)
        for one in star:
            linked[one].remove(bus)
            linked[one].update(other for other in star if other != one)
    first = np.cumsum([0, *map(len, stars)])
    place = {
        frozenset((bus, one)): start + i
        for bus, star, start in zip(buses, stars, first.tolist(), strict=False)
        for i, one in enumerate(star)
    }
    inner = [sum(one not in stay for one in star) for star in stars]
    fill = [
        place[frozenset((star[i], other))]
        for star, n in zip(stars, inner, strict=True)
        for i in range(n)
        for other in star[i + 1 :]
    ]
    return Elimination(
        buses=np.array(buses, dtype=np.int64),
        first=first,
        kept=first[:-1] + np.array(inner, dtype=np.int64),
        neighbours=np.array([one for star in stars for one in star], dtype=np.int64),
        fill=np.array(fill, dtype=np.int64),
        of_line=np.array([place.get(frozenset(line), -1) for line in ends.tolist()], dtype=np.int64),
    )


@compiled
def start_angles(lines: Lines, plan: Elimination, nominal: Array, wanted: Array, theta: Array) -> bool:
    """Solve the power flow of one instance by Newton's method.

    Args:
        lines: the network.
        plan: eliminates all buses but the slack.
        nominal: angles to start from, (n_bus,), rad.
        wanted: injections at all buses, (n_bus,), pu.
        theta: receives the angles, (n_bus,), rad.

    Returns:
        Whether there is a solution, a stable one.
    """
    theta[:] = nominal
    f, off = np.empty(len(theta)), np.empty(len(theta))
    weights, totals = np.empty(len(plan.neighbours)), np.empty(len(plan.buses))
    if not _solve_flow(lines, plan, wanted, theta, f, off, weights, totals, False):
        return False
    for i in range(len(lines.coupling)):
        if abs(theta[lines.ends[i, 0]] - theta[lines.ends[i, 1]]) > 0.5 * np.pi:
            return False
    return True


@compiled
def follow_trajectory(
    lines: Lines,
    plan: Elimination,
    angles: Array,
    p_load: Array,
    theta: Array,
    taken: Indices,
    f: Array,
    stiffness: Array,
) -> bool:
    """Electrical power of the generators along a trajectory of their angles, and its derivative.

    Args:
        lines: the network.
        plan: eliminates all buses but generators and slack.
        angles: of the generators at the power flows, (n_flows, n_gen), rad.
        p_load: load injections there, (n_flows, n_load), pu.
        theta: angles of all buses near the first ones, (n_bus,), rad.
        taken: at which power flows the derivative is taken; the first is one, (n_stiffness,).
        f: receives electrical powers of the generators, (n_flows, n_gen), pu.
        stiffness: receives ∂f/∂θ of the generators, (n_stiffness, n_gen, n_gen), pu/rad.

    Returns:
        Whether there is a solution all along.
    """
    n, n_bus = len(plan.buses), len(theta)
    angle, injection, wanted, off = theta.copy(), np.empty(n_bus), np.zeros(n_bus), np.empty(n_bus)
    before, change, at, known = theta.copy(), np.zeros(n_bus), 0, False
    weights, totals = np.empty(len(plan.neighbours)), np.empty(n)
    for k in range(len(angles)):
        for g in range(angles.shape[1]):
            angle[lines.generators[g]] = angles[k, g]
        for i in range(len(lines.loads)):
            wanted[lines.loads[i]] = p_load[k, i]
        for i in range(n):
            bus = plan.buses[i]
            angle[bus] = before[bus] + change[bus]
        if not _solve_flow(lines, plan, wanted, angle, injection, off, weights, totals, known):
            return False
        known = True
        for i in range(n):
            bus = plan.buses[i]
            change[bus] = angle[bus] - before[bus] if k > 0 else 0.0
            before[bus] = angle[bus]
        for g in range(angles.shape[1]):
            f[k, g] = injection[lines.generators[g]]
        if at < len(taken) and taken[at] == k:
            if not _factorise(lines, plan, angle, weights, totals):
                return False
            _reduce(lines, plan, angle, weights, totals, stiffness[at])
            at += 1
    return True


@compiled
def _solve_flow(
    lines: Lines,
    plan: Elimination,
    wanted: Array,
    theta: Array,
    f: Array,
    off: Array,
    weights: Array,
    totals: Array,
    known: bool,
) -> bool:
    """Angles of the eliminated buses for injections wanted there, by Newton's method; whether it converges.

    The Jacobian is that of the last call, if it is known, until a step does not contract.

    Args:
        lines: the network.
        plan: which buses are solved for.
        wanted: at all buses, (n_bus,), pu.
        theta: where to start; receives the angles, (n_bus,), rad.
        f: receives the injections, (n_bus,), pu.
        off: for intermediate values, (n_bus,).
        weights: of `_factorise`, likewise.
        totals: likewise.
        known: whether weights and totals hold a Jacobian.
    """
    last = np.inf
    for _ in range(STEPS):
        _injections(lines, theta, f)
        worst = 0.0
        for i in range(len(plan.buses)):
            bus = plan.buses[i]
            off[bus] = f[bus] - wanted[bus]
            if not abs(off[bus]) < 1e6:  # nor NaN
                return False
            worst = max(worst, abs(off[bus]))
        if worst < MISMATCH:
            return True
        if not known or worst > CONTRACTION * last:
            if not _factorise(lines, plan, theta, weights, totals):
                return False
            known = True
        last = worst
        _substitute(plan, weights, totals, off)
        for i in range(len(plan.buses)):
            theta[plan.buses[i]] -= off[plan.buses[i]]
    return False


@compiled
def _injections(lines: Lines, theta: Array, f: Array) -> None:
    """f(θ) at all buses, pu."""
    f[:] = 0.0
    for i in range(len(lines.coupling)):
        near, far = lines.ends[i, 0], lines.ends[i, 1]
        flow = lines.coupling[i] * np.sin(theta[near] - theta[far])
        f[near] += flow
        f[far] -= flow


@compiled
def _factorise(lines: Lines, plan: Elimination, theta: Array, weights: Array, totals: Array) -> bool:
    """Eliminate buses from ∂f/∂θ.

    Args:
        lines: the network.
        plan: of elimination.
        theta: angles, (n_bus,), rad.
        weights: receives those of all edges when one of their buses is eliminated, (n_edges,), pu/rad.
        totals: receives the inverse of the sum at each eliminated bus, (n,), rad/pu.

    Returns:
        Whether there is a factorisation.
    """
    weights[:] = 0.0
    for i in range(len(lines.coupling)):
        if plan.of_line[i] >= 0:
            apart = theta[lines.ends[i, 0]] - theta[lines.ends[i, 1]]
            weights[plan.of_line[i]] += lines.coupling[i] * np.cos(apart)
    at = 0
    for k in range(len(plan.buses)):
        total = 0.0
        for e in range(plan.first[k], plan.first[k + 1]):
            total += weights[e]
        if total == 0.0:
            return False
        totals[k] = 1.0 / total
        for e in range(plan.first[k], plan.kept[k]):
            share = weights[e] * totals[k]
            for other in range(e + 1, plan.first[k + 1]):
                weights[plan.fill[at]] += share * weights[other]
                at += 1
    return True


@compiled
def _substitute(plan: Elimination, weights: Array, totals: Array, values: Array) -> None:
    """Powers at eliminated buses to their angles, with those of `_factorise`, in place; (n_bus,)."""
    for k in range(len(plan.buses)):
        values[plan.buses[k]] *= totals[k]
        for e in range(plan.first[k], plan.kept[k]):
            values[plan.neighbours[e]] += weights[e] * values[plan.buses[k]]
    for k in range(len(plan.buses) - 1, -1, -1):
        for e in range(plan.first[k], plan.kept[k]):
            values[plan.buses[k]] += totals[k] * weights[e] * values[plan.neighbours[e]]


@compiled
def _reduce(
    lines: Lines, plan: Elimination, theta: Array, weights: Array, totals: Array, stiffness: Array
) -> None:
    """∂f/∂θ of the generators where the loads fix the other angles, pu/rad: Kron reduction."""
    own = np.full(len(theta), -1)
    for g in range(len(lines.generators)):
        own[lines.generators[g]] = g
    stiffness[:] = 0.0
    for i in range(len(lines.coupling)):
        near, far = own[lines.ends[i, 0]], own[lines.ends[i, 1]]
        if near >= 0 or far >= 0:
            slope = lines.coupling[i] * np.cos(theta[lines.ends[i, 0]] - theta[lines.ends[i, 1]])
            if near >= 0:
                stiffness[near, near] += slope
            if far >= 0:
                stiffness[far, far] += slope
            if near >= 0 and far >= 0:
                stiffness[near, far] -= slope
                stiffness[far, near] -= slope
    for k in range(len(plan.buses)):
        for e in range(plan.kept[k], plan.first[k + 1]):
            g = own[plan.neighbours[e]]
            if g >= 0:
                share = weights[e] * totals[k]
                for other in range(plan.kept[k], plan.first[k + 1]):
                    h = own[plan.neighbours[other]]
                    if h >= 0:
                        stiffness[g, h] -= share * weights[other]
