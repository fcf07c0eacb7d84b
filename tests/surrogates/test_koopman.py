"""The surrogate: guarantees by construction, exactness near equilibrium, condensed rollout, files."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
import torch

from ded_bench.files.errors import InputError
from ded_bench.plants.lossless.network import Network
from ded_bench.plants.plant import SimulationError, simulate
from ded_bench.problem.case import Case
from ded_bench.problem.schedule import Schedule
from ded_bench.results.folder import ResultsFolder
from ded_bench.surrogates.find import find_model
from ded_bench.surrogates.identify import (
    held_out,
    hurried,
    identify,
    load_ramps,
    make_model,
    n_parameters,
    rollout_errors,
    sample_trajectories,
    unpack,
)
from ded_bench.surrogates.koopman import Koopman
from ded_bench.surrogates.linear import (
    EPSILON,
    by_angles,
    discretised,
    energy_form,
    injection_lift,
    linear_model,
    steady_state,
)
from tests.methods.on_surrogates import replay


def test_every_parameter_value_is_stable_with_exact_equilibria(case: Case) -> None:
    form, b, dt = energy_form(case), steady_state(case), case.sampling.dt_s
    rng = np.random.default_rng(1)
    n_gen, n_in = len(case.generators), b.shape[1]
    for draw in range(300):
        x = rng.normal(size=n_parameters(*form.feedthrough.shape)) * 10.0 ** rng.uniform(-2, 1)
        shifted = unpack(form, x)
        k, g = discretised(shifted.generator(), b, shifted.feedthrough, dt)
        assert np.abs(np.linalg.eigvals(k)).max() < 1.0, draw
        inputs = rng.normal(size=n_in)
        rest = b @ inputs
        step = k @ (rest - b @ inputs) + b @ inputs + g @ np.zeros(n_in)
        assert np.abs(step - rest).max() <= 1e-12
        assert np.abs(rest[:n_gen]).max() == 0.0
        assert rest[n_gen] == pytest.approx(-inputs.sum(), abs=1e-12)


@pytest.mark.parametrize("name", ["9bus", "two-area", "39bus", "68bus", "140bus"])
def test_models_rest_at_the_equilibria_of_the_nonlinear_system(name: str) -> None:
    case = Case.load(name)
    network, b = Network(case), steady_state(case)
    rng = np.random.default_rng(2)
    for _ in range(5):
        p_gen = rng.uniform(case.p_min, case.p_max)
        p_load = case.load_nominal * rng.uniform(0.95, 1.05, len(case.loads))
        theta = network.power_flow(p_gen, p_load)
        for model in (linear_model(case), make_model(case, energy_form(case))):
            psi = model.observables(theta, np.zeros(len(p_gen)), p_load)
            np.testing.assert_allclose(psi, b @ np.concatenate([p_gen, p_load]), atol=1e-10)
            np.testing.assert_array_equal(model.b, b)


def test_energy_form_starts_at_the_linearisation(case: Case) -> None:
    linear, model = linear_model(case), make_model(case, energy_form(case))
    # The forms differ by the stability floor only, whose rates are a few EPSILON per second.
    np.testing.assert_allclose(model.k, linear.k, atol=10 * EPSILON * linear.dt_s)
    np.testing.assert_allclose(model.g, linear.g, atol=10 * EPSILON * linear.dt_s)
    modes = Network(case).linearise(Network(case).power_flow(case.p_nominal, case.load_nominal)).modes()
    rates = np.log(np.linalg.eigvals(linear.k)) / linear.dt_s
    np.testing.assert_allclose(np.sort_complex(rates), np.sort_complex(modes), atol=1e-8)


def test_derivatives_by_angles_are_difference_quotients(case: Case) -> None:
    """Of ψ at the nominal point, where the loads are served; the differences err by their square."""
    network, model, size = Network(case), linear_model(case), 1e-4
    found, loads = by_angles(case), network.load_injections(case.load_nominal)
    theta = np.tile(network.power_flow(case.p_nominal, case.load_nominal), (2, 1))
    for g, bus in enumerate(network.generators):
        moved = theta.copy()
        moved[:, bus] += [size, -size]
        moved, _ = network.solve_loads(moved, np.stack([loads, loads]))
        psi = model.observables(moved, np.zeros((2, len(case.generators))), np.zeros((2, len(case.loads))))
        np.testing.assert_allclose(found[:, g], (psi[0] - psi[1]) / (2 * size), rtol=1e-5, atol=1e-5)


def test_linear_model_is_exact_to_second_order(case: Case, quiet_instance) -> None:
    """Small load ramps from the nominal point: halving them quarters the model's error."""
    errors = []
    for size in (0.02, 0.01):
        ramps = {
            bus: {"initial": value, "start": 0.505, "duration": 1.0, "rate": -size}
            for bus, value in zip(case.loads, case.load_nominal.tolist(), strict=True)
        }
        instance = quiet_instance(case, load=ramps, horizon_s=4.0)
        schedule = Schedule(instance.grid, load_ramps(case, instance, np.random.default_rng(0)))
        told, found = replay(case, linear_model(case), instance, schedule), simulate(case, instance, schedule)
        errors.append(max(np.abs(told.omega - found.omega).max(), np.abs(told.p_slack - found.p_slack).max()))
    assert errors[0] < 1e-3
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)


