"""The crowd study's calibrations in float64: the networks' code is compiled for it anyway."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from studies.crowd import tasks


@pytest.fixture(autouse=True, scope="package")
def one_precision() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tasks, "DTYPE", dict.fromkeys(tasks.DTYPE, torch.float64))
        yield
