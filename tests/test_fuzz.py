"""Damaged files: a reader takes a file or refuses it in one line that names it, and nothing else happens.

Every kind of file that a user may hand over is damaged some hundred times, always in the same ways,
and given to the command line. Allowed ends are exit code 0, 1 (the simulation says why) and 2 (one line
with the file's name, and the field's where a field was damaged).
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import gzip
import io
import pickle
import random
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ded_bench.analysis.summary import named, summary
from ded_bench.cli import commands
from ded_bench.files.errors import InputError
from ded_bench.files.strict import write_record
from ded_bench.plants import score as scorer
from ded_bench.problem.benchmark import Manifest, Split
from ded_bench.problem.case import Case
from ded_bench.problem.schedule import Schedule
from ded_bench.results.archive import Archive
from ded_bench.results.rows import ROWS, Row
from ded_bench.results.timing import TIMING, TimingRow
from ded_bench.run import runner
from ded_bench.run.scoring import scored_row
from ded_bench.surrogates.linear import linear_model
from tests.analysis.test_summary import with_gaps
from tests.damage import Mutant, Payload, damaged_arrays, damaged_bytes, damaged_json, damaged_table
from tests.methods.policies import HORIZON, random_policy

#: Every kind of file: where it lies, and how many damaged ones are tried.
FILES = {
    "instance": ("instance.json", 150),
    "case": ("case.json", 120),
    "schedule": ("schedule.csv", 90),
    "compressed schedule": ("schedule.csv.gz", 90),
    "split": ("split.json", 60),
    "manifest": ("MANIFEST.json", 60),
    "results": ("results.csv", 60),
    "model": ("model.safetensors", 70),
    "ded-dpc-paper": ("ded-dpc-paper.safetensors", 70),
    "ded-dpc": ("ded-dpc.safetensors", 70),
    "ded-admm": ("ded-admm.safetensors", 70),
}
POLICIES = ("ded-dpc-paper", "ded-dpc", "ded-admm")
#: Longer valid instances are read, but not simulated.
FEW_STEPS = 20
PARSER = functools.cache(commands.parser)  # making one takes longer than most of these commands
#: What a command says that it is about to do, before it finds what is wrong.
ANNOUNCED = re.compile(r"^ded-bench: \d+ trainings? of .*\n", re.MULTILINE)

Damaged = Sequence[Callable[[random.Random], Mutant]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, threebus: Case, quiet_instance: Any) -> Path:
    """A benchmark with one instance of five steps, a schedule, a results folder, models and policies."""
    folder = tmp_path_factory.mktemp("fuzz") / "threebus"
    case, instance = threebus, quiet_instance(threebus, horizon_s=0.05, seed=[2022, 7])
    write_record(case, folder / "case.json")
    write_record(instance, folder / "instances" / f"{instance.id}.json")
    own = quiet_instance(threebus, id="mine", horizon_s=0.05, seed=[2022, 7])  # no copy of another one
    write_record(own, folder / "instance.json")
    split = {"seed": 1, "train": (instance.id,), "test": (instance.id,)}
    write_record(Split(schema_="ded-bench/split/1", **split), folder / "split.json")
    manifest = Manifest(schema_="ded-bench/manifest/1", version="1-abc", files={"case.json": "00"})
    write_record(manifest, folder / "MANIFEST.json")
    t = np.linspace(0.0, 0.05, 6)
    schedule = Schedule(t, 0.6 + 0.001 * t[:, None])
    schedule.write(folder / "schedule.csv", case.generators)
    schedule.write(folder / "schedule.csv.gz", case.generators)
    archive = Archive(folder / "schedules.npz")
    archive.write("one", schedule, case)
    archive.pack(["one"])
    claimed = {("NO", "ded"): "Optimal", ("TO", "ded"): "Optimal", ("TO", "ded-dpc"): "Policy"}
    rows = [scored(Row(instance.id, "test", *key, "default", status)) for key, status in claimed.items()]
    ROWS.write(folder / "results.csv", rows)
    timed = ("ded", "default", instance.id, "Optimal")
    TIMING.write(folder / "timing.csv", [TimingRow("x", 1, r, *timed, solve_s=0.1) for r in case.regimes])
    rng = np.random.default_rng(0)
    mlp = tuple((0.1 * rng.normal(size=(n, m)), rng.normal(size=n)) for n, m in ((4, 3), (3, 4)))
    wide = dict(k=0.9 * np.eye(5), b=np.zeros((5, 2)), g=np.zeros((5, 2)), lift=rng.normal(size=(5, 9)))
    dataclasses.replace(linear_model(case), mlp=mlp, **wide).save(folder / "model.safetensors")
    with torch.random.fork_rng():
        for method in POLICIES:
            random_policy(method, case, horizon=HORIZON).save(folder / f"{method}.safetensors")
    return folder


def scored(row: Row) -> Row:
    """A row with times and a verdict."""
    verdict = scorer.Score(2.0, 0.0, 1e-9, 0.0, 0.0)
    facts = {"solve_s": 0.1, "iterations": 3, "fingerprint": "00", "case": "threebus"}
    return scored_row(dataclasses.replace(row, **facts), verdict)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reading is real; solving is left out, and so is the simulation of anything long."""
    real = scorer.score
    nothing = scorer.Score(1.0, 0.0, 0.0, 0.0, 0.0)

    def short(case: Case, instance: Any, *others: Any) -> scorer.Score:
        return real(case, instance, *others) if instance.steps <= FEW_STEPS else nothing

    monkeypatch.setattr(commands, "parser", PARSER)
    monkeypatch.setattr(scorer, "score", short)
    monkeypatch.setattr(runner, "run", lambda *_: [])


