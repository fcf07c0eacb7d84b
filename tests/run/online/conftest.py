"""Fixtures of the closed loop's tests."""

from tests.lagged_plant import lagged  # noqa: F401
