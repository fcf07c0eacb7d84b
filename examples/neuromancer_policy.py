"""A NeuroMANCER policy as one's own method: economic dispatch with foresight, learned, blind to dynamics.

Its package is no dependency of ded-bench. From the folder that holds this file, the first line trains:

    pip install neuromancer wandb
    python neuromancer_policy.py
    ded-bench solve --method neuromancer_policy:solve --regime NO --limit 3 --out results/mine
"""

from functools import cache
from pathlib import Path

import numpy as np
import torch
from neuromancer.constraint import variable
from neuromancer.loss import PenaltyLoss
from neuromancer.modules.blocks import MLP
from neuromancer.problem import Problem
from neuromancer.system import Node

from ded_bench import Case, Schedule, load_instances

FILE = Path("neuromancer_policy.pt")
TIMES = np.linspace(0.0, 60.0, 13)  # s; the schedule is linear between them


def inputs(case, instances):
    """What the policy sees of instances: costs, initial powers, the sum of the loads at TIMES."""
    cost = [[*i.cost_gen(case), i.cost_slack(case)] for i in instances]
    known = {"c": cost, "p0": [i.p_initial(case) for i in instances]}
    known["load"] = [-i.p_load(case, TIMES).sum(axis=1) for i in instances]
    return {name: torch.tensor(np.array(values), dtype=torch.float32) for name, values in known.items()}


def policy(case):
    """Network and rollout as NeuroMANCER's nodes; bounds and ramps hold for any weights."""
    n, steps = len(case.generators), len(TIMES) - 1
    least, most = (torch.tensor(limit, dtype=torch.float32) for limit in (case.p_min, case.p_max))
    step = torch.tensor(case.ramp * TIMES[1], dtype=torch.float32)
    network = MLP(n + 1 + n + len(TIMES), steps * n, nonlin=torch.nn.GELU, hsizes=[64, 64])

    def rollout(p0, moves):
        p = [p0]
        for move in moves.reshape(-1, steps, n).unbind(dim=1):
            p.append(torch.clamp(p[-1] + step * torch.tanh(move), least, most))
        return torch.stack(p, dim=1)

    joined = Node(lambda c, p0, load: torch.cat([c, p0, load], dim=1), ["c", "p0", "load"], ["x"])
    return [joined, Node(network, ["x"], ["moves"]), Node(rollout, ["p0", "moves"], ["p"])]


def train(case, instances, epochs=500):
    """Minimise the mean cost Σ c_i P_i + c_s |P_s| over instances; write the weights."""
    nodes, data = policy(case), inputs(case, instances)
    p, c, load = variable("p"), variable("c"), variable("load")
    slack = torch.abs(load - torch.sum(p, dim=2))
    cost = torch.sum(p * c[:, None, :-1], dim=2) + slack * c[:, -1:]
    problem = Problem(nodes, PenaltyLoss([cost.minimize()], []))
    optimizer = torch.optim.Adam(problem.parameters(), 2e-3)
    for epoch in range(epochs):
        loss = problem(data | {"name": "train"})["train_loss"]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if epoch % 100 == 0:
            print(f"epoch {epoch}: {loss.item():.4f}", flush=True)
    torch.save(nodes[1].state_dict(), FILE)


@cache
def trained(case):
    """The nodes with the weights of FILE."""
    nodes = policy(case)
    nodes[1].load_state_dict(torch.load(FILE, weights_only=True))
    return nodes


def solve(instance, regime, case):
    """Answer one instance."""
    data = inputs(case, [instance])
    with torch.no_grad():
        for node in trained(case):
            data |= node(data)
    return Schedule(TIMES, data["p"][0].double().numpy())


if __name__ == "__main__":
    torch.manual_seed(0)
    train(Case.load("9bus"), load_instances("9bus", split="train"))
