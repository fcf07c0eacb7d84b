"""Simulation as a layer that PyTorch differentiates: values are the scorer's, gradients the adjoint's.

Backwards, the plant is linearised along each trajectory (`TimeVarying.gradient`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ded_bench.files.errors import InputError
from ded_bench.learning.as_arrays import INTERVAL_S, model_points
from ded_bench.plants.plant import Plant, SimulationError, in_threads, plant_of, simulate
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule, Trajectory
from ded_bench.surrogates.koopman import hat_functions

try:
    import torch
except ModuleNotFoundError:
    problem = "what is differentiated needs PyTorch: pip install torch"
    raise InputError("torch", "", problem) from None


@dataclass(frozen=True)
class _Runs:
    plant: Plant
    instances: Sequence[Instance]
    t: Array
    interval_s: float
    threads: int | None

    def simulate(self, power: Array) -> list[Trajectory | InputError | SimulationError]:
        def run(item: tuple[Instance, Array]) -> Trajectory:
            return simulate(self.plant.case, item[0], Schedule(self.t, item[1]), self.plant)

        return in_threads(run, zip(self.instances, power, strict=True), self.threads)

    def gradient(self, runs: list[Any], power: Array, by: tuple[Array, ...]) -> list[Any]:
        def back(item: tuple[Any, ...]) -> Array:
            instance, run, p, *given = item
            if not isinstance(run, Trajectory):
                return np.zeros_like(p)
            points = model_points(self.plant.case, instance, Schedule(self.t, p), self.interval_s)
            model = self.plant.linearise_along(run, points)
            return hat_functions(instance.grid[model.points], self.t).T @ model.gradient(*given)

        return in_threads(back, zip(self.instances, runs, power, *by, strict=True), self.threads)


class _SimulationLayer(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, power: torch.Tensor, batch: _Runs) -> tuple[torch.Tensor, ...]:
        ctx.batch, ctx.power = batch, power.detach().double().cpu().numpy()
        ctx.runs = batch.simulate(ctx.power)
        n, n_gen = batch.instances[0].steps + 1, power.shape[2]
        found = [np.full((len(power), n, *of), np.nan) for of in ((n_gen,), (), (n_gen,))]
        for b, run in enumerate(ctx.runs):
            if isinstance(run, Trajectory):
                for values, one in zip(found, (run.omega, run.p_slack, run.p_gen), strict=True):
                    values[b] = one
            elif isinstance(run, InputError):
                raise run
        return tuple(torch.from_numpy(values).to(power) for values in found)

    @staticmethod
    @torch.autograd.function.once_differentiable  # else second derivatives would be zero
    def backward(ctx: Any, *by: torch.Tensor) -> tuple[torch.Tensor, None]:
        given = tuple(part.detach().double().cpu().numpy() for part in by)
        found = ctx.batch.gradient(ctx.runs, ctx.power, given)
        if failed := next((one for one in found if isinstance(one, Exception)), None):
            raise failed
        return torch.from_numpy(np.stack(found)).to(by[0]), None


def simulated(
    case: Case,
    instances: Sequence[Instance],
    t: Array,
    power: torch.Tensor,
    plant: str | Plant | None = None,
    interval_s: float = INTERVAL_S,
    threads: int | None = None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Simulate a batch of schedules; what follows can be differentiated by their powers.

    Args:
        case: the grid.
        instances: of the case, with the same grid of time.
        t: times of the schedules' rows, (n_knots,), s, from 0 to the horizon.
        power: set-points at them, (batch, n_knots, n_gen), pu; double precision tells small excesses apart.
        plant: its name, or a plant of the case; None: the case's own.
        interval_s: see `linearise`.
        threads: how many work at once; None: as many as there are cores.

    Returns:
        ω (batch, n_points, n_gen), rad/s, P_s (batch, n_points), pu, and what generators deliver
        (batch, n_points, n_gen), pu, at all grid points. Those of a schedule that the plant cannot follow
        are not numbers, and its gradient is zero.

    Raises:
        InputError: instances, times or powers do not fit together, or powers are no tensor of real numbers.
    """
    if not (isinstance(power, torch.Tensor) and power.is_floating_point()):
        raise InputError("power", "", "must be a tensor of floating point numbers")
    shape = len(instances), len(t), len(case.generators)
    if tuple(power.shape) != shape:
        raise InputError("power", "", f"has the shape {tuple(power.shape)}, but needs {shape}")
    if len({(i.horizon_s, i.dt_s) for i in instances}) != 1:
        raise InputError("instances", "", "must be some, with the same grid of time")
    batch = _Runs(plant_of(case, plant), instances, np.asarray(t, dtype=np.float64), interval_s, threads)
    omega, p_slack, p_gen = _SimulationLayer.apply(power, batch)  # type: ignore[no-untyped-call]
    return omega, p_slack, p_gen


def cost_and_excess(
    case: Case,
    instances: Sequence[Instance],
    t: Array,
    power: torch.Tensor,
    regime: str,
    plant: str | Plant | None = None,
    interval_s: float = INTERVAL_S,
    threads: int | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """What the scorer says of a batch of schedules, to be differentiated by their powers.

    Args:
        case, instances, t, power, plant, interval_s, threads: as for `simulated`.
        regime: one of the case's.

    Returns:
        `objective` (batch,), a cost, and `freq_violation_hz` (batch,), Hz, of `Score`; the second changes
        with the point and machine at which it is largest. For a mean over points use `simulated`.

    Raises:
        InputError: unknown regime, or as for `simulated`.
    """
    bounds = case.bounds(regime)
    omega, p_slack, p_gen = simulated(case, instances, t, power, plant, interval_s, threads)
    price = torch.from_numpy(np.array([i.cost_gen(case) for i in instances])).to(power)
    slack = torch.from_numpy(np.array([i.cost_slack(case) for i in instances])).to(power)
    cost = (p_gen * price[:, None]).sum(dim=(1, 2)) + slack * p_slack.abs().sum(dim=1)
    matrix, limit = (torch.from_numpy(part).to(power) for part in (bounds.matrix, bounds.limit))
    beyond = (omega @ matrix.T).abs() - limit
    during = beyond[:, :, torch.from_numpy(~bounds.at_end)].amax(dim=(1, 2))
    return cost, torch.maximum(during, beyond[:, -1].amax(dim=1)).clamp(min=0.0) / (2 * np.pi)
