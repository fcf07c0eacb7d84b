"""The certificate: its bounds, what counts as a success, resuming."""

from __future__ import annotations

import collections
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binom

import tests.strange_methods
from ded_bench.analysis import certificate
from ded_bench.analysis.certificate import (
    ROWS,
    Candidate,
    Criteria,
    certify,
    clopper_pearson,
    hoeffding,
    judge,
    meets_limits,
    read_certificates,
    save_certificate,
)
from ded_bench.methods.registry import METHODS, Method
from ded_bench.methods.solution import Settings
from ded_bench.plants.score import score
from ded_bench.problem.case import Case
from ded_bench.problem.sampling import CERTIFICATE_SEED, sample_instance
from ded_bench.problem.schedule import Schedule
from ded_bench.run.tasks import prepared

pytestmark = pytest.mark.usefixtures("inline")


@pytest.mark.parametrize(("successes", "count"), [(1, 1), (7, 10), (995, 1000), (9950, 10_000)])
def test_clopper_pearson_is_the_exact_bound(successes: int, count: int) -> None:
    """At the bound, so many successes or more have exactly the probability δ."""
    for delta in (0.01, 0.2):
        p = clopper_pearson(successes, count, delta)
        assert binom.sf(successes - 1, count, p) == pytest.approx(delta, rel=1e-6)
        assert hoeffding(successes, count, delta) < p < successes / count


def test_bounds_in_closed_form() -> None:
    assert clopper_pearson(100, 100, 0.01) == pytest.approx(0.01 ** (1 / 100))
    assert clopper_pearson(0, 100, 0.01) == 0.0
    assert hoeffding(90, 100, 0.01) == pytest.approx(0.9 - np.sqrt(np.log(100) / 200))
    assert hoeffding(1, 100, 0.01) == 0.0


def test_what_counts() -> None:
    rows = pd.DataFrame(
        {
            "objective": [101.0, 103.0, np.nan, 100.0],
            "reference": [100.0, 100.0, 100.0, np.nan],
            "freq_violation_hz": [0.0, 2e-6, np.nan, 0.0],
            "ramp_violation": [0.0, 0.0, np.nan, 0.0],
            "bound_violation": [0.0, 0.0, np.nan, 1e-7],
            "initial_violation": [0.0, 0.0, np.nan, 0.0],
        }
    )
    assert meets_limits(rows, 1e-6, 1e-8).tolist() == [True, False, False, False]
    assert meets_limits(rows, 1e-5, 1e-6).tolist() == [True, True, False, True]


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Two methods that hold P_0 and note each instance they are asked about."""
    log = tmp_path / "log"
    log.touch()
    monkeypatch.setenv("STRANGE_LOG", str(log))
    for name in ("ded-dpc-paper", "ded"):
        monkeypatch.setitem(METHODS, name, Method(name, "tests.strange_methods", name))
    monkeypatch.setattr(certificate, "CHUNK", 2)
    prepared.cache_clear()
    yield lambda: collections.Counter(log.read_text().split())
    prepared.cache_clear()


def candidate(regime: str) -> Candidate:
    return Candidate("ded-dpc-paper", regime, Settings(), reference="ded")


def rows_of(folder: Path, regime: str) -> list[certificate.CertificateRow]:
    (path,) = (folder / "certificates").glob(f"*-{regime}.csv.gz")
    return ROWS.read(path)


def run(
    case: Case, folder: Path, regime: str, seed: int = 0, count: int = 4, **criteria: float
) -> certificate.Certificate:
    return certify(case, candidate(regime), folder, Criteria(**criteria), count=count, seed=seed)


def test_both_methods_are_re_simulated_on_fresh_instances(calls, threebus: Case, tmp_path: Path) -> None:
    loose = max(threebus.regimes, key=threebus.omega_bound)
    result = run(threebus, tmp_path, loose)
    rows = ROWS.frame(rows_of(tmp_path, loose))
    assert rows["index"].tolist() == [0, 1, 2, 3]
    assert (rows["objective"] == rows["reference"]).all()  # the same schedules
    verdicts = []
    for i, objective in enumerate(rows["objective"]):
        instance = sample_instance(threebus, CERTIFICATE_SEED, i)
        power = instance.p_initial(threebus)
        schedule = Schedule(np.array([0.0, instance.horizon_s]), np.array([power, power]))
        verdicts.append(score(threebus, instance, schedule, loose))
        assert verdicts[-1].objective == pytest.approx(objective, rel=1e-9)
    assert result.meets_limits == result.successes == sum(v.feasible_strict for v in verdicts)
    assert result.near_reference == 4
    assert result.seed == CERTIFICATE_SEED
    assert result.clopper_pearson == clopper_pearson(result.successes, 4, 0.01)
    assert f"{result.successes} of 4" in result.sentence
    assert set(calls().values()) == {2}


def stopped(*call):
    """A judge who is interrupted at the third instance."""
    if 2 in call[-1]:
        raise KeyboardInterrupt
    return judge(*call)


def test_an_interrupted_certificate_goes_on(
    calls, threebus: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    regime = next(iter(threebus.regimes))
    with monkeypatch.context() as patch:
        patch.setattr(certificate, "judge", stopped)
        with pytest.raises(KeyboardInterrupt):
            run(threebus, tmp_path, regime)
    assert len(rows_of(tmp_path, regime)) == 2
    first = run(threebus, tmp_path, regime)
    assert set(calls().values()) == {2}  # once by each method: nothing was done twice
    again = run(threebus, tmp_path, regime)
    assert again.model_copy(update={"date": first.date}) == first
    assert set(calls().values()) == {2}
    run(threebus, tmp_path, regime, count=1)
    assert len(rows_of(tmp_path, regime)) == 4  # fewer are asked for, and none is lost
    run(threebus, tmp_path, regime, seed=1)  # other instances: rows of these do not count
    assert sum(calls().values()) == 16
    with monkeypatch.context() as patch:
        patch.setattr(tests.strange_methods, "VERSION", 99)
        run(threebus, tmp_path, regime, seed=1)
    assert sum(calls().values()) == 24  # rows of another version do not count either


def test_a_folder_keeps_one_of_each_model(calls, threebus: Case, tmp_path: Path) -> None:
    first = run(threebus, tmp_path, next(iter(threebus.regimes)))
    other = first.model_copy(update={"model": "trajectory@f00"})
    newer = first.model_copy(update={"date": "2027-01-01T00:00:00Z"})
    for one in (first, other, newer):
        save_certificate(tmp_path, one)
    assert read_certificates(tmp_path) == (other, newer)


def test_failures_are_no_successes(calls, threebus: Case, tmp_path: Path, monkeypatch) -> None:
    regime = max(threebus.regimes, key=threebus.omega_bound)
    plain = certificate.sample_instances

    def renamed(case, master, count, first, servable):
        for instance in plain(case, master, count, first, servable):
            name = {0: "raise", 1: "apart"}.get(first, "calm")
            yield instance.model_copy(update={"id": f"{name}-{first}"})

    monkeypatch.setattr(certificate, "sample_instances", renamed)
    result = run(threebus, tmp_path, regime, tolerance_hz=1.0)
    lost = [row.objective is None for row in rows_of(tmp_path, regime)]
    assert lost == [True, True, False, False]
    assert result.successes == result.meets_limits == result.near_reference == 2
