"""The paper's optimiser and step reach its printed costs of recording 1-1_1."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.app.conftest import Script, read_json


@pytest.mark.slow
@pytest.mark.real
@pytest.mark.parametrize(("model", "epochs", "printed"), [("lin", 300, 49.1), ("n4", 600, 54.2)])
def test_printed_cost_is_reached(
    script: Script, real_data: Path, tmp_path: Path, model: str, epochs: int, printed: float
) -> None:
    script(
        "train",
        f"model={model}",
        "experiment=paper_traffic",
        "data.recording=1-1_1",
        "data.loader.batch_size=0",
        f"data.source={real_data}",
        f"trainer.max_epochs={epochs}",
        folder=tmp_path,
    )
    assert read_json(tmp_path / "result.json")["summary"]["cost_train"] <= printed
