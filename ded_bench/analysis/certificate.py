"""A statistical certificate of a policy: how surely it meets every limit near the condensed optimum.

m fresh instances are drawn from seeds that nothing else uses. On each, the policy and a reference
method answer, both answers are re-simulated on the true system, and a *success* is a schedule that
meets every limit within the tolerances and costs at most `gap_percent` more than the reference's.
Successes are independent with one unknown probability, which is then, with confidence 1 - δ, at
least the lower bound of Clopper and Pearson, or the weaker one of Hoeffding that the paper's
reference for such guarantees uses. An instance on which either method fails is no success.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import pandas as pd
from pydantic import Field
from scipy.stats import binomtest
from tqdm import tqdm

from ded_bench.files.strict import Record, read_record, write_record
from ded_bench.files.table import Table, cell
from ded_bench.methods.artifact import Artifact
from ded_bench.methods.registry import get_method
from ded_bench.methods.solution import Settings, Solver
from ded_bench.plants import score as scorer
from ded_bench.plants.plant import servable
from ded_bench.plants.score import STRICT_HZ, STRICT_PU, Score, score
from ded_bench.plants.plant import SimulationError
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.sampling import CERTIFICATE_SEED, sample_instances
from ded_bench.problem.schedule import Schedule
from ded_bench.run.code import code_of, code_of_method, named
from ded_bench.run.environment import host, now, version
from ded_bench.run.pool import Workers

FILE = "certificate.json"
#: Instances answered, re-simulated and saved together.
CHUNK = 50


@dataclass(frozen=True)
class Criteria:
    """What counts as a success, and how sure a bound is: its confidence is 1 - delta."""

    reference: str = "ded-ko-knots"
    gap_percent: float = 1.0
    tolerance_hz: float = STRICT_HZ
    tolerance_pu: float = STRICT_PU
    delta: float = 0.01


@dataclass(frozen=True)
class CertificateRow:
    """One fresh instance: both costs, and the policy's violations; empty where there is no schedule."""

    index: int  # of the master seed
    fingerprint: str
    objective: float | None = None
    reference: float | None = None  # objective of the reference
    freq_violation_hz: float | None = cell(default=None, lowest=0)
    ramp_violation: float | None = cell(default=None, lowest=0)
    bound_violation: float | None = cell(default=None, lowest=0)
    initial_violation: float | None = cell(default=None, lowest=0)


ROWS: Table[CertificateRow] = Table(CertificateRow)


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
    artifacts: str  # changes with the case, the policy, the models and the code
    policy: str = ""  # `name@fingerprint` of what shaped the policy's answers
    model: str = ""
    code: str = ""  # of the policy, of the reference, and of the scorer
    reference_code: str = ""
    score_code: str = ""
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
    test = binomtest(successes, count, alternative="greater")
    return float(test.proportion_ci(confidence_level=1.0 - delta, method="exact").low)


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
    criteria: Criteria,
    *,
    count: int = 10_000,
    seed: int = 0,
    workers: int = 1,
) -> Certificate:
    """Answer and re-simulate what `rows_path` lacks of the instances, and certify.

    Rows are saved chunk by chunk; those of another policy, model or case are made anew.

    Args:
        rows_path: CSV with one row per instance (see CertificateRow).
        criteria: what counts as a success, against which method, and how sure the bound is.
        count: how many instances.
        seed: the instances are those of master seed CERTIFICATE_SEED + seed.

    Raises:
        InputError: unknown method or regime, a missing policy or model, or a wrong file of rows.
    """
    case.check_regimes([regime])
    reference = criteria.reference
    made_by = _made_by(case, method, reference, regime, settings)
    fingerprint = _fingerprint(case, method, reference, settings, seed, made_by)
    done = {r.index: r for r in read_rows(rows_path) if r.fingerprint == fingerprint and r.index < count}
    missing = [i for i in range(count) if i not in done]
    chunks = [missing[start : start + CHUNK] for start in range(0, len(missing), CHUNK)]
    calls = [(case, method, reference, regime, settings, seed, tuple(chunk)) for chunk in chunks]
    with tqdm(total=count, initial=len(done), unit="instance", disable=None, desc=f"certify {regime}") as bar:
        for made in _judged(calls, workers):
            done |= {row.index: dataclasses.replace(row, fingerprint=fingerprint) for row in made}
            ROWS.write(rows_path, [done[index] for index in sorted(done)])
            bar.update(len(made))
    rows = ROWS.frame(done.values())
    limits = meets_limits(rows, criteria.tolerance_hz, criteria.tolerance_pu)
    near = gaps(rows) <= criteria.gap_percent
    successes = int((limits & near).sum())
    promise: dict[str, Any] = asdict(criteria) | made_by
    return Certificate(
        case=case.id,
        method=method,
        regime=regime,
        settings=settings.slug,
        seed=CERTIFICATE_SEED + seed,
        count=count,
        successes=successes,
        meets_limits=int(limits.sum()),
        near_reference=int(near.sum()),
        clopper_pearson=clopper_pearson(successes, count, criteria.delta),
        hoeffding=hoeffding(successes, count, criteria.delta),
        artifacts=fingerprint,
        version=version(),
        host=host(),
        date=now(),
        **promise,
    )


