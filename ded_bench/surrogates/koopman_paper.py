"""The paper's identification (kind `koopman-paper`): MLP observables, normalised one-step loss, SGD.

It differs from `identify` in what it minimises, not in the form of the model: the single-sample form
ψ⁺ = K (ψ - B P⁺) + B P⁺ of the paper's eq. (KO_dyn), with the newer input sample. Since P_s answers a
load change at once, K ignores the old P_s (its column is zero); the rest of K is exp(A Δt) with A in
energy form, so that ρ(K) < 1 for every parameter value.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Case
from ded_bench.surrogates.identify import training_trajectories
from ded_bench.surrogates.koopman import Koopman
from ded_bench.surrogates.linear import EPSILON

#: Observables of the MLP, enough for two for each generator, and units of its hidden layer for each of them.
OBSERVABLES_BY_GENERATOR, MORE_OBSERVABLES, HIDDEN_BY_OBSERVABLE = 2, 4, 4
BATCH, STEPS, LEARNING_RATE = 2048, 5000, 2e-3
#: ε of the paper's eq. for the model error, in units of the scaled state.
LOSS_FLOOR = 1e-6


class PaperKoopman(nn.Module):
    """K, B and N(x; w) as parameters; ω and P_s rows of B are fixed by the equilibria."""

    def __init__(self, n_gen: int, n_in: int, dt: float) -> None:
        super().__init__()
        n_observables = OBSERVABLES_BY_GENERATOR * n_gen + MORE_OBSERVABLES
        hidden, n = HIDDEN_BY_OBSERVABLE * n_observables, n_gen + n_observables
        self.n_gen, self.dt = n_gen, dt
        self.skew = nn.Parameter(0.1 * torch.randn(n, n))
        self.dissipation = nn.Parameter(0.3 * torch.eye(n) + 0.05 * torch.randn(n, n))
        self.energy = nn.Parameter(torch.eye(n) + 0.05 * torch.randn(n, n))
        self.slack_row = nn.Parameter(0.1 * torch.randn(n))
        self.steady = nn.Parameter(0.1 * torch.randn(n_observables, n_in))
        self.first = nn.Linear(2 * n_gen + 1, hidden)
        self.last = nn.Linear(hidden, n_observables)

    def matrices(self) -> tuple[Tensor, Tensor]:
        """K, shape (n_psi, n_psi), and B, shape (n_psi, n_in), in the order (ω, P_s, N)."""
        n, n_in = len(self.skew), self.steady.shape[1]
        eye = EPSILON * torch.eye(n)
        r = self.dissipation @ self.dissipation.T + eye
        q = self.energy @ self.energy.T + eye
        inner = torch.linalg.matrix_exp((self.skew - self.skew.T - r) @ q * self.dt)
        rows = torch.cat([inner[: self.n_gen], self.slack_row[None], inner[self.n_gen :]])
        k = torch.cat([rows[:, : self.n_gen], torch.zeros(n + 1, 1), rows[:, self.n_gen :]], dim=1)
        b = torch.cat([torch.zeros(self.n_gen, n_in), -torch.ones(1, n_in), self.steady])
        return k, b

    def observables(self, x: Tensor) -> Tensor:
        """ψ(x), shape (batch, n_psi), from the scaled state x = (θ_gen, P_s, ω)."""
        return torch.cat([x[:, self.n_gen + 1 :], x[:, [self.n_gen]], self.last(self.first(x).tanh())], dim=1)

    def forward(self, x: Tensor, following: Tensor, inputs: Tensor) -> Tensor:
        """The paper's normalised one-step error, shape (batch,)."""
        k, b = self.matrices()
        rest = inputs @ b.T
        error = (self.observables(x) - rest) @ k.T + rest - self.observables(following)
        return error.square().sum(dim=1) / ((x - following).square().sum(dim=1) + LOSS_FLOOR)


def identify_paper(case: Case, seed: int = 0, count: int | None = None, steps: int = STEPS) -> Koopman:
    """Identify a model as the paper does, from the trajectories that `identify.identify` uses."""
    data = training_trajectories(case, seed, count)
    n_gen, n_in = len(case.generators), data.inputs.shape[-1]
    # x = (θ_gen, P_s, ω) shifted and scaled, (n_points, batch, 2 n_gen + 1); ω and P_s are not shifted.
    x = np.concatenate([data.theta, data.p_slack[..., None], data.omega], axis=-1)
    offset, scale = x.mean(axis=(0, 1)), x.std(axis=(0, 1))
    offset[n_gen:] = 0.0
    scale[:n_gen], scale[n_gen + 1 :] = scale[:n_gen].mean(), scale[n_gen + 1 :].mean()
    state = torch.as_tensor((x - offset) / scale)
    # Scaled units: ω and P_s by a common factor each, so that the fixed rows of B keep their meaning.
    inputs = torch.as_tensor(data.inputs / scale[n_gen])
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        model = PaperKoopman(n_gen, n_in, case.sampling.dt_s).double()
    optimiser = torch.optim.Adam(model.parameters(), LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
        at = torch.randint(state.shape[0] - 1, (BATCH,), generator=generator)
        run = torch.randint(state.shape[1], (BATCH,), generator=generator)
        loss = model(state[at, run], state[at + 1, run], inputs[at + 1, run]).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    training = {"seed": seed, "trajectories": data.inputs.shape[1], "steps": steps}
    training["one_step_loss"] = loss.item()
    with torch.no_grad():  # back to the original units
        k, b = (matrix.numpy() for matrix in model.matrices())
        first, last = model.first, model.last
        weight, n_bus = first.weight.numpy() / scale, case.n_bus
        mlp = ((weight, first.bias.numpy() - weight @ offset), (last.weight.numpy(), last.bias.numpy()))
    unit = np.concatenate([scale[n_gen + 1 :], scale[[n_gen]], np.ones(len(model.steady))])
    k = unit[:, None] * k / unit
    b = unit[:, None] * b / scale[n_gen]
    lift = np.zeros((len(unit), 2 * n_bus + n_gen + len(case.loads) + 1))
    lift[:n_gen, 2 * n_bus : 2 * n_bus + n_gen] = np.eye(n_gen)
    lift[n_gen, Network(case).slack] = 1.0
    g = (np.eye(len(k)) - k) @ b
    return Koopman("koopman-paper", case, case.sampling.dt_s, k, b, g, lift, mlp, training)
