"""A NeuroMANCER policy as one's own method, trained on cost and what exceeds the bounds on the plant.

From the folder that holds this file (extras `train` and `examples`); the second line trains for some minutes:

    pip install '.[train,examples]'
    python neuromancer_policy.py
    ded-bench solve --method neuromancer_policy:solve --regime NO --limit 3 --out results/mine
"""

import sys
from functools import cache
from types import ModuleType

# ruff: noqa: E402
# Its plots and its trainer, unused here, import what takes a minute, and what pip does not install with it.
for unused in ("neuromancer.plot", "neuromancer.trainer"):
    sys.modules.setdefault(unused, ModuleType(unused))

import numpy as np
import torch
from neuromancer.constraint import variable
from neuromancer.loss import PenaltyLoss
from neuromancer.modules.blocks import MLP
from neuromancer.problem import Problem
from neuromancer.system import Node

from ded_bench import Schedule
from ded_bench.learning import cost_and_excess, split_arrays

TIMES = np.linspace(0.0, 60.0, 13)  # s; the schedule is linear between them


def known(cost, cost_slack, p_initial, load):
    """What the policy sees of a batch: costs, initial powers, the sum of the loads at TIMES."""
    seen = np.column_stack([cost, cost_slack, p_initial, load.sum(axis=2)])
    return {"seen": torch.tensor(seen), "p0": torch.tensor(p_initial)}


def policy(case):
    """Network and rollout as NeuroMANCER's nodes; limits and ramps hold for any weights."""
    n, steps = len(case.generators), len(TIMES) - 1
    least, most, reach = map(torch.tensor, (case.p_min, case.p_max, case.ramp * TIMES[1]))

    def rollout(p0, moves):
        p = [p0]
        for move in moves.reshape(-1, steps, n).unbind(dim=1):
            p.append(torch.clamp(p[-1] + reach * torch.tanh(move), least, most))
        return torch.stack(p, dim=1)

    torch.manual_seed(0)
    network = MLP(2 * n + 1 + len(TIMES), steps * n, nonlin=torch.nn.GELU, hsizes=[64, 64]).double()
    return [Node(network, ["seen"], ["moves"], "network"), Node(rollout, ["p0", "moves"], ["p"], "rollout")]


def train(name="9bus", regime="NO", steps=200, batch=8):
    """Minimise cost per point and excess over the bounds on training instances; write the weights."""
    data, draw = split_arrays(name, "train", times=TIMES), np.random.default_rng(0)
    nodes, chosen = policy(data.case), []

    def judge(p):
        instances = [data.instances[i] for i in chosen]
        return cost_and_excess(data.case, instances, TIMES, p, regime, interval_s=1.0)

    plant = Node(judge, ["p"], ["cost", "excess"], "plant")
    cost, excess = (
        variable("cost").minimize(weight=1 / data.instances[0].steps),
        1e3 * (variable("excess") <= 0.0),
    )
    problem = Problem([*nodes, plant], PenaltyLoss([cost], [excess]))
    optimizer = torch.optim.Adam(problem.parameters(), 2e-3)
    for step in range(steps):
        chosen[:] = draw.integers(len(data), size=batch)
        batch_of = data.cost[chosen], data.cost_slack[chosen], data.p_initial[chosen], data.load[chosen]
        loss = problem(known(*batch_of) | {"name": "train"})["train_loss"]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        print(f"step {step}: {loss.item():.4f}", flush=True)
    torch.save(nodes[0].state_dict(), f"neuromancer-{name}-{regime}.pt")


@cache
def trained(case, regime):
    """The nodes with their weights."""
    nodes = policy(case)
    nodes[0].load_state_dict(torch.load(f"neuromancer-{case.id}-{regime}.pt", weights_only=True))
    return nodes


def solve(instance, regime, case):
    """Answer one instance."""
    load, p_initial = instance.p_load(case, TIMES), instance.p_initial(case)
    row = instance.cost_gen(case), np.array(instance.cost_slack(case)), p_initial, load
    data = known(*(np.asarray(of)[None] for of in row))
    with torch.no_grad():
        for node in trained(case, regime):
            data |= node(data)
    return Schedule(TIMES, data["p"][0].numpy())


if __name__ == "__main__":
    train(steps=int(sys.argv[1]) if len(sys.argv) > 1 else 200)
