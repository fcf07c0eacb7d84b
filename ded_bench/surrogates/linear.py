"""The swing equations linearised: the surrogate `linear`, and the energy form where identification starts.

The energy form is a parametrisation that is stable for every parameter value. Coordinates are
ψ = (ω, P_s, N) with N = f at all generators but the last; with load injections given, (P_s, N) and the
generators' f determine each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import expm

from ded_bench.plants.lossless.network import Linearisation, Network
from ded_bench.problem.case import Array, Case
from ded_bench.surrogates.koopman import Koopman

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


def discretised(a: Array, b: Array, feedthrough: Array, dt: float) -> tuple[Array, Array]:
    """K and G of dψ/dt = A (ψ - B P) + F dP/dt, exact for inputs linear in between (first-order hold)."""
    n = len(a)
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n] = a * dt
    block[:n, n:] = np.eye(n)
    result = expm(block)
    return result[:n, :n], b + result[:n, n:] @ (feedthrough - b)


def injections_from_generators(n_gen: int) -> Array:
    """The matrix of (P_s, N) = matrix @ f_gen - (Σ loads, 0), shape (n_gen, n_gen)."""
    return np.vstack([-np.ones((1, n_gen)), np.eye(n_gen)[:-1]])


def steady_state(case: Case) -> Array:
    """B, shape (2 n_gen, n_in): ω* = 0, P_s* = -Σ P, N* = the generators' own power."""
    n_gen, n_in = len(case.generators), len(case.generators) + len(case.loads)
    b = np.zeros((2 * n_gen, n_in))
    b[n_gen] = -1.0
    b[np.arange(n_gen + 1, 2 * n_gen), np.arange(n_gen - 1)] = 1.0
    return b


def at_nominal_point(case: Case) -> Linearisation:
    """The swing equations linearised at the power flow of nominal powers and loads."""
    network = Network(case)
    return network.linearise(network.power_flow(case.p_nominal, case.load_nominal))


def energy_form(case: Case) -> EnergyForm:
    """The energy form of the linearisation at the nominal point, up to ε."""
    linear, n = at_nominal_point(case), len(case.generators)
    mix = injections_from_generators(n)
    hessian = np.linalg.inv(mix @ linear.stiffness @ mix.T)
    skew = np.zeros((2 * n, 2 * n))
    skew[n:, :n] = (mix @ linear.stiffness) / linear.m
    energy = np.zeros((2 * n, 2 * n))
    energy[:n, :n] = np.diag(np.sqrt(linear.m - EPSILON))
    energy[n:, n:] = np.linalg.cholesky(hessian - EPSILON * np.eye(n))
    dissipation = np.zeros((2 * n, 2 * n))
    dissipation[:n, :n] = np.diag(np.sqrt(np.maximum(linear.d / linear.m**2 - EPSILON, 0.0)))
    return EnergyForm(skew, dissipation, energy, feedthrough_of(linear))


def feedthrough_of(linear: Linearisation) -> Array:
    """What changes of loads move P_s and N by at once, F, (2 n_gen, n_in)."""
    n, n_load = linear.share.shape
    feedthrough = np.zeros((2 * n, n + n_load))
    feedthrough[n, n:] = linear.slack_share
    feedthrough[n + 1 :, n:] = linear.share[:-1]
    return feedthrough


def injection_lift(case: Case) -> Array:
    """The lift ψ = (ω, P_s, N) that makes equilibria of the nonlinear system exact."""
    network, n = Network(case), len(case.generators)
    lift = np.zeros((2 * n, 2 * network.n_bus + n + len(case.loads) + 1))
    lift[:n, 2 * network.n_bus : 2 * network.n_bus + n] = np.eye(n)
    lift[np.arange(n, 2 * n), [network.slack, *network.generators[:-1]]] = 1.0
    return lift


def physical_model(
    case: Case, kind: str, rates: Array, feedthrough: Array, training: dict[str, Any], dt_s: float | None
) -> Koopman:
    """A model dψ/dt = A (ψ - B P) + F dP/dt, exactly discretised, that starts with the true P_s and N = f(θ).

    It rests at every equilibrium of the nonlinear system, with the true slack power.

    Args:
        case: the grid.
        kind: of the model.
        rates: A, (2 n_gen, 2 n_gen), 1/s.
        feedthrough: F, (2 n_gen, n_in).
        training: facts of where A and F are from.
        dt_s: step, s; None: the case's own.
    """
    dt_s, b = case.sampling.dt_s if dt_s is None else dt_s, steady_state(case)
    k, g = discretised(rates, b, feedthrough, dt_s)
    return Koopman(kind, case, dt_s, k, b, g, injection_lift(case), training=training)


def by_angles(case: Case) -> Array:
    """By how much ψ changes at the nominal point with the generators' angles, (2 n_gen, n_gen), per rad."""
    n = len(case.generators)
    mix = injections_from_generators(n)
    return np.vstack([np.zeros((n, n)), mix @ at_nominal_point(case).stiffness])


def linear_model(case: Case, dt_s: float | None = None) -> Koopman:
    """The surrogate `linear`: the linearisation at the nominal point; `dt_s` as in `physical_model`."""
    linear, n = at_nominal_point(case), len(case.generators)
    rates = np.zeros((2 * n, 2 * n))
    rates[:, :n] = by_angles(case)
    rates[:n, :n] -= np.diag(linear.d / linear.m)
    rates[:n, n:] = -np.linalg.inv(injections_from_generators(n)) / linear.m[:, None]
    facts = {"source": "linearisation at the nominal point"}
    return physical_model(case, "linear", rates, feedthrough_of(linear), facts, dt_s)
