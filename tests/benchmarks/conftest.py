"""Fixtures that benchmarks share with the scripts' tests."""

from tests.app.conftest import script  # noqa: F401
