"""The swing equations with free line weights: few parameters, stable and exact at equilibria for all of them.

Linearised, a line carries its weight w = b cos(Δθ) times the change of the angle across it. The weights of
all lines and the generators' damping are the parameters here; the reduced stiffness S and the loads' shares
follow from them by eliminating the load angles. S is symmetric and positive definite for positive weights,
so that the model is stable, with the energy ½ ωᵀ M ω + ½ δθᵀ S δθ.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ded_bench.koopman.energy_form import injections_from_generators
from ded_bench.problem.case import Array, Case
from ded_bench.truth.network import Network

#: Eigenvalues times step closer than this count as one in a divided difference.
SAME = 1e-6


class Dynamics(NamedTuple):
    """dψ/dt = A (ψ - B P) + F dP/dt with ψ = (ω, P_s, N), and derivatives by parameter."""

    a: Array  # (n, n), 1/s
    f: Array  # (n, n_in)
    da: Array  # (n_parameters, n, n)
    df: Array  # (n_parameters, n, n_in)


class Step(NamedTuple):
    """ψ⁺ - B P⁺ = K (ψ - B P) + H (P⁺ - P) over one step, and derivatives by parameter."""

    k: Array  # (n, n)
    h: Array  # (n, n_in)
    dk: Array  # (n_parameters, n, n)
    dh: Array  # (n_parameters, n, n_in)


@dataclass(frozen=True, eq=False)
class LineForm:
    """Parameters are logarithms of factors on the nominal weights, then on the nominal damping."""

    case: Case
    network: Network
    theta: Array  # of the nominal point, (n_bus,), rad
    weights: Array  # at the nominal point, (n_lines,), pu/rad

    @staticmethod
    def make(case: Case) -> LineForm:
        """Nominal weights are those of the power flow at the nominal point."""
        network = Network(case)
        theta = network.power_flow(case.p_nominal, case.load_nominal)
        return LineForm(case, network, theta, network.coupling * np.cos(theta @ network.incidence.T))

    @property
    def n_parameters(self) -> int:
        """Number of lines and generators."""
        return len(self.weights) + len(self.network.generators)

    def dynamics(self, x: Array) -> Dynamics:
        """A, F and their derivatives at parameters x, shape (n_parameters,); x = 0 is the linearisation."""
        network, n, n_lines = self.network, len(self.network.generators), len(self.weights)
        gen, alg, incidence = network.generators, network.algebraic, network.incidence
        weights, damping = self.weights * np.exp(x[:n_lines]), network.d * np.exp(x[n_lines:])
        full = incidence.T @ (weights[:, None] * incidence)
        to_load = np.zeros((len(alg), len(network.loads)))
        to_load[np.searchsorted(alg, network.loads), np.arange(len(network.loads))] = 1.0
        by_load = np.linalg.solve(full[np.ix_(alg, alg)], to_load)
        by_gen = -np.linalg.solve(full[np.ix_(alg, alg)], full[np.ix_(alg, gen)])
        mix = injections_from_generators(n)
        a = np.zeros((2 * n, 2 * n))
        a[:n, :n] = -np.diag(damping / network.m)
        a[:n, n:] = -np.linalg.inv(mix) / network.m[:, None]
        a[n:, :n] = mix @ (full[np.ix_(gen, gen)] + full[np.ix_(gen, alg)] @ by_gen)
        f = np.zeros((2 * n, n + len(network.loads)))
        f[n:, n:] = mix @ full[np.ix_(gen, alg)] @ by_load
        f[n, n:] -= 1.0  # P_s = -Σ f_gen - Σ P_load
        # The angle across a line is across_gen δθ_gen + across_load δP_load. Its weight changes f_gen by
        # across_genᵀ times that angle, since the energy of the others is least.
        across_gen = incidence[:, gen] + incidence[:, alg] @ by_gen
        across_load = incidence[:, alg] @ by_load
        injected = weights[:, None] * (across_gen @ mix.T)
        da = np.zeros((self.n_parameters, *a.shape))
        da[:n_lines, n:, :n] = injected[:, :, None] * across_gen[:, None, :]
        da[n_lines + np.arange(n), np.arange(n), np.arange(n)] = -damping / network.m
        df = np.zeros((self.n_parameters, *f.shape))
        df[:n_lines, n:, n:] = injected[:, :, None] * across_load[:, None, :]
        return Dynamics(a, f, da, df)


def discretise(dynamics: Dynamics, b: Array, step_s: float) -> Step:
    """The exact step for inputs linear between samples, and its derivatives.

    With A = V Λ V⁻¹ the derivative of a function of A is V (Φ ∘ V⁻¹ dA V) V⁻¹, where Φ holds the function's
    divided differences between eigenvalues (Daleckii and Krein; Higham, Functions of Matrices, theorem 3.11).

    Args:
        dynamics: with distinct, non-zero eigenvalues.
        b: B of the equilibria ψ = B P, shape (n, n_in).
        step_s: step, s.
    """
    value, right = np.linalg.eig(dynamics.a)
    left, z = np.linalg.inv(right), value * step_s
    exponential, mean = np.exp(z), np.expm1(z) / z
    k, phi = ((right * column @ left).real for column in (exponential, mean))
    half, middle = 0.5 * (z[:, None] - z), 0.5 * (z[:, None] + z)
    one = np.abs(half) < SAME
    safe = np.where(one, 1.0, half)
    of_exponential = np.exp(middle) * np.where(one, 1.0, np.sinh(safe) / safe)
    slope = (np.exp(middle) * (middle - 1.0) + 1.0) / np.where(one, middle, 1.0) ** 2
    of_mean = np.where(one, slope, 0.5 * (mean[:, None] - mean) / safe)
    change = step_s * (left @ dynamics.da @ right)
    dk, dphi = ((right @ (change * part) @ left).real for part in (of_exponential, of_mean))
    rest = dynamics.f - b
    return Step(k, phi @ rest, dk, dphi @ rest + phi @ dynamics.df)
