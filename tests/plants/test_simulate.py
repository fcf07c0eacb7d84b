"""The simulator: rest, energy, small perturbations, closed forms, SciPy's integrator, loss of synchronism."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pytest
from scipy.integrate import cumulative_simpson, solve_ivp
from scipy.linalg import expm

from ded_bench.files.errors import InputError
from ded_bench.files.strict import parse_record
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import sample_instance
from ded_bench.problem.schedule import Schedule
from ded_bench.plants.lossless.network import Network
from ded_bench.plants.simulate import SimulationError, simulate


def swinging(case, omega: float) -> dict:
    """Nominal power, neighbouring generators at ±ω in rad/s."""
    return {
        "power": dict(zip(case.generators, case.p_nominal.tolist(), strict=True)),
        "omega": {bus: omega * (-1) ** i for i, bus in enumerate(case.generators)},
    }


def ramping(case, rate: float, start: float = 0.0, duration: float = 1e6) -> dict:
    """Nominal loads; the j-th changes by (-1)^j · rate pu/s from `start` on."""
    return {
        bus: {"initial": value, "start": start, "duration": duration, "rate": rate * (-1) ** j}
        for j, (bus, value) in enumerate(zip(case.loads, case.load_nominal.tolist(), strict=True))
    }


def test_equilibrium_stays_at_rest(case, quiet_instance, constant):
    """Nothing moves but rounding: Newton's mismatch of 1e-12 pu through the slowest mode is below 1e-11."""
    instance = quiet_instance(case, horizon_s=10.0)
    trajectory = simulate(case, instance, constant(instance, case.p_nominal))
    assert np.abs(trajectory.omega).max() < 1e-11
    assert np.abs(trajectory.theta - trajectory.theta[0]).max() < 1e-11
    p_slack = -case.p_nominal.sum() - case.load_nominal.sum()
    np.testing.assert_allclose(trajectory.p_slack, p_slack, rtol=0, atol=1e-11)


def test_the_system_returns_to_rest(case, quiet_instance, constant):
    """After a push and a jump of power it settles where the power flow says, as fast as its modes decay."""
    p_end = 0.5 * (case.p_nominal + case.p_max)
    instance = quiet_instance(case, horizon_s=60.0, dt_s=0.05, initial=swinging(case, 0.1))
    trajectory = simulate(case, instance, constant(instance, p_end))
    network = Network(case)
    rest = network.power_flow(p_end, case.load_nominal)
    slowest = np.exp(network.linearise(rest).modes().real.max() * 60.0)
    assert slowest < 1e-4
    assert np.abs(trajectory.omega[-1]).max() < 3 * slowest
    assert np.abs(trajectory.theta[-1] - rest).max() < 3 * slowest
    assert np.abs(trajectory.omega).max() > 0.05


def test_trajectories_hold_their_inputs(case, alter):
    """What the schedule and the loads were at each t_k, and the state that the instance starts in."""
    instance = alter(sample_instance(case, 31, 0), horizon_s=6.0)
    rng = np.random.default_rng(0)
    p = rng.uniform(case.p_min, case.p_max, (7, len(case.generators)))
    schedule = Schedule(t=np.linspace(0, instance.horizon_s, 7), p=p)
    trajectory = simulate(case, instance, schedule)
    network = Network(case)
    np.testing.assert_array_equal(trajectory.t, instance.grid)
    np.testing.assert_array_equal(trajectory.p_gen, schedule.at(instance.grid))
    np.testing.assert_array_equal(trajectory.p_load, instance.p_load(case))
    np.testing.assert_array_equal(trajectory.omega[0], instance.omega_initial(case))
    np.testing.assert_allclose(trajectory.theta[0], network.initial_angles(instance), rtol=0, atol=1e-12)
    f = network.injections(trajectory.theta)
    np.testing.assert_allclose(f[:, network.loads], trajectory.p_load, rtol=0, atol=1e-11)
    np.testing.assert_allclose(trajectory.p_slack, f[:, network.slack], rtol=0, atol=1e-14)
    np.testing.assert_array_equal(trajectory.theta[:, network.slack], 0.0)


