"""Identification of our Koopman model (kind `koopman`): physics first, then full rollouts.

Starts from the swing equations linearised at the nominal point and fits parameters to rollouts over the
whole horizon by nonlinear least squares in double precision: all of the energy form (`energy_form`).
Stability and exact equilibria hold for every parameter value. On a grid whose energy form has too many
parameters the linearisation itself is the model.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from ded_bench.files.errors import InputError
from ded_bench.plants.plant import SimulationError, servable, simulate
from ded_bench.problem.case import Array, Case
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.instance import Instance
from ded_bench.problem.lossless_case import lossless
from ded_bench.problem.sampling import KOOPMAN_SEED, sample_instances
from ded_bench.problem.schedule import Schedule, Trajectory
from ded_bench.surrogates.koopman import Koopman
from ded_bench.surrogates.linear import EnergyForm, energy_form, physical_model, steady_state

#: Range of a uniform draw.
Span = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Trajectories:
    """Simulated trajectories side by side, time first."""

    inputs: Array  # (n_points, batch, n_gen + n_load), pu
    theta_initial: Array  # (batch, n_bus), rad
    theta: Array  # of the generators, (n_points, batch, n_gen), rad
    omega: Array  # (n_points, batch, n_gen), rad/s
    p_slack: Array  # (n_points, batch), pu

    @property
    def outputs(self) -> Array:
        """(ω, P_s), shape (n_points, batch, n_gen + 1)."""
        return np.concatenate([self.omega, self.p_slack[..., None]], axis=-1)


def _signals(run: Trajectory) -> tuple[Array, ...]:
    """Inputs, first angles, angles of the generators, ω and P_s: not the angles of all buses at all times."""
    initial = np.array([run.columns[f"theta_{bus.id}"][0] for bus in lossless(run.case).buses])
    theta = np.stack([run.columns[f"theta_{g}"] for g in run.case.generators], axis=1)
    return np.hstack([run.p_gen, run.p_load]), initial, theta, run.omega, run.p_slack


def sample_trajectories(
    case: Case, seed: int, count: int, first: int = 0, mix: Sequence[str] | None = None
) -> Trajectories:
    """Simulate `count` fresh instances under the kinds of schedules in `mix` (default: all) in turn.

    Those that the system cannot follow, as on weak grids, are left out.

    Raises:
        InputError: it cannot follow most of them.
    """
    mix = mix or list(KINDS)
    runs = []
    for i, instance in enumerate(sample_instances(case, KOOPMAN_SEED + seed, count, first, servable)):
        rng = np.random.default_rng(np.random.SeedSequence([KOOPMAN_SEED + seed, first + i, 1]))
        schedule = Schedule(instance.grid, KINDS[mix[i % len(mix)]](case, instance, rng))
        with contextlib.suppress(SimulationError):
            runs.append(_signals(simulate(case, instance, schedule)))
    if 2 * len(runs) < count:
        lost = f"the system cannot follow {count - len(runs)} of {count} drawn schedules"
        raise InputError(f"case {case.id}", "", f"{lost}: the power flow has no solution")
    inputs, initial, *signals = zip(*runs, strict=True)
    stacked = (np.stack(signal, axis=1) for signal in signals)
    return Trajectories(np.stack(inputs, axis=1), np.stack(initial), *stacked)


def tracking(
    case: Case,
    instance: Instance,
    rng: np.random.Generator,
    lag_s: Span = (0.1, 3.0),
    smooth_s: Span = (0.02, 0.5),
    rate: Span = (0.4, 1.0),
) -> Array:
    """Follow the static dispatch with a lag and limited rates, smoothed: looks like an optimum.

    The rate is a fraction of the ramp limit, drawn below it since a tight frequency bound allows no more.
    """
    p_load = instance.p_load(case)
    target = merit_order(case, instance.cost_gen(case), instance.cost_slack(case), p_load)
    gain = min(instance.dt_s / rng.uniform(*lag_s), 1.0)  # more would overshoot, where steps are long
    smooth = min(instance.dt_s / rng.uniform(*smooth_s), 1.0)
    most = rng.uniform(*rate) * case.ramp * instance.dt_s
    p = np.empty_like(target)
    p[0] = instance.p_initial(case)
    step = np.zeros(target.shape[1])
    for k in range(len(p) - 1):
        step += smooth * (np.clip(gain * (target[k + 1] - p[k]), -most, most) - step)
        p[k + 1] = p[k] + step
    return p


def hurried(case: Case, instance: Instance, rng: np.random.Generator) -> Array:
    """`tracking` at the ramp limit with little lag: an optimum where frequency bounds do not bind."""
    return tracking(case, instance, rng, lag_s=(0.1, 1.0), smooth_s=(0.02, 0.1), rate=(1.0, 1.0))


def bang_bang(case: Case, instance: Instance, rng: np.random.Generator) -> Array:
    """Ramp up, down or not at all at the limit, for random whiles, within the bounds."""
    n_gen, n = len(case.generators), instance.steps
    rate = np.zeros((n, n_gen))
    for j in range(n_gen):
        k = 0
        while k < n:
            stop = k + int(rng.uniform(0.5, 8.0) / instance.dt_s)
            rate[k:stop, j] = rng.integers(-1, 2)
            k = stop
    return _within(case, instance, rate * case.ramp * instance.dt_s)


def random_knots(case: Case, instance: Instance, rng: np.random.Generator) -> Array:
    """A random walk over the policy's knots, linear between them, within the ramp limit."""
    knots = case.knot_times(instance.horizon_s)
    slopes = rng.uniform(-1, 1, (len(knots) - 1, len(case.generators))) * case.ramp
    at = np.minimum(np.searchsorted(knots, instance.grid[1:], side="left") - 1, len(knots) - 2)
    return _within(case, instance, slopes[at] * instance.dt_s)


