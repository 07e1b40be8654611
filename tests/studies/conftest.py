"""Tables of a study's page."""

from __future__ import annotations

import pandas as pd
import pytest

from nnode.pages.page import Block, TableBlock


@pytest.fixture(scope="module")
def tables(blocks: list[Block]) -> dict[str, pd.DataFrame]:
    """The full tables of a page by name; a module defines the fixture ``blocks``."""
    return {b.name: b.full for b in blocks if isinstance(b, TableBlock) and b.full is not None}
