"""A statistical certificate of a policy: how surely it meets every limit near a linear program's optimum.

m fresh instances are drawn from seeds that nothing else uses. On each, the policy and a reference
method answer, both answers are re-simulated on the plant, and a *success* is a schedule that meets
every limit within the tolerances and costs at most `gap_percent` more than the reference's.
Successes are independent with one unknown probability, which is then, with confidence 1 - δ, at
least the lower bound of Clopper and Pearson, or the weaker one of Hoeffding that the paper's
reference for such guarantees uses. An instance on which either method fails is no success.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pandas as pd
from pydantic import Field
from tqdm import tqdm

from ded_bench.files.strict import Record, read_record, write_record
from ded_bench.files.table import NotNegative, Table
from ded_bench.methods.options import DEFAULT
from ded_bench.methods.registry import get_method
from ded_bench.methods.solution import Settings, named
from ded_bench.plants.plant import plant_of, servable
from ded_bench.plants.score import STRICT_HZ, STRICT_PU, Score
from ded_bench.problem.case import Case
from ded_bench.problem.sampling import CERTIFICATE_SEED, sample_instances
from ded_bench.results.folder import ResultsFolder
from ded_bench.results.timing import model_name
from ded_bench.run.environment import commit, host, now, version
from ded_bench.run.pool import Workers, WorkersLostError
from ded_bench.run.tasks import Task, solve_and_score

#: Instances answered, re-simulated and saved together.
CHUNK = 50


class Criteria(Record):
    """What counts as a success, and how sure a bound is: its confidence is 1 - delta."""

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
    freq_violation_hz: NotNegative | None = None
    ramp_violation: NotNegative | None = None
    bound_violation: NotNegative | None = None
    initial_violation: NotNegative | None = None


ROWS: Table[CertificateRow] = Table(CertificateRow)
#: Columns that are numbers of a policy's score.
SCORES = [name for name in ROWS.names if name in Score.__dataclass_fields__]


class Certificate(Criteria):
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
    clopper_pearson: float
    hoeffding: float
    artifacts: str  # changes with the case, the methods, the policy and the models
    policy: str = ""  # `name@fingerprint` of what shaped the answers
    model: str = ""
    commit: str = ""
    version: str
    host: str
    date: str

    @property
    def key(self) -> tuple[str, str, str, str, str]:
        """What a results folder holds one certificate of."""
        return self.case, self.method, self.settings, self.regime, model_name(self.model)

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


@dataclass(frozen=True)
class Candidate:
    """What is certified: a policy in one regime, beside a reference on the same surrogate."""

    method: str
    regime: str
    settings: Settings
    reference: str = "ded-ko-knots"

    @property
    def pair(self) -> tuple[tuple[str, Settings], tuple[str, Settings]]:
        """The policy and the reference, each with its settings: the reference has its own defaults."""
        own = self.settings
        return (self.method, own), (self.reference, dataclasses.replace(own, options=DEFAULT, policy=None))

    def facts(self, case: Case) -> dict[str, str]:
        """What a certificate says of it: names, models and policies; InputError if one is missing."""
        used = [a for method, own in self.pair for a in get_method(method).artifacts(case, self.regime, own)]
        made_with = {kind: named(dict.fromkeys(used), kind) for kind in ("model", "policy")}
        settings = get_method(self.method).canonical(self.settings).options
        name = {"method": self.method, "settings": settings, "regime": self.regime}
        return name | {"reference": self.reference} | made_with


def read_certificates(folder: Path) -> tuple[Certificate, ...]:
    """Read the certificates of a results folder, none if it has none; InputError if the file is wrong."""
    path = ResultsFolder(folder).certificates
    return read_record(Certificates, path).certificates if path.is_file() else ()


def save_certificate(folder: Path, certificate: Certificate) -> None:
    """Add a certificate to a results folder; one of the same key is replaced."""
    kept = [c for c in read_certificates(folder) if c.key != certificate.key]
    write_record(Certificates(certificates=(*kept, certificate)), ResultsFolder(folder).certificates)


def clopper_pearson(successes: int, count: int, delta: float) -> float:
    """Largest p under which so many successes or more have a probability of at most δ.

    Clopper and Pearson 1934, one-sided: exact for independent trials.
    """
    from scipy.stats import binomtest  # a second to import, and all commands know certificates

    test = binomtest(successes, count, alternative="greater")
    return float(test.proportion_ci(confidence_level=1.0 - delta, method="exact").low)


def hoeffding(successes: int, count: int, delta: float) -> float:
    """Hoeffding's lower bound (1963): successes / m - sqrt(ln(1 / δ) / 2m), at least zero."""
    return max(successes / count - math.sqrt(math.log(1.0 / delta) / (2.0 * count)), 0.0)


