"""Settings of `ded-dpc`; a report reads them, and does without torch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: Short trainings, for comparison with each other only: each `study-…` changes one thing of `study`.
STUDY: dict[str, Any] = {"epochs": 8, "fresh": 16_000}
#: What the policy was trained on and how, by slug; values are options of `training.train`.
#: `train400` sees nothing but the benchmark's training instances, in about as many steps.
SETTINGS: Mapping[str, Mapping[str, Any]] = {
    "default": {},
    "train400": {"fresh": 0, "epochs": 2000},
    "study": STUDY,
    "study-narrow": STUDY | {"width": 12},
    "study-wide": STUDY | {"width": 48},
    "study-near": STUDY | {"dilations": (1, 1, 1, 1)},
    "study-shallow": STUDY | {"dilations": (2, 8)},
    "study-no-dispatch": STUDY | {"blind": ("dispatch",)},
    "study-no-bends": STUDY | {"blind": ("bends",)},
    "study-no-response": STUDY | {"blind": ("response",)},
    "study-one-stage": STUDY | {"stages": 1},
    "study-three-stages": STUDY | {"stages": 3},
    "study-no-prior": STUDY | {"prior": False},
    "study-raw": STUDY | {"normalise": False},
    "study-constant": STUDY | {"rate": "constant"},
    "study-batch32": STUDY | {"batch": 32},
    "study-batch512": STUDY | {"batch": 512},
    "study-fresh4000": {"epochs": 32, "fresh": 4_000},
}
