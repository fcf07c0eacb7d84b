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

#: Hidden channels of each kind that are averaged over other generators.
MIXED = 4
#: Outputs of a stage that are corrections; the others are its memory.
CORRECTIONS = 4
#: Price of one relative unit of excess of |ω| for one second, as a fraction of the instance's cost: an
#: exact penalty, above nearly all of the optimum's multipliers.
PRICE = 0.08
#: Relative excess at which the price has doubled: rare large excesses count for more than many small ones.
DOUBLING = 0.05
#: Relative excess beyond which the price stays as it is: at first a few schedules are far outside.
STRAIGHT = 0.2
#: Costs are relative to the static dispatch, but an instance is not worth more than this mean cost per pair
#: of generators.
SMALLEST_COST = 0.05


class Modes(NamedTuple):
    """The grid in modal coordinates; see `GridResponse`."""

    step: Floats  # per mode: (q, q̇, v, v⁺) -> (q⁺, q̇⁺), (n_modes, 2, 4)
    damping: Floats  # what is left of it, (n_modes, n_modes), 1/s
    half: float  # half the spacing of fine points, s
    instants: Indices  # fine points at which stiffness changes are given, (n_instants,)


class Units(NamedTuple):
    """Limits of a case, and the units in which a stage sees powers; matrices are (n_gen, n_gen)."""

    low: Array  # (n_gen,), pu, as the next four
    high: Array
    step: Array  # largest change between knots by ramps
    unit: Array  # the same by ramps and the bound on |ω|
    pace: Array  # factor of corrections, smaller where swings are faster than knots
    turn: float  # angle that the bound allows between knots, rad
    bound: float  # rad/s
    stiffness: Array
    compliance: Array
    by_stiffness: Array32
    by_compliance: Array32
    gain: Array32  # see `GridResponse`, as the next
    shape: Array32


class Given(NamedTuple):
    """What is known of a batch before the first stage."""

    cost: Array  # (slack, generators), in means of all, (batch, 1 + n_gen)
    static: Array  # (batch, n_gen, n_knots), pu, as the next
    fixed: Array
    offset: Array32  # see `Linear`: (batch, n_fine, n_gen), pu
    slack: Array32  # (batch, n_fine), pu
    leverage: Array32  # what a mode takes from the slack, (batch, n_fine, n_modes), pu/rad
    change: Array32  # (batch, n_instants, n_modes, n_modes), 1/s²
    state: Array32  # (batch, 2, n_modes)
    constant: Array32  # of each generator, (batch, n_gen, n_constant)
    scale: Array  # mean cost of the static dispatch, in means of all costs, (batch,)


class Weights(NamedTuple):
    """Weights of all stages, the stage first, then blocks; but for `constant`, matrices map columns."""

    first: Array32  # of knots before, here and after, (n_stages, 3 width, n_sequence)
    constant: Array32  # (n_stages, n_constant, width)
    times: Array32  # what depends on the knot alone, (n_stages, width, n_knots)
    spread: Array32  # as `first`, (n_stages, n_blocks, 3 width, width)
    spread_bias: Array32  # (n_stages, n_blocks, width)
    mix: Array32  # (n_stages, n_blocks, width, width + 3 MIXED)
    mix_bias: Array32  # (n_stages, n_blocks, width)
    last: Array32  # (n_stages, CORRECTIONS + n_memory, width)
    last_bias: Array32  # (n_stages, CORRECTIONS + n_memory)
