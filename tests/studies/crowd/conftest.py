"""The crowd study in float64, for which the networks' code is compiled in any case."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from studies.crowd import tasks


@pytest.fixture(autouse=True, scope="package")
def double_precision() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tasks, "DTYPE", dict.fromkeys(tasks.DTYPE, torch.float64))
        yield
