"""The paper's policy: loss on the condensed rollout, gradients, training, files, refusals."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from ded_bench.cli import main
from ded_bench.evaluate.ablation import training_table
from ded_bench.files.errors import InputError
from ded_bench.surrogates.condensed import free_response
from ded_bench.surrogates.linear import linear_model
from ded_bench.methods.dpc_paper.paper_features import channels, n_channels
from ded_bench.methods.dpc_paper.paper_inference import FILTERS, WINDOWS, weight_shapes
from ded_bench.methods.dpc_paper.paper_loss import (
    Q_INITIAL,
    Q_OMEGA,
    Q_RAMP,
    Condensed,
    loss_terms,
)
from ded_bench.methods.dpc_paper.paper_network import PaperNetwork
from ded_bench.methods.dpc_paper.paper_policy import METHOD, SETTINGS, Policy, prepare
from ded_bench.methods.dpc_paper.paper_training import LEARNING_RATE, Batch, Loss, Recipe, train
from ded_bench.methods.policy_file import Scope, policy_file, weights_of
from ded_bench.methods.policy_solver import method
from ded_bench.methods.registry import METHODS
from ded_bench.methods.solution import Settings
from ded_bench.methods.training_record import HISTORY, TrainingOptions
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import POLICY_SEED, sample_instance
from ded_bench.problem.schedule import Schedule
from ded_bench.run.code import code_of
from ded_bench.solvers.status import Status
from ded_bench.plants.lossless.network import Network

HORIZON = 4.0


def some_instances(case: Case, count: int) -> list[Instance]:
    return [
        sample_instance(case, POLICY_SEED, i).model_copy(update={"horizon_s": HORIZON}) for i in range(count)
    ]


def fresh_network(case: Case) -> PaperNetwork:
    torch.manual_seed(0)
    return PaperNetwork(n_channels(case), case.p_min, case.p_max)


def test_architecture_is_the_papers(ninebus: Case) -> None:
    network = fresh_network(ninebus)
    convolutions = [m for m in network.modules() if isinstance(m, torch.nn.Conv1d)]
    assert [c.kernel_size[0] for c in convolutions] == list(WINDOWS) == [5, 10, 5]
    assert [c.out_channels for c in convolutions] == [FILTERS, FILTERS, 2] == [30, 30, 2]
    # loads, costs (with the slack's), x_0 = eight angles, P_s, two frequencies; P_0
    assert convolutions[0].in_channels == 3 + 3 + (8 + 1 + 2) + 2
    assert ninebus.n_knots == 50
    extreme = network(1e6 * torch.randn(4, n_channels(ninebus), 50))
    assert extreme.shape == (4, 50, 2)
    assert (extreme >= network.p_min.T - 1e-6).all()
    assert (extreme <= network.p_max.T + 1e-6).all()


@pytest.mark.parametrize("count", [1, 3])
def test_the_policy_is_its_torch_network(case: Case, count: int) -> None:
    network, instances = fresh_network(case), some_instances(case, count)
    seen = channels(Network(case), instances, case.knot_times(HORIZON))
    network.mean.normal_()
    network.scale.uniform_(0.5, 2.0)
    with torch.inference_mode():
        expected = network(torch.as_tensor(seen, dtype=torch.float32)).double().numpy()
    weights = weights_of(network)
    shapes = weight_shapes(n_channels(case), len(case.generators))
    assert [(name, value.shape) for name, value in weights.items()] == list(shapes.items())
    schedules = Policy(Scope(case, "NO", HORIZON), weights, {})(instances)
    # two orders of adding up a few hundred float32 products of order one
    np.testing.assert_allclose([s.p for s in schedules], expected, atol=2e-6)
    assert (np.ptp(expected, axis=1) > 1e-3).all()


def test_channels_are_what_the_paper_lists(case: Case) -> None:
    """Loads over the knots; c with the slack's, x_0 = (θ without the slack's, P_s, ω) and P_0, constant."""
    network, instances = Network(case), some_instances(case, 3)
    knots = case.knot_times(HORIZON)
    seen = channels(network, instances, knots)
    assert seen.shape == (3, n_channels(case), case.n_knots)
    n_load = len(case.loads)
    for found, instance in zip(seen, instances, strict=True):
        np.testing.assert_array_equal(found[:n_load], instance.p_load(case, knots).T)
        theta = network.initial_angles(instance)
        p_slack = -instance.p_initial(case).sum() - instance.p_load(case, np.zeros(1)).sum()  # lossless
        cost = [instance.cost_slack(case), *instance.cost_gen(case)]
        state = [*theta[network.unknown], p_slack, *instance.omega_initial(case)]
        constant = [*cost, *state, *instance.p_initial(case)]
        np.testing.assert_allclose(found[n_load:, 0], constant, atol=1e-11)
    assert (np.ptp(seen[:, n_load:], axis=2) == 0).all()


def sequential_loss(case, model, instance, knots, bound, ramp):
    """The paper's loss written out: step by step, in torch, one instance."""
    network, n_gen = Network(case), len(case.generators)
    k, b, g = (torch.as_tensor(a) for a in (model.k, model.b, model.g))
    times = case.knot_times(instance.horizon_s)
    psi = torch.as_tensor(model.initial(network, [instance])[0])
    p_load = torch.as_tensor(instance.p_load(case))
    cost, c_s = torch.as_tensor(instance.cost_gen(case)), instance.cost_slack(case)
    total = torch.zeros(6, dtype=torch.float64)
    powers = []
    for t in instance.grid:
        j = min(int(np.searchsorted(times, t, side="right")) - 1, len(times) - 2)
        weight = (t - times[j]) / (times[j + 1] - times[j])
        powers.append((1 - weight) * knots[j] + weight * knots[j + 1])
    for step, p_gen in enumerate(powers):
        now = torch.cat([p_gen, p_load[step]])
        total[0] += cost @ p_gen + c_s * psi[n_gen].abs()
        total[1] += Q_OMEGA * (psi[:n_gen] - bound).relu().square().sum()
        total[2] += Q_OMEGA * (-psi[:n_gen] - bound).relu().square().sum()
        if step + 1 < len(powers):
            change = powers[step + 1] - p_gen
            total[3] += Q_RAMP * (-change - ramp).relu().square().sum()
            total[4] += Q_RAMP * (change - ramp).relu().square().sum()
            following = torch.cat([powers[step + 1], p_load[step + 1]])
            psi = k @ (psi - b @ now) + b @ now + g @ (following - now)
    total[5] = Q_INITIAL * (powers[0] - torch.as_tensor(instance.p_initial(case))).square().sum()
    return total


