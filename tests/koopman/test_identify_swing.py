"""Swing equations identified from trajectories: they find laws that are polynomials, and know their data."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import safetensors.numpy

from ded_bench.cli import main
from ded_bench.evaluate import ac_rollouts
from ded_bench.files.errors import InputError
from ded_bench.koopman.identified_swing import IdentifiedSwing, machines_of, monomials
from ded_bench.koopman.identify_swing import fitted, identify_swing, polynomial_terms
from ded_bench.koopman.swing_integrator import Polynomial
from ded_bench.methods import ded_ko_knots_swing
from ded_bench.methods.registry import get_method
from ded_bench.methods.solution import Settings
from ded_bench.problem.ac_case import AcCase
from ded_bench.problem.benchmark import validation_instances
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.status import Status
from ded_bench.truth.network import Network
from ded_bench.truth.simulate import SimulationError, Trajectory

TWO_AREA = Case.load("two-area")
N_GEN, N_X = 3, 5


def made_up() -> IdentifiedSwing:
    """A quadratic law whose equilibria are stable: p = S δθ + P_load shares + a little of every square."""
    parent, factor = polynomial_terms(N_X, 2)
    weight = np.zeros((len(parent), N_GEN + 1))
    weight[0, :N_GEN], weight[0, N_GEN] = TWO_AREA.p_nominal, 7.0
    weight[1:4] = np.array([[9.0, -3.0, -2.0, -4.0], [-3.0, 8.0, -2.0, -3.0], [-2.0, -2.0, 7.0, -3.0]])
    weight[4:6] = -0.2
    weight[6:] = 0.1 * np.random.default_rng(5).standard_normal((len(parent) - 6, N_GEN + 1))
    centre = np.concatenate([[0.4, 0.2, -0.3], TWO_AREA.load_nominal])
    law = Polynomial(centre, np.array([1.0, 1.0, 1.0, 4.0, 4.0]), parent, factor, weight, np.eye(N_X), 9.0)
    return IdentifiedSwing(TWO_AREA, law, {})


@pytest.fixture(scope="module")
def runs() -> list[tuple[Instance, Trajectory]]:
    """What the made-up law does under random powers, ten seconds each."""
    model, found = made_up(), []
    for number, instance in enumerate(validation_instances(TWO_AREA, 8)):
        short = instance.model_copy(update={"horizon_s": 10.0})
        p = np.random.default_rng(number).uniform(-1.0, 1.0, (11, N_GEN)) + TWO_AREA.p_nominal
        p[0] = short.p_initial(TWO_AREA)
        found.append((short, model.simulate(short, Schedule(np.linspace(0.0, 10.0, 11), p))))
    return found


def test_monomials_of_two_variables():
    parent, factor = polynomial_terms(2, 3)
    x, y = 1.3, -0.7
    value, slope = monomials(parent, factor, np.array([[x, y]]), 1)
    assert value[0] == pytest.approx([1, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3])
    assert slope[0, :, 0] == pytest.approx([0, 1, 0, 2 * x, y, 0, 3 * x * x, 2 * x * y, y * y, 0])


def test_least_squares_find_a_polynomial(runs):
    """Of degree two, with polynomials of degree three: no noise, so to the errors of quadrature and ridge."""
    law = fitted(TWO_AREA, [run for _, run in runs], polynomial_terms(N_X, 3), 0.0, np.random.default_rng(0))
    found, truth = IdentifiedSwing(TWO_AREA, law, {}), made_up()
    for instance, run in runs:
        again = found.simulate(instance, Schedule(run.t, run.p_gen))
        assert np.abs(again.omega - run.omega).max() < 3e-4 * np.abs(run.omega).max()
        theta = run.theta[::100][:, [b.kind == "generator" for b in TWO_AREA.buses]]
        said, slope = found.power(theta, run.p_load[::100])
        exact, exact_slope = truth.power(theta, run.p_load[::100])
        assert np.abs(said - exact).max() < 1e-3
        assert np.abs(slope - exact_slope).max() < 5e-2  # of 9 pu/rad


def test_noise_is_averaged(runs):
    """1e-4 Hz on every measured frequency, differentiated over one step, would be 9 rad/s² times m."""
    noise = 2 * np.pi * 1e-4
    law = fitted(
        TWO_AREA, [run for _, run in runs], polynomial_terms(N_X, 2), noise, np.random.default_rng(0)
    )
    found = IdentifiedSwing(TWO_AREA, law, {})
    errors = [
        np.abs(found.simulate(instance, Schedule(run.t, run.p_gen)).omega - run.omega).max()
        for instance, run in runs
    ]
    assert 1e-7 < np.mean(errors) < 2 * noise


def test_equilibria_rest():
    model, instance = made_up(), validation_instances(TWO_AREA, 1)[0]
    initial = instance.initial.model_copy(update={"omega": dict.fromkeys(TWO_AREA.generators, 0.0)})
    load = {bus: ramp.model_copy(update={"rate": 0.0}) for bus, ramp in instance.load.items()}
    quiet = instance.model_copy(update={"horizon_s": 1.0, "load": load, "initial": initial})
    still = Schedule(np.array([0.0, 1.0]), np.tile(quiet.p_initial(TWO_AREA), (2, 1)))
    assert np.abs(model.simulate(quiet, still).omega).max() < 1e-9


def test_given_angles_say_what_was_measured():
    """The model starts with the electrical powers of the lossless network, not with its angles."""
    instance = validation_instances(TWO_AREA, 1)[0]
    network, p_load = Network(TWO_AREA), instance.p_load(TWO_AREA, np.zeros(1))
    measured = instance.p_initial(TWO_AREA) + np.array([0.02, -0.03, 0.01])
    theta = network.power_flow(measured, p_load[0])[network.generators]
    initial = instance.initial.model_copy(
        update={"theta": dict(zip(TWO_AREA.generators, theta.tolist(), strict=True))}
    )
    state = made_up().initial_state(instance.model_copy(update={"initial": initial}))
    assert made_up().power(state.theta[None], p_load)[0][0, :-1] == pytest.approx(measured, abs=1e-9)
    assert np.abs(state.theta - theta).max() > 1e-3


def test_linear_model_is_the_derivative(runs):
    """Against central differences of simulations: what is left falls with the interval between knots."""
    model, (instance, run) = made_up(), runs[1]
    points = np.arange(0, 1001, 20)
    linear = model.linearise_along(run, points)
    change = 1e-4 * np.random.default_rng(3).standard_normal((len(points), N_GEN))
    change[0] = 0.0
    ahead, behind = (
        model.simulate(instance, Schedule(run.t[points], run.p_gen[points] + sign * change))
        for sign in (1, -1)
    )
    omega, p_slack = linear.outputs(change)
    difference = (ahead.omega - behind.omega) / 2
    assert np.abs(omega - linear.omega - difference).max() < 0.02 * np.abs(difference).max()
    slack = (ahead.p_slack - behind.p_slack) / 2
    assert np.abs(p_slack - linear.p_slack - slack).max() < 0.02 * np.abs(slack).max()


def test_nothing_is_said_beyond_the_data(runs):
    model, (instance, run) = made_up(), runs[0]
    narrow = dataclasses.replace(model, law=model.law._replace(reach=0.1))
    with pytest.raises(SimulationError, match="beyond the data"):
        narrow.simulate(instance, Schedule(run.t, run.p_gen))


def test_files_come_back(tmp_path):
    model, path = made_up(), tmp_path / "swing-ac.safetensors"
    model.save(path)
    again = IdentifiedSwing.load(path, TWO_AREA)
    assert again.fingerprint == model.fingerprint
    with pytest.raises(InputError, match="another case"):
        IdentifiedSwing.load(path, Case.load("39bus"))


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [("weight", np.zeros((2, 2)), "shape"), ("parent", np.arange(21.0), "polynomial")],
)
def test_damaged_files(tmp_path, name, value, said):
    path = tmp_path / "swing-ac.safetensors"
    made_up().save(path)
    with safetensors.safe_open(str(path), "np") as file:
        header, arrays = file.metadata(), {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    path.write_bytes(safetensors.numpy.save(arrays | {name: value}, header))
    with pytest.raises(InputError, match=said):
        IdentifiedSwing.load(path, TWO_AREA)


def test_too_many_monomials():
    grid = Case.load("39bus")
    with pytest.raises(InputError, match="monomials"):
        identify_swing(grid, AcCase.of(grid), degree=4)


def test_the_command_and_the_method(tmp_path, monkeypatch):
    """Two trajectories are too few for a good model; the road from command to answer is the same."""
    monkeypatch.setattr(ac_rollouts, "HELD_OUT", 1)
    command = f"train-ko --case two-area --truth ac --kind swing --count 2 --results {tmp_path}"
    assert main(command.split()) == 0
    method, settings = get_method("ded-ko-knots"), Settings("swing-ac", search=(tmp_path,))
    [artifact] = method.artifacts(TWO_AREA, "TO", settings)
    assert artifact.name == "swing-ac"
    assert method.module_of("swing-ac") == ded_ko_knots_swing.__name__
    file = Settings("swing-ac", str(tmp_path / "koopman" / "swing-ac.safetensors"))
    assert method.artifacts(TWO_AREA, "TO", file)[0].fingerprint == artifact.fingerprint


def test_method_without_a_model(tmp_path):
    with pytest.raises(InputError, match="train-ko"):
        get_method("ded-ko-knots").prepare(TWO_AREA, "TO", Settings("swing-ac", search=(tmp_path,)))
    assert main(["train-ko", "--case", "two-area", "--kind", "swing"]) == 2


@pytest.mark.parametrize("in_operation", [False, True])
def test_answers_keep_the_bound_of_their_model(tmp_path, in_operation):
    """The identified model's own simulation of the answer keeps the bound, and costs what was claimed."""
    path = tmp_path / "swing-ac.safetensors"
    made_up().save(path)
    solver = ded_ko_knots_swing.prepare(TWO_AREA, "NO", Settings("swing-ac", str(path)))
    instance = validation_instances(TWO_AREA, 2)[1]
    solution = solver(instance)
    assert solution.status == Status.OPTIMAL
    if in_operation:
        solution = solver.solve(instance, solution)
    assert solution.status == Status.OPTIMAL
    assert solution.schedule is not None
    run = made_up().simulate(instance, solution.schedule)
    assert np.abs(run.omega).max() <= TWO_AREA.omega_bound("NO") + 2 * np.pi * 1e-6
    cost = float((run.p_gen @ instance.cost_gen(TWO_AREA)).sum())
    cost += instance.cost_slack(TWO_AREA) * float(np.abs(run.p_slack).sum())
    assert cost == pytest.approx(solution.solver_objective, rel=1e-6)
    assert machines_of(TWO_AREA).shape == (2, N_GEN)