def end_of(arguments: Sequence[object]) -> tuple[int, str]:
    """Exit code and standard error of a command."""
    errors = io.StringIO()
    with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
        code = commands.main([str(argument) for argument in arguments])
    return code, ANNOUNCED.sub("", errors.getvalue())


def ending(arguments: Sequence[object], path: Path, mutant: Mutant) -> tuple[int | None, str]:
    """Give a command a damaged file at `path`: its exit code, and what is wrong with how it ended."""
    path.write_bytes(mutant.data)
    try:
        code, errors = end_of(arguments)
    except BaseException as error:
        return None, f"{type(error).__name__}: {error}"
    if code == 0:
        return code, ""
    ours = str(path) in errors
    given = any(str(a) in errors for a in (*arguments, "case threebus: regime"))
    rules = {
        "exit code": code in (1, 2),
        "one line": errors.count("\n") == 1 and errors[:-1].isprintable() and len(errors) < 600,
        "a file": ours or given,  # right by itself, it may no longer fit another file, which is named then
        "the field": code == 1
        or not ours
        or not mutant.names
        or any(name in errors for name in mutant.names),
    }
    broken = [rule for rule, kept in rules.items() if not kept]
    return code, f"{broken} {mutant.names}: {errors}" if broken else ""


def mutants(kind: str, count: int, make: Damaged) -> Iterator[Mutant]:
    """So many, the same every time, from several ways of damaging in turn."""
    rng = random.Random(f"ded-bench {kind}")
    for i in range(count):
        yield make[i % len(make)](rng)


def command(folder: Path, kind: str) -> list[object]:
    """A command that reads the file of a kind."""
    path = folder / FILES[kind][0]
    if kind in ("instance", "case", "schedule", "compressed schedule"):
        schedule = path if "schedule" in kind else folder / "schedule.csv"
        given = ["--instance", folder / "instance.json", "--case", folder / "case.json"]
        return ["score", *given, "--schedule", schedule, "--regime", "TO", "--json"]
    method = kind if kind in POLICIES else "ded-ko-knots" if kind == "model" else "ded"
    option = ["--policy", path] if kind in POLICIES else ["--model", path] if kind == "model" else []
    return ["solve", "--method", method, "--regime", "TO", "--case", folder, "--out", folder, *option]


def damage_to(path: Path) -> Damaged:
    """Ways to damage a file, by what is in it."""
    whole = path.read_bytes()
    if path.suffix == ".safetensors":
        return [*[lambda r: damaged_arrays(whole, r)] * 3, lambda r: damaged_bytes(whole, r)]
    if path.suffix == ".json":
        return [*[lambda r: damaged_json(whole.decode(), r)] * 3, lambda r: damaged_bytes(whole, r)]
    if path.suffix == ".csv":
        return [lambda r: damaged_table(whole.decode(), r), lambda r: damaged_bytes(whole, r)]
    if path.suffix == ".npz":
        return [lambda r: damaged_bytes(whole, r)]
    text = gzip.decompress(whole)
    return [
        lambda r: damaged_bytes(whole, r),
        lambda r: Mutant(gzip.compress(damaged_table(text.decode(), r).data, mtime=0)),
        lambda r: Mutant(gzip.compress(damaged_bytes(text, r).data, mtime=0)),
    ]


