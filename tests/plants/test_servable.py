"""What a power flow can serve: closed form on the chain, the rule of `check_servable`, and draws by it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from ded_bench.plants.lossless.servable import servable

from ded_bench.files.errors import InputError
from ded_bench.plants.lossless.network import check_servable
from ded_bench.problem.benchmark import load_manifest, write_benchmark
from ded_bench.problem.case import Case
from ded_bench.problem.dispatch import merit_order
from ded_bench.problem.sampling import drawn_with_redraws, sample_instances

COUNT = 200


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
    assert servable(weak, instances).tolist() == expected
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
    good = servable(weak, plain)
    assert servable(weak, [instance for instance, _ in drawn]).all()
    for (instance, redraws), before, kept in zip(drawn, plain, good, strict=True):
        assert (instance == before) == (redraws == 0) == kept
        assert (instance.id, instance.seed) == (before.id, before.seed)
    assert list(drawn_with_redraws(weak, 1, 5, first=150, servable=servable)) == drawn[150:155]


def test_a_case_that_serves_nothing_is_told(weak: Case, alter) -> None:
    lines = json.loads(weak.model_dump_json(by_alias=True))["lines"]
    hopeless = alter(weak, lines=[line | {"x": 100.0} for line in lines])
    with pytest.raises(InputError, match="sampling: 1000 draws in a row cannot be served"):
        next(sample_instances(hopeless, 1, 1, servable=servable))


def test_the_manifest_counts_redraws(weak: Case, threebus: Case, tmp_path) -> None:
    """Only where there are any: what was written before there was a rule stays as it is."""
    expected = sum(redraws for _, redraws in drawn_with_redraws(weak, 3, 10, servable=servable))
    assert expected > 0
    write_benchmark(weak, 10, 3, tmp_path / "weak", servable=servable)
    manifest = load_manifest(tmp_path / "weak")
    assert manifest is not None
    assert manifest.redraws == expected
    write_benchmark(threebus, 10, 3, tmp_path / "strong", servable=servable)
    assert "redraws" not in (tmp_path / "strong" / "MANIFEST.json").read_text()


def test_shipped_draws_of_the_paper_are_servable(ninebus: Case) -> None:
    """So the 9-bus instances, and all training data, are the same with the rule as without it."""
    assert servable(ninebus, list(sample_instances(ninebus, 2022, 500))).all()
