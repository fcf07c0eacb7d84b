"""What a power flow can serve: closed form on the chain, the rule of `check_servable`, and draws by it."""

from __future__ import annotations

import json

import numpy as np
import pytest

from ded_bench.files.errors import InputError
from ded_bench.plants.plant import plant_of, servable
from ded_bench.problem.case import Case
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import drawn_with_redraws, sample_instances, sample_scenario

COUNT = 200


def check_servable(case: Case, instance: Instance, source: str) -> None:
    plant_of(case).check_servable(instance, source)


@pytest.fixture(scope="module")
def weak(threebus: Case, alter) -> Case:
    """The chain slack - town - plant with lines that cannot carry all that is drawn."""
    lines = json.loads(threebus.model_dump_json(by_alias=True))["lines"]
    return alter(threebus, lines=[line | {"r": 0.0, "x": 1.45} for line in lines])


def test_the_chain_serves_what_its_lines_carry(weak: Case) -> None:
    """Each line carries |V||V|/x: the plant's line its power, the slack's line the rest of the load."""
    instances = list(sample_instances(weak, 1, COUNT))
    v = {bus.id: bus.v for bus in weak.buses}
    most = {bus: v[bus] * v["town"] / 1.45 for bus in ("plant", weak.slack)}
    expected = []
    for instance in instances:
        load = instance.p_load(weak)
        plant = merit_order(weak, instance.cost_gen(weak), instance.cost_slack(weak), load)
        plant, load = np.vstack([instance.p_initial(weak), plant]), np.vstack([load[0], load])
        fits = (np.abs(plant) < most["plant"]) & (np.abs(plant + load) < most[weak.slack])
        expected.append(bool(fits.all()))
    assert 0.2 < np.mean(expected) < 0.8
    served = [servable(weak, instance) for instance in instances]
    assert served == [i if fits else None for i, fits in zip(instances, expected, strict=True)]
    for instance, fits in zip(instances, expected, strict=True):
        if fits:
            check_servable(weak, instance, "drawn")
        else:
            with pytest.raises(InputError, match="cannot be served"):
                check_servable(weak, instance, "drawn")


def test_what_cannot_be_served_is_drawn_again(weak: Case) -> None:
    """From the same generator: the others stay as they are, whichever part is drawn."""
    plain = list(sample_instances(weak, 1, COUNT))
    drawn = list(drawn_with_redraws(weak, 1, COUNT, servable=servable))
    good = [servable(weak, instance) is not None for instance in plain]
    assert all(servable(weak, instance) for instance, _ in drawn)
    for (instance, redraws), before, kept in zip(drawn, plain, good, strict=True):
        assert (instance == before) == (redraws == 0) == kept
        assert (instance.id, instance.seed) == (before.id, before.seed)
    assert list(drawn_with_redraws(weak, 1, 5, first=150, servable=servable)) == drawn[150:155]


def test_shipped_draws_of_the_paper_are_servable(ninebus: Case) -> None:
    """So the 9-bus instances, and all training data, are the same with the rule as without it."""
    assert all(servable(ninebus, instance) for instance in sample_instances(ninebus, 2022, 500))


def _ramp(case, **changes):
    """Nominal loads, the first of which ramps."""
    loads = {
        bus: {"initial": value, "start": 1.0, "duration": 2.0, "rate": 0.0}
        for bus, value in zip(case.loads, case.load_nominal.tolist(), strict=True)
    }
    loads[case.loads[0]] |= changes
    return loads


def test_check_servable_names_source_and_field(case, quiet_instance):
    """Too much load at the start, at the end of a ramp, or at the horizon; what lies beyond is no matter."""
    too_much = quiet_instance(case, load=_ramp(case, initial=-40.0))
    with pytest.raises(InputError, match=r"my\.json: load, initial\.power: initial loads and power cannot"):
        check_servable(case, too_much, "my.json")
    ramps_up = quiet_instance(case, load=_ramp(case, rate=-20.0))
    with pytest.raises(InputError, match=r"my\.json: load: loads at t = 3 s cannot be served"):
        check_servable(case, ramps_up, "my.json")
    horizon = case.sampling.horizon_s
    cut_off = quiet_instance(case, load=_ramp(case, duration=2 * horizon, rate=-40 / horizon))
    with pytest.raises(InputError, match=rf"my\.json: load: loads at t = {horizon:g} s cannot be served"):
        check_servable(case, cut_off, "my.json")
    check_servable(case, quiet_instance(case, load=_ramp(case, start=horizon + 1, rate=-40.0)), "my.json")


def test_scenarios_of_countless_horizons_are_refused(weak: Case) -> None:
    """Every horizon has a ramp for each load: it would draw for hours."""
    with pytest.raises(InputError, match=r"horizon_s: is too short for scenarios of 1e\+06 s"):
        sample_scenario(weak, 0, 0, duration_s=1e6)
