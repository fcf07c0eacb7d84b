"""What no file format can refuse, but is a mistake all the same: signs, units, copies under a name in use."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ded_bench.files.errors import InputError
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance

#: No grid in operation is further from its nominal frequency, Hz; whoever writes more means another quantity.
LARGEST_DEVIATION_HZ = 1.0


def check_plausible(case: Case, instance: Instance, source: str | Path) -> None:
    """Check signs and units of an instance's loads and frequencies.

    Raises:
        InputError: a load injects where the case's draws or the other way round, or a frequency deviation
            is beyond LARGEST_DEVIATION_HZ.
    """
    initial = instance.p_load(case, np.zeros(1))[0]
    for bus, value, nominal in zip(case.loads, initial, case.load_nominal, strict=True):
        if value * nominal < 0:
            does = "draws power, which is negative" if nominal < 0 else "feeds in, which is positive"
            problem = f"{value:g} pu has the wrong sign: in case {case.id} this bus {does}"
            raise InputError(source, f"load.{bus}", problem)
    largest = 2 * np.pi * LARGEST_DEVIATION_HZ
    for bus, value in instance.initial.omega.items():
        if abs(value) > largest:
            problem = (
                f"{value:g} rad/s is {value / (2 * np.pi):.3g} Hz from the nominal frequency; "
                "give the deviation in rad/s, not the frequency in Hz"
            )
            raise InputError(source, f"initial.omega.{bus}", problem)


def check_own_name(instance: Instance, source: str | Path, problems: Path, case: Case) -> None:
    """Check that an instance does not carry the name of another one of its case, whose rows it would replace.

    Args:
        problems: folder of the case's benchmark.

    Raises:
        InputError: the benchmark has an instance of this name with other contents.
    """
    namesake = problems / "instances" / f"{instance.id}.json"
    if namesake.is_file() and Instance.load_file(namesake, case)[0] != instance:
        problem = f"{instance.id} is the name of {namesake}, which says something else: choose another"
        raise InputError(source, "id", problem)