def test_rollout_equals_its_equation_step_by_step(case: Case) -> None:
    """Even and odd numbers of steps, one, none; one ψ_0 for all and one for each."""
    model = linear_model(case)
    rng = np.random.default_rng(1)
    n, n_in = model.b.shape
    for n_points, batch, own in ((1, (), True), (2, (3,), True), (77, (3,), False), (201, (2, 3), True)):
        psi = rng.normal(size=(*(batch if own else ()), n))
        inputs = rng.normal(size=(n_points, *batch, n_in))
        states = model.rollout(psi, inputs)
        expected = np.broadcast_to(psi, states.shape[1:])
        for i in range(n_points):
            np.testing.assert_allclose(states[i], expected, atol=1e-10)
            if i + 1 < n_points:
                deviation = (expected - inputs[i] @ model.b.T) @ model.k.T
                expected = deviation + inputs[i] @ model.b.T + (inputs[i + 1] - inputs[i]) @ model.g.T


def test_identified_model_beats_the_linearisation(case: Case) -> None:
    model = identify(case, seed=5, count=8)
    assert np.abs(np.linalg.eigvals(model.k)).max() < 1.0
    data = held_out(case, seed=5, count=8)
    ours, linear = (rollout_errors(one, data) for one in (model, linear_model(case)))
    if model.training["trajectories"] == 0:  # of a larger grid: it is the linearisation, but for EPSILON
        assert ours[0] == pytest.approx(linear[0], rel=1e-3)
        return
    assert ours[0] < linear[0]
    assert ours[1] < linear[1]


def test_identification_is_repeatable(threebus: Case) -> None:
    model, again, other = (identify(threebus, seed, count=8) for seed in (5, 5, 6))
    assert model.fingerprint == again.fingerprint != other.fingerprint


def test_schedules_to_learn_from_keep_ramps_where_steps_are_long(case: Case, quiet_instance) -> None:
    """Of half a second, which are longer than what smooths them."""
    instance = quiet_instance(case, dt_s=0.5)
    for seed in range(5):
        schedule = hurried(case, instance, np.random.default_rng(seed))
        steps = np.abs(np.diff(schedule, axis=0))
        assert (steps <= case.ramp * instance.dt_s * (1.0 + 1e-9)).all()


