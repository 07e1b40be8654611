"""Fixtures that benchmarks share with the scripts' tests."""

from tests.app.conftest import forks, script  # noqa: F401