def test_p_slack_is_what_acceleration_and_damping_leave(case, quiet_instance):
    """The sum of all swing equations: P_s = Σ (M ω' + D ω) - Σ P - Σ L, ω' by central differences.

    Over dt = 0.01 s these err by dt²/6 times the third derivative of ω, below 1e-4 of its amplitude;
    grid points next to a kink of the loads are left out.
    """
    instance = quiet_instance(
        case, horizon_s=6.0, initial=swinging(case, 0.02), load=ramping(case, -0.02, 1.003, 2.0)
    )
    rising = Schedule(np.array([0.0, 6.0]), np.stack([case.p_nominal, case.p_nominal + 0.2]))
    trajectory = simulate(case, instance, rising)
    m = np.array([case.machines[g].m for g in case.generators])
    d = np.array([case.machines[g].d for g in case.generators])
    rate = (trajectory.omega[2:] - trajectory.omega[:-2]) / (2 * instance.dt_s)
    transient = rate @ m + trajectory.omega[1:-1] @ d
    imbalance = trajectory.p_slack + trajectory.p_gen.sum(axis=1) + trajectory.p_load.sum(axis=1)
    smooth = np.abs(np.diff(trajectory.p_load, n=2, axis=0)).max(axis=1) < 1e-12
    assert 2 <= (~smooth).sum() <= 4
    error = np.abs(imbalance[1:-1] - transient)[smooth]
    assert error.max() < 1e-4 * np.abs(trajectory.omega).max() * m.sum()
    assert np.abs(imbalance).max() > 1e-2


# Energy.


def energy(case, trajectory) -> np.ndarray:
    """Kinetic energy, energy stored in the lines, and potential of constant powers, shape (n_t,)."""
    network = Network(case)
    m = np.array([case.machines[g].m for g in case.generators])
    kinetic = 0.5 * trajectory.omega**2 @ m
    across = trajectory.theta @ network.incidence.T
    lines = (1 - np.cos(across)) @ network.coupling
    work = (trajectory.p_gen * trajectory.theta[:, network.generators]).sum(axis=1)
    return kinetic + lines - work - (trajectory.p_load * trajectory.theta[:, network.loads]).sum(axis=1)


def test_energy_is_conserved_without_damping(case, alter, quiet_instance, constant):
    """With D = 0 and constant inputs, H = kinetic + line - P·θ - L·θ is a first integral.

    Tolerance: on steps of h = 0.01 s a fifth-order method errs by about (ν h)^6 / 720 ~ 1e-14 per step
    for the fastest mode here, ν = 1.5 rad/s, and Newton stops at 1e-12 pu; over 1000 steps both stay
    below 1e-9 of the energy of the swing.
    """
    machines = {g: {**machine.model_dump(), "d": 0.0} for g, machine in case.machines.items()}
    frictionless = alter(case, machines=machines)
    instance = quiet_instance(frictionless, horizon_s=10.0, initial=swinging(case, 0.3))
    trajectory = simulate(frictionless, instance, constant(instance, case.p_nominal))
    total = energy(frictionless, trajectory)
    m = np.array([case.machines[g].m for g in case.generators])
    swing = 0.5 * 0.3**2 * m.sum()
    assert np.abs(total - total[0]).max() < 1e-9 * swing
    kinetic = 0.5 * trajectory.omega**2 @ m
    assert kinetic.max() - kinetic.min() > 0.5 * swing  # it swings: energy does go back and forth


def test_damping_takes_the_energy_that_is_lost(case, quiet_instance, constant):
    """H(t) - H(0) = -∫ Σ D ω² dt; Simpson's rule at 0.01 s errs by less than 2e-7 of what is lost."""
    instance = quiet_instance(case, horizon_s=10.0, initial=swinging(case, 0.3))
    trajectory = simulate(case, instance, constant(instance, case.p_nominal))
    d = np.array([case.machines[g].d for g in case.generators])
    lost = cumulative_simpson(trajectory.omega**2 @ d, x=trajectory.t, initial=0.0)
    total = energy(case, trajectory)
    assert lost[-1] > 0
    np.testing.assert_allclose(total[0] - total, lost, rtol=0, atol=2e-7 * lost[-1])


# Small perturbations.