def load_ramps(case: Case, instance: Instance, rng: np.random.Generator) -> Array:
    """Generators stay where they are; only the loads move."""
    return np.tile(instance.p_initial(case), (instance.steps + 1, 1))


def _within(case: Case, instance: Instance, increments: Array) -> Array:
    p = np.empty((instance.steps + 1, len(case.generators)))
    p[0] = instance.p_initial(case)
    for k, increment in enumerate(increments):
        p[k + 1] = np.clip(p[k] + increment, case.p_min, case.p_max)
    return p


KINDS: dict[str, Callable[[Case, Instance, np.random.Generator], Array]] = {
    "tracking": tracking,
    "hurried": hurried,
    "bang-bang": bang_bang,
    "random knots": random_knots,
    "load ramps": load_ramps,
}


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
    """Identify the model of a case from `count` trajectories (default: see `training_trajectories`).

    Their instances come from masters that no benchmark uses (3,000,000 + seed), under
    schedules that need no optimisation.
    """
    start = energy_form(case)
    if not _is_small(case):
        return make_model(case, start, {"seed": seed, "trajectories": 0})
    data = training_trajectories(case, seed, count)
    training: dict[str, int | float] = {"seed": seed, "trajectories": data.inputs.shape[1]}

    def residuals(x: Array) -> Array:
        unit = np.append(np.full(len(case.generators), OMEGA_UNIT), SLACK_UNIT)
        error = predict(make_model(case, unpack(start, x)), data) - data.outputs
        return np.asarray((error[::STRIDE] / unit).ravel())

    result = least_squares(residuals, np.zeros(n_parameters(*start.feedthrough.shape)), max_nfev=EVALUATIONS)
    return make_model(case, unpack(start, result.x), training | {"cost": float(result.cost)})


def training_trajectories(case: Case, seed: int, count: int | None) -> Trajectories:
    """What both kinds of models are identified from; `count` is by the case's size if None."""
    usual = TRAIN if _is_small(case) else LARGE_GRID_TRAIN
    return sample_trajectories(case, seed, usual if count is None else count, mix=TRAIN_MIX)


def held_out(case: Case, seed: int = 0, count: int = HELD_OUT) -> Trajectories:
    """Trajectories that `identify` with the same seed has not seen, of every kind."""
    return sample_trajectories(case, seed, count, first=1_000_000)


def make_model(case: Case, form: EnergyForm, training: dict[str, int | float] | None = None) -> Koopman:
    """The Koopman model with the parameters of an energy form."""
    return physical_model(case, "koopman", form.generator(), form.feedthrough, training or {}, None)


def _is_small(case: Case) -> bool:
    return n_parameters(*steady_state(case).shape) <= ENERGY_FORM_PARAMETERS


def unpack(start: EnergyForm, x: Array) -> EnergyForm:
    """The form whose parameters differ from `start` by x; any x is admissible."""
    n = len(start.skew)
    strict, lower = np.tril_indices(n, -1), np.tril_indices(n)
    places = strict, lower, lower
    *changes, feed = np.split(x, np.cumsum([len(rows) for rows, _ in places]))
    skew, dissipation, energy = (part.copy() for part in (start.skew, start.dissipation, start.energy))
    for matrix, entries, change in zip((skew, dissipation, energy), places, changes, strict=True):
        matrix[entries] += change
    feedthrough = start.feedthrough + feed.reshape(start.feedthrough.shape)
    return EnergyForm(skew, dissipation, energy, feedthrough)


def n_parameters(n: int, n_in: int) -> int:
    """Length of x in `unpack`, for an energy form of n states and n_in inputs."""
    return n * (n - 1) // 2 + n * (n + 1) + n * n_in


def predict(model: Koopman, data: Trajectories) -> Array:
    """The model's (ω, P_s) under the inputs of trajectories, shape (n_points, batch, n_gen + 1)."""
    n_gen = data.omega.shape[-1]
    psi = model.observables(data.theta_initial, data.omega[0], data.inputs[0, :, n_gen:])
    return model.rollout(psi, data.inputs)[..., : n_gen + 1]


def rollout_errors(model: Koopman, data: Trajectories) -> tuple[float, float]:
    """Largest |Δω| (rad/s) and root mean square of ΔP_s (pu) of a model's rollouts of trajectories."""
    error = predict(model, data) - data.outputs
    return float(np.abs(error[..., :-1]).max()), float(np.sqrt(np.square(error[..., -1]).mean()))
