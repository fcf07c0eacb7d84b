"""What comes of the paper's recipe on islands: its network, loss and training, on the island's linear answer.

    python studies/paper_on_islands.py two-area-agc TO

The network, AdamW, batches, epochs and weights of penalties are those of `ded-dpc-paper`. Its loss sees what
set-points at the knots do to the mean frequency, swings and delivered powers by the linear answer of
`methods/island/island_iterations.py` around the schedule from which that starts, simulated in coarse steps.
Inputs are loads at the knots, costs, angles, frequencies and P_0. Test instances are scored by simulation.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor

from ded_bench import Case, Schedule, load_instances
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
    start: Tensor  # set-points around which answers are linear, (batch, n_knots, n_gen), pu
    out: Tensor  # theirs: mean frequency at the knots and swings at the points, (batch, n_rows), rad/s
    paid: Tensor  # their mean cost, (batch,)
    cost: Tensor  # (batch, n_gen)
    p_initial: Tensor  # (batch, n_gen), pu

    def of_rows(self, rows: Tensor) -> Batch:
        """Some of them."""
        return Batch(*(part[rows] for part in self))


def read(grid: IslandGrid, instances: Sequence[Instance], size: np.ndarray) -> Batch:
    """What the network and the loss see of instances; outputs have these bounds, rad/s."""
    seen: list[tuple[np.ndarray, ...]] = []
    for instance in instances:
        asked, p_initial = grid.ask(instance), instance.p_initial(grid.case)
        found, machines = grid.follow(asked, asked.start), grid.plant.system.scheduled
        start, cost = asked.begun.x[:, machines], instance.cost_gen(grid.case)
        constant = np.concatenate([cost, start[DELTA], start[SPEED], p_initial])
        repeated = np.broadcast_to(constant[:, None], (len(constant), len(grid.knots)))
        channels = np.vstack([instance.p_load(grid.case, grid.knots).T, repeated])
        out = np.concatenate([found.mean, found.swings.ravel()]) * size
        seen.append((channels, asked.start, out, np.array(found.cost), cost, p_initial))
    return Batch(*(torch.as_tensor(np.stack(part), dtype=torch.float32) for part in zip(*seen, strict=True)))


class Loss:
    """The paper's six terms, summed over the points of the grid as in eq. (DPC_loss)."""

    def __init__(self, grid: IslandGrid, steps: int, size: np.ndarray) -> None:
        n, n_gen = len(grid.knots) - 1, len(grid.case.generators)
        each = np.eye(n * n_gen, dtype=np.float32)
        swings = np.stack([swings_by(grid.maps, one.reshape(n, n_gen)).ravel() for one in each], axis=1)
        rows = np.vstack([grid.maps.mean, swings]) * size[:, None]
        limit = size.copy()
        limit[n - 1] *= grid.last
        self.per_interval = steps // n
        points = np.repeat([self.per_interval, self.per_interval / grid.between], [n, len(rows) - n])
        arrays = rows, limit, points, grid.delivered, grid.step / self.per_interval
        self.rows, self.limit, self.points, self.delivered, self.ramp = (
            torch.as_tensor(array, dtype=torch.float32) for array in arrays
        )
        self.steps = steps

    def __call__(self, knots: Tensor, batch: Batch) -> dict[str, Tensor]:
        """Each term of each instance, (batch,); set-points at the knots, (batch, n_knots, n_gen), pu."""
        change = (knots - batch.start)[:, 1:].flatten(1)
        out = batch.out + change @ self.rows.T
        paid = (batch.cost * (change @ self.delivered.T)).sum(dim=1)
        step = knots.diff(dim=1) / self.per_interval

        def ramp(value: Tensor) -> Tensor:
            return Q_RAMP * self.per_interval * value.relu().square().sum(dim=(1, 2))

        return {
            "objective": (batch.paid + paid) * (self.steps + 1),
            "omega above": Q_OMEGA * (self.points * (out - self.limit).relu().square()).sum(dim=1),
            "omega below": Q_OMEGA * (self.points * (-out - self.limit).relu().square()).sum(dim=1),
            "ramp down": ramp(-step - self.ramp),
            "ramp up": ramp(step - self.ramp),
            "initial": Q_INITIAL * (knots[:, 0] - batch.p_initial).square().sum(dim=1),
        }


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
    grid = IslandGrid(case, regime, test[0].horizon_s)
    bounds, n = case.bounds(regime), len(grid.knots) - 1
    limits = [bounds.limit[bounds.kinds.index(kind)] for kind in ("mean", "relative")]
    size = np.repeat(limits, [n, n * grid.maps.swing.shape[1]])
    data = read(grid, train, size)
    torch.manual_seed(0)
    network = PaperNetwork(data.channels.shape[1], case.p_min, case.p_max)
    with tempfile.TemporaryDirectory() as folder:
        loss = Loss(grid, test[0].steps, size)
        run = PaperTraining(network, loss, data, 0, Path(folder) / "policy.safetensors")
        facts = run.train(TrainingOptions(), int(epochs), f"paper's recipe on {name} {regime}")
    with torch.no_grad():
        powers = network(read(grid, test, size).channels).double().numpy().clip(case.p_min, case.p_max)
    found = [scored(case, one, Schedule(grid.knots, p), regime) for one, p in zip(test, powers, strict=True)]
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
