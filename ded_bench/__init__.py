"""ded-bench: a benchmark suite for the dynamics-aware economic dispatch (DED) problem."""

from ded_bench.problem.case import Case
from ded_bench.problem.errors import InputError
from ded_bench.problem.instance import Instance, load_instances
from ded_bench.problem.schedule import Schedule
from ded_bench.truth.score import Score, score
from ded_bench.truth.simulate import Trajectory, simulate

__all__ = [
    "Case",
    "InputError",
    "Instance",
    "Schedule",
    "Score",
    "Trajectory",
    "load_instances",
    "score",
    "simulate",
]
