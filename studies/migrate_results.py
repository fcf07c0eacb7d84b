"""Results of before there were options, moved to the names and files of now.

`python studies/migrate_results.py OLD OUT [--more CASE=FOLDER ...]` reads `OLD/<case>-reference`, writes
`OUT/results/<case>-reference`, and puts what models and settings that are gone have left into
`OUT/studies/tables`. It was run once, on 2026-11-25. Every number stays as it was; nothing is solved.
`ded_bench/results/legacy.py` says which name became which.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import gzip
import io
import json
import shutil
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ded_bench.analysis.certificate import ROWS as CERTIFICATE_ROWS
from ded_bench.analysis.certificate import Candidate, read_certificates, read_rows, save_certificate
from ded_bench.files.arrays import read_arrays, write_arrays
from ded_bench.files.errors import InputError
from ded_bench.methods.solution import Settings, model_artifact, named
from ded_bench.plants.plant import servable
from ded_bench.plants.score import score
from ded_bench.problem.benchmark import select_split
from ded_bench.problem.case import Case
from ded_bench.problem.instance import Instance
from ded_bench.problem.schedule import Schedule
from ded_bench.results.legacy import upgraded
from ded_bench.results.objectives import OBJECTIVES, objectives_file, objectives_of
from ded_bench.results.rows import ROWS, Results, Row
from ded_bench.results.timing import TIMING, model_name
from ded_bench.run.tasks import fingerprint_of

CASES = ("9bus", "two-area", "39bus", "68bus", "140bus")
#: The only grid whose own Koopman model stays: on the others a fit of the lines brought a few per cent.
WITH_KOOPMAN = "9bus"
GONE_MODELS = ("koopman-single", "koopman-ac", "swing-ac", "trajectory-ac")
GONE_SETTINGS = ("averaged", "unlearned", "ac", "swing-ac")
#: Columns that hashes of sources stood in.
DROPPED = ("code", "score_code", "online_code")
#: Tables of studies above this are compressed, bytes.
LARGE = 1_000_000
#: Schedules of more points than this, one at each step, are made lighter.
MANY_POINTS = 1000
#: A point of such a schedule this near to the line through its neighbours tells nothing, pu.
STRAIGHT = 1e-14
#: Its powers are kept in multiples of this, pu: what lies below is noise that does not compress.
ROUNDED = 2.0**-44

Cells = dict[str, str]


def main() -> None:
    """Move every grid's reference run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("old", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--more", nargs="*", default=[], metavar="CASE=FOLDER", help="rows without schedules")
    parser.add_argument("--case", nargs="*", default=CASES)
    a = parser.parse_args()
    more = dict(pair.split("=") for pair in a.more)
    for case in a.case:
        Move(case, a.old / f"{case}-reference", a.out, Path(more[case]) if case in more else None).all()


