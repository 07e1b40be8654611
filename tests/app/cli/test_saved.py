"""Configuration groups and options that a checkpoint provides."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from nnode.app.cli.saved import GROUPS, merge_saved, refuse_changes, saved_groups
from nnode.app.cli.typed import group_defaults
from nnode.calibrate.checkpoint import Checkpoint, save_checkpoint
from nnode.config import choices
from nnode.errors import CheckpointError, ConfigError
from nnode.model import build_model
from tests.app.conftest import composed

UP = "../" * 12 + "proc/self/cwd/theirs"


def checkpoint(folder: Path, **groups: object) -> Path:
    path = folder / "checkpoints" / "best.pt"
    path.parent.mkdir(exist_ok=True)
    saved = Checkpoint(
        config={"model": {}, "data": {}, "groups": groups},
        manifest={},
        model={"terms.0.v0": torch.ones(())},
        optimizer={},
        progress={},
    )
    save_checkpoint(saved, path)
    return path


def test_groups_come_from_the_checkpoint(tmp_path: Path) -> None:
    groups = {"model": "idm", "data": "table", "optimizer": "gauss_newton", "solver": "fused"}
    path = checkpoint(tmp_path, **groups)
    result = saved_groups([f"resume={path}"], "resume")
    assert result == [f"{group}={name}" for group, name in groups.items()]
    for group, name in groups.items():
        assert name in choices(group)
    assert saved_groups([f"resume={path}", "data=esimas"], "resume", ("data",)) == []


@pytest.mark.parametrize(
    "name",
    [
        UP,
        f"../solver/{UP}",
        "./fused",
        "fused/",
        "fused.yaml",
        "../solver/fused",
        "/etc/passwd",
        "fused@hydra",
        "fused,torchdiffeq",
        "fused_schema",
        "none",
        "",
        "null",
        None,
        3,
        ["fused"],
        {"fused": 1},
        "fused\n",
    ],
)
@pytest.mark.parametrize("group", GROUPS)
def test_names_outside_the_configuration_are_refused(
    tmp_path: Path, group: str, name: object
) -> None:
    (tmp_path / "theirs.yaml").write_text("hydra: {callbacks: {one: {_target_: os.abort}}}\n")
    path = checkpoint(tmp_path, **{group: name})
    with pytest.raises(CheckpointError, match=f"no such file in conf/{group}, which has ") as error:
        saved_groups([f"checkpoint={path}"], "checkpoint")
    assert f"give {group}=NAME yourself" in str(error.value)
    if group in ("data", "solver"):
        with pytest.raises(CheckpointError, match=f"no such file in conf/{group}"):
            saved_groups([f"run={tmp_path}"], "run")
    # the user's choice takes precedence
    assert saved_groups([f"checkpoint={path}", f"{group}=x"], "checkpoint", (group,)) == []


@pytest.mark.parametrize("flag", [["--config-dir", "{}"], ["--config-dir={}"], ["-cd", "{}"]])
def test_groups_of_the_user_s_configuration_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flag: list[str]
) -> None:
    (tmp_path / "mine" / "model").mkdir(parents=True)
    (tmp_path / "mine" / "model" / "idm_calibrated.yaml").touch()
    path = checkpoint(tmp_path, model="idm_calibrated")
    options = [f"resume={path}"]
    with pytest.raises(CheckpointError, match="--config-dir"):
        saved_groups(options, "resume")
    folder = str(tmp_path / "mine")
    monkeypatch.setattr(sys, "argv", ["nnode", *(word.format(folder) for word in flag), *options])
    assert saved_groups(options, "resume") == ["model=idm_calibrated"]


def test_defaults_are_read_from_the_configuration_only(tmp_path: Path) -> None:
    (tmp_path / "theirs.yaml").write_text("defaults: [table_schema]\n")
    with pytest.raises(ConfigError, match=r"is unknown, expected one of .*table"):
        group_defaults("data", str(tmp_path / "theirs"))


def test_law_of_an_older_checkpoint_is_unchanged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fields that the checkpoint's law lacks are not taken from the present configuration."""
    config = composed("train", "model=idm")
    monkeypatch.setattr(
        HydraConfig,
        "get",
        lambda: SimpleNamespace(
            runtime=SimpleNamespace(choices={"model": "idm"}), overrides=SimpleNamespace(task=[])
        ),
    )
    saved: dict[str, Any] = {
        "groups": {"model": "idm"},
        "model": OmegaConf.to_container(config.model, resolve=True, enum_to_str=True),
    }
    assert saved["model"]["law"].pop("step") == "rk4"
    merged = merge_saved(config, saved, ("model",))
    assert "step" not in merged.model.law
    model: Any = OmegaConf.to_container(merged.model, resolve=True, enum_to_str=True)
    assert build_model(model).step == "ballistic"
    refuse_changes({"model": model}, saved, ())


def test_option_missing_in_a_checkpoint_has_its_default(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    overrides: list[str] = []
    hydra = SimpleNamespace(overrides=SimpleNamespace(task=overrides))
    monkeypatch.setattr(HydraConfig, "get", lambda: hydra)
    now, saved = {"data": {"fill": 0.5, "smooth": None}}, {"data": {"smooth": None}}
    refuse_changes(now, saved, ())
    overrides.append("data.fill=0.5")
    with pytest.raises(ConfigError, match=r"data\.fill cannot change"):
        refuse_changes(now, saved, ())
