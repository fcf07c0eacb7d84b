"""The unrolled ADMM of the shared policy in torch, for training; see `unrolled_inference`."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from ded_bench.methods.admm.admm_inference import (
    MOST,
    PENALTIES,
    SETTINGS,
    between_nodes,
    limits_of,
    mean_modes_of,
    starting_settings,
    weight_shapes,
)
from ded_bench.methods.admm.grid_response import FINE
from ded_bench.methods.admm.path_model import Outset, PathModel
from ded_bench.methods.admm.plant_gradient import FollowTargets, ModalChange, Respond, Transposed

#: Powers (batch, n_knots, n_gen), ω (batch, n_fine, n_gen) and P_s (batch, n_fine).
Outcome = tuple[Tensor, Tensor, Tensor]


class UnrolledIterations(nn.Module):
    """All iterations for one case, bound and horizon; only `nodes` are learned."""

    start: Tensor
    between: Tensor

    def __init__(self, model: PathModel, iterations: int) -> None:
        super().__init__()
        self.model = model
        self.nodes = nn.Parameter(torch.zeros(weight_shapes()["nodes"]))
        self.register_buffer("start", _single(starting_settings(iterations)), persistent=False)
        self.register_buffer("between", _single(between_nodes(iterations)), persistent=False)

    def settings(self) -> Tensor:
        """See `unrolled_inference.settings_of`."""
        found = self.start * (self.between @ self.nodes).exp()
        columns = list(found.unbind(dim=1))
        for name, most in MOST.items():
            i = list(SETTINGS).index(name)
            columns[i] = columns[i] * most / (most - self.start[:, i] + columns[i])
        return torch.stack(columns, dim=1)

    def forward(self, outset: Outset) -> Outcome:
        """Schedules after the last iteration, within their limits, and what they do."""
        model, limits = self.model, limits_of(self.model)
        linear = model.linearise(outset, model.start_path(outset))
        modes = mean_modes_of(model, linear)
        low, high, step, mass = map(_single, (limits.low, limits.high, limits.step, limits.mass))
        by_mass, n = 1.0 / (mass * limits.unit**2), outset.start.shape[1]
        cost = _single(outset.problems.cost / outset.scale[:, None])
        at_knots, at_fine = means_over_time(n), means_over_time(FINE * (n - 1) + 1)
        price = cost[:, :1] * at_fine
        own = at_knots[1:, None] * cost[:, None, 1:]
        p = _single(outset.start)
        copies: list[Tensor] = []
        duals = [torch.zeros(())] * 4
        for setting in self.settings() * torch.tensor([limits.price] * PENALTIES + [1.0] * 4):
            _, omega, p_slack = Respond.apply(p, model, outset, linear)  # type: ignore[no-untyped-call]
            heavy = setting[3] / (limits.unit**2 * FINE)
            weights = (
                setting[0] * by_mass,
                setting[1] * by_mass,
                setting[2] / (limits.bound**2 * FINE),
                heavy,
            )
            now = [p[:, 1:], p.diff(dim=1), omega, p_slack]
            if not copies:
                copies = [values.detach() for values in now]
            relaxed, tight = setting[6], limits.bound * (1.0 - setting[7])
            wanted = [
                relaxed * a + (1.0 - relaxed) * z + y / w
                for a, z, y, w in zip(now, copies, duals, weights, strict=True)
            ]
            copies = [
                torch.minimum(torch.maximum(wanted[0], low), high),
                torch.minimum(torch.maximum(wanted[1], -step), step),
                torch.minimum(torch.maximum(wanted[2], -tight), tight),
                (wanted[3] - price / heavy).relu() - (-wanted[3] - price / heavy).relu(),
            ]
            duals = [w * (a - z) for w, a, z in zip(weights, wanted, copies, strict=True)]
            forces = [y + w * (a - z) for y, w, a, z in zip(duals, weights, now, copies, strict=True)]
            gradient = own + forces[0] + forces[1]
            gradient = gradient - nn.functional.pad(forces[1][:, 1:], (0, 0, 0, 1))
            gradient = nn.functional.pad(gradient, (0, 0, 1, 0))
            gradient = gradient + Transposed.apply(forces[2], forces[3], model, linear)  # type: ignore[no-untyped-call]
            quadratic = torch.stack(
                [
                    setting[0] / limits.unit**2,
                    setting[1] / limits.unit**2,
                    setting[2] * setting[4] / (limits.bound**2 * FINE),
                    heavy * setting[5],
                ]
            )
            p = p + ModalChange.apply(gradient, quadratic, modes)  # type: ignore[no-untyped-call]
        p_initial = _single(outset.problems.p_initial)
        p = FollowTargets.apply(p, p_initial, low, high, step)  # type: ignore[no-untyped-call]
        x = model.respond(p.detach().numpy().astype(np.float64), outset, linear)[0]
        _, omega, p_slack = Respond.apply(p, model, outset, model.along(outset, x))  # type: ignore[no-untyped-call]
        return p, omega, p_slack


def means_over_time(n: int) -> Tensor:
    """Weights, (n,), of the mean over time of what is linear between n equidistant points."""
    weights = torch.full((n,), 1.0 / (n - 1))
    weights[[0, -1]] *= 0.5
    return weights


def _single(values: np.ndarray) -> Tensor:
    return torch.tensor(values, dtype=torch.float32)