def linear_answer(case, instance, p_gen, rates) -> tuple[np.ndarray, np.ndarray]:
    """ω and P_s of the linearised DAE at the initial equilibrium, by the matrix exponential of one step.

    State (δθ, ω, 1, t), with constant p_gen from t = 0 on and loads that ramp at `rates`.
    """
    network = Network(case)
    theta = network.initial_angles(instance)
    linear = network.linearise(theta)
    n, m = len(case.generators), linear.m[:, None]
    a = np.zeros((2 * n + 2, 2 * n + 2))
    a[:n, n : 2 * n] = np.eye(n)
    a[n : 2 * n, :n] = -linear.stiffness / m
    a[n : 2 * n, n : 2 * n] = -np.diag(linear.d / linear.m)
    a[n : 2 * n, [2 * n]] = (p_gen - instance.p_initial(case))[:, None] / m
    a[n : 2 * n, [2 * n + 1]] = -(linear.share @ rates)[:, None] / m
    a[2 * n + 1, 2 * n] = 1.0
    step = expm(a * instance.dt_s)
    x = [np.concatenate([np.zeros(n), instance.omega_initial(case), [1.0, 0.0]])]
    for _ in range(instance.steps):
        x.append(step @ x[-1])
    states = np.array(x)
    time = states[:, -1:]
    delta_f = states[:, :n] @ linear.stiffness.T + time * (linear.share @ rates)
    p_slack = -instance.p_initial(case).sum() - instance.p_load(case)[0].sum()
    return states[:, n : 2 * n], p_slack - delta_f.sum(axis=1) - (time * rates).sum(axis=1)


def test_small_perturbations_follow_the_linearised_dynamics_to_second_order(case, quiet_instance, constant):
    """A push, a jump of power and load ramps of size ε: errors shrink fourfold as ε halves."""
    errors = []
    for size in (0.1, 0.05):
        horizon = 6.0
        rates = 0.01 * size * (-1.0) ** np.arange(len(case.loads))
        instance = quiet_instance(
            case,
            horizon_s=horizon,
            initial=swinging(case, 0.04 * size),
            load=ramping(case, 0.01 * size),
        )
        p_gen = case.p_nominal + 0.1 * size * np.arange(1, len(case.generators) + 1)
        trajectory = simulate(case, instance, constant(instance, p_gen))
        omega, p_slack = linear_answer(case, instance, p_gen, rates)
        errors.append([np.abs(trajectory.omega - omega).max(), np.abs(trajectory.p_slack - p_slack).max()])
        assert errors[-1][0] < 1e-3 * np.abs(omega).max()
    ratio = np.array(errors[0]) / np.array(errors[1])
    assert ((ratio > 3.5) & (ratio < 4.5)).all()


# The chain as one ordinary differential equation.


@pytest.mark.parametrize(
    ("p_start", "p_end", "rate", "angle", "atol"),
    [(0.6, 0.9, -0.05, 0.5, 1e-10), (15.0, 15.0, 0.0, 12 * np.pi, 1e-5)],
    ids=["large swings", "slipping poles"],
)
def test_chain_follows_its_scalar_swing_equation(threebus, quiet_instance, p_start, p_end, rate, angle, atol):
    """With the load angle in closed form, one generator is a scalar ODE, solved here by DOP853.

    A push of 1 rad/s, a sloped schedule and a load ramp; and 15 pu, which the line cannot carry: with
    a light load between lines of unequal strength, load angles exist all the way round, so nothing
    stops the simulation and the scorer sees a frequency that no regime allows. There, P_s changes by
    5 pu within one step, which magnifies errors in time.
    """
    a, b = 1.02 / abs(0.01 + 0.12j), 1.03 / 0.1
    instance = quiet_instance(threebus, initial=swinging(threebus, 1.0), load=ramping(threebus, rate))
    schedule = Schedule(t=np.array([0.0, 6.0]), p=np.array([[p_start], [p_end]]))
    slope = (p_end - p_start) / 6.0

    def torque_and_slack(t, theta):
        amplitude = np.hypot(a + b * np.cos(theta), b * np.sin(theta))
        phi = np.arctan2(b * np.sin(theta), a + b * np.cos(theta))
        town = phi + np.arcsin((-1.0 + rate * t) / amplitude)
        return b * np.sin(theta - town), -a * np.sin(town)

    def rhs(t, y):
        return [y[1], (p_start + slope * t - torque_and_slack(t, y[0])[0] - 1.2 * y[1]) / 2.0]

    start = np.arcsin((0.6 - 1.0) / a) + np.arcsin(0.6 / b)
    grid = instance.grid
    known = solve_ivp(rhs, (0, 6), [start, 1.0], "DOP853", t_eval=grid, rtol=1e-12, atol=1e-13).y
    trajectory = simulate(threebus, instance, schedule)
    assert np.abs(trajectory.theta).max() > angle
    np.testing.assert_allclose(trajectory.theta[:, 2], known[0], rtol=0, atol=atol)
    np.testing.assert_allclose(trajectory.omega[:, 0], known[1], rtol=0, atol=atol)
    p_slack = torque_and_slack(grid, known[0])[1]
    np.testing.assert_allclose(trajectory.p_slack, p_slack, rtol=0, atol=atol)


