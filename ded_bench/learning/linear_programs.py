"""The linear programs of one closed loop as arrays, for those who start solvers from the last answer."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from ded_bench.files.errors import InputError
from ded_bench.files.strict import write_atomically
from ded_bench.methods.solution import Settings
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.scenario import Scenario
from ded_bench.problem.schedule import Schedule
from ded_bench.results.folder import search_folders
from ded_bench.run.online.loop import LoopOptions, Planned, answered, run_loop
from ded_bench.solvers.linear_program import LISTENERS, FormAnswer, FreeForm
from ded_bench.solvers.status import Status


def export_programs(
    path: str | Path,
    case: Case,
    scenario: Scenario,
    method: str,
    regime: str,
    settings: Settings | None = None,
    options: LoopOptions | None = None,
) -> int:
    """Operate one scenario in this process and keep the linear programs that are solved, in order.

    Each has the form: minimise c'x with l <= A x <= u and lb <= x <= ub. The file is NumPy's `.npz`, without
    pickled objects. Program k has arrays `k_c`, `k_lb`, `k_ub`, `k_x` (n_columns,), `k_l`, `k_u` (n_rows,),
    and A by columns: `k_data`, `k_indices`, `k_indptr`; x is what the loop's solver answered. Of all
    programs, (n,): `start_s`, when the plan takes effect, s; `objective`, c'x of the answer, NaN where it
    is not optimal; `solver`.

    Args:
        path: of the file.
        case: the grid.
        scenario: what happens.
        method: whose plans are followed.
        regime: one of the case's.
        settings: of the method; None: the default ones.
        options: of the loop; None: a plan every second, without latency.

    Returns:
        How many programs there are.

    Raises:
        InputError: unknown method, regime or settings, a scenario of another case, or the method solves no
            linear programs.
        SimulationError: the plant cannot follow.
    """
    scenario.check_case(case)
    own = settings or Settings()
    own = own if own.search else replace(own, search=search_folders(case))
    options, arrays, now = options or LoopOptions(), {}, 0.0
    told: list[tuple[float, float, str]] = []

    def keep(form: FreeForm, answer: FormAnswer) -> None:
        a, low, high = form.all_rows()
        matrix = {"l": low, "u": high, "data": a.data, "indices": a.indices, "indptr": a.indptr}
        columns = {"c": form.cost, "lb": form.lower, "ub": form.upper, "x": answer.x}
        arrays.update({f"{len(told)}_{name}": np.array(of) for name, of in (columns | matrix).items()})
        claimed = float(form.cost @ answer.x) if answer.status == Status.OPTIMAL else np.nan
        told.append((now, claimed, answer.version))

    def ask(instance: Instance, last: Schedule | None) -> Planned:
        nonlocal now
        now = int(instance.id.rpartition("-")[2]) * instance.dt_s  # the loop numbers its instances by step
        solution, warm = answered(case, method, regime, own, instance, last)
        return Planned(solution.schedule, warm=warm)

    LISTENERS.append(keep)
    try:
        with threadpool_limits(1):
            run_loop(case, scenario, ask, options)
    finally:
        LISTENERS.remove(keep)
    if not told:
        raise InputError("method", method, "solves no linear programs")
    arrays["start_s"], arrays["objective"], arrays["solver"] = map(np.array, zip(*told, strict=True))
    content = io.BytesIO()
    np.savez_compressed(content, allow_pickle=False, **arrays)
    write_atomically(Path(path), content.getvalue())
    return len(told)
