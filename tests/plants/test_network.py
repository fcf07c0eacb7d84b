"""Power flow, load angles and linearisation: known numbers, closed forms, finite differences, refusals."""

from __future__ import annotations

import numpy as np
import pytest

from ded_bench.plants.lossless.algebraic import eliminate, elimination_order, solve_factorised
from ded_bench.plants.lossless.network import MISMATCH, Network
from ded_bench.plants.plant import SimulationError
from ded_bench.problem.sampling import sample_instances


@pytest.fixture(scope="module")
def network(case) -> Network:
    """The network of each case."""
    return Network(case)


@pytest.fixture(scope="module")
def chain(threebus):
    """Couplings a (slack - load) and b (load - generator) of the chain, by hand."""
    assert [bus.id for bus in threebus.buses] == ["town", "s", "plant"]
    return 1.02 / abs(0.01 + 0.12j), 1.03 / 0.1


def random_powers(case, n: int, seed: int = 0):
    """Generator powers within their limits and loads within half of nominal to either side."""
    rng = np.random.default_rng(seed)
    p_gen = rng.uniform(case.p_min, case.p_max, (n, len(case.generators)))
    p_load = case.load_nominal * rng.uniform(0.5, 1.5, (n, len(case.loads)))
    return p_gen, p_load


# Known numbers of the 9-bus case at nominal power, given to 4 digits.


def test_ninebus_has_its_documented_numbers(ninebus):
    """Angles at buses s, 2..9 in rad, P_s in pu, two damped pairs in rad/s.

    The slack answers a load step at once: shares .53, .14 and .53 of a step at loads 5, 7 and 9, where
    δP_s = -share · δL, L being an injection.
    """
    network = Network(ninebus)
    theta = network.power_flow(ninebus.p_nominal, ninebus.load_nominal)
    known = [0, 0.1705, 0.0889, -0.0371, -0.0637, 0.0403, 0.0161, 0.0709, -0.0695]
    np.testing.assert_allclose(theta, known, rtol=0, atol=0.5e-4)
    assert network.injections(theta)[network.slack] == pytest.approx(0.67, abs=1e-12)
    linear = network.linearise(theta)
    modes = sorted(linear.modes(), key=lambda mode: (mode.imag, mode.real))
    known = [-0.1722 - 1.4285j, -0.1892 - 0.6636j, -0.1892 + 0.6636j, -0.1722 + 1.4285j]
    np.testing.assert_allclose(np.real(modes), np.real(known), rtol=0, atol=0.5e-4)
    np.testing.assert_allclose(np.imag(modes), np.imag(known), rtol=0, atol=0.5e-4)
    np.testing.assert_allclose(-linear.slack_share, [0.53, 0.14, 0.53], rtol=0, atol=5e-3)


# Closed forms of the three-bus chain.