class Move:
    """One grid's reference run on its way."""

    def __init__(self, case: str, old: Path, out: Path, more: Path | None) -> None:
        self.case, self.old, self.more = Case.load(case), old, more
        self.new, self.tables = out / "results" / old.name, out / "studies" / "tables"
        self.instances = {
            instance.id: instance
            for split in ("all", "validation")
            for instance, _ in select_split(case, split, None, servable).instances
        }

    def all(self) -> None:
        """Move everything, models and policies first: they have a part in the names of rows."""
        shutil.rmtree(self.new, ignore_errors=True)
        self.models()
        self.policies()
        self.results()
        self.timing()
        self.online()
        self.certificates()

    def is_gone(self, cells: Cells) -> bool:
        """Whether a row of then is of a model or settings that are gone."""
        now, model = upgraded(dict(cells)), cells["model"].partition("@")[0]
        gone = model in GONE_MODELS or (model == "koopman" and self.case.id != WITH_KOOPMAN)
        return gone or now["settings"] in GONE_SETTINGS or now["settings"].startswith(("study", "start-"))

    def models(self) -> None:
        """The models that are kept."""
        for path in sorted((self.old / "koopman").iterdir()):
            name, kind = path.name.partition(".")[0], path.name.partition(".")[2]
            if name == "exchanged":
                self.study(path.read_text().splitlines(), "exchanged")
            elif kind == "safetensors" and (
                name == "koopman-paper" or (name == "koopman" and self.case.id == WITH_KOOPMAN)
            ):
                copy(path, self.new / "koopman" / f"{name}.{kind}")

    def policies(self) -> None:
        """Policies with the names of now; their weights stay."""
        for path in sorted((self.old / "policies").iterdir()):
            if "averaged" in path.name or path.suffix == ".pt":
                continue
            place = self.new / "policies" / path.name.replace("ded-dpc-shared", "ded-admm")
            if path.suffix == ".safetensors":
                arrays, header = read_arrays(path)
                header["method"] = header["method"].replace("ded-dpc-shared", "ded-admm")
                write_arrays(place, arrays, header)
            else:
                copy(path, place)

    def results(self) -> None:
        """Rows and schedules."""
        header, rows = read_cells(self.old / "results.csv")
        if self.more:
            rows += read_cells(self.more / "results.csv")[1]
        gone = [cells for cells in rows if self.is_gone(cells)]
        self.study(lines_of(header, gone), "retired")
        results, moved = Results(self.new), []
        for cells in rows:
            if not self.is_gone(cells):
                moved.append((cells, self.row(cells)))
        assert len({row.key for _, row in moved}) == len(moved)
        results.add(row for _, row in moved)
        kept = 0
        for cells, row in moved:
            place = Path(cells["method"], cells["settings"], cells["regime"], f"{cells['instance']}.csv.gz")
            path = self.old / "schedules" / place
            if path.is_file():
                instance = self.instances[row.instance]
                schedule = Schedule.read(path, self.case, instance.horizon_s)
                if len(schedule.t) > MANY_POINTS:
                    schedule = lighter(self.case, instance, schedule, row.regime)
                results.archive(row).write(row.member, schedule, self.case)
                kept += 1
        results.pack()
        OBJECTIVES.write(objectives_file(self.new), objectives_of(results.rows.values()))
        print(f"{self.case.id}: {len(moved)} rows, {kept} schedules, {len(gone)} rows to the studies")

    def row(self, cells: Cells) -> Row:
        """A row of now: with names, fingerprint, and the models that follow from the case, of today."""
        cells = {name: text for name, text in upgraded(cells).items() if name not in DROPPED}
        ((row, _),) = ROWS.rows([(0, list(cells.values()))], list(cells), self.old)
        model = model_name(row.model)
        if model:
            used = model_artifact(self.case, Settings(model=model, search=(self.new,)))
            if model.startswith("koopman") and named([used], "model") != row.model:
                raise InputError(self.old, str(row.key), f"is of another model than {used.path}")
            row = dataclasses.replace(row, model=named([used], "model"))
        fingerprint = fingerprint_of(self.case, self.instances[row.instance], row.key)
        return dataclasses.replace(row, fingerprint=fingerprint)

    def timing(self) -> None:
        """Times of what is still there."""
        header, rows = read_cells(self.old / "timing.csv")
        self.study(lines_of(header, [cells for cells in rows if self.is_gone(cells)]), "retired-timing")
        kept = [cells for cells in rows if not self.is_gone(cells)]
        found = [(i, list(cells.values())) for i, cells in enumerate(kept)]
        TIMING.write(self.new / "timing.csv", [row for row, _ in TIMING.rows(found, header, self.old)])

    def online(self) -> None:
        """Rows of the closed loop: the methods' own latencies stay, sweeps go to the studies."""
        if not (self.old / "online.csv").is_file():
            return
        header, rows = read_cells(self.old / "online.csv")
        usual = {"latency_source": "timing", "forecast": "announced", "predicted": "True", "truth": "paper"}

        def stays(cells: Cells) -> bool:
            return not self.is_gone(cells) and all(cells[name] == text for name, text in usual.items())

        self.study(lines_of(header, [cells for cells in rows if not stays(cells)]), "online")
        write_upgraded(self.new / "online.csv", header, filter(stays, rows))
        header, rows = read_cells(self.old / "hindsight.csv")
        write_upgraded(self.new / "hindsight.csv", header, [c for c in rows if c["truth"] == "paper"])

    def certificates(self) -> None:
        """Certificates, and the rows that they count."""
        if not (self.old / "certificate.json").is_file():
            return
        then = json.loads((self.old / "certificate.json").read_text())["certificates"]
        for old, certificate in zip(then, read_certificates(self.old), strict=True):
            model = model_name(certificate.model)
            policy = self.new / "policies" / f"{certificate.method}-{certificate.regime}.safetensors"
            settings = Settings(certificate.settings, model, policy, search=(self.new,))
            candidate = Candidate(certificate.method, certificate.regime, settings)
            seed = certificate.seed % 1_000_000
            fingerprint = candidate.fingerprint(self.case, seed)
            facts = candidate.facts(self.case) | {"artifacts": fingerprint}
            save_certificate(self.new, certificate.model_copy(update=facts))
            name = f"{old['method']}-{old['settings']}-{old['regime']}.csv"
            rows = read_rows(self.old / "certificates" / name)
            rows = [dataclasses.replace(row, fingerprint=fingerprint) for row in rows]
            CERTIFICATE_ROWS.write(candidate.rows_file(self.case, self.new), rows)

    def study(self, lines: list[str], name: str) -> None:
        """Keep rows as they were, in a table of the studies."""
        if len(lines) < 2:
            return
        text = ("\n".join(lines) + "\n").encode()
        place = self.tables / f"{self.case.id}-{name}.csv"
        place.parent.mkdir(parents=True, exist_ok=True)
        if len(text) > LARGE:
            place.with_suffix(".csv.gz").write_bytes(gzip.compress(text, 9, mtime=0))
        else:
            place.write_bytes(text)


