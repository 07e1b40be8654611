"""What a checkpoint chooses of the configuration that is composed today."""

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
    made = Checkpoint(
        config={"model": {}, "data": {}, "groups": groups},
        manifest={},
        model={"terms.0.v0": torch.ones(())},
        optimizer={},
        progress={},
    )
    save_checkpoint(made, path)
    return path


def test_groups_are_files_of_the_configuration(tmp_path: Path) -> None:
    own = {"model": "idm", "data": "table", "optimizer": "gauss_newton", "solver": "fused"}
    path = checkpoint(tmp_path, **own)
    result = saved_groups([f"resume={path}"], "resume")
    assert result == [f"{group}={name}" for group, name in own.items()]
    for group, name in own.items():
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
def test_any_other_name_is_refused(tmp_path: Path, group: str, name: object) -> None:
    (tmp_path / "theirs.yaml").write_text("hydra: {callbacks: {one: {_target_: os.abort}}}\n")
    path = checkpoint(tmp_path, **{group: name})
    with pytest.raises(CheckpointError, match=f"no such file in conf/{group}, which has ") as error:
        saved_groups([f"checkpoint={path}"], "checkpoint")
    assert f"give {group}=NAME yourself" in str(error.value)
    if group in ("data", "solver"):
        with pytest.raises(CheckpointError, match=f"no such file in conf/{group}"):
            saved_groups([f"run={tmp_path}"], "run")
    # what the user says himself is his own
    assert saved_groups([f"checkpoint={path}", f"{group}=x"], "checkpoint", (group,)) == []


@pytest.mark.parametrize("words", [["--config-dir", "{}"], ["--config-dir={}"], ["-cd", "{}"]])
def test_the_user_s_own_folder_has_further_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str]
) -> None:
    (tmp_path / "mine" / "model").mkdir(parents=True)
    (tmp_path / "mine" / "model" / "idm_calibrated.yaml").touch()
    path = checkpoint(tmp_path, model="idm_calibrated")
    given = [f"resume={path}"]
    with pytest.raises(CheckpointError, match="--config-dir"):
        saved_groups(given, "resume")
    folder = str(tmp_path / "mine")
    monkeypatch.setattr(sys, "argv", ["nnode", *(word.format(folder) for word in words), *given])
    assert saved_groups(given, "resume") == ["model=idm_calibrated"]


def test_defaults_are_read_of_such_files_alone(tmp_path: Path) -> None:
    (tmp_path / "theirs.yaml").write_text("defaults: [table_schema]\n")
    with pytest.raises(ConfigError, match=r"is unknown, expected one of .*table"):
        group_defaults("data", str(tmp_path / "theirs"))


def test_a_law_stays_as_its_checkpoint_describes_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """What its description does not say, as the method of stepping of an older one, does not come
    from today's."""
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
    now: Any = OmegaConf.to_container(merged.model, resolve=True, enum_to_str=True)
    assert build_model(now).step == "ballistic"
    refuse_changes({"model": now}, saved, ())


def test_an_option_that_a_checkpoint_does_not_know_has_its_default(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given: list[str] = []
    hydra = SimpleNamespace(overrides=SimpleNamespace(task=given))
    monkeypatch.setattr(HydraConfig, "get", lambda: hydra)
    now, saved = {"data": {"fill": 0.5, "smooth": None}}, {"data": {"smooth": None}}
    refuse_changes(now, saved, ())
    given.append("data.fill=0.5")
    with pytest.raises(ConfigError, match=r"data\.fill cannot change"):
        refuse_changes(now, saved, ())
