"""Kinds of values that files hold."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer

from ded_bench.files.strict import Record

Array = NDArray[np.float64]
#: Numbers beyond these are typing errors or in other units; within them no product overflows.
SMALLEST, LARGEST = 1e-9, 1e9
Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Positive = Annotated[float, Field(gt=0, le=LARGEST)]
NonNegative = Annotated[float, Field(ge=0, le=LARGEST)]
Magnitude = Annotated[float, Field(ge=SMALLEST, le=LARGEST)]
Probability = Annotated[float, Field(ge=0, le=1)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
Range = tuple[Number, Number]


class Extended(Record):
    """A record that a later schema extends: what is not given is not written, as before."""

    @model_serializer(mode="wrap")
    def _given(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {name: value for name, value in write(self).items() if value is not None}
