"""Compare weights of `ded-admm` that were trained in different ways.

Run as `python studies/admm_derivative_free.py 39bus TO OLD.safetensors NEW.safetensors 64`: policies answer
so many fresh validation draws, and the simulation judges; costs are relative to those of the first policy.
"""

import sys

import numpy as np

from ded_bench import Case
from ded_bench.methods.admm.admm_policy import AdmmPolicy
from ded_bench.plants.plant import servable
from ded_bench.plants.score import score
from ded_bench.problem.benchmark import validation_instances

#: Validation draws: none that a choice was made on before.
FIRST = 40_000


def main(name: str, regime: str, old: str, new: str, count: str) -> None:
    """Print a line per policy."""
    case, first = Case.load(name), None
    draws = list(validation_instances(case, int(count), FIRST, servable=servable))
    for path in (old, new):
        policy = AdmmPolicy.load(path, case, regime)
        found = [score(case, i, s, regime) for i, s in zip(draws, policy(draws), strict=True)]
        cost, excess = np.array([(one.objective, one.freq_violation_hz) for one in found]).T
        first = cost if first is None else first
        more = 100 * (cost / first - 1)
        facts = policy.training
        print(
            f"{name} {regime}: {facts['cpu_seconds']:.0f} s of CPU, {facts['steps']} steps, held out "
            f"{facts['held_out_loss']:.6f}, margin {facts['margin']}; cost {more.mean():+.4f} ± "
            f"{more.std() / np.sqrt(len(more)):.4f} %, violation {excess.mean():.1e} Hz in the mean, "
            f"{excess.max():.1e} at most, feasible {sum(one.feasible for one in found)} of {len(found)}"
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
