"""Models known before any data: the linearisation, and the energy form that stays stable.

Coordinates are ψ = (ω, P_s, N) with N = f at all generators but the last; with load injections
given, (P_s, N) and the generators' f determine each other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import expm, logm

from ded_bench.koopman.model import Koopman
from ded_bench.problem.case import Array, Case
from ded_bench.truth.network import Network

#: Floor of dissipation R and of energy Q, so that every parameter value is strictly stable.
EPSILON = 1e-5


@dataclass(frozen=True, eq=False)
class EnergyForm:
    """Parameters of a stable continuous-time model dψ/dt = A (ψ - B P) + F dP/dt.

    A = (J - R) Q with J skew, R = L Lᵀ + εI, Q = U Uᵀ + εI (the swing equation's energy form): A is
    Hurwitz and exp(A Δt) has spectral radius below one whatever the parameters are.
    """

    skew: Array  # (n, n); its antisymmetric part is J
    dissipation: Array  # L, (n, n)
    energy: Array  # U, (n, n)
    feedthrough: Array  # F, (n, n_in)

    def generator(self) -> Array:
        """A, shape (n, n), 1/s."""
        eye = EPSILON * np.eye(len(self.skew))
        r = self.dissipation @ self.dissipation.T + eye
        q = self.energy @ self.energy.T + eye
        return np.asarray((self.skew - self.skew.T - r) @ q)

    def discretise(self, b: Array, dt: float) -> tuple[Array, Array]:
        """Exact K and G for inputs linear between samples (first-order hold)."""
        n = len(self.skew)
        block = np.zeros((2 * n, 2 * n))
        block[:n, :n] = self.generator() * dt
        block[:n, n:] = np.eye(n)
        result = expm(block)
        return result[:n, :n], b + result[:n, n:] @ (self.feedthrough - b)


def injection_rows(case: Case) -> Array:
    """W, shape (n_gen, n_bus): (P_s, N) = W f, the slack and all generators but the last."""
    network = Network(case)
    rows = np.zeros((len(case.generators), network.n_bus))
    rows[0, network.slack] = 1.0
    rows[np.arange(1, len(rows)), network.generators[:-1]] = 1.0
    return rows


def steady_state(case: Case) -> Array:
    """B, shape (2 n_gen, n_in): ω* = 0, P_s* = -Σ P, N* = the generators' own power."""
    n_gen, n_in = len(case.generators), len(case.generators) + len(case.loads)
    b = np.zeros((2 * n_gen, n_in))
    b[n_gen] = -1.0
    b[np.arange(n_gen + 1, 2 * n_gen), np.arange(n_gen - 1)] = 1.0
    return b


def energy_form(case: Case, theta: Array) -> EnergyForm:
    """The energy form of the linearisation at angles `theta`, shape (n_bus,), up to ε."""
    network = Network(case)
    linear = network.linearise(theta)
    n = len(case.generators)
    mix = np.vstack([-np.ones((1, n)), np.eye(n)[:-1]])  # (P_s, N) = mix @ f_gen - (Σ loads, 0)
    hessian = np.linalg.inv(mix @ linear.stiffness @ mix.T)
    skew = np.zeros((2 * n, 2 * n))
    skew[n:, :n] = (mix @ linear.stiffness) / linear.m
    energy = np.zeros((2 * n, 2 * n))
    energy[:n, :n] = np.diag(np.sqrt(linear.m - EPSILON))
    energy[n:, n:] = np.linalg.cholesky(hessian - EPSILON * np.eye(n))
    dissipation = np.zeros((2 * n, 2 * n))
    dissipation[:n, :n] = np.diag(np.sqrt(np.maximum(linear.d / linear.m**2 - EPSILON, 0.0)))
    feedthrough = np.zeros((2 * n, n + len(case.loads)))
    feedthrough[n, n:] = linear.slack_share
    feedthrough[n + 1 :, n:] = linear.share[:-1]
    return EnergyForm(skew, dissipation, energy, feedthrough)


def linear_model(case: Case, dt_s: float | None = None) -> Koopman:
    """The linearisation at the nominal point, exactly discretised: the yardstick (kind `linear`).

    It starts from the linearised P_s and N of x_0, as a linear model of the DAE would.

    Args:
        case: the grid.
        dt_s: step, s; the case's own by default.
    """
    dt_s = case.sampling.dt_s if dt_s is None else dt_s
    network = Network(case)
    theta = network.power_flow(case.p_nominal, case.load_nominal)
    linear = network.linearise(theta)
    n, n_bus = len(case.generators), network.n_bus
    mix = np.vstack([-np.ones((1, n)), np.eye(n)[:-1]])
    a = np.zeros((2 * n, 2 * n))
    a[:n, :n] = -np.diag(linear.d / linear.m)
    a[:n, n:] = -np.linalg.inv(mix) / linear.m[:, None]
    a[n:, :n] = mix @ linear.stiffness
    b = steady_state(case)
    form = energy_form(case, theta)
    block = np.zeros((4 * n, 4 * n))
    block[: 2 * n, : 2 * n] = a * dt_s
    block[: 2 * n, 2 * n :] = np.eye(2 * n)
    exact = expm(block)
    k, phi = exact[: 2 * n, : 2 * n], exact[: 2 * n, 2 * n :]
    # f_gen ≈ f* + S (θ_gen - θ*) + T (P_load - L*); P_s = -Σ f_gen - Σ P_load.
    angle = np.zeros((n, n_bus))
    angle[:, network.generators] = linear.stiffness
    f_start = network.injections(theta)[network.generators]
    base = f_start - angle @ theta - linear.share @ case.load_nominal
    lift = np.zeros((2 * n, 2 * n_bus + n + len(case.loads) + 1))
    lift[:n, 2 * n_bus : 2 * n_bus + n] = np.eye(n)
    lift[n:, n_bus : 2 * n_bus] = mix @ angle
    lift[n:, 2 * n_bus + n : -1] = mix @ linear.share
    lift[n, 2 * n_bus + n : -1] -= 1.0
    lift[n:, -1] = mix @ base
    return Koopman(
        kind="linear",
        case_id=case.id,
        case_fingerprint=case.fingerprint,
        dt_s=dt_s,
        k=k,
        b=b,
        g=b + phi @ (form.feedthrough - b),
        lift=lift,
        training={"source": "linearisation at the nominal point"},
    )


def single_sample(model: Koopman, case: Case) -> Koopman:
    """The same dynamics in the paper's form with one input sample per step (kind `<kind>-single`).

    With F what answers an input at once, ζ = ψ - F P has no derivative of P in its equation, and
    holding the newer sample over a step gives ζ⁺ = K ζ + (I - K)(B - F) P⁺. The observables are
    (ω, P_s, ζ), and K ignores the old (ω, P_s): the new ones are ζ⁺'s plus their rows of F P⁺.
    """
    n, n_gen = len(model.k), len(case.generators)
    network = Network(case)
    mean = np.linalg.solve(logm(model.k).real, model.k - np.eye(n))  # of exp(A s) over a step
    feedthrough = model.b + np.linalg.solve(mean, model.g - model.b)
    k = np.zeros((n + n_gen + 1,) * 2)
    k[:, n_gen + 1 :] = np.vstack([model.k[: n_gen + 1], model.k])
    b = np.vstack([model.b[: n_gen + 1], model.b - feedthrough])
    away = model.lift.copy()
    away[:, [*network.generators, *network.loads]] -= feedthrough  # f equals P wherever P enters
    return replace(
        model,
        kind=f"{model.kind}-single",
        k=k,
        b=b,
        g=(np.eye(len(k)) - k) @ b,
        lift=np.vstack([model.lift[: n_gen + 1], away]),
    )


def injection_lift(case: Case, n_extra: int = 0) -> Array:
    """The lift ψ = (ω, P_s, N) that makes equilibria of the nonlinear system exact."""
    n, n_bus = len(case.generators), len(case.buses)
    lift = np.zeros((2 * n + n_extra, 2 * n_bus + n + len(case.loads) + 1))
    lift[:n, 2 * n_bus : 2 * n_bus + n] = np.eye(n)
    lift[n : 2 * n, :n_bus] = injection_rows(case)
    return lift
