"""What comes of the paper's recipe on the linear answer along each instance's trajectory.

    python studies/paper_along_trajectories.py two-area TO

The network, AdamW, batches, epochs and weights of penalties are those of `ded-dpc-paper`. Its loss sees the
grid linearised along the first schedule of `ded-admm`, beside a slack along that of each instance, as
`methods/admm/modal_grid.py` has it. On islands it sees what set-points at the knots do to the mean frequency,
swings and delivered powers by the linear answer of `methods/island/island_iterations.py` around the schedule
from which that starts, simulated in coarse steps; inputs are loads at the knots, costs, angles, frequencies
and P_0. Test instances are scored by simulation.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor

from ded_bench import Case, Schedule, load_instances
from ded_bench.methods.admm.modal_grid import ModalGrid
from ded_bench.methods.admm.problems import POINTS, problems_of
from ded_bench.methods.admm.torch_iterations import Respond, means_over_time
from ded_bench.methods.dpc_paper.paper_policy import channels
from ded_bench.methods.dpc_paper.paper_training import (
    EPOCHS,
    Q_INITIAL,
    Q_OMEGA,
    Q_RAMP,
    PaperNetwork,
    PaperTraining,
)
from ded_bench.methods.island.island_iterations import IslandGrid, swings_by
from ded_bench.methods.training_record import TrainingOptions
from ded_bench.plants.detailed.machine_arrays import DELTA, SPEED
from ded_bench.plants.plant import SimulationError
from ded_bench.plants.score import Score, score
from ded_bench.problem.instance import Instance


class Batch(NamedTuple):
    """Instances as tensors."""

    channels: Tensor  # (batch, n_channels, n_knots)
    row: Tensor  # which of all instances, (batch,)
    cost: Tensor  # the slack's, if any, and generators', (batch, n)
    p_initial: Tensor  # (batch, n_gen), pu


def batch_of(case: Case, instances: Sequence[Instance], seen: Sequence[np.ndarray]) -> Batch:
    """Instances whose channels are these."""
    slack = [[i.cost_slack(case)] if case.slack is not None else [] for i in instances]
    cost = [[*of_slack, *i.cost_gen(case)] for of_slack, i in zip(slack, instances, strict=True)]
    parts = np.stack(seen), cost, np.stack([i.p_initial(case) for i in instances])
    first, *others = (torch.as_tensor(np.asarray(part), dtype=torch.float32) for part in parts)
    return Batch(first, torch.arange(len(instances)), *others)


def priced(knots: Tensor, ramp: Tensor, p_initial: Tensor, points: int) -> dict[str, Tensor]:
    """The terms of ramps, at so many points of an interval between knots, and of P_0."""
    step = knots.diff(dim=1) / points

    def beyond(value: Tensor) -> Tensor:
        return Q_RAMP * points * value.relu().square().sum(dim=(1, 2))

    initial = Q_INITIAL * (knots[:, 0] - p_initial).square().sum(dim=1)
    return {"ramp down": beyond(-step - ramp), "ramp up": beyond(step - ramp), "initial": initial}


class BesideSlack:
    """The paper's six terms of a lossless grid."""

    def __init__(self, case: Case, regime: str, train: Sequence[Instance]) -> None:
        self.grid = ModalGrid(case, case.omega_bound(regime), train[0].horizon_s)
        self.steps, self.points = train[0].steps, train[0].steps // (len(self.grid.knots) - 1)
        self.start = self.grid.start(problems_of(case, train, self.grid.points))
        self.linear = self.grid.along_first(self.start)
        self.ramp = torch.as_tensor(case.ramp * train[0].dt_s, dtype=torch.float32)

    def read(self, instances: Sequence[Instance]) -> Batch:
        """What the network sees."""
        grid = self.grid
        return batch_of(grid.case, instances, list(channels(grid.network, instances, grid.knots)))

    def __call__(self, knots: Tensor, batch: Batch) -> dict[str, Tensor]:
        """Each term of each instance, (batch,); powers at the knots, (batch, n_knots, n_gen), pu."""
        rows = batch.row.numpy()
        start = SimpleNamespace(state=self.start.state[rows])
        linear = SimpleNamespace(**{name: part[rows] for name, part in vars(self.linear).items()})
        omega, p_slack = Respond.apply(knots, self.grid, start, linear)
        generators = (batch.cost[:, 1:] * (means_over_time(knots.shape[1])[:, None] * knots).sum(dim=1)).sum(
            dim=1
        )
        slack = batch.cost[:, 0] * (means_over_time(p_slack.shape[1]) * p_slack.abs()).sum(dim=1)
        weight = Q_OMEGA * self.points / POINTS
        above, below = (
            weight * (sign * omega - self.grid.bound).relu().square().sum(dim=(1, 2)) for sign in (1, -1)
        )
        terms = {
            "objective": (generators + slack) * (self.steps + 1),
            "omega above": above,
            "omega below": below,
        }
        return terms | priced(knots, self.ramp, batch.p_initial, self.points)


