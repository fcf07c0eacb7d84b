"""A NeuroMANCER policy as one's own method: economic dispatch with foresight, learned, blind to dynamics.

Its package is no dependency of ded-bench. From the folder that holds this file, the first line trains:

    pip install neuromancer wandb
    python neuromancer_policy.py
    ded-bench solve --method neuromancer_policy:solve --regime NO --limit 3 --out results/mine

Was run with neuromancer 1.5.6 (its import needs wandb, which it calls optional), torch 2.13.0, lightning
2.6.6 and wandb 0.31.0. It trains in seconds; the schedules of the first 20 test instances in NO are feasible,
and cost 5.1 % more than those of DED in the mean.
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

    def seen(*known):
        return torch.cat(known, dim=1)

    return [
        Node(seen, ["c", "p0", "load"], ["x"], name="inputs"),
        Node(network, ["x"], ["moves"], name="network"),
        Node(rollout, ["p0", "moves"], ["p"], name="rollout"),
    ]


def cost(p, c, load):
    """Σ c_i P_i + c_s |P_s| of instances, summed over TIMES; P_s balances the loads."""
    slack = torch.abs(load - p.sum(dim=2))
    return ((p * c[:, None, :-1]).sum(dim=2) + c[:, -1:] * slack).sum(dim=1)


def train(case, instances, epochs=500):
    """Minimise the mean cost over instances; write the weights."""
    nodes, data = policy(case), inputs(case, instances)
    judged = Node(cost, ["p", "c", "load"], ["cost"], name="cost")
    problem = Problem([*nodes, judged], PenaltyLoss([variable("cost").minimize(name="mean cost")], []))
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
