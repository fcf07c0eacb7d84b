"""The policy with weights shared by generators: model of the grid, iterations, what holds for any weights."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from ded_bench.files.errors import InputError
from ded_bench.methods import ed
from ded_bench.methods.admm.drawn_problems import Problems, draw, sampled
from ded_bench.methods.admm.grid_response import GridResponse
from ded_bench.methods.admm.iteration_records import PRICE
from ded_bench.methods.admm.path_model import Linear, Outset, PathModel
from ded_bench.methods.admm.plant_gradient import FollowTargets, Respond
from ded_bench.methods.admm.admm_margin import with_margin
from ded_bench.methods.admm.admm_policy import METHOD, SharedPolicy, prepare
from ded_bench.methods.admm.admm_inference import weight_shapes
from ded_bench.methods.admm.admm_iterations import UnrolledIterations
from ded_bench.methods.admm.admm_loss import ScheduleLoss
from ded_bench.methods.admm.admm_training import read_start, train
from ded_bench.methods.policy_file import Scope, write_policy
from ded_bench.methods.solution import Settings
from ded_bench.methods.training_record import TrainingOptions, checkpoint_file
from ded_bench.problem.case import REPOSITORY, Case
from ded_bench.problem.instance import Initial, Instance, LoadPoints
from ded_bench.problem.sampling import POLICY_SEED, VALIDATION_SEED, sample_instance
from ded_bench.problem.schedule import Schedule
from ded_bench.plants.lossless.network import Network
from ded_bench.plants.score import score
from ded_bench.plants.lossless.servable import servable
from ded_bench.plants.simulate import simulate

HORIZON, ITERATIONS = 12.0, 6


def path_model(case: Case, horizon: float = HORIZON) -> PathModel:
    bound = case.omega_bound(list(case.regimes)[-1])
    return PathModel(case, bound, GridResponse.make(case, case.knot_times(horizon)))


def drawn(model: PathModel, count: int = 6, seed: int = 0) -> Outset:
    return model.outset(
        draw(model.case, model.bound, model.response.fine, count, np.random.default_rng(seed))
    )


def linearised(model: PathModel, outset: Outset) -> Linear:
    return model.linearise(outset, model.start_path(outset))


def random_iterations(model: PathModel, size: float = 0.3) -> UnrolledIterations:
    """Iterations whose weights are not zero."""
    torch.manual_seed(0)
    unrolled = UnrolledIterations(model, ITERATIONS)
    with torch.no_grad():
        unrolled.nodes.add_(size * torch.randn_like(unrolled.nodes))
    return unrolled


def random_policy(case: Case, size: float = 0.3, horizon: float = HORIZON) -> SharedPolicy:
    scope = Scope(case, list(case.regimes)[-1], horizon)
    return SharedPolicy.of(scope, random_iterations(path_model(case, horizon), size), {"seed": 0})


def short_instance(case: Case, index: int = 0, horizon: float = HORIZON) -> Instance:
    """An instance whose load ramps lie within a short horizon."""
    found = sample_instance(case, POLICY_SEED, index)
    load = {
        bus: ramp.model_copy(update={"start": ramp.start * horizon / found.horizon_s})
        for bus, ramp in found.load.items()
    }
    return found.model_copy(update={"horizon_s": horizon, "load": load})


def in_operation(case: Case, index: int = 0, horizon: float = HORIZON) -> Instance:
    """The same as points, from a state that is no equilibrium."""
    found = short_instance(case, index, horizon)
    times = np.linspace(0.0, horizon, 25)
    load = {
        bus: LoadPoints(points=tuple(zip(times.tolist(), ramp.at(times).tolist(), strict=True)))
        for bus, ramp in found.load.items()
    }
    network = Network(case)
    angles = network.initial_angles(found)[network.generators] + 0.002
    given = dict(zip(case.generators, angles.tolist(), strict=True))
    initial = Initial(power=found.initial.power, omega=found.initial.omega, theta=given)
    return found.model_copy(update={"schema_": "ded-bench/instance/2", "load": load, "initial": initial})


def test_response_is_what_happens(case: Case) -> None:
    """Against the simulation of the nonlinear equations: less than 4 % of the tightest bound."""
    horizon = case.sampling.horizon_s
    model = path_model(case, horizon)
    for instance in (sample_instance(case, POLICY_SEED, 1), in_operation(case, 2, horizon)):
        outset = model.outset(Problems.of(case, [instance], model.response.fine))
        _, omega, p_slack = model.respond(outset.start, outset, linearised(model, outset))
        truth = simulate(case, instance, Schedule(model.response.knots, outset.start[0]))
        points = np.clip(np.round(model.response.fine / instance.dt_s).astype(int), 0, instance.steps)
        near = np.abs(model.response.fine - instance.grid[points]) < 1e-3
        assert np.abs(omega[0] - truth.omega[points])[near].max() < 0.04 * model.bound + 1e-3
        assert np.abs(p_slack[0] - truth.p_slack[points])[near].max() < 0.01


def test_loads_around_kinks_are_means_weighted_by_hats(ninebus: Case) -> None:
    """Against quadrature of the load times the hat function of each fine point."""
    instance, fine = sample_instance(ninebus, POLICY_SEED, 3), np.linspace(0.0, 60.0, 197)
    values = sampled(ninebus, [instance], fine)[0]
    h = fine[1]
    offsets = np.linspace(-h, h, 4001)
    hat = 1.0 - np.abs(offsets) / h
    for k in range(1, len(fine) - 1):
        exact = (instance.p_load(ninebus, fine[k] + offsets) * hat[:, None]).sum(axis=0) / hat.sum()
        np.testing.assert_allclose(values[k], exact, atol=1e-7)


def test_gradient_of_the_response_is_its_transpose(case: Case) -> None:
    """The response is affine in the powers, so that differences are exact but for round-off."""
    model = path_model(case)
    outset = drawn(model)
    linear = linearised(model, outset)
    rng = np.random.default_rng(0)
    direction = rng.standard_normal(outset.start.shape)
    before = model.respond(outset.start, outset, linear)
    after = model.respond(outset.start + direction, outset, linear)
    weights = [torch.tensor(rng.standard_normal(part.shape), dtype=torch.float32) for part in before]
    powers = torch.tensor(outset.start, dtype=torch.float32, requires_grad=True)
    outcome = Respond.apply(powers, model, outset, linear)
    sum((w * part).sum() for w, part in zip(weights, outcome, strict=True)).backward()
    along = float((powers.grad.double().numpy() * direction).sum())
    expected = sum(float((w.numpy() * (b - a)).sum()) for w, a, b in zip(weights, before, after, strict=True))
    size = sum(
        float(np.abs(w.numpy() * (b - a)).sum()) for w, a, b in zip(weights, before, after, strict=True)
    )
    assert along == pytest.approx(expected, abs=1e-5 * size)  # float32


def test_follower_keeps_limits_and_its_gradient_is_that_of_torch() -> None:
    """Compared with the recursion recorded by torch, where no target lies beyond a bound."""
    torch.manual_seed(0)
    targets = torch.rand(4, 20, 3, requires_grad=True)
    p_initial, step = torch.rand(4, 3), torch.full((3,), 0.2)
    low, high = torch.zeros(3), torch.ones(3)
    powers = FollowTargets.apply(targets, p_initial, low, high, step)
    weights = torch.randn_like(powers)
    (powers * weights).sum().backward()
    found, targets.grad = targets.grad, None
    p = [p_initial]
    for target in targets.unbind(1)[1:]:
        p.append(torch.maximum(torch.minimum(p[-1] + 0.2, target), p[-1] - 0.2))
    recorded = torch.stack(p, dim=1)
    (recorded * weights).sum().backward()
    torch.testing.assert_close(powers, recorded)
    torch.testing.assert_close(found, targets.grad)


def test_a_target_beyond_a_bound_can_come_back() -> None:
    targets = torch.full((1, 2, 1), 2.0, requires_grad=True)
    limits = torch.zeros(1), torch.ones(1), torch.full((1,), 9.0)
    for sign, expected in ((1.0, 1.0), (-1.0, 0.0)):
        targets.grad = None
        (sign * FollowTargets.apply(targets, torch.zeros(1, 1), *limits)).sum().backward()
        assert float(targets.grad[0, 1, 0]) == expected


def test_compiled_iterations_are_those_of_torch(case: Case) -> None:
    """Every answer is that of torch, or the first schedule where that has less loss."""
    model = path_model(case)
    outset, unrolled, loss = drawn(model), random_iterations(model), ScheduleLoss(model)
    linear = linearised(model, outset)
    with torch.no_grad():
        last = unrolled(outset)[0].double().numpy()
    losses = []
    for powers in (outset.start, last):
        outcome = [torch.as_tensor(o, dtype=torch.float32) for o in model.respond(powers, outset, linear)[1:]]
        judged = loss(outset, (torch.as_tensor(powers, dtype=torch.float32), outcome[0], outcome[1]))
        losses.append((judged.cost + PRICE * judged.penalty).numpy())
    policy = SharedPolicy.of(Scope(case, list(case.regimes)[-1], HORIZON), unrolled, {})
    better = losses[1] <= losses[0]
    assert better.any()
    expected = np.where(better[:, None, None], last, outset.start)
    clear = np.abs(losses[1] - losses[0]) > 1e-4
    np.testing.assert_allclose(policy.powers(outset.problems)[clear], expected[clear], atol=2e-4)


@pytest.mark.parametrize("size", [0.3, 3.0])
def test_limits_hold_for_any_weights(case: Case, size: float) -> None:
    """Ramps, bounds and P_0 to round-off, for ramps and in operation."""
    policy = random_policy(case, size)
    for instance in (short_instance(case, 4), in_operation(case, 5)):
        (schedule,) = policy(instance)
        judged = score(case, instance, schedule, list(case.regimes)[-1])
        assert judged.ramp_violation < 1e-12
        assert judged.bound_violation < 1e-12
        assert judged.initial_violation < 1e-12


def test_order_of_generators_does_not_matter(case: Case) -> None:
    """Buses in another order: the same schedules."""
    data = json.loads(case.model_dump_json(by_alias=True))
    data["buses"] = data["buses"][::-1]
    other = Case.model_validate_json(json.dumps(data))
    assert other.generators == case.generators[::-1]
    policy = random_policy(case)
    same = SharedPolicy(Scope(other, policy.scope.regime, HORIZON), policy.weights, policy.training)
    instance = short_instance(case, 6)
    np.testing.assert_allclose(same(instance)[0].p[:, ::-1], policy(instance)[0].p, atol=1e-5)


def test_one_set_of_weights_serves_every_grid(ninebus: Case, threebus: Case) -> None:
    policy = random_policy(ninebus)
    other = SharedPolicy(Scope(threebus, "TO", HORIZON), policy.weights, policy.training)
    assert other(short_instance(threebus))[0].p.shape == (threebus.n_knots, len(threebus.generators))
    assert {name: value.shape for name, value in policy.weights.items()} == weight_shapes()


def test_what_is_drawn_for_training_is_of_both_kinds(case: Case) -> None:
    problems = drawn(path_model(case), 200).problems
    moved = np.abs(problems.delta).max(axis=1) > 0
    assert 0.1 < moved.mean() < 0.5
    assert np.isfinite(problems.load).all()
    if case.schema_ != "ded-bench/case/1":
        assert (problems.load[~moved] * case.load_nominal >= 0).all()


def test_loss_is_the_scorers(ninebus: Case) -> None:
    """Cost within 0.05 %, largest excess within 2 % of the bound, of what the simulation says."""
    model = path_model(ninebus, 60.0)
    instance = sample_instance(ninebus, POLICY_SEED, 7)
    outset = model.outset(Problems.of(ninebus, [instance], model.response.fine))
    outcome = model.respond(outset.start, outset, linearised(model, outset))
    tensors = [torch.as_tensor(part, dtype=torch.float32) for part in (outset.start, *outcome[1:])]
    loss = ScheduleLoss(model)
    judged = loss(outset, (tensors[0], tensors[1], tensors[2]))
    truth = score(ninebus, instance, Schedule(model.response.knots, outset.start[0]), "TO")
    cost = float(judged.cost[0] * outset.scale[0]) * len(instance.grid)
    assert cost == pytest.approx(truth.objective, rel=5e-4)
    excess = truth.freq_violation_hz * 2 * np.pi / model.bound
    assert float(judged.excess[0]) == pytest.approx(excess, abs=0.02)


def test_gradient_of_the_loss_by_differences(threebus: Case) -> None:
    """Along the gradient's own direction; float32 and kinks leave 5 %."""
    model = path_model(threebus)
    outset, unrolled, loss = drawn(model), random_iterations(model), ScheduleLoss(model)

    def value() -> torch.Tensor:
        judged = loss(outset, unrolled(outset), 0.5)
        return (judged.cost + 0.05 * judged.penalty).mean()

    torch.autograd.backward(value())
    gradient = unrolled.nodes.grad
    direction = gradient / gradient.norm()
    size = 2e-3
    with torch.no_grad():
        unrolled.nodes.add_(size * direction)
        above = float(value())
        unrolled.nodes.sub_(2 * size * direction)
        below = float(value())
    assert (above - below) / (2 * size) == pytest.approx(float(gradient.norm()), rel=0.05)


