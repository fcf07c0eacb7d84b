"""A statistical certificate of a policy: how surely it meets every limit near the condensed optimum.

m fresh instances are drawn from seeds that nothing else uses. On each, the policy and a reference
method answer, both answers are re-simulated on the true system, and a *success* is a schedule that
meets every limit within the tolerances and costs at most `gap_percent` more than the reference's.
Successes are independent with one unknown probability, which is then, with confidence 1 - δ, at
least the lower bound of Clopper and Pearson, or the weaker one of Hoeffding that the paper's
reference for such guarantees uses. An instance on which either method fails is no success.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from pydantic import Field
from scipy.special import betaincinv
from tqdm import tqdm

from ded_bench.files.errors import InputError
from ded_bench.files.strict import Record, read_record, write_atomically, write_record
from ded_bench.methods.registry import get_method
from ded_bench.methods.solution import Settings, Solver
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import CERTIFICATE_SEED, sample_instances
from ded_bench.problem.schedule import Schedule
from ded_bench.run.environment import host, now, version
from ded_bench.run.pool import Workers
from ded_bench.truth.score import STRICT_HZ, STRICT_PU, Score, score
from ded_bench.truth.servable import servable
from ded_bench.truth.simulate import SimulationError

REFERENCE = "ded-ko-knots"
COUNT, DELTA, GAP_PERCENT = 10_000, 0.01, 1.0
FILE = "certificate.json"
#: Instances answered, re-simulated and saved together.
CHUNK = 50
COLUMNS = (
    "index",
    "objective",
    "reference",
    "freq_violation_hz",
    "ramp_violation",
    "bound_violation",
    "initial_violation",
    "fingerprint",
)


class Certificate(Record):
    """Lower confidence bounds on the probability of success, with all that they depend on."""

    case: str
    method: str
    reference: str
    regime: str
    settings: str
    seed: int  # master seed of the instances
    count: int
    successes: int
    meets_limits: int  # instances on which every limit is met, whatever the cost
    near_reference: int  # instances within the gap, whatever the limits
    tolerance_hz: float
    tolerance_pu: float
    gap_percent: float
    delta: float
    clopper_pearson: float
    hoeffding: float
    artifacts: str  # fingerprints of the case, the policy and the models
    version: str
    host: str
    date: str

    @property
    def key(self) -> tuple[str, str, str, str]:
        """What a results folder holds one certificate of."""
        return self.case, self.method, self.settings, self.regime

    @property
    def sentence(self) -> str:
        """The certificate in words."""
        return (
            f"With {1 - self.delta:.0%} confidence, at least {self.clopper_pearson:.2%} of "
            f"fresh {self.regime} instances meet every limit within "
            f"{self.tolerance_hz:g} Hz and {self.tolerance_pu:g} pu and cost at most {self.gap_percent:g} % "
            f"more than {self.reference} ({self.successes} of {self.count} did; "
            f"Hoeffding's bound: {self.hoeffding:.2%})."
        )


class Certificates(Record):
    """The certificates of a results folder."""

    schema_: Literal["ded-bench/certificates/1"] = Field(alias="schema", default="ded-bench/certificates/1")
    certificates: tuple[Certificate, ...] = ()


def read_certificates(folder: Path) -> tuple[Certificate, ...]:
    """Read the certificates of a results folder, none if it has none; InputError if the file is wrong."""
    path = folder / FILE
    return read_record(Certificates, path).certificates if path.is_file() else ()


def save_certificate(folder: Path, certificate: Certificate) -> None:
    """Add a certificate to a results folder; one for the same method, settings and regime is replaced."""
    kept = [c for c in read_certificates(folder) if c.key != certificate.key]
    write_record(Certificates(certificates=(*kept, certificate)), folder / FILE)


def rows_file(folder: Path, method: str, regime: str, settings: Settings) -> Path:
    """Where a results folder keeps the rows that a certificate counts."""
    return folder / "certificates" / f"{method}-{settings.slug}-{regime}.csv"


def clopper_pearson(successes: int, count: int, delta: float) -> float:
    """Largest p under which so many successes or more have a probability of at most δ.

    Clopper and Pearson 1934, one-sided: exact for independent trials.
    """
    _check_trials(successes, count, delta)
    return float(betaincinv(successes, count - successes + 1, delta)) if successes else 0.0


def hoeffding(successes: int, count: int, delta: float) -> float:
    """Hoeffding's lower bound (1963): successes / m - sqrt(ln(1 / δ) / 2m), at least zero."""
    _check_trials(successes, count, delta)
    return max(successes / count - math.sqrt(math.log(1.0 / delta) / (2.0 * count)), 0.0)


