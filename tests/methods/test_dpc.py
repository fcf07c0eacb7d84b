"""Our policy: what holds for any weights, its networks, its loss, files, refusals."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from ded_bench.files.errors import InputError
from ded_bench.surrogates.condensed import CondensedRollout, free_response
from ded_bench.surrogates.linear import linear_model
from ded_bench.methods.dpc import training
from ded_bench.methods.dpc.coarse_rollout import coarse_free_response, coarse_stride
from ded_bench.methods.dpc.export import export
from ded_bench.methods.dpc.inference import CompiledStages, weight_shapes
from ded_bench.methods.dpc.inputs import Channels, Inputs, n_channels, sequence_groups
from ded_bench.methods.dpc.loss import Objective
from ded_bench.methods.dpc.policy import CHUNK, METHOD, DispatchPolicy, prepare
from ded_bench.methods.dpc.policy_network import StagedNetwork
from ded_bench.methods.dpc.response import Response
from ded_bench.methods.dpc.training import Loss, Pool
from ded_bench.methods.policy_file import Scope, policy_file
from ded_bench.methods.ramp_follower import follow
from ded_bench.methods.solution import Settings
from ded_bench.problem.case import Case
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.instance import Instance, LoadPoints
from ded_bench.problem.sampling import POLICY_SEED, sample_instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.status import Status
from ded_bench.plants.lossless.network import Network
from ded_bench.plants.score import score
from ded_bench.plants.simulate import simulate

HORIZON = 4.0


def some_instances(case: Case, count: int, first: int = 0, horizon: float = HORIZON) -> list[Instance]:
    """Instances whose load ramps lie within a short horizon."""
    chosen = []
    for i in range(first, first + count):
        drawn = sample_instance(case, POLICY_SEED, i)
        load = {
            bus: ramp.model_copy(update={"start": ramp.start * horizon / drawn.horizon_s})
            for bus, ramp in drawn.load.items()
        }
        chosen.append(drawn.model_copy(update={"horizon_s": horizon, "load": load}))
    return chosen


def response_of(case: Case, horizon: float = HORIZON) -> Response:
    return Response.make(case, case.knot_times(horizon))


def channels_of(case: Case, inputs: Inputs) -> Channels:
    return Channels.of(case, inputs, response_of(case))


def random_network(case: Case, size: float = 1.0, horizon: float = HORIZON) -> StagedNetwork:
    """A network whose last layers are not zero, with inputs normalised."""
    torch.manual_seed(0)
    response = response_of(case, horizon)
    network = StagedNetwork(case, response, 2, 16, (1, 2, 4))
    for stage in network.stages:
        torch.nn.init.normal_(stage.last.weight, std=size)
    inputs = Inputs.of(case, some_instances(case, 20, horizon=horizon))
    network.normalise(Channels.of(case, inputs, response))
    return network.eval()


def random_policy(case: Case, size: float = 1.0, horizon: float = HORIZON) -> DispatchPolicy:
    scope = Scope(case, next(iter(case.regimes)), horizon)
    return DispatchPolicy.of(scope, random_network(case, size, horizon), {"seed": 0})


def tensors(channels: Channels) -> list[torch.Tensor]:
    """What the network takes, in float32."""
    arrays = channels.start, channels.free_response, channels.sequence, channels.constants
    return [torch.as_tensor(a, dtype=torch.float32) for a in arrays]


def test_static_dispatch_of_the_knots_is_the_merit_order(case: Case) -> None:
    knots = case.knot_times(HORIZON)
    inputs = Inputs.of(case, some_instances(case, 30))
    inputs.cost[:10] = np.round(inputs.cost[:10])  # ties, and costs of zero
    channels = channels_of(case, inputs)
    expected = merit_order(case, inputs.cost[:, None, 1:], inputs.cost[:, :1], inputs.p_load(knots))
    static = channels.sequence[..., sequence_groups(case)["dispatch"]][..., :-1]
    np.testing.assert_allclose(static, expected, atol=1e-12)
    step = case.ramp * knots[1]
    np.testing.assert_array_equal(channels.start, follow(static[:, 1:], inputs.p_initial, step))
    p_slack = -inputs.p_load(knots).sum(axis=2) - expected.sum(axis=2)
    total = (expected * inputs.cost[:, None, 1:]).sum(axis=2) + inputs.cost[:, :1] * np.abs(p_slack)
    np.testing.assert_allclose(channels.static_cost(inputs), total.mean(axis=1), atol=1e-12)
    assert (channels.sequence.shape[2], channels.constants.shape[1]) == n_channels(case)


def test_bends_say_what_loads_do_between_knots(case: Case) -> None:
    knots = case.knot_times(HORIZON)
    instances = some_instances(case, 5)
    channels = channels_of(case, Inputs.of(case, instances))
    n_load, spacing = len(case.loads), knots[1]
    for b, instance in enumerate(instances):
        fine = np.linspace(0.0, HORIZON, (case.n_knots - 1) * 400 + 1)
        values = instance.p_load(case, fine)
        halves = 0.5 * (values[1:] + values[:-1]) * (fine[1] - fine[0])
        mean = halves.reshape(case.n_knots - 1, 400, n_load).sum(axis=1) / spacing
        at = instance.p_load(case, knots)
        np.testing.assert_allclose(channels.sequence[b, :, :n_load], at, atol=1e-14)
        expected = mean - 0.5 * (at[1:] + at[:-1])
        np.testing.assert_allclose(channels.sequence[b, 1:, n_load : 2 * n_load], expected, atol=1e-8)
        assert np.abs(expected).max() > 1e-5


@pytest.mark.parametrize("size", [0.0, 1.0, 1e3])
def test_bounds_ramps_and_initial_input_hold_for_any_weights(case: Case, size: float) -> None:
    horizon = case.sampling.horizon_s
    instances = [sample_instance(case, POLICY_SEED, i) for i in range(40)]
    policy = random_policy(case, size, horizon)
    for instance, schedule in zip(instances, policy(instances), strict=True):
        p = schedule.at(instance.grid)
        ramp = case.ramp * instance.dt_s
        assert len(p) == instance.steps + 1
        assert (np.abs(np.diff(p, axis=0)) <= ramp + 1e-12).all()
        assert np.maximum(p - case.p_max, case.p_min - p).max() <= 1e-12
        np.testing.assert_array_equal(p[0], instance.p_initial(case))
    moved = np.abs(np.diff([s.p for s in policy(instances)], axis=1)).max(axis=(0, 1))
    assert moved == pytest.approx(case.ramp * policy.knots[1])  # the limit was reached


def test_the_scorer_finds_no_violation_of_what_holds_by_construction(case: Case) -> None:
    instances = some_instances(case, 4)
    schedules = random_policy(case)(instances)
    for instance, schedule in zip(instances, schedules, strict=True):
        verdict = score(case, instance, schedule, next(iter(case.regimes)))
        assert max(verdict.ramp_violation, verdict.bound_violation, verdict.initial_violation) <= 1e-12


def test_compiled_twin_equals_the_torch_network(case: Case) -> None:
    network = random_network(case)
    channels = channels_of(case, Inputs.of(case, some_instances(case, 9)))
    with torch.no_grad():
        expected = network(*tensors(channels)).numpy()
    state = {name: value.numpy() for name, value in network.state_dict().items()}
    shapes = weight_shapes(case, response_of(case).n_outputs, 2, 16, len(network.dilations))
    assert [(name, value.shape) for name, value in state.items()] == list(shapes.items())
    twin = CompiledStages(case, response_of(case), state, network.dilations)
    np.testing.assert_allclose(twin(channels), expected, rtol=1e-4, atol=1e-4)
    assert np.abs(expected - channels.start).max() > 0.05


def test_the_response_is_the_linear_models(case: Case) -> None:
    """Condensed in coarse steps, from any state: the rollout in fine ones."""
    knots = case.knot_times(HORIZON)
    rng, response = np.random.default_rng(0), response_of(case)
    fine = linear_model(case, response.nodes[1] / 8)
    grid = np.linspace(0.0, HORIZON, 8 * (len(response.nodes) - 1) + 1)
    n_gen, n_load = len(case.generators), len(case.loads)
    theta, omega = rng.normal(0.0, 0.01, (2, 3, n_gen))
    theta[0] = 0.0
    loads = -rng.uniform(0.5, 1.5, (3, len(response.nodes), n_load))
    powers = rng.uniform(0.5, 1.5, (3, case.n_knots, n_gen))
    loads[:, 0], powers[:, 0] = case.load_nominal, case.p_nominal  # where the model's angles are exact
    network = Network(case)
    angles = np.tile(network.power_flow(case.p_nominal, case.load_nominal), (3, 1))
    angles[:, network.generators] += theta
    psi = fine.observables(network, angles, omega, loads[:, 0])
    seen = response(response.free_response(np.hstack([theta, omega]), loads), powers).reshape(
        3, case.n_knots, 2, n_gen + 1
    )
    for b in range(3):
        columns = [np.interp(grid, knots, column) for column in powers[b].T]
        columns += [np.interp(grid, response.nodes, column) for column in loads[b].T]
        inputs = np.stack(columns, axis=1)
        outputs = fine.rollout(psi[b], inputs)[:, : n_gen + 1]
        np.testing.assert_allclose(seen[b, :, 0], outputs[::16], atol=1e-5)  # float32
        np.testing.assert_allclose(seen[b, 1:, 1], outputs[8::16], atol=1e-5)
        np.testing.assert_array_equal(seen[b, 0, 0], seen[b, 0, 1])
        assert np.ptp(outputs, axis=0).min() > 1e-2


def test_angles_off_equilibrium_enter_the_response(case: Case, quiet_instance) -> None:
    """Released a little off the nominal equilibrium, the true grid swings as the response says."""
    knots = case.knot_times(HORIZON)
    network = Network(case)
    angles = network.power_flow(case.p_nominal, case.load_nominal)[network.generators]
    power = dict(zip(case.generators, case.p_nominal.tolist(), strict=True))
    initial = {"power": power, "omega": dict.fromkeys(case.generators, 0.0)}
    theta = dict(zip(case.generators, (angles + 1e-4).tolist(), strict=True))
    changes = {"schema": "ded-bench/instance/2", "initial": initial | {"theta": theta}, "horizon_s": HORIZON}
    instance = quiet_instance(case, **changes)
    inputs, response = Inputs.of(case, [instance]), response_of(case)
    n_gen = len(case.generators)
    np.testing.assert_allclose(inputs.state[:, :n_gen], 1e-4, rtol=1e-6)
    p_gen = np.tile(case.p_nominal, (1, case.n_knots, 1))
    seen = response(Channels.of(case, inputs, response).free_response, p_gen)[0, :, :n_gen]
    run = simulate(case, instance, Schedule(knots, p_gen[0]))
    true = np.stack([np.interp(knots, instance.grid, column) for column in run.omega.T], axis=1)
    peak = np.abs(true).max()
    assert peak > 1e-5
    np.testing.assert_allclose(seen, true, atol=0.02 * peak)
    at_rest = quiet_instance(case, horizon_s=HORIZON)
    assert not Inputs.of(case, [at_rest]).state.any()
    model, stride = linear_model(case), 10
    free = coarse_free_response(network, model, inputs, instance.grid, stride)
    p_load = instance.p_load(case)[None]
    expected = free_response(model, model.initial(network, [instance]), p_load, stride)
    np.testing.assert_allclose(free, expected, atol=1e-7)


def test_a_ramp_and_its_points_are_the_same_load(case: Case) -> None:
    """Every kind of load path gives the same channels, however its segments are written down."""
    ramps = some_instances(case, 4)
    points = []
    for instance in ramps:
        load = {}
        for bus, ramp in instance.load.items():
            times = np.unique([0.0, ramp.start, ramp.start + ramp.duration, 1.0, 2.5, 40.0])
            load[bus] = LoadPoints(points=[(t, float(ramp.at(np.array(t)))) for t in times.tolist()])
        points.append(instance.model_copy(update={"load": load}))
    seen = [channels_of(case, Inputs.of(case, batch)) for batch in (ramps, points, [points[0], ramps[1]])]
    for name in ("sequence", "constants", "start", "free_response"):
        values = [getattr(channels, name) for channels in seen]
        # single precision: a batch of another size may be summed in another order
        np.testing.assert_allclose(values[1], values[0], rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(values[2], values[0][:2], rtol=1e-6, atol=1e-6)
    grid = ramps[0].grid
    expected = np.stack([i.p_load(case, grid) for i in ramps])
    for batch in (ramps, points):
        np.testing.assert_allclose(Inputs.of(case, batch).p_load(grid), expected, atol=1e-12)


def test_batches_threads_and_single_calls_agree(threebus: Case) -> None:
    policy, instances = random_policy(threebus), some_instances(threebus, 2 * CHUNK + 3)
    inputs = Inputs.of(threebus, instances)
    whole = policy.powers(inputs)
    assert policy([]) == []
    assert whole.shape == (len(instances), threebus.n_knots, len(threebus.generators))
    np.testing.assert_array_equal(policy.powers(inputs, threads=2), whole)
    for b in (0, CHUNK, len(instances) - 1):
        np.testing.assert_allclose(policy(instances[b])[0].p, whole[b], atol=1e-5)


def test_coarse_rollout_is_the_fine_one(case: Case) -> None:
    knots = case.knot_times(HORIZON)
    model, instances = linear_model(case), some_instances(case, 3)
    network, grid = Network(case), instances[0].grid
    inputs, stride = Inputs.of(case, instances), coarse_stride(instances[0].dt_s, instances[0].steps)
    assert stride > 1
    p_load = np.stack([i.p_load(case) for i in instances])
    fine = free_response(model, model.initial(network, instances), p_load)
    coarse = coarse_free_response(network, model, inputs, grid, stride)
    np.testing.assert_allclose(coarse, fine[:, :, ::stride], atol=1e-6)

    p_gen = torch.as_tensor(random_policy(case).powers(inputs))
    cost = torch.as_tensor(inputs.cost)
    values = []
    for step, free in ((1, fine), (stride, fine[:, :, ::stride])):
        objective = Objective.make(CondensedRollout.make(case, model, grid, knots, step), torch.float64)
        omega, p_slack = objective.rollout(torch.as_tensor(free.copy()), p_gen)
        values.append((objective.cost(p_gen, p_slack, cost), omega.abs().amax(dim=(1, 2))))
    torch.testing.assert_close(values[0][0], values[1][0], rtol=1e-3, atol=0.0)
    torch.testing.assert_close(values[0][1], values[1][1], rtol=1e-2, atol=0.0)
    # the fine cost is the sum that the scorer takes
    powers = np.stack([np.interp(grid, knots, p_gen[0, :, g]) for g in range(p_gen.shape[2])], axis=1)
    one = Objective.make(CondensedRollout.make(case, model, grid, knots), torch.float64)
    _, slack = one.rollout(torch.as_tensor(fine[:1].copy()), p_gen[:1])
    total = (powers @ inputs.cost[0, 1:]).sum() + inputs.cost[0, 0] * np.abs(slack.numpy()).sum()
    assert float(values[0][0][0]) == pytest.approx(total, rel=1e-12)


def test_gradient_of_the_loss_matches_finite_differences(threebus: Case) -> None:
    model, instances = linear_model(threebus), some_instances(threebus, 3)
    inputs, stride = Inputs.of(threebus, instances), 10
    channels = channels_of(threebus, inputs)
    free = coarse_free_response(Network(threebus), model, inputs, instances[0].grid, stride)
    pool = Pool.of(channels, inputs, free, len(instances[0].grid))
    pool = Pool(*(getattr(pool, name).double() for name in pool.__dataclass_fields__))
    condensed = CondensedRollout.make(
        threebus, model, instances[0].grid, threebus.knot_times(HORIZON), stride
    )
    objective = Objective.make(condensed, torch.float64)
    loss = Loss(objective, 1e-3, 0.1)
    network = random_network(threebus, 0.003).double()
    network.step.fill_(1.0)
    for limit in (network.low.sub_, network.high.add_):  # `Clip` is tested apart
        limit(5.0)

    def total() -> torch.Tensor:
        cost, excess = loss(loss.powers(network, pool), pool, 0.03)
        return cost.sum() + training._penalty(excess).sum()

    total().backward()
    first, second = network.stages
    for weight, index in (
        (second.last.bias, (0,)),
        (first.mix[2].bias, (3,)),
        (first.last.bias, (0,)),
        (second.embed[2].bias, (40,)),
    ):
        with torch.no_grad():
            weight[index] += 1e-6
            above = total()
            weight[index] -= 2e-6
            below = total()
            weight[index] += 1e-6
        numeric = float(above - below) / 2e-6
        assert abs(numeric) > 1e-3
        assert float(weight.grad[index]) == pytest.approx(numeric, rel=1e-3)


def test_policy_files_round_trip_and_serve_as_a_method(threebus: Case, tmp_path: Path) -> None:
    policy = random_policy(threebus)
    regime = policy.scope.regime
    path = policy_file(tmp_path, METHOD, regime)
    policy.save(path)
    loaded = DispatchPolicy.load(path, threebus, regime)
    assert loaded.fingerprint == policy.fingerprint
    instances = some_instances(threebus, 3)
    for a, b in zip(loaded(instances), policy(instances), strict=True):
        np.testing.assert_array_equal(a.p, b.p)
    solution = prepare(threebus, regime, Settings(search=(tmp_path,)))(instances[0])
    assert solution.status == Status.POLICY
    assert solution.solve_s > 0
    np.testing.assert_array_equal(solution.schedule.p, policy(instances[0])[0].p)


def test_the_exported_network_is_the_same_function(case: Case, tmp_path: Path) -> None:
    policy, network = random_policy(case), random_network(case)
    export(policy, tmp_path / "policy.pt2")
    exported = torch.export.load(str(tmp_path / "policy.pt2")).module()
    for count in (1, 7):
        inputs = tensors(channels_of(case, Inputs.of(case, some_instances(case, count))))
        with torch.no_grad():
            torch.testing.assert_close(exported(*inputs), network(*inputs))


def test_policy_refuses_what_it_was_not_trained_for(
    threebus: Case, ninebus: Case, tmp_path: Path, alter
) -> None:
    policy, path = random_policy(threebus), tmp_path / "p.safetensors"
    policy.save(path)
    regime = policy.scope.regime
    other_regime = next(r for r in threebus.regimes if r != regime)
    with pytest.raises(InputError, match="regime"):
        DispatchPolicy.load(path, threebus, other_regime)
    with pytest.raises(InputError, match="case"):
        DispatchPolicy.load(path, ninebus, regime)
    with pytest.raises(InputError, match="case_fingerprint"):
        DispatchPolicy.load(path, alter(threebus, ramp_pu_per_s=0.01), regime)
    with pytest.raises(InputError, match="horizon"):
        policy(some_instances(threebus, 1, horizon=2.0))
    with pytest.raises(InputError, match="case"):
        policy(some_instances(ninebus, 1))
    with pytest.raises(InputError, match=r"train-dpc --method ded-dpc .* --settings train400"):
        prepare(threebus, regime, Settings(name="train400", search=(tmp_path,)))
    for name, value, problem in (
        ("dilations", [1, 2, 70], "numbers of knots"),
        ("dilations", [1, 2], "width or depth"),
        ("width", 17, "width or depth"),
        ("stages", 3, "width or depth"),
        ("stages", None, "lacks"),
    ):
        dataclasses.replace(policy, training=policy.training | {name: value}).save(path)
        with pytest.raises(InputError, match=problem):
            DispatchPolicy.load(path, threebus, regime)