def test_schedules_that_the_system_cannot_follow_are_left_out(case: Case, monkeypatch) -> None:
    """A third of them is; the others are what they were. Where most are, that is said."""
    complete, calls = sample_trajectories(case, seed=1, count=6), itertools.count()

    def failing(period: int):
        def run(case, instance, schedule):
            if next(calls) % period == 0:
                raise SimulationError("no power flow")
            return simulate(case, instance, schedule)

        return run

    monkeypatch.setattr("ded_bench.surrogates.identify.simulate", failing(3))
    part = sample_trajectories(case, seed=1, count=6)
    assert part.inputs.shape[1] == 4
    assert (part.omega == complete.omega[:, [1, 2, 4, 5]]).all()
    assert (part.theta_initial == complete.theta_initial[[1, 2, 4, 5]]).all()
    monkeypatch.setattr("ded_bench.surrogates.identify.simulate", failing(1))
    with pytest.raises(InputError, match="cannot follow 6 of 6 drawn schedules"):
        sample_trajectories(case, seed=1, count=6)


def test_model_files_round_trip(case: Case, tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    width = 2 * len(case.generators) + 1
    n_extra = 3
    plain = linear_model(case)
    n = len(plain.k) + n_extra
    model = dataclasses.replace(
        plain,
        k=rng.normal(size=(n, n)),
        b=rng.normal(size=(n, plain.b.shape[1])),
        g=rng.normal(size=(n, plain.b.shape[1])),
        lift=np.vstack([injection_lift(case), np.zeros((n_extra, injection_lift(case).shape[1]))]),
        mlp=(
            (rng.normal(size=(5, width)), rng.normal(size=5)),
            (rng.normal(size=(3, 5)), rng.normal(size=3)),
        ),
    )
    path = ResultsFolder(tmp_path).model("koopman")
    model.save(path)
    loaded = find_model(case, "koopman", [tmp_path / "nowhere", tmp_path])
    assert loaded.fingerprint == model.fingerprint
    network = Network(case)
    theta = network.power_flow(case.p_nominal, case.load_nominal)
    state = theta, np.full(len(case.generators), 0.01), case.load_nominal
    np.testing.assert_array_equal(loaded.observables(*state), model.observables(*state))


def test_model_files_are_checked(ninebus: Case, threebus: Case, tmp_path: Path) -> None:
    model = linear_model(ninebus)
    path = tmp_path / "m.safetensors"
    model.save(path)
    with pytest.raises(InputError, match="another case"):
        Koopman.load(path, threebus)
    dataclasses.replace(model, k=model.k[:3]).save(path)
    with pytest.raises(InputError, match=r"m\.safetensors: k"):
        Koopman.load(path, ninebus)
    path.write_bytes(b"not a model")
    with pytest.raises(InputError, match="is not a model"):
        Koopman.load(path, ninebus)
    with pytest.raises(InputError, match="train-ko"):
        find_model(ninebus, "koopman", [tmp_path])
    with pytest.raises(InputError, match="no such file"):
        find_model(ninebus, "nonsense", [tmp_path])


def test_paper_identification_is_stable_exact_at_equilibria_and_learns(case: Case) -> None:
    from ded_bench.surrogates.koopman_paper import PaperKoopman, identify_paper

    model = identify_paper(case, seed=1, count=4, steps=100)
    assert np.abs(np.linalg.eigvals(model.k)).max() < 1.0
    n_gen = len(case.generators)
    assert (model.b[:n_gen] == 0).all()
    np.testing.assert_allclose(model.b[n_gen], -1.0, rtol=1e-12)
    # The newer input sample: one step from ψ = B P under P⁺ lands where K (ψ - B P⁺) + B P⁺ does.
    rng = np.random.default_rng(0)
    old, new = rng.normal(size=(2, model.b.shape[1]))
    stepped = model.rollout(model.b @ old, np.stack([old, new]))[1]
    np.testing.assert_allclose(stepped, model.k @ (model.b @ (old - new)) + model.b @ new, atol=1e-12)
    untrained = identify_paper(case, seed=1, count=4, steps=1)
    assert model.training["one_step_loss"] < 0.5 * untrained.training["one_step_loss"]
    torch.manual_seed(0)
    for _ in range(50):
        drawn = PaperKoopman(n_gen, model.b.shape[1], model.dt_s).double()
        for parameter in drawn.parameters():
            torch.nn.init.normal_(parameter, std=2.0)
        assert torch.linalg.eigvals(drawn.matrices()[0]).abs().max() < 1.0
