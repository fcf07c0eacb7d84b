"""Memory: a program that would take too much of it is refused by its size, before it is made."""

from __future__ import annotations

from ded_bench.methods.solution import Solution
from ded_bench.solvers.status import Status

#: What the program of one worker may take, bytes.
MAX_BYTES = 4 * 2**30


def too_large(needed: float, program: str, advice: str) -> Solution | None:
    """Return a `Failed` answer if a program would take more than `MAX_BYTES`; None if it may be made.

    Args:
        needed: an estimate from its size, bytes.
        program: what the message calls it.
        advice: what to do instead, for the same message.
    """
    if needed <= MAX_BYTES:
        return None
    error = f"{program} would take {needed / 2**30:.0f} GiB; {advice}"
    return Solution(Status.FAILED, build_s=0.0, setup_s=0.0, solve_s=0.0, error=error)