def certify(
    case: Case,
    candidate: Candidate,
    folder: Path,
    criteria: Criteria,
    *,
    count: int = 10_000,
    seed: int = 0,
    workers: int = 1,
) -> Certificate:
    """Answer and re-simulate what a results folder lacks of the instances, and certify.

    Rows are saved chunk by chunk; those of another policy, model, version or case are made anew.

    Args:
        case: the grid.
        candidate: what is certified.
        folder: where rows are kept, one for each instance (see CertificateRow).
        criteria: what counts as a success, and how sure the bound is.
        count: how many instances.
        seed: the instances are those of master seed CERTIFICATE_SEED + seed.
        workers: processes.

    Raises:
        InputError: unknown method or regime, a missing policy or model, or a wrong file of rows.
    """
    case.check_regimes([candidate.regime])
    facts = candidate.facts(case)
    names = facts["method"], facts["settings"], model_name(facts["model"]), facts["regime"]
    path = ResultsFolder(folder).certificate_rows(*names)
    versions = [str(get_method(method).version) for method, _ in candidate.pair]
    decisive = "|".join([case.fingerprint, str(seed), *versions, *facts.values()])
    fingerprint = hashlib.sha256(decisive.encode()).hexdigest()[:12]
    done = {r.index: r for r in ROWS.existing(path) if r.fingerprint == fingerprint}
    missing = [i for i in range(count) if i not in done]
    chunks = [tuple(missing[start : start + CHUNK]) for start in range(0, len(missing), CHUNK)]
    calls = [(judge, (case, candidate, seed, chunk)) for chunk in chunks]
    bar = tqdm(total=count, initial=count - len(missing), unit="instance", disable=None, desc="certify")
    with bar, Workers(workers) as pool:
        for _, made in pool.imap(calls, chunks):
            if not isinstance(made, list):
                raise WorkersLostError(f"a chunk of the certificate failed: {made}")
            done |= {row.index: dataclasses.replace(row, fingerprint=fingerprint) for row in made}
            ROWS.write(path, [done[index] for index in sorted(done)])
            bar.update(len(made))
    rows = ROWS.frame(done[index] for index in range(count))
    limits = meets_limits(rows, criteria.tolerance_hz, criteria.tolerance_pu)
    near = 100.0 * (rows["objective"] / rows["reference"] - 1.0) <= criteria.gap_percent
    successes = int((limits & near).sum())
    known: dict[str, Any] = criteria.model_dump() | facts
    return Certificate(
        case=case.id,
        seed=CERTIFICATE_SEED + seed,
        count=count,
        successes=successes,
        meets_limits=int(limits.sum()),
        near_reference=int(near.sum()),
        clopper_pearson=clopper_pearson(successes, count, criteria.delta),
        hoeffding=hoeffding(successes, count, criteria.delta),
        artifacts=fingerprint,
        commit=commit(),
        version=version(),
        host=host(),
        date=now(),
        **known,
    )


def meets_limits(rows: pd.DataFrame, tolerance_hz: float, tolerance_pu: float) -> pd.Series[bool]:
    """Whether every limit is met within the tolerances; a failure meets none."""
    power = rows[["ramp_violation", "bound_violation", "initial_violation"]].max(axis=1, skipna=False)
    return (rows["freq_violation_hz"] <= tolerance_hz) & (power <= tolerance_pu)


def judge(case: Case, candidate: Candidate, seed: int, indices: Sequence[int]) -> list[CertificateRow]:
    """Answer some instances with both methods and re-simulate; one row each, without fingerprint."""
    rows = []
    for index in indices:
        instance = next(sample_instances(case, CERTIFICATE_SEED + seed, 1, index, servable))
        tasks = [Task(instance, "", candidate.regime, *one) for one in candidate.pair]
        verdicts = [solve_and_score(case, task, plant_of(case).name).verdict for task in tasks]
        # None where there is no schedule, or its plant cannot follow it.
        own, other = (verdict if isinstance(verdict, Score) else None for verdict in verdicts)
        cells = {name: getattr(own, name) for name in SCORES} if own else {}
        rows.append(CertificateRow(index, "", reference=other.objective if other else None, **cells))
    return rows