@pytest.mark.parametrize("kind", FILES)
def test_commands_survive(folder: Path, kind: str) -> None:
    """Most damaged files are refused, some are as right as before; no row of the results changes."""
    (name, count), arguments = FILES[kind], command(folder, kind)
    path = folder / name
    whole, before = path.read_bytes(), (folder / "results.csv").read_bytes()
    codes, problems = [], []
    for mutant in mutants(kind, count, damage_to(path)):
        code, problem = ending(arguments, path, mutant)
        codes.append(code)
        problems += [f"{problem[:600]} <- {mutant.data[:1500]!r}"] if problem else []
    path.write_bytes(whole)
    assert not problems, "\n".join(problems[:20])
    assert end_of(arguments)[0] == 0  # what was damaged was right
    assert 0.3 * len(codes) < codes.count(2) < len(codes) == count, codes.count(2)
    assert (folder / "results.csv").read_bytes() == before


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("timing.csv", lambda path, _: TIMING.existing(path)),
        ("schedules.npz", lambda path, case: Archive(path).read("one", case, 0.05)),
    ],
)
def test_readers_survive(folder: Path, threebus: Case, name: str, read: Callable[..., object]) -> None:
    """Those whose commands have longer work to do."""
    path, refused = folder / name, []
    whole = path.read_bytes()
    for mutant in mutants(name, 150, damage_to(path)):
        path.write_bytes(mutant.data)
        try:
            read(path, threebus)
        except InputError as error:
            refused.append((error, mutant))
    path.write_bytes(whole)
    assert 0.3 * 150 < len(refused) < 150
    for error, mutant in refused:
        assert error.source.startswith(str(path))
        assert str(error).isprintable()
        assert not mutant.names or any(name in str(error) for name in mutant.names)


def test_summaries_survive_what_results_may_hold(folder: Path) -> None:
    """Numbers that nobody would expect are still numbers: the table is made, without a warning."""
    whole = (folder / "results.csv").read_text()
    path, made = folder / "odd.csv", 0
    for mutant in mutants("results", 80, [lambda r: damaged_table(whole, r)]):
        path.write_bytes(mutant.data)
        with contextlib.suppress(InputError):
            rows = {row.key: row for row in ROWS.read(path)}
            frame = with_gaps(named(ROWS.frame(rows.values())))
            summary(frame)
            made += 1
    assert made > 10


@pytest.mark.parametrize("kind", [kind for kind in FILES if kind != "manifest"])
def test_pickles_are_not_opened(folder: Path, tmp_path: Path, kind: str) -> None:
    """What would run code if it were unpickled, however it is packed, is only a damaged file."""
    path, trace, zipped = folder / FILES[kind][0], tmp_path / "trace", io.BytesIO()
    torch.save(Payload(trace), zipped)
    plain = pickle.dumps(Payload(trace))
    whole = path.read_bytes()
    for data in (plain, zipped.getvalue(), gzip.compress(plain)):
        assert ending(command(folder, kind), path, Mutant(data)) == (2, "")
    path.write_bytes(whole)
    assert not trace.exists()
    pickle.loads(plain)
    assert trace.exists()  # it would have


def test_a_checkpoint_is_not_unpickled_either(folder: Path, tmp_path: Path) -> None:
    """Resuming from a file that is no checkpoint of this training is refused; nothing runs."""
    out, trace = tmp_path / "p.safetensors", tmp_path / "trace"
    path = out.with_suffix(".checkpoint")
    options = "--method ded-dpc-paper --regime TO --model linear --resume --epochs 1 --limit 1"
    arguments = ["train-dpc", *options.split(), "--case", folder, "--out", out]
    torch.save(Payload(trace), path)
    for data in (path.read_bytes(), b"", b"text", pickle.dumps(Payload(trace))):
        assert ending(arguments, path, Mutant(data)) == (2, "")
    assert not trace.exists()
    assert not out.exists()