def lighter(case: Case, instance: Instance, schedule: Schedule, regime: str) -> Schedule:
    """A schedule with rounded powers and without straight points, if its score stays equal to 1e-12."""
    t, p, kept = schedule.t, schedule.p, [0]
    while kept[-1] < len(t) - 1:
        last = kept[-1] + 1
        while last + 1 < len(t) and is_straight(t, p, kept[-1], last + 1):
            last += 1
        kept.append(last)
    made = Schedule(t[kept], np.round(p[kept] / ROUNDED) * ROUNDED)
    before, after = (dataclasses.asdict(score(case, instance, s, regime)) for s in (schedule, made))
    same = np.isclose(before.pop("objective"), after.pop("objective"), rtol=1e-12, atol=0)
    same &= np.allclose(list(before.values()), list(after.values()), rtol=0, atol=1e-12)
    if not same:
        print(f"{instance.id} {regime}: kept whole", before, after)
    return made if same else schedule


def is_straight(t: np.ndarray, p: np.ndarray, first: int, last: int) -> bool:
    """Whether all points between two lie on the line through them."""
    weight = ((t[first + 1 : last] - t[first]) / (t[last] - t[first]))[:, None]
    line = p[first] + weight * (p[last] - p[first])
    return bool(np.abs(line - p[first + 1 : last]).max() <= STRAIGHT)


def read_cells(path: Path) -> tuple[list[str], list[Cells]]:
    """Header and rows of a table, as texts."""
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        rows = list(reader)
        return list(reader.fieldnames or ()), rows


def lines_of(header: Iterable[str], rows: Iterable[Cells]) -> list[str]:
    """A table as lines of CSV."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(header), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().splitlines()


def write_cells(path: Path, header: Iterable[str], rows: Iterable[Cells]) -> None:
    """Write a table of texts."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines_of(header, rows)) + "\n")


def write_upgraded(path: Path, header: list[str], rows: Iterable[Cells]) -> None:
    """Write rows with the names of now, under a header of now."""
    found = [upgraded(dict(cells)) for cells in rows]
    names = [{"truth": "plant"}.get(name, name) for name in header if name not in DROPPED]
    names += [*(["method_version"] if "method" in header else []), "commit"]
    write_cells(path, names, [{name: cells.get(name, "") for name in names} for cells in found])


def copy(path: Path, place: Path) -> None:
    """Copy a file."""
    place.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, place)


if __name__ == "__main__":
    main()