class OnIsland:
    """The paper's six terms of an island."""

    def __init__(self, case: Case, regime: str, train: Sequence[Instance]) -> None:
        self.grid = grid = IslandGrid(case, regime, train[0].horizon_s)
        bounds, n, n_gen = case.bounds(regime), len(grid.knots) - 1, len(case.generators)
        limits = [bounds.limit[bounds.kinds.index(kind)] for kind in ("mean", "relative")]
        each = np.eye(n * n_gen, dtype=np.float32)
        swings = np.stack([swings_by(grid.maps, one.reshape(n, n_gen)).ravel() for one in each], axis=1)
        size = np.repeat(limits, [n, len(swings)])
        limit = size.copy()
        limit[n - 1] *= grid.last
        self.steps, self.points = train[0].steps, train[0].steps // n
        weight = np.repeat([self.points, self.points / grid.between], [n, len(swings)])
        starts, outs, paid = [], [], []
        for instance in train:
            asked = grid.ask(instance)
            found = grid.follow(asked, asked.start)
            _, delivered = grid.coarse.follow(asked.begun, grid.hat @ asked.start)
            starts.append(asked.start)
            outs.append(np.concatenate([found.mean, found.swings.ravel()]) * size)
            paid.append(grid.weight @ delivered @ asked.cost)
        arrays = (
            np.stack(starts),
            np.stack(outs),
            np.array(paid),
            np.vstack([grid.maps.mean, swings]) * size[:, None],
            limit,
            weight,
            grid.delivered,
            grid.step / self.points,
        )
        tensors = (torch.as_tensor(array, dtype=torch.float32) for array in arrays)
        self.start, self.out, self.paid, self.rows, self.limit, self.weight, self.delivered, self.ramp = (
            tensors
        )

    def read(self, instances: Sequence[Instance]) -> Batch:
        """What the network sees."""
        grid, machines, seen = self.grid, self.grid.plant.system.scheduled, []
        for one in instances:
            start = grid.ask(one).begun.x[:, machines]
            constant = (one.cost_gen(grid.case), start[DELTA], start[SPEED], one.p_initial(grid.case))
            repeated = np.tile(np.concatenate(constant)[:, None], len(grid.knots))
            seen.append(np.vstack([one.p_load(grid.case, grid.knots).T, repeated]))
        return batch_of(grid.case, instances, seen)

    def __call__(self, knots: Tensor, batch: Batch) -> dict[str, Tensor]:
        """Each term of each instance, (batch,); set-points at the knots, (batch, n_knots, n_gen), pu."""
        change = (knots - self.start[batch.row])[:, 1:].flatten(1)
        out = self.out[batch.row] + change @ self.rows.T
        paid = self.paid[batch.row] + (batch.cost * (change @ self.delivered.T)).sum(dim=1)
        above, below = (
            Q_OMEGA * (self.weight * (sign * out - self.limit).relu().square()).sum(dim=1) for sign in (1, -1)
        )
        terms = {"objective": paid * (self.steps + 1), "omega above": above, "omega below": below}
        return terms | priced(knots, self.ramp, batch.p_initial, self.points)


def scored(case: Case, instance: Instance, schedule: Schedule, regime: str) -> Score | None:
    """What a schedule does; None: the plant cannot follow it."""
    try:
        return score(case, instance, schedule, regime)
    except SimulationError:
        return None


def main(name: str, regime: str, epochs: str = str(EPOCHS)) -> None:
    """Train, answer the test instances, and print what came of it."""
    case = Case.load(name)
    train, test = (load_instances(name, split=split) for split in ("train", "test"))
    loss = (OnIsland if case.slack is None else BesideSlack)(case, regime, train)
    data = loss.read(train)
    torch.manual_seed(0)
    network = PaperNetwork(data.channels.shape[1], case.p_min, case.p_max)
    with tempfile.TemporaryDirectory() as folder:
        run = PaperTraining(network, loss, data, 0, Path(folder) / "policy.safetensors")
        facts = run.train(TrainingOptions(), int(epochs), f"paper's recipe on {name} {regime}")
    with torch.no_grad():
        powers = network(loss.read(test).channels).double().numpy().clip(case.p_min, case.p_max)
    found = [
        scored(case, one, Schedule(loss.grid.knots, p), regime) for one, p in zip(test, powers, strict=True)
    ]
    done = [one for one in found if one is not None]
    excess = 1e3 * np.array([one.freq_violation_hz for one in done])
    jump = np.abs(powers[:, 0] - [one.p_initial(case) for one in test]).max(axis=1)
    told = {
        "steps of training; seconds": f"{facts['steps']}; {facts['seconds']:.0f}",
        "feasible test instances": f"{sum(one.feasible for one in done)} of {len(test)}",
        "not carried by the plant": f"{len(test) - len(done)}",
        "jump at t = 0, mean of the largest, pu": f"{jump.mean():.3g}",
        "frequency violation, mean of the largest, mHz": f"{excess.mean():.3g}",
        "the largest of all instances, mHz": f"{excess.max():.3g}",
    }
    print("\n".join(f"| {what} | {number} |" for what, number in told.items()))


if __name__ == "__main__":
    with threadpool_limits(1):
        main(*sys.argv[1:])