# Any state.


def continued(case, instance, trajectory, k: int):
    """The instance that begins at grid point k of a trajectory, its loads given by points."""
    tau, grid = trajectory.t[k], trajectory.t[k:] - trajectory.t[k]
    gen = Network(case).generators
    data = json.loads(instance.model_dump_json(by_alias=True)) | {"schema": "ded-bench/instance/2"}
    data["horizon_s"] = instance.horizon_s - tau
    data["load"] = {
        bus: {"points": np.column_stack([grid, column]).tolist()}
        for bus, column in zip(case.loads, trajectory.p_load[k:].T, strict=True)
    }
    data["initial"] = {
        name: dict(zip(case.generators, values.tolist(), strict=True))
        for name, values in (
            ("power", trajectory.p_gen[k]),
            ("omega", trajectory.omega[k]),
            ("theta", trajectory.theta[k, gen]),
        )
    }
    return parse_record(Instance, json.dumps(data), "continued")


def test_a_trajectory_goes_on_from_any_of_its_states(case, alter):
    """(θ, ω, P) at an instant, far from any equilibrium, and the loads to come determine all that follows."""
    instance = alter(sample_instance(case, 31, 2), horizon_s=6.0, initial=swinging(case, 0.1))
    rng = np.random.default_rng(2)
    p = rng.uniform(case.p_min, case.p_max, (7, len(case.generators)))
    uncut = simulate(case, instance, Schedule(np.linspace(0.0, 6.0, 7), p))
    for k in (1, 137, 300):
        rest = continued(case, instance, uncut, k)
        part = simulate(case, rest, Schedule(rest.grid, uncut.p_gen[k:]))
        for name in ("theta", "omega", "p_slack"):
            np.testing.assert_allclose(getattr(part, name), getattr(uncut, name)[k:], rtol=0, atol=2e-9)
    deviation = Network(case).power_flow(uncut.p_gen[300], uncut.p_load[300]) - uncut.theta[300]
    assert np.abs(deviation).max() > 1e-2


def test_points_that_equal_a_ramp_give_the_same_trajectory(case, quiet_instance, constant):
    """A load's path is what counts, not how the file says it."""
    ramped = quiet_instance(case, horizon_s=2.0, load=ramping(case, -0.02, 0.503, 1.0))
    points = {
        bus: {"points": [[t, float(load.at(np.array(t)))] for t in (0.0, 0.503, 1.503, 2.0)]}
        for bus, load in ramped.load.items()
    }
    pointed = quiet_instance(case, schema="ded-bench/instance/2", horizon_s=2.0, load=points)
    schedule = constant(ramped, case.p_nominal)
    first, second = (simulate(case, i, schedule) for i in (ramped, pointed))
    np.testing.assert_allclose(second.omega, first.omega, rtol=0, atol=1e-12)
    np.testing.assert_allclose(second.p_slack, first.p_slack, rtol=0, atol=1e-12)
    assert np.abs(first.omega).max() > 1e-4


# Against SciPy's adaptive integrator.


def test_fixed_steps_agree_with_scipys_adaptive_ones(case, alter):
    """Knots between grid points, load ramps and a swing; SciPy starts anew wherever an input bends.

    SciPy's local error is 1e-11 of the state; over some thousand steps less than 1e-8 remains.
    """
    instance = alter(sample_instance(case, 31, 1), horizon_s=6.0)
    rng = np.random.default_rng(1)
    p = rng.uniform(case.p_min, case.p_max, (5, len(case.generators)))
    trajectory = simulate(case, instance, Schedule(np.linspace(0, instance.horizon_s, 5), p))
    theta, omega = adaptive(case, trajectory)
    assert np.abs(trajectory.omega).max() > 1e-2
    np.testing.assert_allclose(trajectory.omega, omega, rtol=0, atol=1e-8)
    gen = Network(case).generators
    np.testing.assert_allclose(trajectory.theta[:, gen], theta, rtol=0, atol=1e-8)


