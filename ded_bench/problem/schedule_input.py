"""Schedules as notebooks have them: arrays, lists, data frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ded_bench.files.errors import InputError
from ded_bench.problem.case import Case
from ded_bench.problem.schedule import Schedule

if TYPE_CHECKING:
    import pandas as pd


def as_schedule(given: Schedule | pd.DataFrame, case: Case) -> Schedule:
    """A schedule whose times and powers are arrays of floats.

    Args:
        given: a schedule, its `t` and `p` arrays or nested lists; or a data frame with the columns of a
            schedule's file, `t` (s) and `P_<bus>` (pu), and perhaps others, such as that of a trajectory.

    Raises:
        InputError: it is something else, a column is missing, or shapes or values are wrong.
    """
    if isinstance(given, Schedule):
        t, p = given.t, given.p
    elif hasattr(given, "columns"):
        names = ["t", *(f"P_{bus}" for bus in case.generators)]
        found = [str(name) for name in given.columns]
        for name in names:
            if found.count(name) != 1:
                raise InputError("schedule", name, f"one such column is needed (found: {', '.join(found)})")
        t, p = given[names[0]].to_numpy(), given[names[1:]].to_numpy()
    else:
        problem = f"is a {type(given).__name__}; give a Schedule, or a data frame with columns t, P_<bus>"
        raise InputError("schedule", "", problem)
    try:
        if np.iscomplexobj(t) or np.iscomplexobj(p):  # NumPy would only warn
            raise TypeError("some are complex")
        times, powers = np.asarray(t, dtype=np.float64), np.asarray(p, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError("schedule", "t, P", f"must be real numbers, a row for each time ({error})") from None
    if times.ndim != 1 or powers.shape != (len(times), len(case.generators)):
        wanted = f"({len(times)}, {len(case.generators)}): a row per time, a column per generator"
        raise InputError("schedule", "P", f"has the shape {powers.shape}, but needs {wanted}")
    return Schedule(times, powers)
