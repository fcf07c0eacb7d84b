"""Machines with their controls as arrays on 100 MVA, in one form that compiled and symbolic equations share.

Every machine has the states of `STATES`. What a model lacks stands still: its inverse time constants are
zero. A classical machine is one whose flux linkages stand still, behind x'd on both axes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ded_bench.plants.time_varying import Indices
from ded_bench.problem.case import Array

#: Rotor angle (rad), speed deviation (pu), flux linkages, exciter, field voltage, exciter's feedback,
#: stabiliser, governor and turbine; a row of a state array each.
STATES = (
    *("delta", "w", "e1q", "e1d", "e2d", "e2q"),
    *("exciter", "v_f", "feedback"),
    *("washout", "lead_a", "lead_b"),
    *("gate", "turbine"),
)
N_STATES = len(STATES)
DELTA, SPEED, E1Q, E1D, E2D, E2Q, EXCITER, FIELD, FEEDBACK, WASHOUT, LEAD_A, LEAD_B, GATE, TURBINE = range(
    N_STATES
)


class MachineArrays(NamedTuple):
    """Constants of n machines, each of shape (n,); powers and reactances on 100 MVA, times inverse in 1/s."""

    omega_0: float  # rad/s
    port: Indices
    inverse_m: Array  # 1 / (2 h), pu/s; 0: the rotor keeps its speed
    inertia: Array  # weights of the mean frequency, sum 1
    d: Array
    x: Array  # of the source behind which the machine stands: subtransient, or x'd of a classical machine
    gd1: Array
    gd2: Array
    gq1: Array
    gq2: Array
    xd: Array
    xd1: Array
    xq: Array
    xq1: Array
    xl: Array
    rate_d1: Array  # 1 / T'd0
    rate_q1: Array
    rate_d2: Array
    rate_q2: Array
    dc: Array  # 1: exciter IEEEX1; 0: SEXS, or none
    gain: Array  # k, ka
    lead: Array  # ta / tb of SEXS, kf / tf of IEEEX1
    rate_x: Array  # of the first lag: 1 / tb, 1 / ta
    rate_f: Array  # of the field voltage: 1 / te; 0: it is constant
    ke: Array
    rate_fb: Array  # 1 / tf of IEEEX1
    ks: Array
    rate_w: Array  # 1 / tw
    lead_a: Array  # t1 / t2
    rate_a: Array
    lead_b: Array  # t3 / t4
    rate_b: Array
    droop: Array  # 1 / r, pu of 100 MVA per pu of speed
    rate_g: Array
    reheat: Array  # t2 / t3
    rate_h: Array


def machine_arrays(machines: Any, ports: Indices, infinite: str | None) -> MachineArrays:
    """Arrays of a case's machine records.

    Args:
        machines: the records.
        ports: the port of each machine, (n,).
        infinite: name of the machine that keeps its speed, if one does.
    """
    rows = [_constants(m, machines.base_mva) for m in machines.machines]
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    rigid = np.array([m.name == infinite for m in machines.machines])
    m = columns.pop("m")
    weights = rigid if rigid.any() else m
    return MachineArrays(
        omega_0=2.0 * np.pi * machines.f0_hz,
        port=ports,
        inverse_m=np.where(rigid, 0.0, 1.0 / m),
        inertia=weights / weights.sum(),
        **columns,
    )


def _constants(machine: Any, base_mva: float) -> dict[str, float]:
    k = machine.mva / base_mva
    common = {"m": 2.0 * machine.h * k, "d": machine.d * k}
    common |= _exciter(machine.exciter) | _stabiliser(machine.pss)
    governor = machine.governor
    common |= {"droop": k / governor.r, "rate_g": 1.0 / governor.t1}
    common |= {"reheat": governor.t2 / governor.t3, "rate_h": 1.0 / governor.t3}
    if machine.model == "GENCLS":
        same = dict.fromkeys(("x", "xd", "xd1", "xq", "xq1", "xl"), machine.xd1 / k)
        return common | same | _CLASSICAL
    xd1, xq1, xd2, xl = machine.xd1, machine.xq1, machine.xd2, machine.xl
    return common | {
        "x": xd2 / k,
        "gd1": (xd2 - xl) / (xd1 - xl),
        "gd2": k * (xd1 - xd2) / (xd1 - xl) ** 2,
        "gq1": (xd2 - xl) / (xq1 - xl),
        "gq2": k * (xq1 - xd2) / (xq1 - xl) ** 2,
        **{name: getattr(machine, name) / k for name in ("xd", "xd1", "xq", "xq1", "xl")},
        "rate_d1": 1.0 / machine.Td10,
        "rate_q1": 1.0 / machine.Tq10,
        "rate_d2": 1.0 / machine.Td20,
        "rate_q2": 1.0 / machine.Tq20,
    }


_CLASSICAL = {"gd1": 1.0, "gd2": 0.0, "gq1": 1.0, "gq2": 0.0} | dict.fromkeys(
    ("rate_d1", "rate_q1", "rate_d2", "rate_q2"), 0.0
)


def _exciter(exciter: Any) -> dict[str, float]:
    none = {"dc": 0.0, "gain": 0.0, "lead": 0.0, "rate_x": 0.0, "rate_f": 0.0, "ke": 1.0, "rate_fb": 0.0}
    if exciter is None:
        return none
    if exciter.model == "SEXS":
        lead = exciter.ta / exciter.tb
        return none | {"gain": exciter.k, "lead": lead, "rate_x": 1 / exciter.tb, "rate_f": 1 / exciter.te}
    return {
        "dc": 1.0,
        "gain": exciter.ka,
        "lead": exciter.kf / exciter.tf,
        "rate_x": 1.0 / exciter.ta,
        "rate_f": 1.0 / exciter.te,
        "ke": exciter.ke,
        "rate_fb": 1.0 / exciter.tf,
    }


def _stabiliser(pss: Any) -> dict[str, float]:
    if pss is None:
        return dict.fromkeys(("ks", "rate_w", "lead_a", "rate_a", "lead_b", "rate_b"), 0.0)
    return {
        "ks": pss.ks,
        "rate_w": 1.0 / pss.tw,
        "lead_a": pss.t1 / pss.t2,
        "rate_a": 1.0 / pss.t2,
        "lead_b": pss.t3 / pss.t4,
        "rate_b": 1.0 / pss.t4,
    }


def moving(data: MachineArrays) -> Indices:
    """Places in a flat state array (N_STATES × n) of the states that can change, in ascending order."""
    rates = np.ones((N_STATES, len(data.port)))
    for state, rate in (
        *((E1Q, data.rate_d1), (E1D, data.rate_q1), (E2D, data.rate_d2), (E2Q, data.rate_q2)),
        *((EXCITER, data.rate_x), (FIELD, data.rate_f), (FEEDBACK, data.rate_fb)),
        *((WASHOUT, data.rate_w), (LEAD_A, data.rate_a), (LEAD_B, data.rate_b)),
    ):
        rates[state] = rate
    rates[DELTA] = rates[SPEED] = data.inverse_m
    return np.flatnonzero(rates)
