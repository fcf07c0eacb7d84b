"""The paper's policy: loss on the condensed rollout, gradients, training, files, refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from ded_bench.files.errors import InputError
from ded_bench.koopman.condensed import free_response
from ded_bench.koopman.linear import linear_model
from ded_bench.methods.dpc_paper.paper_features import Features
from ded_bench.methods.dpc_paper.paper_loss import (
    Q_INITIAL,
    Q_OMEGA,
    Q_RAMP,
    Condensed,
    knot_times,
    loss_terms,
)
from ded_bench.methods.dpc_paper.paper_policy import (
    FILTERS,
    METHOD,
    N_KNOTS,
    WINDOWS,
    PaperNetwork,
    Policy,
    n_channels,
    prepare,
)
from ded_bench.methods.dpc_paper.paper_training import Batch, policy_loss, train
from ded_bench.methods.policy_file import policy_file
from ded_bench.methods.policy_solver import Interpolation
from ded_bench.methods.solution import Settings
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import POLICY_SEED, sample_instance
from ded_bench.problem.schedule import Schedule
from ded_bench.solvers.status import Status
from ded_bench.truth.network import Network, PowerFlowError

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
    assert N_KNOTS == 50
    extreme = network(1e6 * torch.randn(4, n_channels(ninebus), N_KNOTS))
    assert extreme.shape == (4, N_KNOTS, 2)
    assert (extreme >= network.p_min.T - 1e-6).all()
    assert (extreme <= network.p_max.T + 1e-6).all()


@pytest.mark.parametrize("count", [1, 3])
def test_the_policy_is_its_torch_network(case: Case, count: int) -> None:
    network, instances = fresh_network(case), some_instances(case, count)
    channels = Features.of(Network(case), instances, knot_times(HORIZON, N_KNOTS)).channels()
    network.mean.normal_()
    network.scale.uniform_(0.5, 2.0)
    with torch.inference_mode():
        expected = network(torch.as_tensor(channels, dtype=torch.float32)).double().numpy()
    schedules = Policy(case, "NO", HORIZON, network, {})(instances)
    # two orders of adding up a few hundred float32 products of order one
    np.testing.assert_allclose([s.p for s in schedules], expected, atol=2e-6)
    assert (np.ptp(expected, axis=1) > 1e-3).all()


def test_features_are_what_the_paper_lists(case: Case) -> None:
    network, instances = Network(case), some_instances(case, 3)
    knots = knot_times(HORIZON, N_KNOTS)
    features = Features.of(network, instances, knots)
    for b, instance in enumerate(instances):
        np.testing.assert_array_equal(features.p_load[b], instance.p_load(case, knots))
        theta = network.initial_angles(instance)
        p_slack = network.injections(theta)[network.slack]
        state = [theta[network.unknown], [p_slack], instance.omega_initial(case)]
        np.testing.assert_allclose(features.state[b], np.concatenate(state), atol=1e-11)
    channels = features.channels()
    assert channels.shape == (3, n_channels(case), N_KNOTS)
    assert (np.ptp(channels[:, len(case.loads) :], axis=2) == 0).all()


def sequential_loss(case, model, instance, knots, bound, ramp):
    """The paper's loss written out: step by step, in torch, one instance."""
    network, n_gen = Network(case), len(case.generators)
    k, b, g = (torch.as_tensor(a) for a in (model.k, model.b, model.g))
    times = knot_times(instance.horizon_s, N_KNOTS)
    psi = torch.as_tensor(model.initial(network, [instance])[0])
    p_load = torch.as_tensor(instance.p_load(case))
    cost, c_s = torch.as_tensor(instance.cost_gen(case)), instance.cost_slack(case)
    total = torch.zeros(6, dtype=torch.float64)
    powers = []
    for t in instance.grid:
        j = min(int(np.searchsorted(times, t, side="right")) - 1, N_KNOTS - 2)
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


def test_features_hold_the_power_flow_or_say_that_there_is_none(case: Case) -> None:
    """The compiled one is Newton's method with the same tolerance: 1e-12 pu, some 1e-12 rad."""
    network, knots = Network(case), knot_times(HORIZON, N_KNOTS)
    instances = [sample_instance(case, 5, i) for i in range(50)]
    features = Features.of(network, instances, knots)
    theta = network.power_flow(features.p_initial, features.p_load[:, 0])[:, network.unknown]
    np.testing.assert_allclose(features.state[:, : theta.shape[1]], theta, rtol=0, atol=1e-11)
    power = {bus: 40.0 for bus in case.generators}
    initial = instances[1].initial.model_copy(update={"power": power})
    instances[1] = instances[1].model_copy(update={"initial": initial})
    with pytest.raises(PowerFlowError, match="no solution"):
        Features.of(network, instances, knots)


