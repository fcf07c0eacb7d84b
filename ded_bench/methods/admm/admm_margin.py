"""How far below its bound a trained policy must plan, found by simulating what it answers."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from ded_bench.methods.admm.admm_policy import SharedPolicy
from ded_bench.methods.policy_file import Scope
from ded_bench.plants.score import score
from ded_bench.plants.plant import SimulationError
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule

#: Fractions of the bound that are tried, in this order.
MARGINS = (0.0, 0.01, 0.02, 0.03, 0.04, 0.06, 0.08, 0.12, 0.16, 0.2, 0.25)
#: The first margin that keeps so large a part of the instances within the scorer's tolerance is taken.
WANTED = 0.98
#: So many margins after the best so far, none better, end the search.
PATIENCE = 3
#: Most instances that are simulated with each margin.
SIMULATED = 50


def with_margin(policy: SharedPolicy, instances: Sequence[Instance]) -> SharedPolicy:
    """The policy with the least margin that makes enough of its schedules feasible on the true system.

    Where no margin does, the one with most feasible schedules of those tried, and of several the least.

    Args:
        policy: trained; its margin so far counts for nothing.
        instances: not those that it will be judged on. Those that cannot be scored count as infeasible.
    """
    found: list[tuple[float, SharedPolicy]] = []
    for margin in MARGINS:
        tried = dataclasses.replace(policy, training=policy.training | {"margin": margin})
        share = _feasible_share(tried, instances[:SIMULATED])
        facts = tried.training | {"margin_feasible": share, "margin_instances": len(instances[:SIMULATED])}
        found.append((share, dataclasses.replace(tried, training=facts)))
        best = max(found, key=lambda pair: pair[0])
        if share >= WANTED or len(found) - found.index(best) > PATIENCE:
            break
    return best[1]


def _feasible_share(policy: SharedPolicy, instances: Sequence[Instance]) -> float:
    scope = policy.scope
    pairs = zip(instances, policy(instances), strict=True)
    return sum(_feasible(scope, instance, schedule) for instance, schedule in pairs) / len(instances)


def _feasible(scope: Scope, instance: Instance, schedule: Schedule) -> bool:
    try:
        return score(scope.case, instance, schedule, scope.regime).feasible
    except SimulationError:
        return False