def test_condensed_loss_equals_the_sequential_one_in_values_and_gradients(case: Case) -> None:
    model, instances = linear_model(case), some_instances(case, 2)
    grid, ramp = instances[0].grid, torch.as_tensor(case.ramp * instances[0].dt_s)
    bound = 1e-4  # so tight that both frequency terms count
    rng = np.random.default_rng(0)
    raw = rng.uniform(case.p_min, case.p_max, (2, case.n_knots, len(case.generators)))
    condensed = Condensed.make(case, model, grid, case.knot_times(HORIZON), torch.float64)
    batch = Batch.of(case, model, instances, "cpu")
    p_load = np.stack([i.p_load(case) for i in instances], axis=1)
    free = free_response(model, model.initial(Network(case), instances), p_load.swapaxes(0, 1))

    knots = torch.tensor(raw, requires_grad=True)
    omega, p_slack = condensed.rollout(torch.as_tensor(free.copy()), knots)
    cost = [v.double() for v in (batch.cost_gen, batch.cost_slack, batch.p_initial)]
    terms = loss_terms(omega, p_slack, condensed.powers(knots), *cost, bound, ramp)
    values = torch.stack(list(terms.values()), dim=1)
    values.sum().backward()
    for b, instance in enumerate(instances):
        alone = torch.tensor(raw[b], requires_grad=True)
        expected = sequential_loss(case, model, instance, alone, bound, ramp)
        expected.sum().backward()
        assert (expected > 0).all()
        torch.testing.assert_close(values[b], expected, rtol=1e-6, atol=1e-6)  # costs are stored in float32
        torch.testing.assert_close(knots.grad[b], alone.grad, rtol=1e-5, atol=1e-5)


