"""Fixtures shared with the tests of scripts."""

from tests.app.conftest import forks, script  # noqa: F401
