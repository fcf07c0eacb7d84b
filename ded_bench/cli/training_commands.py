"""Commands that train Koopman models and policies."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ded_bench.cli.arguments import (
    DEFAULT_CASE,
    MODEL_HELP,
    command,
    natural,
    positive,
    positive_number,
)
from ded_bench.files.errors import InputError
from ded_bench.files.strict import write_atomically
from ded_bench.koopman.surrogates import TRAINED, default_results, search_folders
from ded_bench.problem.benchmark import select_split
from ded_bench.problem.case import Case

if TYPE_CHECKING:
    pass


def add_commands(commands: Any) -> None:
    """Declare these commands and their options."""
    p = command(commands, "train-ko", "identify the Koopman model from simulated trajectories")
    p.add_argument("--kind", choices=TRAINED, default=TRAINED[0], help="ours, or the paper's recipe")
    p.add_argument("--case", default=DEFAULT_CASE)
    p.add_argument("--seed", type=natural, default=0)
    p.add_argument("--results", type=Path, help="results folder that keeps models and policies")
    p.add_argument("--out", type=Path, help="model file; default: in the results folder")
    p.add_argument("--force", action="store_true", help="train even if the file exists")
    p.set_defaults(run=_train_ko)

    p = command(commands, "train-dpc", "train a policy on the training instances")
    p.add_argument("--method", default="ded-dpc", help="ded-dpc or ded-dpc-paper")
    p.add_argument("--settings", default="default", help="slug of the training settings")
    p.add_argument("--regime", required=True, metavar="R", help="NO or TO")
    p.add_argument("--case", default=DEFAULT_CASE)
    p.add_argument("--model", default="koopman", help=MODEL_HELP)
    p.add_argument("--seed", type=natural, default=0)
    budget = p.add_mutually_exclusive_group()
    budget.add_argument("--seconds", type=positive_number, metavar="S", help="train for so long")
    budget.add_argument("--epochs", type=positive, metavar="N")
    p.add_argument("--limit", type=positive, help="only the first so many training instances")
    p.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    p.add_argument("--resume", action="store_true", help="go on from the checkpoint")
    p.add_argument("--force", action="store_true", help="train even if the file exists")
    p.add_argument("--results", type=Path, help="results folder that keeps models and policies")
    p.add_argument("--out", type=Path, help="policy file; default: in the results folder")
    p.set_defaults(run=_train_dpc)

    p = command(commands, "rollouts", "errors of the Koopman models under full DED's schedules")
    p.add_argument("--case", default=DEFAULT_CASE)
    p.add_argument("--results", type=Path, help="results folder")
    p.set_defaults(run=_rollouts)


def _train_ko(a: argparse.Namespace) -> int:
    from ded_bench.koopman.identify import held_out, identify, rollout_table
    from ded_bench.koopman.identify_paper import identify_paper
    from ded_bench.koopman.linear import linear_model
    from ded_bench.koopman.surrogates import model_file

    case = Case.load(a.case)
    out = a.out or model_file(a.results or default_results(case), a.kind)
    if out.exists() and not a.force:
        print(f"{out} is there already (--force makes it anew)")
        return 0
    model = (identify if a.kind == "koopman" else identify_paper)(case, a.seed)
    model.save(out)
    table = rollout_table(case, [linear_model(case), model], held_out(case, a.seed))
    write_atomically(out.with_suffix(".errors.csv"), table.to_csv(index=False))
    print(table.to_string(index=False, float_format="{:.3g}".format))
    print(f"wrote {out}")
    return 0


def _train_dpc(a: argparse.Namespace) -> int:
    import torch

    from ded_bench.koopman.surrogates import find_model
    from ded_bench.methods.policy_file import policy_file
    from ded_bench.methods.registry import get_method

    method = get_method(a.method)
    train, choices = method.train, method.settings
    if a.settings not in choices:
        raise InputError("--settings", a.settings, f"unknown (known: {', '.join(choices)})")
    case = Case.load(a.case)
    case.check_regimes([a.regime])
    results = a.results or default_results(case)
    out = a.out or policy_file(results, a.method, a.regime, a.model, a.settings)
    if out.exists() and not (a.force or a.resume):
        print(f"{out} is there already (--force trains anew)")
        return 0
    model = find_model(case, a.model, search_folders(case, results))
    instances = [instance for instance, _ in select_split(a.case, "train", a.limit).instances]
    torch.set_num_threads(1)  # these networks gain nothing from more, and results then repeat anywhere
    options: dict[str, Any] = dict(choices[a.settings])
    options |= {"seed": a.seed, "seconds": a.seconds, "device": a.device, "resume": a.resume}
    options |= {"epochs": a.epochs} if a.epochs else {}
    policy = train(case, a.regime, instances, model, out, **options)
    facts = policy.training
    print(
        f"wrote {out}: {facts['epochs']} epochs in {facts['seconds']:.0f} s, "
        f"held-out loss {facts['held_out_loss']:.6g}"
    )
    return 0


def _rollouts(a: argparse.Namespace) -> int:
    from ded_bench.evaluate.ablation import rollout_errors
    from ded_bench.koopman.surrogates import MODELS, find_model
    from ded_bench.run.results import Results

    chosen = select_split(a.case)
    case = chosen.case
    folder = a.results or default_results(case)
    models = []
    for name in MODELS:
        try:
            models.append(find_model(case, name, search_folders(case, folder)))
        except InputError as error:
            print(f"ded-bench: left out: {error}", file=sys.stderr)
    instances = [instance for instance, _ in chosen.instances]
    table = rollout_errors(case, Results(folder), instances, models)
    print(table.to_string(index=False, float_format="{:.3g}".format))
    return 0