def test_gradient_of_the_policy_matches_finite_differences(threebus: Case) -> None:
    model, instances = linear_model(threebus), some_instances(threebus, 3)
    batch = Batch.of(threebus, model, instances, "cpu")
    batch = Batch(*(getattr(batch, name).double() for name in batch.__dataclass_fields__))
    network = fresh_network(threebus).double()
    knots = threebus.knot_times(HORIZON)
    condensed = Condensed.make(threebus, model, instances[0].grid, knots, torch.float64)
    loss = Loss(condensed, 1e-3, torch.tensor([1e-4]).double())

    def total() -> torch.Tensor:
        return torch.stack(list(loss(network, batch).values())).sum()

    weight = next(m for m in network.modules() if isinstance(m, torch.nn.Conv1d)).weight
    total().backward()
    step = 1e-6
    for index in [(0, 0, 0), (7, 1, 2), (29, 2, 4)]:
        with torch.no_grad():
            weight[index] += step
            above = total()
            weight[index] -= 2 * step
            below = total()
            weight[index] += step
        numeric = float(above - below) / (2 * step)
        assert float(weight.grad[index]) == pytest.approx(numeric, rel=1e-4, abs=1e-4)


def trained(case: Case, out: Path, epochs: int, resume: bool = False, **recipe: object) -> Policy:
    """A short training on ten instances."""
    regime, options = next(iter(case.regimes)), TrainingOptions(seed=3, resume=resume)
    instances = some_instances(case, 10)
    return train(case, regime, instances, linear_model(case), out, options, epochs=epochs, **recipe)


