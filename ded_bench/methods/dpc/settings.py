"""Settings of `ded-dpc`; a report reads them, and does without torch."""

from __future__ import annotations

from typing import Any

#: Short trainings, for comparison with each other only: each `study-…` changes one thing of `study`.
STUDY: dict[str, Any] = {"epochs": 6}
#: What the policy was trained on and how, by slug; values are options of `ded_dpc_train.train`.
#: `train400` sees nothing but the benchmark's training instances, in about as many steps.
SETTINGS: dict[str, dict[str, Any]] = {
    "default": {},
    "train400": {"fresh": 0, "epochs": 6000},
    "study": STUDY,
    "study-narrow": STUDY | {"width": 16},
    "study-wide": STUDY | {"width": 64},
    "study-near": STUDY | {"dilations": (1, 1, 1, 1, 1, 1)},
    "study-shallow": STUDY | {"dilations": (2, 8)},
    "study-no-dispatch": STUDY | {"blind": ("dispatch",)},
    "study-no-bends": STUDY | {"blind": ("bends",)},
    "study-no-prior": STUDY | {"prior": False},
    "study-raw": STUDY | {"normalise": False},
    "study-constant": STUDY | {"rate": "constant"},
    "study-batch32": STUDY | {"batch": 32},
    "study-batch512": STUDY | {"batch": 512},
    "study-fresh4000": {"epochs": 96, "fresh": 4000},
}
