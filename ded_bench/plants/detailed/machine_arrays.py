"""Machines with their controls as arrays on 100 MVA, in one form that compiled and symbolic equations share.

Every machine has the same states. What a model lacks stands still: its inverse time constants are
zero. A classical machine is one whose flux linkages stand still, behind x'd on both axes.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np

from ded_bench.problem.quantities import Indices

#: Rotor angle (rad), speed deviation (pu), flux linkages, exciter, field voltage, exciter's feedback,
#: stabiliser, governor and turbine; a row of a state array each.
N_STATES = 14
DELTA, SPEED, E1Q, E1D, E2D, E2Q, EXCITER, FIELD, FEEDBACK, WASHOUT, LEAD_A, LEAD_B, GATE, TURBINE = range(
    N_STATES
)

#: Constants of a machine: network, rotor, windings, exciter, stabiliser, governor.
MACHINE = np.dtype(
    [
        ("port", np.int64),
        ("omega_0", float),  # rad/s
        ("inverse_m", float),  # 1 / (2 h), pu/s; 0: the rotor keeps its speed
        ("inertia", float),  # its weight in the mean frequency; all sum to 1
        ("d", float),
        ("x", float),  # of the source behind which it stands: subtransient, or x'd of a classical machine
        *((name, float) for name in ("gd1", "gd2", "gq1", "gq2", "xd", "xd1", "xq", "xq1", "xl")),
        *((name, float) for name in ("rate_d1", "rate_q1", "rate_d2", "rate_q2")),  # 1 / T'd0 and so on
        ("dc", float),  # 1: exciter IEEEX1; 0: SEXS, or none
        ("gain", float),  # k, ka
        ("lead", float),  # ta / tb of SEXS, kf / tf of IEEEX1
        ("rate_x", float),  # of the first lag: 1 / tb, 1 / ta
        ("rate_f", float),  # of the field voltage: 1 / te; 0: it is constant
        ("ke", float),
        ("rate_fb", float),  # 1 / tf of IEEEX1
        ("ks", float),
        ("rate_w", float),  # 1 / tw
        ("lead_a", float),  # t1 / t2
        ("rate_a", float),  # 1 / t2
        ("lead_b", float),  # t3 / t4
        ("rate_b", float),  # 1 / t4
        ("droop", float),  # 1 / r, pu of 100 MVA per pu of speed
        ("rate_g", float),  # 1 / t1
        ("reheat", float),  # t2 / t3
        ("rate_h", float),  # 1 / t3
    ]
)
#: Records of MACHINE, (n_machine,), whose fields are attributes: structured, so that compiled functions take
#: one array instead of forty.
MachineArrays: TypeAlias = "np.recarray[tuple[int], np.dtype[np.void]]"


def machine_arrays(machines: Any, ports: Indices, infinite: str | None) -> MachineArrays:
    """Arrays of a case's machine records.

    Args:
        machines: the records.
        ports: the port of each machine, (n,).
        infinite: name of the machine that keeps its speed, if one does.
    """
    data = np.zeros(len(machines.machines), MACHINE).view(np.recarray)
    for place, machine in enumerate(machines.machines):
        for name, value in _constants(machine, machines.base_mva).items():
            data[name][place] = value
    rigid = np.array([m.name == infinite for m in machines.machines])
    m = np.array([2.0 * m.h * (m.mva / machines.base_mva) for m in machines.machines])
    weights = rigid if rigid.any() else m
    data["port"], data["omega_0"] = ports, 2.0 * np.pi * machines.f0_hz
    data["inverse_m"], data["inertia"] = np.where(rigid, 0.0, 1.0 / m), weights / weights.sum()
    return data


def _constants(machine: Any, base_mva: float) -> dict[str, float]:
    """What a machine's own data say; all else is zero."""
    k, governor = machine.mva / base_mva, machine.governor
    common = {"d": machine.d * k, **_exciter(machine.exciter), **_stabiliser(machine.pss)}
    common |= {"droop": k / governor.r, "rate_g": 1.0 / governor.t1}
    common |= {"reheat": governor.t2 / governor.t3, "rate_h": 1.0 / governor.t3}
    if machine.model == "GENCLS":
        same = dict.fromkeys(("x", "xd", "xd1", "xq", "xq1", "xl"), machine.xd1 / k)
        return common | same | {"gd1": 1.0, "gq1": 1.0}
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


def _exciter(exciter: Any) -> dict[str, float]:
    if exciter is None:
        return {"ke": 1.0}
    if exciter.model == "SEXS":
        gain, lead, lag, own = exciter.k, exciter.ta / exciter.tb, exciter.tb, {"ke": 1.0}
    else:
        gain, lead, lag = exciter.ka, exciter.kf / exciter.tf, exciter.ta
        own = {"dc": 1.0, "ke": exciter.ke, "rate_fb": 1.0 / exciter.tf}
    return own | {"gain": gain, "lead": lead, "rate_x": 1.0 / lag, "rate_f": 1.0 / exciter.te}


def _stabiliser(pss: Any) -> dict[str, float]:
    if pss is None:
        return {}
    return {
        "ks": pss.ks,
        "rate_w": 1.0 / pss.tw,
        "lead_a": pss.t1 / pss.t2,
        "rate_a": 1.0 / pss.t2,
        "lead_b": pss.t3 / pss.t4,
        "rate_b": 1.0 / pss.t4,
    }
