"""Results are bit-identical for the same seed; threads change only the rounding."""

from __future__ import annotations

from pathlib import Path

import pytest

from nnode.calibrate.checkpoint import load_checkpoint
from nnode.data.synthetic import demo_data
from tests.app.conftest import Script

#: Relative difference of parameters after three epochs with another order of summation.
ROUNDING = 1e-9


def trained(script: Script, raw: Path, folder: Path, *overrides: str) -> dict[str, float]:
    script(
        "train",
        "experiment=demo_crowd",
        f"data.source={raw}",
        "trainer.max_epochs=3",
        "trainer.figure_every=0",
        "data.loader.batch_size=2",
        f"hydra.run.dir={folder}",
        *overrides,
    )
    model = load_checkpoint(folder / "checkpoints" / "last.pt").build()
    return {
        f"{name}[{k}]": float(value)
        for name, p in model.named_parameters()
        for k, value in enumerate(p.detach().flatten())
    }


@pytest.mark.slow
def test_workers_and_threads_do_not_change_results(script: Script, tmp_path: Path) -> None:
    raw = tmp_path / "raw"
    demo_data(raw)
    first = trained(script, raw, tmp_path / "0", "trainer.threads=1")
    assert len(set(first.values())) > 10
    for workers in (0, 1, 2):
        folder = tmp_path / f"workers{workers}"
        repeated = trained(
            script, raw, folder, "trainer.threads=1", f"data.loader.workers={workers}"
        )
        assert repeated == first
    threads = trained(script, raw, tmp_path / "threads", "trainer.threads=2")
    assert threads == pytest.approx(first, rel=ROUNDING, abs=1e-12)
    other = trained(script, raw, tmp_path / "seed", "trainer.threads=1", "seed=7")
    assert other != pytest.approx(first, rel=1e-3)
