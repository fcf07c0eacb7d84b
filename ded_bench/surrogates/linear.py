"""The linearisation at the nominal point, the surrogate made of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import expm

from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Case
from ded_bench.surrogates.energy_form import (
    energy_form,
    injection_lift,
    injections_from_generators,
    steady_state,
)
from ded_bench.surrogates.koopman import Koopman


def linear_model(case: Case, dt_s: float | None = None) -> Koopman:
    """The linearisation at the nominal point, exactly discretised, with the linearised P_s and N of x_0.

    At an equilibrium away from the nominal point it does not start where it rests; `nominal_model` does.

    Args:
        case: the grid.
        dt_s: step, s; the case's own by default.
    """
    dt_s = case.sampling.dt_s if dt_s is None else dt_s
    network = Network(case)
    theta = network.power_flow(case.p_nominal, case.load_nominal)
    linear = network.linearise(theta)
    n, n_bus = len(case.generators), network.n_bus
    mix = injections_from_generators(n)
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


def nominal_model(case: Case) -> Koopman:
    """The surrogate `linear`: the linearisation at the nominal point, with the true P_s and N = f(θ) of x_0.

    It rests at every equilibrium of the nonlinear system, with the true slack power.
    """
    return replace(linear_model(case), lift=injection_lift(case))
