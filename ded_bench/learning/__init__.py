"""For those who train: a split as arrays, simulation in batches, linear maps, and a differentiable layer.

`split_arrays`, `simulate_many`, `linearise` and `condense` need no PyTorch; `simulated` and
`cost_and_excess`, which PyTorch differentiates, need the extra `train`. `casadi_model` has
the equations for optimisers, `export_programs` writes the linear programs of a closed loop.
Each is imported when first asked for.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ded_bench.learning.as_arrays import CondensedMap as CondensedMap
    from ded_bench.learning.as_arrays import SplitArrays as SplitArrays
    from ded_bench.learning.as_arrays import condense as condense
    from ded_bench.learning.as_arrays import linearise as linearise
    from ded_bench.learning.as_arrays import split_arrays as split_arrays
    from ded_bench.learning.casadi_expressions import CasadiModel as CasadiModel
    from ded_bench.learning.casadi_expressions import casadi_model as casadi_model
    from ded_bench.learning.differentiable import cost_and_excess as cost_and_excess
    from ded_bench.learning.differentiable import simulated as simulated
    from ded_bench.learning.linear_programs import export_programs as export_programs

_HOMES = {
    **dict.fromkeys(("CasadiModel", "casadi_model"), "ded_bench.learning.casadi_expressions"),
    **dict.fromkeys(("cost_and_excess", "simulated"), "ded_bench.learning.differentiable"),
    "export_programs": "ded_bench.learning.linear_programs",
    "simulate_many": "ded_bench",
    **dict.fromkeys(("condense", "linearise", "split_arrays"), "ded_bench.learning.as_arrays"),
    **dict.fromkeys(("CondensedMap", "SplitArrays"), "ded_bench.learning.as_arrays"),
}
__all__ = [*_HOMES]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
