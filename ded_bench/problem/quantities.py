"""Kinds of values that files hold."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    Field,
    GetPydanticSchema,
    PlainSerializer,
    SerializerFunctionWrapHandler,
    WrapValidator,
    model_serializer,
)

from ded_bench.files.strict import Record

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Indices = NDArray[np.intp]
#: Numbers beyond these are typing errors or in other units; within them no product overflows.
SMALLEST, LARGEST = 1e-9, 1e9
Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Positive = Annotated[float, Field(gt=0, le=LARGEST)]
NonNegative = Annotated[float, Field(ge=0, le=LARGEST)]
Magnitude = Annotated[float, Field(ge=SMALLEST, le=LARGEST)]
#: s; what is faster needs no model here, and millions of steps.
TimeConst = Annotated[float, Field(ge=1e-4, le=LARGEST)]
Probability = Annotated[float, Field(ge=0, le=1)]
#: What may name a case, a bus or an instance.
NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$"
Name = Annotated[str, Field(pattern=NAME)]
Range = tuple[Number, Number]
MAX_STEPS = 1_000_000
#: Of a load in one file.
MAX_POINTS = 100_000


def as_array(kind: Any) -> GetPydanticSchema:
    """What is checked as rows of this kind and kept as an array that nobody changes."""

    def kept(rows: object, checked: Callable[[object], object]) -> Array:
        array = np.array(checked(rows.tolist() if isinstance(rows, np.ndarray) else rows))
        array.flags.writeable = False
        return array

    stored = Annotated[kind, WrapValidator(kept), PlainSerializer(np.ndarray.tolist)]
    return GetPydanticSchema(lambda _, handler: handler(stored))


class Extended(Record):
    """A record that a later schema extends: what is not given is not written, as before."""

    @model_serializer(mode="wrap")
    def _given(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {name: value for name, value in write(self).items() if value is not None}


def largest_divisor(count: int, most: float) -> int:
    """The largest divisor of a number that is at most so large; 1 if none is."""
    return next(n for n in range(max(int(most + 1e-9), 1), 0, -1) if count % n == 0)


def check_whole_steps(name: str, length_s: float, dt_s: float) -> None:
    """Raise ValueError unless a time of this name is a number of steps, and not too many."""
    steps = length_s / dt_s
    if steps > MAX_STEPS:  # first, since the quotient may be infinite
        raise ValueError(f"dt_s: more than {MAX_STEPS} time steps")
    if abs(steps - round(steps)) > 1e-9 * steps or round(steps) < 1:
        raise ValueError(f"{name}: must be a whole multiple of dt_s")
