"""Our policy: what its network reads, and its compiled twin."""

from __future__ import annotations

import numpy as np
import torch

from ded_bench.methods.dpc.channels import Channels, Response
from ded_bench.methods.dpc.dpc_policy import DispatchPolicy
from ded_bench.methods.dpc.inference import CompiledStages
from ded_bench.methods.stacked_instances import StackedInstances
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance, LoadPoints
from ded_bench.surrogates.linear import by_angles, linear_model
from tests.methods.policies import short_instances, staged_network

HORIZON = 4.0


def some_instances(case: Case, count: int) -> list[Instance]:
    return short_instances(case, count, horizon=HORIZON)


def response_of(case: Case) -> Response:
    return Response.make(case, case.knot_times(HORIZON))


def channels_of(case: Case, inputs: StackedInstances) -> Channels:
    return Channels.of(case, inputs, response_of(case))


def test_compiled_twin_equals_the_torch_network(case: Case) -> None:
    network = staged_network(case, horizon=HORIZON)
    channels = channels_of(case, StackedInstances.of(case, some_instances(case, 9)))
    with torch.no_grad():
        arrays = channels.start, channels.free_response, channels.sequence, channels.constants
        expected = network(*(torch.as_tensor(a, dtype=torch.float32) for a in arrays)).numpy()
    state = {name: value.numpy() for name, value in network.state_dict().items()}
    shapes = DispatchPolicy.shapes(case, {})
    assert [(name, value.shape) for name, value in state.items()] == list(shapes.items())
    twin = CompiledStages(case, response_of(case), state)
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
    psi = np.concatenate([powers[:, 0], loads[:, 0]], axis=1) @ fine.b.T + theta @ by_angles(case).T
    psi[:, :n_gen] += omega
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
    mixed = [points[0], ramps[1]]
    seen = [channels_of(case, StackedInstances.of(case, batch)) for batch in (ramps, points, mixed)]
    for name in ("sequence", "constants", "start", "free_response"):
        values = [getattr(channels, name) for channels in seen]
        # single precision: a batch of another size may be summed in another order
        np.testing.assert_allclose(values[1], values[0], rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(values[2], values[0][:2], rtol=1e-6, atol=1e-6)
    grid = ramps[0].grid
    expected = np.stack([i.p_load(case, grid) for i in ramps])
    for batch in (ramps, points):
        np.testing.assert_allclose(StackedInstances.of(case, batch).p_load(grid), expected, atol=1e-12)
