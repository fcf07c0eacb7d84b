"""What a grid is like before anything is optimised on it: for choosing its ranges and regimes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ded_bench.methods import ed
from ded_bench.plants.plant import NominalPoint, SimulationError, plant_of, servable, simulate
from ded_bench.problem.case import Array, Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.lossless_case import LosslessCase
from ded_bench.problem.quantities import largest_divisor
from ded_bench.problem.sampling import VALIDATION_SEED, drawn_with_redraws

#: Longest distance of knots, in periods of the fastest mode.
KNOT_PERIODS = 2 / 3
#: Within these lie the data of nearly all grids.
PLAUSIBLE = {"|V| of buses, pu": (0.8, 1.2), "inertia constants, s": (1.0, 15.0), "modes, Hz": (0.1, 3.0)}


@dataclass(frozen=True)
class CaseCheck:
    """Nominal operating point, modes around it, and what becomes of drawn instances."""

    nominal: NominalPoint
    frequency_hz: Array  # |λ|/2π of the modes, ascending; with full machine models those that oscillate
    damping: Array  # their damping ratios -Re λ/|λ|
    knots: int | None  # suggested number, see `suggested_knots`; None for full machine models
    drawn: int  # instances
    served: int  # of these at the first draw
    redrawn_loads: int  # because their sign changed; not in case/1
    peak_hz: dict[str, Array]  # by kind of bound: largest under static dispatch, ascending; ∞: collapse
    violating: dict[str, float]  # by regime: share that static dispatch takes beyond a bound


def check_case(case: Case, count: int) -> CaseCheck:
    """Examine a case on validation instances 0 to count - 1.

    Raises:
        SimulationError: the nominal powers have no equilibrium.
    """
    nominal = plant_of(case).nominal()
    modes = nominal.modes[nominal.modes.imag >= (0.0 if isinstance(case, LosslessCase) else 1e-6)]
    modes = modes[np.argsort(np.abs(modes))]
    drawn = list(drawn_with_redraws(case, VALIDATION_SEED, count))
    served = [found for instance, _ in drawn if (found := servable(case, instance))]
    frequency = np.abs(modes) / (2 * np.pi)
    runs = [_static(case, instance) for instance in served]
    beyond = {
        regime: [omega is None or max(case.bounds(regime).excess_hz(omega).values()) > 0 for omega in runs]
        for regime in case.regimes
    }
    bounds = case.bounds(next(iter(case.regimes)))
    free, collapsed = bounds.tightened(part=1.0), dict.fromkeys(bounds.kinds, np.inf)
    peaks = [collapsed if omega is None else free.excess_hz(omega) for omega in runs]
    return CaseCheck(
        nominal=nominal,
        frequency_hz=frequency,
        damping=-modes.real / np.abs(modes),
        knots=suggested_knots(case, float(frequency[-1])) if isinstance(case, LosslessCase) else None,
        drawn=count,
        served=len(served),
        redrawn_loads=sum(redraws for _, redraws in drawn),
        peak_hz={kind: np.sort([one[kind] for one in peaks]) for kind in collapsed},
        violating={regime: float(np.mean(found)) if found else 0.0 for regime, found in beyond.items()},
    )


def implausible(case: Case, found: CaseCheck) -> Iterator[str]:
    """What to look at again: data that few grids have, knots that are too few, bounds that tell nothing."""
    loads = zip(case.loads, case.load_nominal, strict=True)
    if feeding := [f"{bus} {power:g}" for bus, power in loads if power > 0]:
        yield f"loads that feed in, pu (a load that draws is negative): {', '.join(feeding)}"
    powers = zip(case.generators, case.p_nominal, case.p_min, case.p_max, strict=True)
    if beyond := [f"{name} {power:g}" for name, power, low, high in powers if not low <= power <= high]:
        yield f"nominal powers beyond the machines' limits, pu: {', '.join(beyond)}"
    if isinstance(case, LosslessCase):
        # Behind x'd a generator's |V| is no bus's; its largest power is its base.
        voltages = {bus.id: bus.v for bus in case.buses if bus.kind != "generator"}
        rated = {n: m.m * np.pi * case.f0_hz / m.p_max for n, m in case.machines.items() if m.p_max > 0}
    else:
        voltages = {bus.id: bus.v for bus in case.detailed.network.buses}
        rated = {name: machine.h for name, machine in case.detailed.machines.items()}
    modes = {str(place): value for place, value in enumerate(found.frequency_hz.tolist(), start=1)}
    for (name, (low, high)), values in zip(PLAUSIBLE.items(), (voltages, rated, modes), strict=True):
        if outside := [f"{key} {value:.3g}" for key, value in values.items() if not low <= value <= high]:
            yield f"{name}, outside {low:g} to {high:g}: {', '.join(outside[:5])}{', …' * (len(outside) > 5)}"
    if found.knots and case.n_knots < found.knots:
        yield f"knots: {case.n_knots}, fewer than the {found.knots} that the fastest mode suggests"
    for regime, share in found.violating.items():
        if found.served and share in (0, 1):
            said = "breaks it" if share else "keeps its bounds, which cost nothing,"
            yield f"regime {regime}: static dispatch {said} on every draw"


def suggested_knots(case: Case, fastest_hz: float) -> int:
    """Fewest equidistant knots on grid points, at most two thirds of the fastest mode's period apart.

    At 0.4 s, two thirds of the 39-bus grid's fastest period, knots cost 0.03 % of the objective there, at
    1.2 s 0.2 %.
    """
    steps = round(case.sampling.horizon_s / case.sampling.dt_s)
    return 1 + steps // largest_divisor(steps, min(KNOT_PERIODS / (fastest_hz * case.sampling.dt_s), steps))


def _static(case: Case, instance: Instance) -> Array | None:
    """Frequency deviations under static dispatch, (n, n_gen), rad/s; None where the system collapses."""
    try:
        return simulate(case, instance, ed.dispatch(case, instance)).omega
    except SimulationError:
        return None
