"""A small calibration problem: platoons by a linear law."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from nnode.calibrate.trainer import Trainer
from nnode.data.store import Store, write_store
from tests.builders import linear
from tests.calibrate.together import trainer_of


@pytest.fixture(scope="session")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """Seven platoons of two to four cars over 1 s, v0 = 22 m/s and L = 4 m."""
    rng = np.random.default_rng(1)
    starts = [np.cumsum(rng.uniform(8, 30, rng.integers(2, 5))) for _ in range(7)]
    folder = tmp_path_factory.mktemp("platoons") / "store"
    return write_store(folder, linear(starts, 22, 4, 6, 0.002), {"dt": 0.2, "files": {}})


@pytest.fixture(scope="session")
def make_trainer(store: Store) -> Callable[..., Trainer]:
    """See :func:`tests.calibrate.together.trainer_of`."""
    return partial(trainer_of, store)
