"""The loss of the shared policy: relative cost, and a penalty on |ω| out of bounds.

Everything but the bound on |ω| holds by construction.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ded_bench.methods.admm.admm_iterations import Outcome, means_over_time
from ded_bench.methods.admm.iteration_records import DOUBLING, STRAIGHT
from ded_bench.methods.admm.path_model import Outset, PathModel

#: The policy is trained on a bound tighter by this fraction, so that small excesses stay within the true one.
MARGIN = 0.015


@dataclass(frozen=True, eq=False)
class Judged:
    """Cost as a part of `Outset.scale`, penalty, and largest relative excess of |ω|, each (batch,)."""

    cost: Tensor
    penalty: Tensor
    excess: Tensor


class ScheduleLoss:
    """Judges outcomes of one case and bound."""

    def __init__(self, model: PathModel) -> None:
        self.model = model
        self.spacing = float(model.response.fine[1])
        self.at_fine = means_over_time(len(model.response.fine))
        self.at_knots = means_over_time(len(model.response.knots))

    def __call__(self, outset: Outset, outcome: Outcome, margin: float = 0.0) -> Judged:
        """Judge schedules by what they do.

        Args:
            outset: of their problems.
            outcome: powers, frequencies and slack powers.
            margin: fraction by which the bound is tightened.
        """
        powers, omega, p_slack = outcome
        cost = torch.as_tensor(outset.problems.cost, dtype=torch.float32)
        generators = ((powers * cost[:, None, 1:]).sum(dim=2) * self.at_knots).sum(dim=1)
        total = generators + cost[:, 0] * (p_slack.abs() * self.at_fine).sum(dim=1)
        excess = (omega.abs() / self.model.bound - (1.0 - margin)).relu()
        bent = excess.clamp_max(STRAIGHT)
        penalty = (excess + (excess - 0.5 * bent) * bent / DOUBLING).sum(dim=(1, 2)) * self.spacing
        scale = torch.as_tensor(outset.scale, dtype=torch.float32)
        return Judged(total / scale, penalty, excess.amax(dim=(1, 2)))
