"""The recordings of ESIMAS, prepared once."""

from __future__ import annotations

from pathlib import Path

import pytest

from nnode.data.options import Faults
from nnode.data.prepare import prepare
from nnode.data.readers.esimas import EsimasOptions


@pytest.fixture(scope="package")
def esimas(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("esimas")
    prepare(EsimasOptions(name="esimas", source=str(real_data), faults=Faults.keep), folder)
    return str(folder)
