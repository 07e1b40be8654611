"""A configuration composed today with what a checkpoint was made with."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from nnode.app.cli.saved import merge_saved, refuse_changes
from nnode.models import build_model
from tests.app.conftest import composed


def test_a_law_stays_as_its_checkpoint_describes_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """What its description does not say, as the method of stepping of an older one, does not come
    from today's."""
    config = composed("train", "model=idm")
    monkeypatch.setattr(
        HydraConfig, "get",
        lambda: SimpleNamespace(
            runtime=SimpleNamespace(choices={"model": "idm"}), overrides=SimpleNamespace(task=[])
        ),
    )  # fmt: skip
    saved: dict[str, Any] = {
        "groups": {"model": "idm"},
        "model": OmegaConf.to_container(config.model, resolve=True, enum_to_str=True),
    }
    assert saved["model"]["law"].pop("step") == "rk4"
    merged = merge_saved(config, saved, ("model",))
    assert "step" not in merged.model.law
    now: Any = OmegaConf.to_container(merged.model, resolve=True, enum_to_str=True)
    assert build_model(now).step == "ballistic"
    refuse_changes({"model": now}, saved, ())
