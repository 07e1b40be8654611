"""A small calibration problem: a few platoons obeying a linear law."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from nnode.calibrate.optimizers import AdadeltaOptions, OptimizerOptions, build_optimizer
from nnode.calibrate.options import TrainerOptions
from nnode.calibrate.trainer import Provenance, Trainer
from nnode.data.dataset import SequenceDataset, make_loader
from nnode.data.options import LoaderOptions
from nnode.data.store import Store, write_store
from nnode.model import build_model
from nnode.simulation import FusedSolver
from tests.builders import linear

LIN = {"term": "lin", "name": "lin", "leader": "constant", "v0": 30.0, "L": 5.0, "L_min": 2.0}


@pytest.fixture(scope="session")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """Seven platoons of two to four cars over 1 s, v0 = 22 m/s and L = 4 m."""
    rng = np.random.default_rng(1)
    starts = [np.cumsum(rng.uniform(8, 30, rng.integers(2, 5))) for _ in range(7)]
    folder = tmp_path_factory.mktemp("platoons") / "store"
    return write_store(folder, linear(starts, 22, 4, 6, 0.002), {"dt": 0.2, "files": {}})


@pytest.fixture(scope="session")
def make_trainer(store: Store) -> Callable[..., Trainer]:
    """Build a trainer in a folder; all randomness from its seed."""

    def make(
        folder: Path,
        optimizer: OptimizerOptions | None = None,
        seed: int = 0,
        batch_size: int = 2,
        dt: float = 0.1,
        **options: object,
    ) -> Trainer:
        model = build_model(LIN, seed)
        chosen = optimizer or AdadeltaOptions()
        train = make_loader(
            SequenceDataset(store, range(5)), LoaderOptions(batch_size=batch_size), seed=seed
        )
        heldout = make_loader(
            SequenceDataset(store, [5, 6]), LoaderOptions(shuffle=False), seed=seed
        )
        defaults: dict[str, object] = {"max_epochs": 6, "figure_every": 0, "save_every": 1e9}
        settings = TrainerOptions(**{**defaults, **options})  # type: ignore[arg-type]
        config = {"model": LIN, "seed": seed, "trainer": {"dtype": "float64"}}
        return Trainer(
            model,
            FusedSolver(dt),
            build_optimizer(model, chosen, seed),
            train,
            heldout,
            settings,
            folder,
            Provenance(config=config, manifest=store.manifest, split={"train": [], "heldout": []}),
        )

    return make