def certify(
    case: Case,
    method: str,
    regime: str,
    settings: Settings,
    rows_path: Path,
    *,
    count: int = COUNT,
    seed: int = 0,
    reference: str = REFERENCE,
    gap_percent: float = GAP_PERCENT,
    tolerance_hz: float = STRICT_HZ,
    tolerance_pu: float = STRICT_PU,
    delta: float = DELTA,
    workers: int = 1,
) -> Certificate:
    """Answer and re-simulate what `rows_path` lacks of the instances, and certify.

    Rows are saved chunk by chunk; those of another policy, model or case are made anew.

    Args:
        rows_path: CSV with one row per instance (COLUMNS).
        seed: the instances are those of master seed CERTIFICATE_SEED + seed.

    Raises:
        InputError: unknown method or regime, a missing policy or model, or a wrong file of rows.
    """
    case.check_regimes([regime])
    fingerprint = _fingerprint(case, method, reference, regime, settings, seed)
    rows = read_rows(rows_path)
    rows = rows[(rows["fingerprint"] == fingerprint) & (rows["index"] < count)]
    done = set(rows["index"])
    missing = [i for i in range(count) if i not in done]
    chunks = [missing[start : start + CHUNK] for start in range(0, len(missing), CHUNK)]
    calls = [(case, method, reference, regime, settings, seed, tuple(chunk)) for chunk in chunks]
    with tqdm(total=count, initial=len(done), unit="instance", disable=None, desc=f"certify {regime}") as bar:
        for made in _judged(calls, workers):
            rows = pd.concat([rows, made.assign(fingerprint=fingerprint)], ignore_index=True)
            rows = rows.sort_values("index", ignore_index=True)
            write_atomically(rows_path, rows.to_csv(index=False))
            bar.update(len(made))
    limits = meets_limits(rows, tolerance_hz, tolerance_pu)
    near = gaps(rows) <= gap_percent
    successes = int((limits & near).sum())
    return Certificate(
        case=case.id,
        method=method,
        reference=reference,
        regime=regime,
        settings=settings.slug,
        seed=CERTIFICATE_SEED + seed,
        count=count,
        successes=successes,
        meets_limits=int(limits.sum()),
        near_reference=int(near.sum()),
        tolerance_hz=tolerance_hz,
        tolerance_pu=tolerance_pu,
        gap_percent=gap_percent,
        delta=delta,
        clopper_pearson=clopper_pearson(successes, count, delta),
        hoeffding=hoeffding(successes, count, delta),
        artifacts=fingerprint,
        version=version(),
        host=host(),
        date=now(),
    )


def gaps(rows: pd.DataFrame) -> pd.Series[float]:
    """Increase of the cost over the reference, percent; missing where either failed."""
    return 100.0 * (rows["objective"] / rows["reference"] - 1.0)


def meets_limits(rows: pd.DataFrame, tolerance_hz: float, tolerance_pu: float) -> pd.Series[bool]:
    """Whether every limit is met within the tolerances; a failure meets none."""
    power = rows[["ramp_violation", "bound_violation", "initial_violation"]].max(axis=1, skipna=False)
    return (rows["freq_violation_hz"] <= tolerance_hz) & (power <= tolerance_pu)


