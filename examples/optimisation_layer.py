"""Dispatch with foresight as a CVXPY layer, whose dislike of changing ramps is learned through the plant.

From the folder that holds this file (extras `train` and `examples`); the second line trains for some minutes:

    pip install '.[train,examples]'
    python optimisation_layer.py
    ded-bench solve --method optimisation_layer:solve --regime TO --limit 3 --out results/mine
"""

import sys
from functools import cache

import cvxpy as cp
import numpy as np
import torch
from cvxpylayers.torch import CvxpyLayer

from ded_bench import Schedule
from ded_bench.learning import cost_and_excess, split_arrays

TIMES = np.linspace(0.0, 60.0, 25)  # s; the schedule is linear between them


@cache
def layer(case):
    """Powers at TIMES by costs, P_0, demand and the weights of changes of ramps, of each machine."""
    n, knots = len(case.generators), len(TIMES)
    p, slack = cp.Variable((knots, n)), cp.Variable(knots)
    cost, cost_slack = cp.Parameter(n), cp.Parameter(nonneg=True)
    start, demand, weight = cp.Parameter(n), cp.Parameter(knots), cp.Parameter(n, nonneg=True)
    moves, reach = cp.diff(p, axis=0), np.tile(case.ramp * TIMES[1], (knots - 1, 1))
    turns = cp.vstack([moves[0], cp.diff(moves, axis=0)])
    paid = cp.sum(p @ cost) + cost_slack * cp.norm1(slack)
    smooth = weight @ cp.sum(cp.square(turns), axis=0)
    keeps = [slack == demand - cp.sum(p, axis=1), p[0] == start]
    keeps += [p >= case.p_min, p <= case.p_max, cp.abs(moves) <= reach]
    problem = cp.Problem(cp.Minimize(paid + smooth), keeps)
    return CvxpyLayer(problem, [cost, cost_slack, start, demand, weight], [p])


def powers(case, cost, cost_slack, p_initial, load, weight):
    """Schedules of a batch, (batch, knots, n_gen)."""
    known = (torch.tensor(of) for of in (cost, cost_slack, p_initial, -load.sum(axis=2)))
    return layer(case)(*known, weight.expand(len(cost), -1), solver_args={"solve_method": "Clarabel"})[0]


def train(name="9bus", regime="TO", steps=100, batch=8):
    """Minimise cost and priced excess over training instances; write the weights."""
    data, draw = split_arrays(name, "train", times=TIMES), np.random.default_rng(0)
    case, n = data.case, len(data.case.generators)
    log_weight = torch.zeros(n, dtype=torch.double, requires_grad=True)
    optimizer = torch.optim.Adam([log_weight], 0.1)
    for step in range(steps):
        k = draw.integers(len(data), size=batch)
        known = data.cost[k], data.cost_slack[k], data.p_initial[k], data.load[k]
        p = powers(case, *known, log_weight.exp())
        cost, excess = cost_and_excess(case, [data.instances[i] for i in k], TIMES, p, regime, interval_s=0.5)
        loss = (cost / data.instances[0].steps + 1e3 * excess).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        print(f"step {step}: {loss.item():.5f}, excess {1e3 * excess.mean().item():.3f} mHz", flush=True)
    np.save(f"layer-{name}-{regime}.npy", log_weight.exp().detach().numpy())


def solve(instance, regime, case):
    """Answer one instance."""
    load, p_initial = instance.p_load(case, TIMES), instance.p_initial(case)
    known = instance.cost_gen(case), np.array(instance.cost_slack(case)), p_initial, load
    weight = torch.tensor(np.load(f"layer-{case.id}-{regime}.npy"))
    return Schedule(TIMES, powers(case, *(of[None] for of in known), weight)[0].numpy())


if __name__ == "__main__":
    train(steps=int(sys.argv[1]) if len(sys.argv) > 1 else 100)