def quickly(case: Case, out: Path, epochs: int, resume: bool = False) -> SharedPolicy:
    instances = [short_instance(case, i) for i in range(8)]
    options = TrainingOptions(resume=resume)
    return train(case, "TO", instances, None, out, options, epochs=epochs, iterations=ITERATIONS)


def test_training_keeps_the_best_repeats_and_goes_on(
    threebus: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ded_bench.methods.admm.admm_training.STEPS", 4)
    monkeypatch.setattr("ded_bench.methods.admm.admm_training.ROWS", 400)
    whole = quickly(threebus, tmp_path / "a.safetensors", 2)
    history = (tmp_path / "a.history.csv").read_text().splitlines()
    assert len(history) == 3
    held_out = [float(line.split(",")[3]) for line in history[1:]]
    assert np.isfinite(held_out).all()
    assert whole.training["held_out_loss"] == min(held_out)
    again = quickly(threebus, tmp_path / "b.safetensors", 2)
    assert again.fingerprint == whole.fingerprint
    quickly(threebus, tmp_path / "c.safetensors", 2, resume=True)
    done = quickly(threebus, tmp_path / "c.safetensors", 2, resume=True)
    assert done.fingerprint == whole.fingerprint
    checkpoint_file(tmp_path / "c.safetensors").write_bytes(b"no checkpoint")
    with pytest.raises(InputError, match="no checkpoint"):
        quickly(threebus, tmp_path / "c.safetensors", 2, resume=True)


def test_files_keep_the_policy_and_refuse_what_does_not_fit(
    ninebus: Case, threebus: Case, tmp_path: Path
) -> None:
    policy, path = random_policy(ninebus), tmp_path / "p.safetensors"
    policy.save(path)
    found = SharedPolicy.load(path, ninebus, "TO")
    assert found.fingerprint == policy.fingerprint
    instance = short_instance(ninebus)
    np.testing.assert_array_equal(found(instance)[0].p, policy(instance)[0].p)
    with pytest.raises(InputError, match="regime"):
        SharedPolicy.load(path, ninebus, "NO")
    with pytest.raises(InputError, match="case"):
        SharedPolicy.load(path, threebus, "TO")
    dataclasses.replace(policy, weights={"nodes": np.zeros((2, 7))}).save(path)
    with pytest.raises(InputError, match="wrong shape"):
        SharedPolicy.load(path, ninebus, "TO")
    dataclasses.replace(policy, training={"iterations": "many"}).save(path)
    with pytest.raises(InputError, match="iterations"):
        SharedPolicy.load(path, ninebus, "TO")
    assert METHOD != "ded-dpc-paper"


def test_it_answers_only_what_it_was_trained_for(ninebus: Case, threebus: Case) -> None:
    policy = random_policy(ninebus)
    with pytest.raises(InputError, match="case"):
        policy(short_instance(threebus))
    with pytest.raises(InputError, match="horizon"):
        policy(sample_instance(ninebus, POLICY_SEED, 0))
    assert policy([]) == []


def test_committed_weights_are_worth_having() -> None:
    """On a validation instance of two-area: limits are met, and NO costs less than static dispatch does."""
    case = Case.load("two-area")
    instance = sample_instance(case, VALIDATION_SEED, 0, servable)
    found = {}
    for regime in case.regimes:
        settings = Settings(search=(REPOSITORY / "results" / "two-area-reference",))
        solution = prepare(case, regime, settings)(instance)
        assert solution.schedule is not None
        found[regime] = score(case, instance, solution.schedule, regime)
        assert found[regime].feasible
    static = ed.prepare(case, "NO", Settings())(instance).schedule
    assert static is not None
    assert found["NO"].objective <= 1.0001 * score(case, instance, static, "NO").objective
    assert found["NO"].objective <= found["TO"].objective


def test_training_starts_from_weights_of_another_grid(ninebus: Case, threebus: Case, tmp_path: Path) -> None:
    start, out = tmp_path / "start.safetensors", tmp_path / "p.safetensors"
    known = random_policy(threebus)
    known.save(start)
    found = read_start(start)
    assert all(np.array_equal(found[name], value) for name, value in known.weights.items())
    instances = [short_instance(ninebus, i) for i in range(4)]
    options = TrainingOptions(seconds=1e-3, start=start)
    trained = train(ninebus, "TO", instances, None, out, options, epochs=1, iterations=ITERATIONS)
    assert trained.training["start"] == known.fingerprint
    assert trained.fingerprint != known.fingerprint
    other = tmp_path / "other.safetensors"
    write_policy(other, "ded-dpc", known.scope, known.weights, {})
    with pytest.raises(InputError, match=METHOD):
        read_start(other)


def test_margin_is_the_least_that_makes_enough_schedules_feasible(
    ninebus: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = random_policy(ninebus)
    instances = [short_instance(ninebus, i) for i in range(4)]
    margins = (0.0, 0.3, 0.6)
    shares = []
    for margin in margins:
        tried = dataclasses.replace(policy, training=policy.training | {"margin": margin})
        pairs = zip(instances, tried(instances), strict=True)
        shares.append(np.mean([score(ninebus, i, s, policy.scope.regime).feasible for i, s in pairs]))
    monkeypatch.setattr("ded_bench.methods.admm.admm_margin.MARGINS", margins)
    for wanted in (0.0, *shares, 2.0):
        monkeypatch.setattr("ded_bench.methods.admm.admm_margin.WANTED", wanted)
        chosen = with_margin(policy, instances).training
        enough = [margin for margin, share in zip(margins, shares, strict=True) if share >= wanted]
        best = margins[int(np.argmax(shares))]
        assert chosen["margin"] == (enough[0] if enough else best)
        assert chosen["margin_feasible"] == shares[margins.index(chosen["margin"])]