def gaps(rows: pd.DataFrame) -> pd.Series[float]:
    """Increase of the cost over the reference, percent; missing where either failed."""
    return 100.0 * (rows["objective"] / rows["reference"] - 1.0)


def meets_limits(rows: pd.DataFrame, tolerance_hz: float, tolerance_pu: float) -> pd.Series[bool]:
    """Whether every limit is met within the tolerances; a failure meets none."""
    power = rows[["ramp_violation", "bound_violation", "initial_violation"]].max(axis=1, skipna=False)
    return (rows["freq_violation_hz"] <= tolerance_hz) & (power <= tolerance_pu)


def read_rows(path: Path) -> list[CertificateRow]:
    """Read the rows of earlier runs, none if there is no such file; InputError if it is wrong."""
    return ROWS.read(path) if path.is_file() else []


def judge(
    case: Case,
    method: str,
    reference: str,
    regime: str,
    settings: Settings,
    seed: int,
    indices: tuple[int, ...],
) -> list[CertificateRow]:
    """Answer some instances with both methods and re-simulate; one row each, without fingerprint."""
    instances = [next(sample_instances(case, CERTIFICATE_SEED + seed, 1, i, servable)) for i in indices]
    plain = _plain(settings)
    schedules = [
        *_schedules(case, method, regime, settings, instances),
        *_schedules(case, reference, regime, plain, instances),
    ]
    scores = _scores(case, [*instances, *instances], schedules, regime)
    verdicts = scores[: len(instances)], scores[len(instances) :]
    return [
        CertificateRow(index, "", reference=other.objective if other else None, **asdict(own) if own else {})
        for index, own, other in zip(indices, *verdicts, strict=True)
    ]


def _judged(calls: list[tuple[Any, ...]], workers: int) -> Iterator[list[CertificateRow]]:
    if workers == 1:
        yield from (judge(*call) for call in calls)
        return
    with Workers(workers) as pool:
        for _, answer in pool.imap([(judge, call) for call in calls], calls):
            if not isinstance(answer, list):
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


def _made_by(case: Case, method: str, reference: str, regime: str, settings: Settings) -> dict[str, str]:
    """What the answers and their scores depend on, as fields of a certificate."""
    found = {}
    used: list[Artifact] = []
    for name, field, own in ((method, "code", settings), (reference, "reference_code", _plain(settings))):
        answering = get_method(name)
        artifacts = answering.artifacts(case, regime, own)
        found[field] = code_of_method(answering, own.name, artifacts)
        used += [artifact for artifact in artifacts if artifact not in used]
    for kind in ("model", "policy"):
        found[kind] = named(used, kind)
    return found | {"score_code": code_of(scorer.__name__)}


def _fingerprint(
    case: Case, method: str, reference: str, settings: Settings, seed: int, made_by: dict[str, str]
) -> str:
    parts = [
        case.fingerprint,
        method,
        reference,
        settings.slug,
        str(seed),
        *map(str, sorted(made_by.items())),
    ]
    return hashlib.sha256("|".join(parts).encode()).hexdigest()[:12]


def _plain(settings: Settings) -> Settings:
    """The reference method's settings: its own defaults, on the same Koopman model."""
    return Settings("default", settings.model, None, settings.time_limit_s, settings.search)


def _check_trials(successes: int, count: int, delta: float) -> None:
    if not (0 <= successes <= count and count > 0 and 0 < delta < 1):
        raise ValueError(f"{successes} successes of {count} with delta {delta}")