def test_chain_load_angle(threebus, chain):
    """a sin x + b sin(x - θ_g) = L is A sin(x - φ) = L with A cos φ = a + b cos θ_g, A sin φ = b sin θ_g."""
    a, b = chain
    network = Network(threebus)
    rng = np.random.default_rng(1)
    theta_gen, load = rng.uniform(-1.5, 1.5, 300), rng.uniform(-3, 3, 300)
    guess = np.stack([np.zeros(300), np.zeros(300), theta_gen], axis=1)
    theta, f = network.solve_loads(guess, network.load_injections(load[:, None]))
    np.testing.assert_allclose(f, network.injections(theta), rtol=0, atol=1e-14)  # rounding
    amplitude = np.hypot(a + b * np.cos(theta_gen), b * np.sin(theta_gen))
    phi = np.arctan2(b * np.sin(theta_gen), a + b * np.cos(theta_gen))
    np.testing.assert_allclose(theta[:, 0], phi + np.arcsin(load / amplitude), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(theta[:, 1:], guess[:, 1:])


def test_injections_at_any_angles(ninebus):
    """However many turns an angle has, as while Newton's method is far from a solution."""
    network = Network(ninebus)
    theta = np.random.default_rng(5).uniform(-40.0, 40.0, (200, network.n_bus))
    wanted = network.injections(theta)
    found, f = network.solve_loads(theta, wanted[:, network.algebraic])
    np.testing.assert_array_equal(found, theta)
    np.testing.assert_allclose(f, wanted, rtol=0, atol=1e-13 * network.coupling.sum())


@pytest.mark.parametrize("kept", [0, 4])
def test_elimination_is_that_of_full_matrices(kept: int):
    """Answers and the Schur complement of random sparse symmetric matrices, definite or not."""
    rng, n = np.random.default_rng(kept), 40
    for _ in range(20):
        pairs = rng.integers(0, n, (60, 2))
        pairs = pairs[pairs[:, 0] != pairs[:, 1]]
        half = np.diag(rng.uniform(10.0, 15.0, n) * rng.choice([-1.0, 1.0], n))
        half[pairs[:, 0], pairs[:, 1]] = rng.normal(size=len(pairs))
        matrix = half + half.T
        elimination, right = elimination_order(pairs.tolist(), n, kept), rng.normal(size=n)
        left, factor, x = matrix.copy(), np.empty(n - kept + len(elimination.met)), right.copy()
        eliminate(elimination, left, factor)
        inner, across = matrix[kept:, kept:], matrix[kept:, :kept]
        schur = matrix[:kept, :kept] - across.T @ np.linalg.solve(inner, across)
        np.testing.assert_allclose(left[:kept, :kept], schur, rtol=0, atol=1e-12)
        if not kept:
            solve_factorised(elimination, factor, x)
            np.testing.assert_allclose(matrix @ x, right, rtol=0, atol=1e-13)


def test_elimination_meets_few():
    """A square grid has no more entries than nested dissection leaves: 31/4 n log2 n (George, 1973)."""
    side = 12
    pairs = [(side * i + j, side * i + j + 1) for i in range(side) for j in range(side - 1)]
    pairs += [(side * i + j, side * i + side + j) for i in range(side - 1) for j in range(side)]
    n = side**2
    elimination = elimination_order(pairs, n)
    assert sorted(elimination.order) == list(range(n))
    assert len(elimination.met) < 31 / 4 * n * np.log2(side)


# Properties that hold on every case.


def test_injections_sum_to_zero(network):
    """Lines are lossless: whatever the angles, what goes in comes out."""
    theta = np.random.default_rng(2).uniform(-np.pi, np.pi, (50, 4, network.n_bus))
    f = network.injections(theta)
    assert f.shape == theta.shape
    assert np.abs(f.sum(axis=-1)).max() < 1e-13 * network.coupling.sum()


def test_power_flow_satisfies_its_equations(case, network):
    """Every bus injects what it should, the slack what is left; angles relative to the slack."""
    p_gen, p_load = random_powers(case, 200)
    theta = network.power_flow(p_gen, p_load)
    f = network.injections(theta)
    np.testing.assert_allclose(f[:, network.generators], p_gen, rtol=0, atol=MISMATCH)
    np.testing.assert_allclose(f[:, network.loads], p_load, rtol=0, atol=MISMATCH)
    junctions = sorted(set(network.algebraic) - set(network.loads))
    assert len(junctions) == [bus.kind for bus in case.buses].count("junction")
    assert np.abs(f[:, junctions]).max(initial=0.0) < MISMATCH
    balance = -p_gen.sum(axis=-1) - p_load.sum(axis=-1)
    np.testing.assert_allclose(f[:, network.slack], balance, rtol=0, atol=network.n_bus * MISMATCH)
    np.testing.assert_array_equal(theta[:, network.slack], 0.0)


def test_batches_equal_one_by_one(case, network):
    """Leading dimensions broadcast and do not mix."""
    p_gen, p_load = random_powers(case, 6)
    batch = network.power_flow(p_gen.reshape(2, 3, -1), p_load.reshape(2, 3, -1)).reshape(6, -1)
    one_by_one = [network.power_flow(g, load) for g, load in zip(p_gen, p_load, strict=True)]
    np.testing.assert_allclose(batch, one_by_one, rtol=0, atol=1e-12)
    mixed = network.power_flow(p_gen[0], p_load)
    np.testing.assert_allclose(mixed[4], network.power_flow(p_gen[0], p_load[4]), rtol=0, atol=1e-12)


def test_initial_angles_serve_initial_power_and_loads(case, network):
    """The state at t_0 is an equilibrium of P_0 and the loads before any ramp."""
    for instance in sample_instances(case, 21, 20):
        f = network.injections(network.initial_angles(instance))
        np.testing.assert_allclose(f[network.generators], instance.p_initial(case), rtol=0, atol=1e-11)
        initial = [instance.load[bus].initial for bus in case.loads]
        np.testing.assert_allclose(f[network.loads], initial, rtol=0, atol=1e-11)


def test_linearisation_matches_finite_differences(case, network):
    """Central differences of the nonlinear functions with load angles eliminated by Newton.

    Step h = 1e-4 rad or pu: truncation of order h² ~ 1e-8 times third derivatives, rounding about
    1e-12/h ~ 1e-8; hence 1e-6.
    """
    h = 1e-4
    for p_gen, p_load in zip(*random_powers(case, 5), strict=True):
        theta = network.power_flow(p_gen, p_load)
        linear = network.linearise(theta)

        def f_at(
            gen: np.ndarray, load: np.ndarray, theta: np.ndarray = theta, p_load: np.ndarray = p_load
        ) -> np.ndarray:
            moved = theta.copy()
            moved[network.generators] += gen
            return network.solve_loads(moved, network.load_injections(p_load + load))[1]

        still, steady = np.zeros(len(case.generators)), np.zeros(len(case.loads))
        for j, step in enumerate(h * np.eye(len(still))):
            slope = (f_at(step, steady) - f_at(-step, steady)) / (2 * h)
            np.testing.assert_allclose(linear.stiffness[:, j], slope[network.generators], rtol=0, atol=1e-6)
            assert slope[network.slack] == pytest.approx(-linear.stiffness[:, j].sum(), abs=1e-6)
        for j, step in enumerate(h * np.eye(len(steady))):
            slope = (f_at(still, step) - f_at(still, -step)) / (2 * h)
            np.testing.assert_allclose(linear.share[:, j], slope[network.generators], rtol=0, atol=1e-6)
            assert linear.slack_share[j] == pytest.approx(slope[network.slack], abs=1e-6)


# Refusals.


def test_power_flow_answers_exactly_where_there_is_a_stable_answer(threebus, chain):
    """On the chain that is |P + L| < a and |P| < b; elsewhere, and for other roots, it refuses."""
    a, b = chain
    network = Network(threebus)
    loadings = np.array([-1.5, -1.02, -0.99, -0.9, -0.5, 0.0, 0.3, 0.7, 0.95, 0.99, 1.01, 1.2, 2.0])
    for slack_line in loadings:
        for generator_line in loadings:
            p_gen = np.array([generator_line * b])
            p_load = np.array([slack_line * a]) - p_gen
            if max(abs(slack_line), abs(generator_line)) < 1:
                theta = network.power_flow(p_gen, p_load)
                town = np.arcsin(slack_line)
                known = [town, 0, town + np.arcsin(generator_line)]
                np.testing.assert_allclose(theta, known, rtol=0, atol=1e-10)
            else:
                with pytest.raises(SimulationError):
                    network.power_flow(p_gen, p_load)
