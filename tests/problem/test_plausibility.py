"""Mistakes that no file format refuses: signs, units, edited copies under the name of another."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ded_bench.files.errors import InputError
from ded_bench.files.strict import write_record
from ded_bench.problem.benchmark import check_own_name
from ded_bench.problem.case import SHIPPED_CASES, Case
from ded_bench.problem.instance import Instance, check_plausible


def test_shipped_instances_are_plausible() -> None:
    """The first of every case; those of 9bus all."""
    files = [path for folder in SHIPPED_CASES.glob("*/instances") for path in sorted(folder.iterdir())[:1]]
    files += sorted((SHIPPED_CASES / "9bus" / "instances").iterdir())
    assert len(files) > 500
    for path in files:
        instance, case = Instance.load_file(path)
        check_plausible(case, instance, path)
        check_own_name(instance, path, path.parent.parent, case)


def test_every_load_has_the_sign_of_the_case(case: Case, quiet_instance) -> None:
    """A feed-in among the loads is positive, and a mistake if negative."""
    good = quiet_instance(case)
    check_plausible(case, good, "good.json")
    for bus in case.loads:
        wrong = good.load[bus].model_copy(update={"initial": -good.load[bus].initial})
        bad = good.model_copy(update={"load": good.load | {bus: wrong}})
        with pytest.raises(InputError, match=rf"bad.json: load.{bus}: .* pu has the wrong sign"):
            check_plausible(case, bad, "bad.json")


@pytest.mark.parametrize("frequency", [60.0, 59.98, -6.3, 6.3])
def test_a_frequency_in_hertz_is_no_deviation(case: Case, quiet_instance, frequency: float) -> None:
    good = quiet_instance(case)
    first = case.generators[0]
    for value in (frequency, np.copysign(6.2, frequency)):
        initial = good.initial.model_copy(update={"omega": good.initial.omega | {first: float(value)}})
        changed = good.model_copy(update={"initial": initial})
        if abs(value) < 2 * np.pi:
            check_plausible(case, changed, "x.json")
        else:
            with pytest.raises(InputError, match=rf"initial.omega.{first}: .* give the deviation in rad/s"):
                check_plausible(case, changed, "x.json")


def test_an_edited_copy_needs_a_name_of_its_own(
    threebus: Case, quiet_instance, alter, tmp_path: Path
) -> None:
    instance = quiet_instance(threebus)
    place = tmp_path / "instances" / f"{instance.id}.json"
    check_own_name(instance, "copy.json", tmp_path, threebus)
    write_record(instance, place)
    check_own_name(instance, "copy.json", tmp_path, threebus)  # the same instance, wherever it lies
    edited = alter(instance, horizon_s=2 * instance.horizon_s)
    with pytest.raises(InputError, match=rf"copy.json: id: {instance.id} is the name of .*: choose another"):
        check_own_name(edited, "copy.json", tmp_path, threebus)
    check_own_name(alter(edited, id="mine"), "copy.json", tmp_path, threebus)
