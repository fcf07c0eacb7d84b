"""What a grid answers to generator power: the swing equation at the nominal point, in its modes.

With x the generators' angles relative to those at t = 0 and the same damping rate γ for all of them,

    M ẍ + γ M ẋ + S x = P - P_0 - T (L - L_0) - r

where S and T are the reduced stiffness and load share of the nominal point, and r is all that is not in
them. In modal coordinates x = q shape each mode is an oscillator of its own, which is advanced exactly
from one fine point to the next under an input that is linear between them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ded_bench.methods.admm.iteration_records import Indices, Modes
from ded_bench.methods.admm.mode_kernels import oscillators
from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Array, Case

#: Fine points per interval between knots.
FINE = 4
#: Damping rates that differ by less than this part are the same in all but the digits of the data.
ROUND_OFF = 1e-6
#: Instants at which the stiffness along a path is taken; linear between them.
INSTANTS = 5
#: Longest time from one power flow along a path to the next, s, but for knots farther apart.
FLOWS_S = 0.8


@dataclass(frozen=True, eq=False)
class GridResponse:
    """Constants of a case and its knots."""

    knots: Array  # (n_knots,), s
    fine: Array  # fine points, FINE per interval, (n_fine,), s
    stiffness: Array  # S, (n_gen, n_gen), pu/rad
    compliance: Array  # its inverse
    share: Array  # T, (n_gen, n_load)
    gain: Array  # powers into modes, (n_gen, n_modes): v = p @ gain
    shape: Array  # modes into angles, (n_modes, n_gen): x = q @ shape
    rate: float  # γ, 1/s
    step: Array  # per mode: (q, q̇, v, v⁺) -> (q⁺, q̇⁺), (n_modes, 2, 4)
    damping: Array  # of the modes, less γ, (n_modes, n_modes), 1/s
    every: int  # from one station, where a path's power flow is solved, to the next, in knots
    instants: Indices  # knots, all stations, at which stiffness along a path is taken, (n_instants,)
    network: Network
    theta: Array  # angles of the nominal point, (n_bus,), rad

    @staticmethod
    def make(case: Case, knots: Array) -> GridResponse:
        """Linearise a case at its nominal point; knots are equidistant."""
        network = Network(case)
        theta = network.power_flow(case.p_nominal, case.load_nominal)
        linear = network.linearise(theta)
        root = np.sqrt(linear.m)
        squares, u = np.linalg.eigh(linear.stiffness / np.outer(root, root))
        rate = float(linear.d.sum() / linear.m.sum())
        other = linear.d / linear.m - rate
        other[np.abs(other) < ROUND_OFF * rate] = 0.0
        fine = np.linspace(knots[0], knots[-1], FINE * (len(knots) - 1) + 1)
        every = largest_divisor(len(knots) - 1, FLOWS_S / (knots[1] - knots[0]))
        stations = (len(knots) - 1) // every + 1
        return GridResponse(
            knots=knots,
            fine=fine,
            stiffness=linear.stiffness,
            compliance=np.asarray(np.linalg.inv(linear.stiffness)),
            share=linear.share,
            gain=u / root[:, None],
            shape=(u / root[:, None]).T.copy(),
            rate=rate,
            step=oscillators(squares, rate, float(fine[1])),
            damping=u.T @ np.diag(other) @ u,
            every=every,
            instants=every * np.linspace(0, stations - 1, min(INSTANTS, stations)).round().astype(np.int64),
            network=network,
            theta=theta,
        )

    @property
    def modes(self) -> Modes:
        """What compiled functions see of it."""
        step, half = np.ascontiguousarray(np.moveaxis(self.step, 0, 2)), 0.5 * float(self.fine[1])
        return Modes(step, half * self.damping, half, self.instants * FINE)


def largest_divisor(count: int, most: float) -> int:
    """The largest divisor of a number that is at most so large; 1 if none is."""
    return max(n for n in range(1, max(int(most + 1e-9), 1) + 1) if count % n == 0)
