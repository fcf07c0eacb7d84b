"""The simulator: rest, energy, closed forms, the cheaper integration for plans, loss of synchronism."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ded_bench.methods import ed
from ded_bench.plants.lossless import lossless_plant, stepper
from ded_bench.plants.lossless.network import Network
from ded_bench.plants.plant import SimulationError, plant_of, simulate
from ded_bench.problem.case import Case
from ded_bench.problem.sampling import sample_instance
from ded_bench.problem.schedule import Schedule


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


# Energy.


def energy(case, trajectory) -> np.ndarray:
    """Kinetic energy, energy stored in the lines, and potential of constant powers, shape (n_t,)."""
    network = Network(case)
    m = np.array([case.machines[g].m for g in case.generators])
    kinetic = 0.5 * trajectory.omega**2 @ m
    across = trajectory.states @ network.incidence.T
    lines = (1 - np.cos(across)) @ network.coupling
    work = (trajectory.p_gen * trajectory.states[:, network.generators]).sum(axis=1)
    return kinetic + lines - work - (trajectory.p_load * trajectory.states[:, network.loads]).sum(axis=1)


def test_energy_is_conserved_without_damping(case, alter, quiet_instance, constant):
    """With D = 0 and constant inputs, H = kinetic + line - P·θ - L·θ is a first integral.

    Tolerance: a step errs by about (ν h)^6 / 720 ~ 1e-11 for the fastest mode here, ν = 4.5 rad/s, and Newton
    stops at 1e-12 pu; over 1000 steps both stay below 1e-8 of the energy of the swing.
    """
    machines = {g: {**machine.model_dump(), "d": 0.0} for g, machine in case.machines.items()}
    frictionless = alter(case, machines=machines)
    instance = quiet_instance(frictionless, horizon_s=10.0, initial=swinging(case, 0.3))
    trajectory = simulate(frictionless, instance, constant(instance, case.p_nominal))
    total = energy(frictionless, trajectory)
    m = np.array([case.machines[g].m for g in case.generators])
    swing = 0.5 * 0.3**2 * m.sum()
    assert np.abs(total - total[0]).max() < 1e-8 * swing
    kinetic = 0.5 * trajectory.omega**2 @ m
    assert kinetic.max() - kinetic.min() > 0.5 * swing  # it swings: energy does go back and forth


# The chain as one ordinary differential equation.


@pytest.mark.parametrize(
    ("p_start", "p_end", "rate", "angle", "atol"),
    [(0.6, 0.9, -0.05, 0.5, 1e-10), (15.0, 15.0, 0.0, 12 * np.pi, 3e-5)],
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
    assert np.abs(trajectory.states).max() > angle
    np.testing.assert_allclose(trajectory.states[:, 2], known[0], rtol=0, atol=atol)
    np.testing.assert_allclose(trajectory.omega[:, 0], known[1], rtol=0, atol=atol)
    p_slack = torque_and_slack(grid, known[0])[1]
    np.testing.assert_allclose(trajectory.p_slack, p_slack, rtol=0, atol=atol)


# Where a linearisation follows.


@pytest.mark.parametrize("name", ["9bus", "two-area", "39bus", "140bus"])
def test_planning_is_exact_within_a_microhertz(name: str) -> None:
    """Under the static dispatch of every second, which shakes frequencies more than any plan does."""
    case = Case.load(name)
    instance = sample_instance(case, 77, 0).model_copy(update={"horizon_s": 20.0})
    schedule = ed.dispatch(case, instance, 1.0)
    plan, truth = (simulate(case, instance, schedule, exact=exact) for exact in (False, True))
    np.testing.assert_allclose(plan.omega, truth.omega, atol=2 * np.pi * 1e-6)
    np.testing.assert_allclose(plan.p_slack, truth.p_slack, atol=5e-6)
    np.testing.assert_array_equal(plan.p_gen, truth.p_gen)


def test_weights_have_their_order() -> None:
    """Runge-Kutta: conditions of order five, by sums over some rooted trees (Hairer et al., table II.2.2).

    Adams: from 0 to 1 they integrate what powers of time are at points before, and for the corrector at 1.
    """
    b, c = stepper.WEIGHTS, stepper.NODES
    a = np.hstack([stepper.STAGES, np.zeros((len(c), 1))])
    np.testing.assert_allclose(a.sum(axis=1), c, atol=1e-15)
    trees = [c**0, c, c**2, a @ c, c**3, c * (a @ c), a @ c**2, a @ a @ c, c**4, a @ a @ a @ c]
    known = [1, 1 / 2, 1 / 3, 1 / 6, 1 / 4, 1 / 8, 1 / 12, 1 / 24, 1 / 5, 1 / 120]
    np.testing.assert_allclose([b @ tree for tree in trees], known)
    degree = np.arange(6)[:, None]
    for weights, first in ((stepper.BASHFORTH, 0.0), (stepper.MOULTON, 1.0)):
        points = first - np.arange(6)
        np.testing.assert_allclose((weights * points**degree).sum(axis=1), 1 / (degree[:, 0] + 1), rtol=1e-8)


@pytest.mark.parametrize("name", ["9bus", "two-area", "39bus", "68bus", "140bus"])
def test_shorter_steps_change_nothing(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A schedule with two kinks a second: within 1e-9 Hz, a thousandth of what strict feasibility leaves."""
    case = Case.load(name)
    instance = sample_instance(case, 77, 0).model_copy(update={"horizon_s": 20.0})
    schedule = ed.dispatch(case, instance, 1.0)
    found = simulate(case, instance, schedule)
    fastest = np.abs(plant_of(case).nominal().modes).max()
    monkeypatch.setattr(lossless_plant, "STEP_BY_MODE", fastest * instance.dt_s / 8)  # so many a point
    known = simulate(case, instance, schedule)
    assert not np.array_equal(found.omega, known.omega)
    np.testing.assert_allclose(found.omega, known.omega, rtol=0, atol=2 * np.pi * 1e-9)


# Refusals.


@pytest.mark.parametrize("power", [20.0, -20.0, 50.0, 1e6, 1e308])
def test_losing_synchronism_is_an_error(case, quiet_instance, constant, power):
    """Far more power than lines can carry pulls generators away until loads cannot be served."""
    loads = ramping(case, 0.0)
    for load in loads.values():
        load["initial"] *= 2
    instance = quiet_instance(case, load=loads)
    with pytest.raises(SimulationError, match="cannot follow this schedule"):
        simulate(case, instance, constant(instance, np.full(len(case.generators), power)))
