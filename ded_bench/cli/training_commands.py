"""Commands that train Koopman models and policies."""

from __future__ import annotations

import argparse
import contextlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ded_bench.cli.arguments import (
    MODEL_HELP,
    command,
    counted,
    declare,
    names,
    positive,
    positive_number,
    say,
)
from ded_bench.files.errors import InputError
from ded_bench.files.strict import check_writable
from ded_bench.methods.registry import get_method, trainable
from ded_bench.methods.solution import Settings
from ded_bench.methods.training_record import LOSSES, TrainingOptions, policy_file
from ded_bench.problem.benchmark import select_split
from ded_bench.problem.case import Case
from ded_bench.problem.sampling import POLICY_SEED, VALIDATION_SEED
from ded_bench.results.folder import ResultsFolder, default_results, search_folders
from ded_bench.run.environment import commit, version
from ded_bench.run.pool import Workers
from ded_bench.surrogates.find import TRAINED


def add_commands(commands: Any) -> None:
    """Declare these commands and their options."""
    p = command(commands, "train-ko", "identify the Koopman model from simulated trajectories")
    p.add_argument("--kind", choices=TRAINED, default=TRAINED[0], help="ours, or the paper's recipe")
    declare(p, "--case", "--seed", "--results")
    p.add_argument("--count", type=positive, metavar="N", help="trajectories; default: by the case's size")
    p.add_argument("--out", type=Path, help="model file; default: in the results folder")
    p.add_argument("--force", action="store_true", help="train even if the file exists")
    p.set_defaults(run=_train_ko)

    p = command(commands, "train-dpc", "train policies")
    p.add_argument(
        "--method",
        type=names,
        metavar="M[,M]",
        help=f"default: all of {','.join(trainable())} that plan on the case",
    )
    declare(p, "--regime", "--case", "--seed", "--results")
    p.add_argument("--model", default="", help=f"to train on: {MODEL_HELP}; default: {TRAINED[0]}")
    budget = p.add_mutually_exclusive_group()
    budget.add_argument("--seconds", type=positive_number, metavar="S", help="train for so long")
    budget.add_argument("--epochs", type=positive, metavar="N", help="train for so many")
    p.add_argument("--limit", type=positive, help="only the first so many training instances")
    p.add_argument("--device", default="cpu", metavar="NAME", help="of torch, such as cuda; default: cpu")
    p.add_argument("--resume", action="store_true", help="go on from the checkpoint")
    p.add_argument("--force", action="store_true", help="train even if the file exists")
    p.add_argument("--workers", type=positive, default=1, metavar="N", help="trainings at a time")
    p.add_argument("--out", type=Path, help="policy file; default: in the results folder")
    p.set_defaults(run=_train_dpc)


def _train_ko(a: argparse.Namespace) -> int:
    case = Case.load(a.case)
    out = a.out or ResultsFolder(a.results or default_results(case)).model(a.kind)
    if out.is_file() and not a.force:
        print(f"{out} is there already (--force makes it anew)")
        return 0
    check_writable(out)
    is_paper = a.kind == TRAINED[1]
    with _missing_named():
        if is_paper:
            from ded_bench.surrogates.koopman_paper import identify_paper
    say(f"simulating trajectories of {case.id}, then identifying {out.stem}")
    from ded_bench.surrogates.identify import held_out, identify, rollout_errors

    model = (identify_paper if is_paper else identify)(case, a.seed, a.count)
    model.save(out)
    if a.count and not model.training["trajectories"]:
        say("--count has no effect: the energy form of so large a grid is not fitted to trajectories")
    omega, p_slack = rollout_errors(model, held_out(case, a.seed))
    held = f"{omega / (2 * math.pi):.3g} Hz at most, P_s by {p_slack:.3g} pu rms, on held-out trajectories"
    print(f"wrote {out}: ω errs by {held}")
    return 0


def _train_dpc(a: argparse.Namespace) -> int:
    from ded_bench.run.tasks import reason_of

    case = Case.load(a.case)
    regimes = a.regime or tuple(case.regimes)
    case.check_regimes(regimes)
    methods = [get_method(name) for name in a.method or trainable(case)]
    if (most := VALIDATION_SEED - POLICY_SEED) <= a.seed:
        raise InputError("--seed", str(a.seed), f"must be below {most}: beyond lie draws of validation")
    jobs = [(method.name, regime) for method in methods for regime in regimes]
    if a.out and len(jobs) > 1:
        raise InputError(a.out, "", "is one file; name one method and regime with --out")
    with _missing_named():
        for method in methods:
            _ = method.train  # says if it is not trained
            method.check(case, Settings())
    if a.device != "cpu" and (others := [method.name for method in methods if not method.takes_device]):
        raise InputError("--device", a.device, f"{others[0]} is trained on the CPU alone")
    say(f"{counted(len(jobs), 'training')} of {', '.join(method.name for method in methods)} on {case.id}")
    if len(jobs) == 1:  # what stops it is the command's
        print(_train_one(a, *jobs[0]), flush=True)
        return 0
    code = 0
    with Workers(min(a.workers, len(jobs))) as pool:
        for job, said in pool.imap(((_train_one, (a, *job)) for job in jobs), jobs):
            if isinstance(said, str):
                print(said, flush=True)
                continue
            is_input = isinstance(said, InputError)
            code = max(code, 2 if is_input else 1)
            say(f"{' '.join(job)}: {said if is_input else reason_of(said)}")
    return code


def _train_one(a: argparse.Namespace, name: str, regime: str) -> str:
    """Train one policy as the command's options say; returns what to tell."""
    case = Case.load(a.case)
    results = a.results or default_results(case)
    out: Path = a.out or policy_file(results, name, regime, a.model)
    if out.is_file() and not (a.force or a.resume):
        return f"{out} is there already (--force trains anew)"
    instances = [instance for instance, _ in select_split(a.case, "train", a.limit).instances]
    check_writable(out)
    options = TrainingOptions(
        seed=a.seed,
        seconds=a.seconds,
        epochs=a.epochs,
        resume=a.resume,
        device=a.device,
        model=a.model,
        search=search_folders(case, results),
        version=version(),
        commit=commit(),
    )
    facts = get_method(name).train(case, regime, instances, out, options).training
    losses = [f", {loss.replace('_', ' ')} {facts[loss]:.6g}" for loss in LOSSES if loss in facts]
    return f"wrote {out}: {facts['epochs']} epochs in {facts['seconds']:.0f} s{''.join(losses)}"


@contextlib.contextmanager
def _missing_named() -> Iterator[None]:
    """Say what to install where a package is not that only training needs."""
    try:
        yield
    except ModuleNotFoundError as error:
        package = str(error.name).partition(".")[0]
        if package not in ("cma", "torch"):
            raise
        raise InputError(package, "", f"training needs it: pip install {package}") from None
