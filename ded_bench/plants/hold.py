"""Maps of a linear model from grid point to grid point under inputs that are linear between them.

First-order hold: x⁺ = f x + g u + h Δu, one map for each of several intervals; over many steps by doubling.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ded_bench.problem.quantities import Array, Indices

#: Terms of the exponential series below this are left out; doubles resolve no more.
SERIES_END = 1e-18


class Hold(NamedTuple):
    """x⁺ = f x + g u + h Δu over some grid steps: u is the input at their start, Δu its change per step.

    Arrays have one map for each of several intervals.
    """

    f: Array  # (n_maps, n_state, n_state)
    g: Array  # (n_maps, n_state, n_gen)
    h: Array  # (n_maps, n_state, n_gen)

    def then(self, other: Hold, steps: int) -> Hold:
        """This map over `steps` steps, followed by another one."""
        g = other.f @ self.g + other.g
        return Hold(other.f @ self.f, g, other.f @ self.h + steps * other.g + other.h)

    def take(self, chosen: Indices) -> Hold:
        """The maps of some intervals."""
        return Hold(self.f[chosen], self.g[chosen], self.h[chosen])


class Sums(NamedTuple):
    """Rows in x, u and Δu per step at some grid point, one or several for each interval."""

    x: Array  # (..., n_state)
    u: Array  # (..., n_gen)
    slope: Array  # (..., n_gen)

    @staticmethod
    def of(x: Array, u: Array) -> Sums:
        """Rows in x and u alone."""
        return Sums(x, u, np.zeros_like(u))

    def take(self, chosen: Indices) -> Sums:
        """Some of the rows."""
        return Sums(*(part[chosen] for part in self))

    def after(self, first: Hold, steps: int) -> Sums:
        """As rows in what is `steps` steps earlier, the map over which is `first`: (n_maps, n_rows, ...)."""
        x, u, slope = (self.x @ part for part in first)
        return Sums(x, u + self.u, slope + steps * self.u + self.slope)


def doubled(step: Hold, lengths: Indices) -> tuple[Hold, ...]:
    """Maps over 1, 2, 4, ... grid steps of intervals of so many; zero where an interval is shorter."""
    powers = [step]
    while (steps := 2 ** len(powers)) <= lengths.max():
        long = np.flatnonzero(lengths >= steps)
        last, twice = powers[-1].take(long), Hold(*(np.zeros(part.shape) for part in step))
        for whole, part in zip(twice, last.then(last, steps // 2), strict=True):
            whole[long] = part
        powers.append(twice)
    return tuple(powers)


def across_intervals(powers: tuple[Hold, ...], lengths: Indices) -> Hold:
    """Maps over whole intervals of so many grid steps, from those of `doubled`."""
    across = Hold(*(np.empty(part.shape) for part in powers[0]))
    for length in np.unique(lengths).tolist():
        chosen = np.flatnonzero(lengths == length)
        first, *bits = (bit for bit in range(len(powers)) if length >> bit & 1)
        total, done = powers[first].take(chosen), 2**first
        for bit in bits:
            total, done = total.then(powers[bit].take(chosen), done), done + 2**bit
        for whole, of_length in zip(across, total, strict=True):
            whole[chosen] = of_length
    return across


def series_step(
    derivative: Callable[[Array], Array], n_maps: int, n_state: int, size: float
) -> tuple[Array, Array, Array]:
    """exp(A dt), φ_1 and φ_2 of several A by the series, where A dt is known by its products alone.

    φ_2 = Σ (A dt)^i / (i + 2)!, φ_1 = I + A dt φ_2 and exp(A dt) = I + A dt φ_1; with these the first-order
    hold of dx/dt = A x + B u is f = exp(A dt), g = dt φ_1 B, h = dt φ_2 B.

    Args:
        derivative: A dt times a value of shape (n_maps, n_state, n_state).
        n_maps: how many A.
        n_state: their size.
        size: a bound of |A dt| in some norm.

    Returns:
        Each of shape (n_maps, n_state, n_state).
    """
    eye = np.broadcast_to(np.eye(n_state), (n_maps, n_state, n_state))
    term, total, degree, remainder = eye / 2.0, eye / 2.0, 0, 1.0
    while remainder > SERIES_END:
        degree += 1
        term = derivative(term) / (degree + 2)
        total = total + term
        remainder *= size / degree
    first = eye + derivative(total)
    return eye + derivative(first), first, total


def repeated(step: Hold, times: int) -> Hold:
    """Maps over several steps, from those over one."""
    lengths = np.full(len(step.f), times)
    return across_intervals(doubled(step, lengths), lengths)
