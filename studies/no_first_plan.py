"""The closed loop without a plan at t = 0: powers stay until the first answer of `ded-rti` is due.

`ded-bench online` gives every method a first plan in time. What that is worth shows with a method that throws
its first answer away. Run it from the folder that holds this file, or with that folder on PYTHONPATH:

    ded-bench online --method no_first_plan:prepare --regime TO --latency 7 --state present --scenarios 10
"""

from ded_bench import Schedule, Settings
from ded_bench.methods.registry import get_method
from ded_bench.results.folder import search_folders


class NoFirstPlan:
    """Answers as a solver does, but for the plan that nothing is in force before."""

    def __init__(self, case, solver):
        self.case, self.solver = case, solver

    def solve(self, instance, last=None):
        """The solver's answer; first, the powers at t = 0."""
        if last is not None:
            return self.solver.solve(instance, last)
        power = instance.p_initial(self.case)
        return Schedule([0.0, instance.horizon_s], [power, power])


def prepare(case, regime, settings):
    """`ded-rti`, but for its first plan."""
    chosen = Settings(search=search_folders(case))
    return NoFirstPlan(case, get_method("ded-rti").prepare(case, regime, chosen))