def read_rows(path: Path) -> pd.DataFrame:
    """Read the rows of earlier runs; an empty table if there are none.

    Raises:
        InputError: the file is no table of rows.
    """
    if not path.is_file():
        return pd.DataFrame({name: pd.Series(dtype="float64") for name in COLUMNS})
    try:
        rows = pd.read_csv(path, dtype={"fingerprint": str, "index": int})
    except (ValueError, OSError) as error:
        raise InputError(path, "", f"is not a table of certificate rows ({str(error)[:80]})") from None
    if tuple(rows.columns) != COLUMNS:
        raise InputError(path, "", f"must have the columns {', '.join(COLUMNS)}")
    return rows


def judge(
    case: Case,
    method: str,
    reference: str,
    regime: str,
    settings: Settings,
    seed: int,
    indices: tuple[int, ...],
) -> pd.DataFrame:
    """Answer some instances with both methods and re-simulate; one row each, without fingerprint."""
    instances = [next(sample_instances(case, CERTIFICATE_SEED + seed, 1, i, servable)) for i in indices]
    plain = _plain(settings)
    schedules = [
        *_schedules(case, method, regime, settings, instances),
        *_schedules(case, reference, regime, plain, instances),
    ]
    scores = _scores(case, [*instances, *instances], schedules, regime)
    verdicts = scores[: len(instances)], scores[len(instances) :]
    rows = []
    for index, own, other in zip(indices, *verdicts, strict=True):
        row: dict[str, Any] = dict.fromkeys(COLUMNS[:-1], np.nan)
        row |= asdict(own) if own else {}
        rows.append(row | {"index": index, "reference": other.objective if other else np.nan})
    return pd.DataFrame(rows, columns=list(COLUMNS[:-1]))


def _judged(calls: list[tuple[Any, ...]], workers: int) -> Iterator[pd.DataFrame]:
    if workers == 1:
        yield from (judge(*call) for call in calls)
        return
    with Workers(workers) as pool:
        for _, answer in pool.imap([(judge, call) for call in calls], calls):
            if not isinstance(answer, pd.DataFrame):
                raise RuntimeError(f"a chunk of the certificate failed: {answer}")
            yield answer


def _schedules(
    case: Case, method: str, regime: str, settings: Settings, instances: list[Instance]
) -> list[Schedule | None]:
    solve = _prepared(case, method, regime, settings)
    return [_answer(solve, instance) for instance in instances]


def _answer(solve: Solver, instance: Instance) -> Schedule | None:
    try:
        return solve(instance).schedule
    except Exception:  # the boundary to the methods: an instance without an answer is no success
        return None


@functools.lru_cache(maxsize=4)
def _prepared(case: Case, method: str, regime: str, settings: Settings) -> Solver:
    return get_method(method).prepare(case, regime, settings)


def _scores(
    case: Case, instances: list[Instance], schedules: list[Schedule | None], regime: str
) -> list[Score | None]:
    """Scores; None where there is no schedule or the system loses synchronism."""
    result: list[Score | None] = []
    for instance, schedule in zip(instances, schedules, strict=True):
        try:
            result.append(None if schedule is None else score(case, instance, schedule, regime))
        except SimulationError:
            result.append(None)
    return result


def _fingerprint(case: Case, method: str, reference: str, regime: str, settings: Settings, seed: int) -> str:
    plain = _plain(settings)
    parts = [
        case.fingerprint,
        method,
        settings.slug,
        *(a.fingerprint for a in get_method(method).artifacts(case, regime, settings)),
        reference,
        *(a.fingerprint for a in get_method(reference).artifacts(case, regime, plain)),
        str(seed),
    ]
    return "-".join(part for part in parts if part)


def _plain(settings: Settings) -> Settings:
    """The reference method's settings: its own defaults, on the same Koopman model."""
    return Settings("default", settings.model, None, settings.time_limit_s, settings.search)


def _check_trials(successes: int, count: int, delta: float) -> None:
    if not (0 <= successes <= count and count > 0 and 0 < delta < 1):
        raise ValueError(f"{successes} successes of {count} with delta {delta}")
