"""Published errors, recomputed from published parameters."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from studies.following import printed, tasks
from studies.following.data import PAIRS, PLATOONS, stores
from studies.options import FollowingStudyOptions

pytestmark = pytest.mark.real


@pytest.fixture(scope="module")
def folders(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    if not (real_data / "ngsim_pairs").is_dir():
        pytest.skip(f"{real_data} has no ngsim_pairs")
    result = stores(
        FollowingStudyOptions(source=str(real_data)), tmp_path_factory.mktemp("following")
    )
    return {name: str(store.folder) for name, store in result.items()}


def test_published_errors_of_test_pairs(folders: dict[str, str]) -> None:
    result = tasks.reproduced_pairs(folders[PAIRS])
    for law, expected in printed.errors.items():
        for objective, value in zip(printed.objectives, expected, strict=True):
            errors = result[f"{law} {objective}"]
            assert len(errors) == 20
            assert np.mean(errors) == pytest.approx(value, abs=0.01), (law, objective)


def test_published_errors_of_the_platoon(folders: dict[str, str]) -> None:
    result = tasks.reproduced_platoon(folders[PLATOONS])
    assert result["stopped"] == pytest.approx(printed.platoon_errors, abs=0.03)
