"""What compiled functions of the shared policy are given, and the price by which schedules are judged."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ded_bench.problem.case import Array

Array32 = NDArray[np.float32]
#: Of either precision.
Floats = NDArray[np.floating[Any]]
Indices = NDArray[np.int_]

#: Price of one relative unit of excess of |ω| for one second, as a fraction of the instance's cost: an
#: exact penalty. docs/model.md tells how it was chosen.
PRICE = 0.1
#: Relative excess at which the price has doubled: rare large excesses count for more than many small ones.
DOUBLING = 0.05
#: Relative excess beyond which the price stays as it is: at first a few schedules are far outside.
STRAIGHT = 0.2
#: Costs are relative to the ramp-limited dispatch, but an instance is not worth more than this mean cost per
#: pair of generators.
SMALLEST_COST = 0.05


class Modes(NamedTuple):
    """The grid in modal coordinates; see `GridResponse`."""

    step: Floats  # (q, q̇, v, v⁺) -> (q⁺, q̇⁺) of each mode, (2, 4, n_modes)
    damping: Floats  # what is left of it, for half a step, (n_modes, n_modes)
    half: float  # half the spacing of fine points, s
    instants: Indices  # fine points at which stiffness changes are given, (n_instants,)


class Limits(NamedTuple):
    """Limits of a case, and what makes them comparable."""

    low: Array  # (n_gen,), pu, as the next two
    high: Array
    step: Array  # largest change between knots by ramps
    bound: float  # of |ω|, rad/s
    mass: Array  # M in means of all, (n_gen,)
    unit: float  # of powers: what ramps and the bound allow between knots, pu
    price: float  # one unit at one knot, as a part of what all generators can give at all of them
    gain: Array32  # see `GridResponse`, as the next
    shape: Array32


class Given(NamedTuple):
    """What is known of a batch before the first iteration."""

    cost: Array  # (slack, generators), as parts of `Outset.scale`, (batch, 1 + n_gen), 1/pu
    offset: Array32  # see `Linear`: (batch, n_fine, n_modes)
    slack: Array32  # (batch, n_fine), pu
    leverage: Array32  # what a mode takes from the slack, (batch, n_fine, n_modes), pu/rad
    change: Array32  # (batch, n_instants, n_modes, n_modes), 1/s²
    state: Array32  # (batch, 2, n_modes)
    mean_modes: Array  # of the mean stiffness, powers by column, (batch, n_gen, n_modes)
    mean_maps: Array  # of `interval_maps`, (batch, fine + 1, 2, 4, n_modes)
    mean_outputs: Array  # squares of ω and P_s in a mean mode, see `modal_change`, (batch, 2, n_modes)
