"""A Koopman model of the full AC network, identified from simulated trajectories alone (kind `koopman-ac`).

No equation of the network is used. Machines are known: with their inertia and damping, measured frequencies
tell the electrical powers p = P - D ω - M dω/dt. Least squares over all trajectories gives

    p = S θ + T P_load + c,    P_s = s θ + t P_load + c_s,

and with V = (s; S without its last row), T_V likewise, and coordinates q = V δθ + T_V δP_load, which are
(P_s, N) up to constants,

    M dω/dt = -D ω - S V⁻¹ δq,    dq/dt = V ω + T_V dP_load/dt.

A stable matrix has the energy form A = (J - R) Q, with Q from Lyapunov's equation (see `energy_form`).
Equilibria are those of the two affine laws; the slack's contains the losses, so ψ = (ω, P_s, N, 1) has a
constant.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_continuous_lyapunov

from ded_bench.files.errors import InputError
from ded_bench.koopman.data import KINDS
from ded_bench.koopman.energy_form import EPSILON, EnergyForm
from ded_bench.koopman.model import Koopman
from ded_bench.problem.ac_case import AcCase
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import KOOPMAN_SEED, sample_instance
from ded_bench.problem.schedule import Schedule
from ded_bench.truth.ac_simulate import simulate_ac
from ded_bench.truth.network import Network
from ded_bench.truth.simulate import SimulationError, Trajectory

KIND = "koopman-ac"
TRAIN = 24
#: Kinds of schedules to learn from, and where draws start whose trajectories only judge.
MIX, HELD_OUT_FIRST = ("tracking", "tracking", "hurried", "random knots"), 1_000_000
#: So many draws in a row that the AC network cannot carry are enough to give up.
MAX_DRAWS = 500
#: Samples are taken every so many steps; dω/dt is the central difference of fourth order over parts of them.
STRIDE, PART = 20, 4
#: Slowest decay that the model may have, 1/s, and dissipation in Lyapunov's equation as a part of the energy.
DECAY, DISSIPATION = 0.05, 0.1


class _Laws(NamedTuple):
    """Electrical powers of the generators, then of the slack, as affine functions of angles and loads."""

    by_angle: Array  # (n_gen + 1, n_gen), pu/rad
    by_load: Array  # (n_gen + 1, n_load)
    constant: Array  # (n_gen + 1,), pu


def sample_ac(
    case: Case, data: AcCase, seed: int, count: int, first: int = 0
) -> tuple[list[Instance], list[Trajectory]]:
    """Simulate the first `count` draws that the AC network can carry under schedules that need no optimum.

    Args:
        case: the grid.
        data: its AC data.
        seed: of the master 3,000,000 + seed, which no benchmark uses.
        count: how many.
        first: number of the first draw.

    Raises:
        InputError: the network can carry none of many draws.
    """
    instances: list[Instance] = []
    runs: list[Trajectory] = []
    draw = last = first
    while len(runs) < count:
        if draw - last > MAX_DRAWS:
            raise InputError(f"case {case.id}", "sampling", f"AC carries none of {MAX_DRAWS} draws in a row")
        instance = sample_instance(case, KOOPMAN_SEED + seed, draw)
        rng = np.random.default_rng(np.random.SeedSequence([KOOPMAN_SEED + seed, draw, 1]))
        kind, draw = KINDS[MIX[len(runs) % len(MIX)]], draw + 1
        try:
            run = simulate_ac(case, data, instance, Schedule(instance.grid, kind(case, instance, rng)))
        except SimulationError:
            continue
        instances.append(instance)
        runs.append(run)
        last = draw
    return instances, runs


def identify_ac(
    case: Case, data: AcCase, seed: int = 0, count: int | None = None, noise_hz: float = 0.0
) -> Koopman:
    """Identify the model of a case from `count` simulated trajectories (24 by default).

    Args:
        case: the grid; of it, only the machines are used.
        data: what is simulated on.
        seed: see `sample_ac`.
        count: how many trajectories.
        noise_hz: standard deviation of the noise added to measured frequencies.
    """
    count = TRAIN if count is None else count
    _, runs = sample_ac(case, data, seed, count)
    rng = np.random.default_rng(np.random.SeedSequence([KOOPMAN_SEED + seed, 2]))
    training = {"seed": seed, "trajectories": count, "noise_hz": noise_hz}
    laws = _fitted(case, runs, 2 * np.pi * noise_hz, rng)
    return _model(case, laws, training)


def _fitted(case: Case, runs: list[Trajectory], noise: float, rng: np.random.Generator) -> _Laws:
    """Least squares over all samples; noise in rad/s."""
    m, d = _machines(case)
    place = {bus.id: i for i, bus in enumerate(case.buses)}
    generators = [place[bus] for bus in case.generators]
    features, powers = [], []
    for run in runs:
        omega = run.omega + noise * rng.standard_normal(run.omega.shape)
        k = np.arange(2 * PART, len(omega) - 2 * PART, STRIDE)
        near, far = omega[k + PART] - omega[k - PART], omega[k + 2 * PART] - omega[k - 2 * PART]
        rate = (8 * near - far) / (12 * PART * float(run.t[1] - run.t[0]))
        features.append(np.hstack([run.theta[k][:, generators], run.p_load[k], np.ones((len(k), 1))]))
        powers.append(np.hstack([run.p_gen[k] - d * omega[k] - m * rate, run.p_slack[k, None]]))
    laws = np.linalg.lstsq(np.concatenate(features), np.concatenate(powers), rcond=None)[0].T
    n = len(generators)
    return _Laws(laws[:, :n], laws[:, n:-1], laws[:, -1])


def _model(case: Case, laws: _Laws, training: dict[str, int | float]) -> Koopman:
    n, n_in = len(case.generators), len(case.generators) + len(case.loads)
    m, d = _machines(case)
    stiffness, slack = laws.by_angle[:n], laws.by_angle[n]
    order = [n, *range(n - 1)]  # P_s, then the generators but the last
    v, by_load = laws.by_angle[order], laws.by_load[order]
    a = np.zeros((2 * n, 2 * n))
    a[:n, :n] = -np.diag(d / m)
    a[:n, n:] = -(stiffness @ np.linalg.inv(v)) / m[:, None]
    a[n:, :n] = v
    feedthrough = np.zeros((2 * n, n_in))
    feedthrough[n:, n:] = by_load
    through = slack @ np.linalg.inv(stiffness)
    b = np.zeros((2 * n, n_in))
    b[n, :n], b[n, n:] = through, laws.by_load[n] - through @ laws.by_load[:n]
    b[np.arange(n + 1, 2 * n), np.arange(n - 1)] = 1.0
    offset = np.zeros(2 * n)
    offset[n] = laws.constant[n] - through @ laws.constant[:n]
    k, g = _energy_form(a, m, feedthrough).discretise(b, case.sampling.dt_s)
    whole = np.eye(2 * n + 1)
    whole[: 2 * n, : 2 * n], whole[: 2 * n, -1] = k, offset - k @ offset
    return Koopman(
        kind=KIND,
        case_id=case.id,
        case_fingerprint=case.fingerprint,
        dt_s=case.sampling.dt_s,
        k=whole,
        b=np.vstack([b, np.zeros((1, n_in))]),
        g=np.vstack([g, np.zeros((1, n_in))]),
        lift=_lift(case, b[n], offset[n]),
        training=training,
    )


def _energy_form(a: Array, m: Array, feedthrough: Array) -> EnergyForm:
    """The energy form of A, with decay added where it has too little."""
    n = len(m)
    slow = float(np.linalg.eigvals(a).real.max()) + DECAY
    a = a - max(slow, 0.0) * np.eye(2 * n)
    size = np.append(m, np.full(n, m.mean()))
    energy = solve_continuous_lyapunov(a.T, -DISSIPATION * np.diag(size))
    energy *= 1.0 / np.linalg.eigvalsh(energy).mean()
    product = a @ np.linalg.inv(energy)
    eye = EPSILON * np.eye(2 * n)
    return EnergyForm(
        skew=np.tril(product - product.T, -1) / 2,
        dissipation=np.asarray(np.linalg.cholesky(-(product + product.T) / 2 - eye), dtype=np.float64),
        energy=np.asarray(np.linalg.cholesky(energy - eye), dtype=np.float64),
        feedthrough=feedthrough,
    )


def _lift(case: Case, slack: Array, constant: float) -> Array:
    """ψ_0 of an equilibrium: f equals P_0 at the generators, and the slack's law gives its power."""
    n, n_bus = len(case.generators), len(case.buses)
    generators = Network(case).generators
    lift = np.zeros((2 * n + 1, 2 * n_bus + n + len(case.loads) + 1))
    lift[np.arange(n), 2 * n_bus + np.arange(n)] = 1.0
    lift[n, generators], lift[n, 2 * n_bus + n : -1], lift[n, -1] = slack[:n], slack[n:], constant
    lift[np.arange(n + 1, 2 * n), generators[:-1]] = 1.0
    lift[-1, -1] = 1.0
    return lift


def _machines(case: Case) -> tuple[Array, Array]:
    """Inertia and damping of the generators."""
    machines = [case.machines[bus] for bus in case.generators]
    return np.array([machine.m for machine in machines]), np.array([machine.d for machine in machines])
