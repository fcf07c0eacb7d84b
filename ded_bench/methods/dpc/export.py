"""A policy as a network in torch again, and as a file for runtimes that know `torch.export`."""

from __future__ import annotations

import io
from pathlib import Path

import torch

from ded_bench.files.strict import write_atomically
from ded_bench.methods.dpc.inputs import n_channels
from ded_bench.methods.dpc.policy import DispatchPolicy
from ded_bench.methods.dpc.policy_network import StagedNetwork


def network_of(policy: DispatchPolicy) -> StagedNetwork:
    """The network with the policy's weights."""
    stages, width, dilations = (policy.training[name] for name in ("stages", "width", "dilations"))
    network = StagedNetwork(policy.scope.case, policy.response, stages, width, tuple(dilations))
    network.load_state_dict({name: torch.as_tensor(value) for name, value in policy.weights.items()})
    return network.eval()


def export(policy: DispatchPolicy, path: Path) -> None:
    """Write the network (channels in, powers at the knots out), without the `BoundKeeper` that follows it."""
    case = policy.scope.case
    n_sequence, n_constants = n_channels(case)
    widths = len(case.generators), policy.response.n_outputs, n_sequence
    example = (*(torch.zeros(2, case.n_knots, n) for n in widths), torch.zeros(2, n_constants))
    batch = {0: torch.export.Dim("batch")}
    program = torch.export.export(network_of(policy), example, dynamic_shapes=(batch,) * 4)
    buffer = io.BytesIO()
    torch.export.save(program, buffer)
    write_atomically(path, buffer.getvalue())
