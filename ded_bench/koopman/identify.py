"""Identification of our Koopman model (kind `koopman`): physics first, then full rollouts.

Starts from the energy form of the swing equations linearised at the nominal point and fits all its
parameters to rollouts over the whole horizon by nonlinear least squares in double precision.
Stability and exact equilibria hold for every parameter value.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from scipy.optimize import least_squares

from ded_bench.koopman.data import Trajectories, sample_trajectories
from ded_bench.koopman.energy_form import EnergyForm, energy_form, injection_lift, steady_state
from ded_bench.koopman.model import Koopman
from ded_bench.problem.case import Array, Case
from ded_bench.truth.network import Network

TRAIN, HELD_OUT = 120, 60
#: Kinds of schedules to train on; the held-out ones have all kinds, two of which were never seen.
TRAIN_MIX = ("tracking", "tracking", "hurried", "random knots")
#: Residuals are taken every so many steps and in these units: rad/s and pu.
STRIDE, OMEGA_UNIT, SLACK_UNIT = 20, 2 * np.pi * 5e-6, 1e-4
#: Gauss-Newton evaluations; the cost changes in its fourth digit after about eight.
EVALUATIONS = 10


def identify(case: Case, seed: int = 0, count: int = TRAIN) -> Koopman:
    """Identify the model of a case from `count` trajectories.

    Their instances come from masters that no benchmark uses (3,000,000 + seed), under
    schedules that need no optimisation.
    """
    data = sample_trajectories(case, seed, count, mix=TRAIN_MIX)
    network = Network(case)
    start = energy_form(case, network.power_flow(case.p_nominal, case.load_nominal))

    def residuals(x: Array) -> Array:
        return _residuals(make_model(case, unpack(start, x)), network, data)

    result = least_squares(residuals, np.zeros(n_parameters(start)), max_nfev=EVALUATIONS)
    training = {"seed": seed, "trajectories": count, "cost": float(result.cost)}
    return make_model(case, unpack(start, result.x), training)


def held_out(case: Case, seed: int = 0, count: int = HELD_OUT) -> Trajectories:
    """Trajectories that `identify` with the same seed has not seen, of every kind."""
    return sample_trajectories(case, seed, count, first=1_000_000)


def make_model(case: Case, form: EnergyForm, training: dict[str, int | float] | None = None) -> Koopman:
    """The Koopman model with the parameters of an energy form."""
    b = steady_state(case)
    k, g = form.discretise(b, case.sampling.dt_s)
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


def n_parameters(form: EnergyForm) -> int:
    """Length of x in `unpack`."""
    n = len(form.skew)
    return n * (n - 1) // 2 + n * (n + 1) + form.feedthrough.size


def predict(model: Koopman, network: Network, data: Trajectories) -> Array:
    """The model's (ω, P_s) under the inputs of trajectories, shape (n_points, batch, n_gen + 1)."""
    n_gen = len(network.generators)
    psi = model.observables(network, data.theta[0], data.omega[0], data.inputs[0, :, n_gen:])
    return model.rollout(psi, data.inputs)[..., : n_gen + 1]


def rollout_table(case: Case, models: Sequence[Koopman], data: Trajectories) -> pd.DataFrame:
    """Rollout errors by model and kind of schedule: |Δω| in Hz, ΔP_s in pu."""
    network = Network(case)
    n_gen = len(case.generators)
    rows = []
    for model in models:
        error = predict(model, network, data) - data.outputs
        worst = np.abs(error[..., :n_gen]).max(axis=(0, 2)) / (2 * np.pi)
        rms = np.sqrt(np.square(error[..., n_gen]).mean(axis=0))
        for kind in dict.fromkeys(data.kinds):
            chosen = np.array([k == kind for k in data.kinds])
            rows.append(
                {
                    "model": model.kind,
                    "schedules": kind,
                    "n": int(chosen.sum()),
                    "mean max |Δω| (Hz)": worst[chosen].mean(),
                    "max |Δω| (Hz)": worst[chosen].max(),
                    "mean RMS ΔP_s (pu)": rms[chosen].mean(),
                }
            )
    return pd.DataFrame(rows)


def _residuals(model: Koopman, network: Network, data: Trajectories) -> Array:
    n_gen = len(network.generators)
    unit = np.append(np.full(n_gen, OMEGA_UNIT), SLACK_UNIT)
    error = (predict(model, network, data) - data.outputs)[::STRIDE] / unit
    return np.asarray(error.ravel())


def _shifted(matrix: Array, entries: tuple[Any, ...], values: Array) -> Array:
    result = matrix.copy()
    result[entries] += values
    return result
