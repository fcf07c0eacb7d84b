"""A policy of one's own, trained through the plant itself: the layer of `ded_bench.learning` has gradients.

From the folder that holds this file (extra `train`); the first line trains for about two minutes:

    python learned_policy.py
    ded-bench solve --method learned_policy:solve --regime NO --limit 3 --out results/mine
"""

import sys
from functools import cache

import numpy as np
import torch

from ded_bench import Case, Schedule
from ded_bench.learning import simulated, split_arrays

KNOTS = 13


def network(case):
    """From costs, P_0 and loads to a part of the ramp limit for each machine and interval."""
    torch.manual_seed(0)
    n = len(case.generators)
    sizes = len(case.priced) + n + KNOTS * len(case.loads), 64, n * (KNOTS - 1)
    return torch.nn.Sequential(
        torch.nn.Linear(*sizes[:2]), torch.nn.GELU(), torch.nn.Linear(*sizes[1:]), torch.nn.Tanh()
    ).double()


def powers(case, net, t, cost, p_initial, load):
    """Schedules of a batch, (batch, KNOTS, n_gen): bounds and ramps hold for any weights."""
    known = torch.tensor(np.concatenate([cost, p_initial, load.reshape(len(load), -1)], axis=1))
    moves = net(known).reshape(len(load), KNOTS - 1, -1) * torch.tensor(case.ramp * t[1])
    p, least, most = [torch.tensor(p_initial)], torch.tensor(case.p_min), torch.tensor(case.p_max)
    for move in moves.unbind(1):
        p.append(torch.minimum(torch.maximum(p[-1] + move, least), most))
    return torch.stack(p, dim=1)


def costs(case, instances):
    """Of the slack, if there is one, and the generators, (batch, n_priced)."""
    return np.array([[i.cost[name] for name in case.priced] for i in instances])


def train(name="9bus", regime="NO", steps=150, batch=8):
    """Minimise cost per point plus a price on what exceeds the bounds; write the weights."""
    t = np.linspace(0.0, Case.load(name).sampling.horizon_s, KNOTS)
    data = split_arrays(name, "train", times=t)
    case, net, draw = data.case, network(data.case), np.random.default_rng(0)
    bounds, optimizer = case.bounds(regime), torch.optim.Adam(net.parameters(), 3e-3)
    for step in range(steps):
        chosen = draw.integers(len(data), size=batch)
        instances = [data.instances[i] for i in chosen]
        cost = costs(case, instances)
        p = powers(case, net, t, cost, data.p_initial[chosen], data.load[chosen])
        omega, p_slack, p_gen = simulated(case, instances, t, p, interval_s=1.0)
        price, slack = torch.tensor(data.cost[chosen]), torch.tensor(data.cost_slack[chosen])
        paid = (p_gen * price[:, None]).sum(2) + slack[:, None] * p_slack.abs()
        beyond = torch.relu((omega @ torch.tensor(bounds.matrix.T)).abs() - torch.tensor(bounds.limit))
        loss = paid.mean() + 100.0 * beyond.sum(2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        print(f"step {step}: {loss.item():.5f}", flush=True)
    torch.save(net.state_dict(), f"learned-{name}-{regime}.pt")


@cache
def trained(case, regime):
    """The network with its weights."""
    net = network(case)
    net.load_state_dict(torch.load(f"learned-{case.id}-{regime}.pt", weights_only=True))
    return net


def solve(instance, regime, case):
    """Answer one instance."""
    t = np.linspace(0.0, instance.horizon_s, KNOTS)
    known = costs(case, [instance]), instance.p_initial(case)[None], instance.p_load(case, t)[None]
    with torch.no_grad():
        return Schedule(t, powers(case, trained(case, regime), t, *known)[0].numpy())


if __name__ == "__main__":
    train(steps=int(sys.argv[1]) if len(sys.argv) > 1 else 150)