def test_fixed_steps_agree_with_scipys_on_a_zigzag(case, alter):
    """Inputs bend at every grid point, so that extrapolated load angles are poor guesses."""
    instance = alter(sample_instance(case, 31, 1), horizon_s=0.5)
    zigzag = case.p_nominal + 1e-3 * (-1.0) ** np.arange(len(instance.grid))[:, None]
    trajectory = simulate(case, instance, Schedule(instance.grid, zigzag))
    _, omega = adaptive(case, trajectory)
    np.testing.assert_allclose(trajectory.omega, omega, rtol=0, atol=1e-9)


def adaptive(case, trajectory) -> tuple[np.ndarray, np.ndarray]:
    """θ and ω of the generators under a trajectory's inputs by SciPy's DOP853, each (n, n_gen)."""
    network, t = Network(case), trajectory.t
    gen, injection = network.generators, network.load_injections(trajectory.p_load)
    n, angles = len(gen), trajectory.theta[0].copy()
    inputs = np.hstack([trajectory.p_gen, injection])
    bent = np.abs(np.diff(inputs, n=2, axis=0)).max(axis=1) > 1e-12
    knots = np.array([0, *(1 + np.flatnonzero(bent)), len(t) - 1])
    out = np.empty((len(t), 2 * n))
    out[0] = np.concatenate([angles[gen], trajectory.omega[0]])
    for first, last in itertools.pairwise(knots):

        def rhs(time, y, first=first, last=last):
            share = (time - t[first]) / (t[last] - t[first])
            now = (1 - share) * inputs[first] + share * inputs[last]
            angles[gen] = y[:n]
            angles[:], f = network.solve_loads(angles, now[n:])
            return np.concatenate([y[n:], network.acceleration(y[n:], now[:n], f[gen])])

        answer = solve_ivp(
            rhs,
            (t[first], t[last]),
            out[first],
            "DOP853",
            t[first : last + 1],
            rtol=1e-11,
            atol=1e-12,
            max_step=0.5,
        )
        out[first + 1 : last + 1] = answer.y.T[1:]
    return out[:, :n], out[:, n:]


def test_simulating_twice_gives_the_same_bits(case, alter):
    """Nothing is random and nothing is kept from the run before."""
    instance = alter(sample_instance(case, 41, 9), horizon_s=1.0)
    schedule = Schedule(t=np.array([0.0, 1.0]), p=np.stack([case.p_min, case.p_max]))
    first, second = simulate(case, instance, schedule), simulate(case, instance, schedule)
    np.testing.assert_array_equal(first.omega, second.omega)
    np.testing.assert_array_equal(first.p_slack, second.p_slack)


# Refusals.


@pytest.mark.parametrize("power", [20.0, -20.0, 1e6, 1e308])
def test_losing_synchronism_is_an_error(case, quiet_instance, constant, power):
    """Far more power than lines can carry pulls generators away until loads cannot be served."""
    loads = ramping(case, 0.0)
    for load in loads.values():
        load["initial"] *= 2
    instance = quiet_instance(case, load=loads)
    with pytest.raises(SimulationError, match="cannot follow this schedule"):
        simulate(case, instance, constant(instance, np.full(len(case.generators), power)))


def test_a_collapsing_load_is_an_error(case, quiet_instance, constant):
    """Loads that ramp beyond what the network can deliver."""
    instance = quiet_instance(case, load=ramping(case, -20.0))
    with pytest.raises(SimulationError, match="cannot follow this schedule"):
        simulate(case, instance, constant(instance, case.p_nominal))


def test_an_impossible_start_is_an_error(case, quiet_instance, constant):
    """No power flow at t = 0, no trajectory."""
    power = dict.fromkeys(case.generators, 50.0)
    instance = quiet_instance(case, initial={"power": power, "omega": dict.fromkeys(case.generators, 0.0)})
    with pytest.raises(SimulationError):
        simulate(case, instance, constant(instance, case.p_nominal))


def test_schedules_of_another_horizon_are_refused(case, quiet_instance):
    instance = quiet_instance(case)
    short = Schedule(t=np.array([0.0, 1.0]), p=np.stack([case.p_nominal] * 2))
    with pytest.raises(InputError, match="must end at the horizon"):
        simulate(case, instance, short)
