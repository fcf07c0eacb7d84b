"""Identification of our Koopman model (kind `koopman`): physics first, then full rollouts.

Starts from the swing equations linearised at the nominal point and fits parameters to rollouts over the
whole horizon by nonlinear least squares in double precision: all of the energy form (`energy_form`).
Stability and exact equilibria hold for every parameter value. On a grid whose energy form has too many
parameters the linearisation itself is the model.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import least_squares

from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Array, Case
from ded_bench.surrogates.identification_data import Trajectories, sample_trajectories
from ded_bench.surrogates.koopman import Koopman
from ded_bench.surrogates.linear import (
    EnergyForm,
    discretised,
    energy_form,
    injection_lift,
    steady_state,
)

TRAIN, HELD_OUT = 120, 60
#: The whole energy form is fitted if it has at most so many parameters: each costs a rollout of all
#: trajectories at every evaluation.
ENERGY_FORM_PARAMETERS = 60
#: Trajectories for the paper's identification of larger grids: there are more generators on each.
LARGE_GRID_TRAIN = 40
#: Kinds of schedules to train on; the held-out ones have all kinds, two of which were never seen.
TRAIN_MIX = ("tracking", "tracking", "hurried", "random knots")
#: Residuals are taken every so many steps and in these units: rad/s and pu.
STRIDE, OMEGA_UNIT, SLACK_UNIT = 20, 2 * np.pi * 5e-6, 1e-4
#: Gauss-Newton evaluations; the cost changes in its fourth digit after about eight.
EVALUATIONS = 10


def identify(case: Case, seed: int = 0, count: int | None = None) -> Koopman:
    """Identify the model of a case from `count` trajectories (default: `n_training`).

    Their instances come from masters that no benchmark uses (3,000,000 + seed), under
    schedules that need no optimisation.
    """
    network = Network(case)
    start = energy_form(case, network.power_flow(case.p_nominal, case.load_nominal))
    if not _is_small(case):
        return make_model(case, start, {"seed": seed, "trajectories": 0})
    count = n_training(case) if count is None else count
    data = sample_trajectories(case, seed, count, mix=TRAIN_MIX)
    training: dict[str, int | float] = {"seed": seed, "trajectories": len(data.kinds)}

    def residuals(x: Array) -> Array:
        unit = np.append(np.full(len(network.generators), OMEGA_UNIT), SLACK_UNIT)
        error = predict(make_model(case, unpack(start, x)), network, data) - data.outputs
        return np.asarray((error[::STRIDE] / unit).ravel())

    result = least_squares(residuals, np.zeros(n_parameters(*start.feedthrough.shape)), max_nfev=EVALUATIONS)
    return make_model(case, unpack(start, result.x), training | {"cost": float(result.cost)})


def n_training(case: Case) -> int:
    """Trajectories that both kinds of models are identified from."""
    return TRAIN if _is_small(case) else LARGE_GRID_TRAIN


def held_out(case: Case, seed: int = 0, count: int = HELD_OUT) -> Trajectories:
    """Trajectories that `identify` with the same seed has not seen, of every kind."""
    return sample_trajectories(case, seed, count, first=1_000_000)


def make_model(case: Case, form: EnergyForm, training: dict[str, int | float] | None = None) -> Koopman:
    """The Koopman model with the parameters of an energy form."""
    b = steady_state(case)
    k, g = discretised(form.generator(), b, form.feedthrough, case.sampling.dt_s)
    return Koopman(
        kind="koopman",
        case_id=case.id,
        case_fingerprint=case.fingerprint,
        dt_s=case.sampling.dt_s,
        k=k,
        b=b,
        g=g,
        lift=injection_lift(case),
        training=training or {},
    )


def _is_small(case: Case) -> bool:
    return n_parameters(*steady_state(case).shape) <= ENERGY_FORM_PARAMETERS


def unpack(start: EnergyForm, x: Array) -> EnergyForm:
    """The form whose parameters differ from `start` by x; any x is admissible."""
    n = len(start.skew)
    strict, lower = np.tril_indices(n, -1), np.tril_indices(n)
    skew, dissipation, energy, feed = np.split(x, np.cumsum([len(strict[0]), len(lower[0]), len(lower[0])]))
    return EnergyForm(
        _shifted(start.skew, strict, skew),
        _shifted(start.dissipation, lower, dissipation),
        _shifted(start.energy, lower, energy),
        start.feedthrough + feed.reshape(start.feedthrough.shape),
    )


def n_parameters(n: int, n_in: int) -> int:
    """Length of x in `unpack`, for an energy form of n states and n_in inputs."""
    return n * (n - 1) // 2 + n * (n + 1) + n * n_in


def predict(model: Koopman, network: Network, data: Trajectories) -> Array:
    """The model's (ω, P_s) under the inputs of trajectories, shape (n_points, batch, n_gen + 1)."""
    n_gen = len(network.generators)
    psi = model.observables(network, data.theta_initial, data.omega[0], data.inputs[0, :, n_gen:])
    return model.rollout(psi, data.inputs)[..., : n_gen + 1]


def rollout_errors(model: Koopman, network: Network, data: Trajectories) -> tuple[float, float]:
    """Largest |Δω| (rad/s) and root mean square of ΔP_s (pu) of a model's rollouts of trajectories."""
    error = predict(model, network, data) - data.outputs
    return float(np.abs(error[..., :-1]).max()), float(np.sqrt(np.square(error[..., -1]).mean()))


def _shifted(matrix: Array, entries: tuple[Any, ...], values: Array) -> Array:
    result = matrix.copy()
    result[entries] += values
    return result
