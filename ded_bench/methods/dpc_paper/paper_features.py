"""What a policy sees of an instance: the paper's parameters ζ = (loads, c, x_0, P_0)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ded_bench.methods.dpc.inputs import Inputs
from ded_bench.methods.dpc.kernels import power_flow
from ded_bench.problem.case import Array
from ded_bench.problem.instance import Instance
from ded_bench.truth.network import MISMATCH, NEWTON_STEPS, Network


@dataclass(frozen=True, eq=False)
class Features:
    """Raw inputs of a batch of instances, in the units of the files."""

    p_load: Array  # loads at the knots, (batch, n_knots, n_load), pu
    cost: Array  # (slack, generators), (batch, 1 + n_gen)
    state: Array  # x_0 = (θ without slack, P_s, ω), (batch, n_bus - 1 + 1 + n_gen)
    p_initial: Array  # P_0, (batch, n_gen), pu

    @staticmethod
    def of(network: Network, instances: Sequence[Instance], knots: Array) -> Features:
        """Collect the features of instances; solves one power flow for all of them."""
        inputs = Inputs.of(network.case, instances)
        p_load, p_initial = inputs.p_load(knots), inputs.p_initial
        theta = _angles(network, p_initial, p_load[:, 0])
        p_slack = -p_initial.sum(axis=1) - p_load[:, 0].sum(axis=1)
        state = np.concatenate([theta[:, network.unknown], p_slack[:, None], inputs.omega], axis=1)
        return Features(p_load, inputs.cost, state, p_initial)

    def channels(self) -> Array:
        """All features as channels over the knots, constants repeated, (batch, n_channels, n_knots)."""
        constant = np.concatenate([self.cost, self.state, self.p_initial], axis=1)
        repeated = np.broadcast_to(constant[:, :, None], (*constant.shape, self.p_load.shape[1]))
        return np.concatenate([self.p_load.transpose(0, 2, 1), repeated], axis=1)


def _angles(network: Network, p_gen: Array, p_load: Array) -> Array:
    """`Network.power_flow`, compiled: for one instance that takes a third of an answer's time."""
    theta = np.zeros((len(p_gen), network.n_bus))
    theta[:, network.generators], theta[:, network.loads] = p_gen, p_load
    wanted = theta[:, network.unknown]
    power_flow(wanted, network.unknown, network.ends, network.coupling, MISMATCH, NEWTON_STEPS, theta)
    # Where it found nothing, the other finds out why.
    return network.power_flow(p_gen, p_load) if np.isnan(theta).any() else theta