def test_the_default_is_the_papers_recipe_and_nothing_else(threebus: Case, tmp_path: Path) -> None:
    """Written out: AdamW at 5e-4 on the loss, over all instances, raw inputs, the last weights."""
    assert SETTINGS["default"] == {}
    assert LEARNING_RATE == 5e-4
    policy = trained(threebus, tmp_path / "p.safetensors", 7, batch=4)
    assert (policy.training["instances"], policy.training["held_out"]) == (10, 0)
    instances, model = some_instances(threebus, 10), linear_model(threebus)
    data = Batch.of(threebus, model, instances, "cpu")
    knots, dt = threebus.knot_times(HORIZON), instances[0].dt_s
    condensed = Condensed.make(threebus, model, instances[0].grid, knots, torch.float32)
    ramp = torch.as_tensor(threebus.ramp * dt, dtype=torch.float32)
    loss = Loss(condensed, threebus.omega_bound(policy.scope.regime), ramp)
    torch.manual_seed(3)
    network, order = PaperNetwork(n_channels(threebus), threebus.p_min, threebus.p_max), torch.Generator()
    optimiser = torch.optim.AdamW(network.parameters(), lr=5e-4)
    order.manual_seed(3)
    for _ in range(7):
        for rows in torch.randperm(10, generator=order).split(4):
            optimiser.zero_grad()
            sum(loss(network, data[rows]).values()).backward()
            optimiser.step()
    expected = network.state_dict()
    assert (expected["mean"] == 0).all()
    assert (expected["scale"] == 1).all()
    for name, value in policy.weights.items():
        np.testing.assert_allclose(value, expected[name].numpy(), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("slug", SETTINGS)
def test_training_lowers_the_loss_repeats_and_resumes(threebus: Case, tmp_path: Path, slug: str) -> None:
    recipe = {name: value for name, value in SETTINGS[slug].items() if name != "epochs"}
    one = trained(threebus, tmp_path / "a.safetensors", 40, **recipe)
    two = trained(threebus, tmp_path / "b.safetensors", 40, **recipe)
    assert one.fingerprint == two.fingerprint
    trained(threebus, tmp_path / "c.safetensors", 20, **recipe)
    resumed = trained(threebus, tmp_path / "c.safetensors", 40, resume=True, **recipe)
    assert resumed.fingerprint == one.fingerprint
    history = pd.read_csv(tmp_path / "a.history.csv")
    assert tuple(history)[:4] == HISTORY
    assert history["epoch"].tolist() == [10, 20, 30, 40]
    decisive, fact = ("held out", "held_out_loss") if "held_out" in recipe else ("training", "training_loss")
    assert history[decisive].iloc[-1] < history[decisive].iloc[0]
    kept = history[decisive].min() if "held_out" in recipe else history[decisive].iloc[-1]
    assert one.training[fact] == pytest.approx(kept)
    assert history["held out"].isna().all() == ("held_out" not in recipe)
    terms = history.drop(columns=list(HISTORY)).sum(axis=1)
    np.testing.assert_allclose(terms, history[decisive], rtol=1e-6)


def test_what_the_averaged_recipe_adds(threebus: Case, tmp_path: Path) -> None:
    """Each addition changes the weights, and is told in the policy's header."""
    recipes = [{}, {"normalise": True}, {"averaging": 0.9}, {"held_out": 0.2}]
    policies = [trained(threebus, tmp_path / f"{i}.safetensors", 5, **r) for i, r in enumerate(recipes)]
    assert len({policy.fingerprint for policy in policies}) == 4
    for policy, recipe in zip(policies, recipes, strict=True):
        assert policy.training["recipe"] == dataclasses.asdict(Recipe(epochs=5, **recipe))
    assert (policies[3].training["instances"], policies[3].training["held_out"]) == (8, 2)
    assert (policies[1].weights["scale"] != 1).any()
    assert Recipe(**SETTINGS["averaged"]) != Recipe()


def test_a_time_limit_ends_the_training(threebus: Case, tmp_path: Path) -> None:
    options, regime = TrainingOptions(seconds=0.1), next(iter(threebus.regimes))
    out, instances = tmp_path / "p.safetensors", some_instances(threebus, 10)
    policy = train(threebus, regime, instances, linear_model(threebus), out, options, epochs=100_000)
    assert 0.1 <= policy.training["seconds"] < 5.0
    assert 1 <= policy.training["epochs"] < 100_000


@pytest.fixture(scope="module")
def policy(threebus: Case) -> Policy:
    network = fresh_network(threebus).eval()
    return Policy(Scope(threebus, next(iter(threebus.regimes)), HORIZON), weights_of(network), {"seed": 0})


def test_policy_files_round_trip_and_batches_equal_single_calls(
    policy: Policy, threebus: Case, tmp_path: Path
) -> None:
    path = policy_file(tmp_path, METHOD, policy.scope.regime)
    policy.save(path)
    loaded = Policy.load(path, threebus, policy.scope.regime)
    assert loaded.fingerprint == policy.fingerprint
    instances = some_instances(threebus, 3)
    for instance, schedule in zip(instances, loaded(instances), strict=True):
        np.testing.assert_allclose(schedule.p, policy(instance)[0].p, atol=1e-6)
        assert (schedule.p >= threebus.p_min).all()
        assert (schedule.p <= threebus.p_max).all()
    solve = prepare(threebus, policy.scope.regime, Settings(search=(tmp_path,)))
    solution = solve(instances[0])
    assert solution.status == Status.POLICY
    assert solution.solve_s > 0
    np.testing.assert_array_equal(solution.schedule.p, loaded(instances[0])[0].p)


def test_policy_refuses_what_it_was_not_trained_for(
    policy: Policy, threebus: Case, ninebus: Case, tmp_path: Path, alter
) -> None:
    path = tmp_path / "p.safetensors"
    policy.save(path)
    other_regime = next(r for r in threebus.regimes if r != policy.scope.regime)
    with pytest.raises(InputError, match="regime"):
        Policy.load(path, threebus, other_regime)
    with pytest.raises(InputError, match="case"):
        Policy.load(path, ninebus, policy.scope.regime)
    with pytest.raises(InputError, match="case_fingerprint"):
        Policy.load(path, alter(threebus, ramp_pu_per_s=0.01), policy.scope.regime)
    with pytest.raises(InputError, match="horizon"):
        policy(some_instances(threebus, 1)[0].model_copy(update={"horizon_s": 2.0}))
    with pytest.raises(InputError, match="case"):
        policy(some_instances(ninebus, 1))
    with pytest.raises(InputError, match="train-dpc"):
        prepare(threebus, policy.scope.regime, Settings(search=(tmp_path / "empty",)))
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputError, match=r"p\.safetensors"):
        Policy.load(path, threebus, policy.scope.regime)


def test_what_is_timed_is_what_is_answered(policy: Policy, threebus: Case) -> None:
    """The first call is paid for by another instance; then one call gives one answer."""
    asked: list[str] = []

    class Counting:
        scope = policy.scope

        def __call__(self, instance: Instance) -> list[Schedule]:
            asked.append(instance.id)
            return policy(instance)

    solve, (instance,) = method(Counting()), some_instances(threebus, 1)
    instance = instance.model_copy(update={"id": "mine"})
    assert len(asked) == 1
    solve(instance)
    solve(instance)
    assert asked[1:] == ["mine", "mine"]


def test_a_policy_trained_by_the_command_says_which_code_trained_it(tmp_path: Path) -> None:
    out = tmp_path / "policies" / "p.safetensors"
    arguments = ["--method", METHOD, "--regime", "TO", "--model", "linear", "--epochs", "1", "--limit", "1"]
    assert main(["train-dpc", *arguments, "--out", str(out)]) == 0
    assert training_table(tmp_path, ["code"])["code"].tolist() == [code_of(METHODS[METHOD].trainer)]
