"""Radau IIA collocation with three points: its points, weights and polynomials."""

from __future__ import annotations

import math

import numpy as np

from ded_bench.problem.case import Array

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
