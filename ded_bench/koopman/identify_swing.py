"""Identify swing equations from AC trajectories: polynomials of electrical powers, by least squares.

Machines are known: M dω/dt + D ω = P - p(θ, P_load), where ω, θ, P and the loads are measured. Multiplied by
a short bump φ and integrated by parts, no measured frequency is differentiated,

    ∫ φ p dt = ∫ φ (P - D ω) dt + M ∫ φ' ω dt,

which is linear in the polynomials' weights and averages noise (Shinbrot, On the analysis of linear and
nonlinear systems, Transactions of the ASME 79, 1957).
"""

from __future__ import annotations

import itertools

import numpy as np

from ded_bench.files.errors import InputError
from ded_bench.koopman.identified_swing import IdentifiedSwing, generator_places, machines_of, monomials
from ded_bench.koopman.identify_ac import sample_ac
from ded_bench.koopman.swing_integrator import Polynomial
from ded_bench.koopman.trajectory import Indices
from ded_bench.problem.ac_case import AcCase
from ded_bench.problem.case import Array, Case
from ded_bench.problem.sampling import KOOPMAN_SEED
from ded_bench.truth.simulate import Trajectory

#: Trajectories to learn from, and the polynomials' degree.
TRAIN, DEGREE = 48, 4
#: Half the length of a bump, and the distance from one to the next, s.
HALF_S, EVERY_S = 0.2, 0.2
#: Weights are penalised by their squares times this part of the mean square of a monomial's data.
RIDGE = 1e-9
#: States may lie so many times as far from the middle of the data as the farthest of these.
REACH = 1.1
#: More monomials than this are no problem for least squares in memory.
MOST = 3000


def identify_swing(
    case: Case,
    data: AcCase,
    seed: int = 0,
    count: int | None = None,
    noise_hz: float = 0.0,
    degree: int = DEGREE,
) -> IdentifiedSwing:
    """Identify the model of a case from `count` simulated trajectories.

    Args:
        case: the grid; of it, only the machines are used.
        data: what is simulated on.
        seed: see `sample_ac`.
        count: how many trajectories.
        noise_hz: standard deviation of the noise added to measured frequencies.
        degree: of the polynomials.

    Raises:
        InputError: the polynomials have too many monomials, or the network carries none of many draws.
    """
    count = TRAIN if count is None else count
    parent, factor = polynomial_terms(len(case.generators) + len(case.loads), degree)
    if len(parent) > MOST:
        problem = f"a polynomial of degree {degree} has {len(parent)} monomials; at most {MOST} are fitted"
        raise InputError("--kind", "swing", problem)
    _, runs = sample_ac(case, data, seed, count)
    rng = np.random.default_rng(np.random.SeedSequence([KOOPMAN_SEED + seed, 2]))
    training = {"seed": seed, "trajectories": count, "noise_hz": noise_hz, "degree": degree}
    law = fitted(case, runs, (parent, factor), 2 * np.pi * noise_hz, rng)
    return IdentifiedSwing(case, law, training)


def polynomial_terms(n_x: int, degree: int) -> tuple[Indices, Indices]:
    """`parent` and `factor` of all monomials of n_x variables up to a degree (see `Polynomial`)."""
    place: dict[tuple[int, ...], int] = {(): 0}
    parent, factor = [0], [0]
    for order in range(1, degree + 1):
        for variables in itertools.combinations_with_replacement(range(n_x), order):
            place[variables] = len(parent)
            parent.append(place[variables[:-1]])
            factor.append(variables[-1])
    return np.array(parent), np.array(factor)


def fitted(
    case: Case,
    runs: list[Trajectory],
    terms: tuple[Indices, Indices],
    noise: float,
    rng: np.random.Generator,
    ridge: float = RIDGE,
) -> Polynomial:
    """Least squares over all bumps of all trajectories; noise in rad/s."""
    generators = generator_places(case)
    states = [np.hstack([run.theta[:, generators], run.p_load]) for run in runs]
    together = np.concatenate(states)
    centre, scale = together.mean(axis=0), together.std(axis=0)
    shape: Array = np.asarray(
        np.linalg.inv(np.linalg.cholesky(np.cov((together - centre).T / scale[:, None])))
    )
    reach = REACH * max(float(np.linalg.norm((x - centre) / scale @ shape.T, axis=1).max()) for x in states)
    features, powers = [], []
    for run, x in zip(runs, states, strict=True):
        omega = run.omega + noise * rng.standard_normal(run.omega.shape)
        value, _ = monomials(*terms, (x - centre) / scale, 0)
        averaged, power = _weighted(run, omega, value, machines_of(case))
        features.append(averaged)
        powers.append(power)
    f, y = np.concatenate(features), np.concatenate(powers)
    size = np.square(f).mean(axis=0)
    gram = np.vstack([f, np.diag(np.sqrt(ridge * len(f) * size))])
    weight = np.linalg.lstsq(gram, np.vstack([y, np.zeros((len(size), y.shape[1]))]), rcond=None)[0]
    return Polynomial(centre, scale, *terms, weight, shape, reach)


def _weighted(run: Trajectory, omega: Array, value: Array, machines: Array) -> tuple[Array, Array]:
    """Integrals over all bumps of one trajectory: of the monomials, and of the machines' powers."""
    dt = float(run.t[1] - run.t[0])
    half, every = round(HALF_S / dt), round(EVERY_S / dt)
    s = np.arange(-half, half + 1) / half
    bump = (1 - s**2) ** 4
    slope = -8 * s * (1 - s**2) ** 3 / (half * dt)
    slope, bump = slope / bump.sum(), bump / bump.sum()
    first = np.arange(0, len(omega) - 2 * half, every)
    window = first[:, None] + np.arange(2 * half + 1)
    m, d = machines
    power = np.einsum("s,nsg->ng", bump, (run.p_gen - d * omega)[window])
    power += m * np.einsum("s,nsg->ng", slope, omega[window])
    slack = run.p_slack[window] @ bump
    averaged = np.stack([value[k : k + 2 * half + 1].T @ bump for k in first])
    return averaged, np.hstack([power, slack[:, None]])
