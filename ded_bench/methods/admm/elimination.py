"""How buses of a network are eliminated: their order, and what lines that makes (power flow, Kron reduction).

Eliminating a bus whose lines have weights w_i turns this star into a mesh of lines of weights w_i w_j / Σ w.
Buses of few lines go first (minimum degree), so that networks of hundreds of buses stay sparse.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from ded_bench.methods.admm.iteration_records import Indices


class Elimination(NamedTuple):
    """A plan of elimination. An edge is named by its place in `neighbours`; each has one place."""

    buses: Indices  # in their order, (n,)
    first: Indices  # place of each bus's first edge, and one past the last, (n + 1,)
    kept: Indices  # place of its first edge to a bus that is kept; these come last, (n,)
    neighbours: Indices  # where edges lead, (n_edges,)
    fill: Indices  # edge of each mesh line, for pairs of edges the first of which leads to no kept bus
    of_line: Indices  # edge of each line, -1 between two kept buses, (n_line,)


def plan_elimination(ends: Indices, n_bus: int, kept: Iterable[int]) -> Elimination:
    """Order all buses but those that are kept.

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
