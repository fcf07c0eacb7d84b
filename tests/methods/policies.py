"""Policies with random weights, and short instances, that several tests share."""

from __future__ import annotations

import numpy as np
import torch

from ded_bench.methods.admm.admm_policy import AdmmPolicy
from ded_bench.methods.admm.modal_grid import ModalGrid, ModalLinearisation, Start
from ded_bench.methods.admm.problems import draw
from ded_bench.methods.admm.torch_iterations import TorchIterations
from ded_bench.methods.dpc.channels import Channels, Response
from ded_bench.methods.dpc.dpc_policy import DispatchPolicy
from ded_bench.methods.dpc.training import StagedNetwork
from ded_bench.methods.dpc_paper.paper_policy import PaperPolicy, n_channels
from ded_bench.methods.dpc_paper.paper_training import PaperNetwork
from ded_bench.methods.stacked_instances import StackedInstances
from ded_bench.methods.trained_policy import Scope, TrainedPolicy, weights_of
from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Initial, Instance, LoadPoints
from ded_bench.problem.sampling import POLICY_SEED, sample_instance

HORIZON, ITERATIONS = 12.0, 6


def tightest(case: Case) -> str:
    return min(case.regimes, key=case.omega_bound)


def short_instances(case: Case, count: int, first: int = 0, horizon: float = HORIZON) -> list[Instance]:
    """Instances whose load ramps lie within a short horizon."""
    chosen = []
    for i in range(first, first + count):
        drawn = sample_instance(case, POLICY_SEED, i)
        load = {
            bus: ramp.model_copy(update={"start": ramp.start * horizon / drawn.horizon_s})
            for bus, ramp in drawn.load.items()
        }
        chosen.append(drawn.model_copy(update={"horizon_s": horizon, "load": load}))
    return chosen


def in_operation(case: Case, index: int = 0, horizon: float = HORIZON) -> Instance:
    """The same as points, from a state that is no equilibrium."""
    (found,) = short_instances(case, 1, index, horizon)
    times = np.linspace(0.0, horizon, 25)
    load = {
        bus: LoadPoints(points=tuple(zip(times.tolist(), ramp.at(times).tolist(), strict=True)))
        for bus, ramp in found.load.items()
    }
    network = Network(case)
    angles = network.initial_angles(found)[network.generators] + 0.002
    given = dict(zip(case.generators, angles.tolist(), strict=True))
    initial = Initial(power=found.initial.power, omega=found.initial.omega, theta=given)
    return found.model_copy(update={"schema_": "ded-bench/instance/2", "load": load, "initial": initial})


def staged_network(case: Case, size: float = 1.0, horizon: float = HORIZON) -> StagedNetwork:
    """A network of `ded-dpc` whose last layers are not zero, with inputs normalised."""
    torch.manual_seed(0)
    response = Response.make(case, case.knot_times(horizon))
    network = StagedNetwork(case, response)
    for stage in network.stages:
        torch.nn.init.normal_(stage.last.weight, std=size)
    inputs = StackedInstances.of(case, short_instances(case, 20, horizon=horizon))
    network.normalise(Channels.of(case, inputs, response))
    return network.eval()


def modal_grid(case: Case, horizon: float = HORIZON) -> ModalGrid:
    return ModalGrid(case, case.omega_bound(list(case.regimes)[-1]), horizon)


def started(grid: ModalGrid, count: int = 6, seed: int = 0) -> tuple[Start, ModalLinearisation]:
    """Drawn problems, and the grid along their first schedules."""
    start = grid.start(draw(grid.case, grid.bound, grid.points, POLICY_SEED, seed * count, count))
    return start, grid.along_first(start)


def torch_iterations(grid: ModalGrid, size: float = 0.3) -> TorchIterations:
    """Iterations of `ded-admm` whose weights are not zero."""
    torch.manual_seed(0)
    network = TorchIterations(grid, ITERATIONS)
    with torch.no_grad():
        network.nodes.add_(size * torch.randn_like(network.nodes))
    return network


#: Methods whose policies `random_policy` makes.
RANDOM = ("ded-dpc", "ded-admm", "ded-dpc-paper")


def random_policy(method: str, case: Case, size: float = 0.3, horizon: float = HORIZON) -> TrainedPolicy:
    """A policy of the last regime."""
    assert method in RANDOM
    scope = Scope(case, list(case.regimes)[-1], horizon)
    if method == "ded-dpc":
        staged = staged_network(case, size, horizon)
        return DispatchPolicy(scope, weights_of(staged), {"seed": 0})
    if method == "ded-admm":
        network = torch_iterations(modal_grid(case, horizon), size)
        return AdmmPolicy(scope, weights_of(network), {"seed": 0, "iterations": ITERATIONS})
    torch.manual_seed(0)
    return PaperPolicy(scope, weights_of(PaperNetwork(n_channels(case), case.p_min, case.p_max)), {"seed": 0})
