"""The paper's policy: what it reads, its network, its loss and gradients, its recipe."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from ded_bench.files.errors import InputError
from ded_bench.methods.dpc_paper.paper_policy import FILTERS, WINDOWS, PaperPolicy, channels, n_channels
from ded_bench.methods.dpc_paper.paper_training import (
    BATCH,
    LEARNING_RATE,
    Q_INITIAL,
    Q_OMEGA,
    Q_RAMP,
    Batch,
    PaperLoss,
    PaperNetwork,
    train,
)
from ded_bench.methods.trained_policy import Scope, weights_of
from ded_bench.methods.training_record import TrainingOptions
from ded_bench.plants.lossless.network import Network
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import POLICY_SEED, sample_instance
from ded_bench.surrogates.koopman import CondensedRollout, hat_functions
from ded_bench.surrogates.linear import linear_model

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
    shapes = PaperPolicy.shapes(case, {})
    assert [(name, value.shape) for name, value in weights.items()] == list(shapes.items())
    schedules = PaperPolicy(Scope(case, "NO", HORIZON), weights, {})(instances)
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
    n_gen = len(case.generators)
    k, b, g = (torch.as_tensor(a) for a in (model.k, model.b, model.g))
    times = case.knot_times(instance.horizon_s)
    psi = torch.as_tensor(model.initial([instance])[0])
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


def loss_and_data(case: Case, count: int, bound: float) -> tuple[PaperLoss, Batch]:
    """In double precision."""
    model, instances = linear_model(case), some_instances(case, count)
    condensed = CondensedRollout.make(model, instances[0].grid, case.knot_times(HORIZON))
    data = Batch.of(case, model, instances)
    data = Batch(*(part.double() for part in data))
    loss = PaperLoss(condensed, bound, case.ramp * instances[0].dt_s)
    loss.gamma = torch.as_tensor(condensed.gamma.reshape(loss.gamma.shape))
    loss.hats, loss.ramp = (
        torch.as_tensor(hat_functions(condensed.points, condensed.knots)),
        loss.ramp.double(),
    )
    return loss, data


def test_condensed_loss_equals_the_sequential_one_in_values_and_gradients(case: Case) -> None:
    bound = 1e-4  # so tight that both frequency terms count
    loss, batch = loss_and_data(case, 2, bound)
    raw = np.random.default_rng(0).uniform(case.p_min, case.p_max, (2, case.n_knots, len(case.generators)))
    knots = torch.tensor(raw, requires_grad=True)
    values = torch.stack(list(loss(knots, batch).values()), dim=1)
    values.sum().backward()
    for b, instance in enumerate(some_instances(case, 2)):
        alone = torch.tensor(raw[b], requires_grad=True)
        expected = sequential_loss(case, linear_model(case), instance, alone, bound, loss.ramp)
        expected.sum().backward()
        assert (expected > 0).all()
        torch.testing.assert_close(values[b], expected, rtol=1e-5, atol=1e-5)  # data are stored in float32
        torch.testing.assert_close(knots.grad[b], alone.grad, rtol=1e-4, atol=1e-4)


def test_the_recipe_is_the_papers_and_nothing_else(threebus: Case, tmp_path: Path) -> None:
    """Written out: AdamW at 5e-4 on the loss, over all instances, raw inputs, the last weights."""
    assert (LEARNING_RATE, BATCH) == (5e-4, 8)
    instances, regime = some_instances(threebus, 10), next(iter(threebus.regimes))
    model = linear_model(threebus)
    model.save(tmp_path / "model.safetensors")
    options = TrainingOptions(seed=3, epochs=7, model=str(tmp_path / "model.safetensors"))
    policy = train(threebus, regime, instances, tmp_path / "p.safetensors", options)
    assert (policy.training["instances"], policy.training["held_out"]) == (10, 0)
    data = Batch.of(threebus, model, instances)
    condensed = CondensedRollout.make(model, instances[0].grid, threebus.knot_times(HORIZON))
    loss = PaperLoss(condensed, threebus.omega_bound(regime), threebus.ramp * instances[0].dt_s)
    torch.manual_seed(3)
    network, order = PaperNetwork(n_channels(threebus), threebus.p_min, threebus.p_max), torch.Generator()
    optimiser = torch.optim.AdamW(network.parameters(), lr=5e-4)
    order.manual_seed(3)
    for _ in range(7):
        for rows in torch.randperm(10, generator=order).split(8):
            optimiser.zero_grad()
            some = Batch(*(part[rows] for part in data))
            sum(term.mean() for term in loss(network(some.channels), some).values()).backward()
            optimiser.step()
    expected = network.state_dict()
    assert (expected["mean"] == 0).all()
    assert (expected["scale"] == 1).all()
    for name, value in policy.weights.items():
        np.testing.assert_allclose(value, expected[name].numpy(), rtol=1e-4, atol=1e-6)


def test_a_device_that_torch_does_not_have_is_refused(threebus: Case, tmp_path: Path) -> None:
    options, instances = TrainingOptions(model="linear", epochs=1, device="gpu"), some_instances(threebus, 8)
    with pytest.raises(InputError, match="--device"):
        train(threebus, next(iter(threebus.regimes)), instances, tmp_path / "p.safetensors", options)