def test_condensed_loss_equals_the_sequential_one_in_values_and_gradients(case: Case) -> None:
    model, instances = linear_model(case), some_instances(case, 2)
    grid, ramp = instances[0].grid, case.ramp_pu_per_s * instances[0].dt_s
    bound = 1e-4  # so tight that both frequency terms count
    rng = np.random.default_rng(0)
    raw = rng.uniform(case.p_min, case.p_max, (2, N_KNOTS, len(case.generators)))
    condensed = Condensed.make(case, model, grid, knot_times(HORIZON, N_KNOTS), torch.float64)
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
    condensed = Condensed.make(
        threebus, model, instances[0].grid, knot_times(HORIZON, N_KNOTS), torch.float64
    )

    def total() -> torch.Tensor:
        return torch.stack(list(policy_loss(network, condensed, batch, 1e-3, 1e-4).values())).sum()

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


def test_training_lowers_the_loss_repeats_and_resumes(threebus: Case, tmp_path: Path) -> None:
    model, instances = linear_model(threebus), some_instances(threebus, 10)
    regime = next(iter(threebus.regimes))
    one = train(threebus, regime, instances, model, tmp_path / "a.safetensors", seed=3, epochs=40)
    two = train(threebus, regime, instances, model, tmp_path / "b.safetensors", seed=3, epochs=40)
    assert one.fingerprint == two.fingerprint
    train(threebus, regime, instances, model, tmp_path / "c.safetensors", seed=3, epochs=20)
    resumed = train(
        threebus, regime, instances, model, tmp_path / "c.safetensors", seed=3, epochs=40, resume=True
    )
    assert resumed.fingerprint == one.fingerprint
    history = pd.read_csv(tmp_path / "a.history.csv")
    assert history["epoch"].tolist() == [10, 20, 30, 40]
    assert history["held out"].iloc[-1] < history["held out"].iloc[0]
    assert one.training["held_out_loss"] == pytest.approx(history["held out"].min())


@pytest.fixture(scope="module")
def policy(threebus: Case) -> Policy:
    network = fresh_network(threebus).eval()
    return Policy(threebus, next(iter(threebus.regimes)), HORIZON, network, {"seed": 0})


def test_policy_files_round_trip_and_batches_equal_single_calls(
    policy: Policy, threebus: Case, tmp_path: Path
) -> None:
    path = policy_file(tmp_path, METHOD, policy.regime)
    policy.save(path)
    loaded = Policy.load(path, threebus, policy.regime)
    assert loaded.fingerprint == policy.fingerprint
    instances = some_instances(threebus, 3)
    for instance, schedule in zip(instances, loaded(instances), strict=True):
        np.testing.assert_allclose(schedule.p, policy(instance)[0].p, atol=1e-6)
        assert (schedule.p >= threebus.p_min).all()
        assert (schedule.p <= threebus.p_max).all()
    solve = prepare(threebus, policy.regime, Settings(search=(tmp_path,)))
    solution = solve(instances[0])
    assert solution.status == Status.POLICY
    assert solution.solve_s > 0
    np.testing.assert_array_equal(solution.schedule.p, loaded(instances[0])[0].p)


def test_policy_refuses_what_it_was_not_trained_for(
    policy: Policy, threebus: Case, ninebus: Case, tmp_path: Path, alter
) -> None:
    path = tmp_path / "p.safetensors"
    policy.save(path)
    other_regime = next(r for r in threebus.regimes if r != policy.regime)
    with pytest.raises(InputError, match="regime"):
        Policy.load(path, threebus, other_regime)
    with pytest.raises(InputError, match="case"):
        Policy.load(path, ninebus, policy.regime)
    with pytest.raises(InputError, match="case_fingerprint"):
        Policy.load(path, alter(threebus, ramp_pu_per_s=0.01), policy.regime)
    with pytest.raises(InputError, match="horizon"):
        policy(some_instances(threebus, 1)[0].model_copy(update={"horizon_s": 2.0}))
    with pytest.raises(InputError, match="case"):
        policy(some_instances(ninebus, 1))
    with pytest.raises(InputError, match="train-dpc"):
        prepare(threebus, policy.regime, Settings(search=(tmp_path / "empty",)))
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputError, match=r"p\.safetensors"):
        Policy.load(path, threebus, policy.regime)


@pytest.mark.parametrize("n", [2, 7, 50, 6001])
def test_interpolation_gives_the_values_of_a_schedule(case: Case, n: int) -> None:
    """At all grid points, both ends included, wherever the knots lie between them."""
    powers = np.random.default_rng(n).uniform(case.p_min, case.p_max, (n, len(case.generators)))
    schedule, grid = Schedule(np.linspace(0.0, 60.0, n), powers), np.arange(6001) * 0.01
    found = Interpolation(schedule.t, grid)(schedule.p)
    np.testing.assert_allclose(found, schedule.at(grid), rtol=0, atol=1e-15)
