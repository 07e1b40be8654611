"""A checkpoint's configuration under what the user asks for now."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from nnode.calibrate.checkpoint import load_checkpoint
from nnode.errors import CheckpointError, ConfigError
from nnode.models.field import FIELD

GROUPS = ("model", "data", "optimizer", "solver")


#: Groups that were chosen for the user, from his first checkpoint.
_chosen: set[str] = set()


def in_hydra() -> bool:
    """Whether Hydra runs now; a job that has ended leaves its configuration behind."""
    return HydraConfig.initialized() and GlobalHydra.instance().is_initialized()


def plain_config(config: DictConfig) -> dict[str, Any]:
    """The composed configuration in plain types, with the groups it was composed from.

    One that was made without Hydra names its groups itself.
    """
    plain = OmegaConf.to_container(config, resolve=True, enum_to_str=True)
    assert isinstance(plain, dict)
    make_absolute(plain.get("data", {}))
    if not in_hydra():
        return {str(k): v for k, v in plain.items() if k != "resume"}
    choices = HydraConfig.get().runtime.choices
    groups = {group: str(choices[group]) for group in GROUPS if group in choices}
    return {**{str(k): v for k, v in plain.items() if k != "resume"}, "groups": groups}


def make_absolute(data: dict[str, Any]) -> None:
    """Let a data set's files be found again from any working directory."""
    for key in ("path", "source", "prepared", "walls", "geometry"):
        place = data.get(key)
        if isinstance(place, str) and Path(place).exists():
            data[key] = str(Path(place).absolute())


def path_given(overrides: list[str], option: str) -> str | None:
    """The first path that ``option=PATH`` or ``option=[PATH, ...]`` names."""
    for override in reversed(overrides):
        key, _, value = override.partition("=")
        if key == option and value not in ("", "null"):
            return value.strip("[]").split(",")[0].strip().strip("'\"") or None
    return None


def saved_groups(overrides: list[str], option: str, groups: tuple[str, ...] = GROUPS) -> list[str]:
    """Overrides that choose a checkpoint's groups where the user chooses none."""
    path = path_given(overrides, option)
    if path is None:
        return []
    saved = load_checkpoint(path).config.get("groups", {})
    given = {override.partition("=")[0] for override in overrides}
    chosen = [g for g in groups if g in saved and g not in given]
    _chosen.update(chosen)
    return [f"{group}={saved[group]}" for group in chosen]


def field_groups(overrides: list[str]) -> list[str]:
    """Overrides that choose compiled code and Gauss and Newton's method for the field's laws where
    the user chooses nothing else; the paper's models keep the paper's."""
    pairs = (override.partition("=") for override in overrides)
    chosen = {key.lstrip("+"): value for key, _, value in pairs}
    laws = chosen.get("model", "").split(",")
    if not set(laws) <= set(FIELD) or "experiment" in chosen:
        return []
    wanted = {"solver": "fused", "optimizer": "gauss_newton"}
    return [f"{group}={choice}" for group, choice in wanted.items() if group not in chosen]


def train_groups(overrides: list[str]) -> list[str]:
    """What ``scripts/train.py`` chooses for the user, from a checkpoint or for a law."""
    return saved_groups(overrides, option="resume") or field_groups(overrides)


def merge_saved(config: DictConfig, saved: dict[str, Any], sections: tuple[str, ...]) -> DictConfig:
    """``config`` with ``sections`` as a checkpoint has them, and the user's options on top.

    A section stays as composed where the user chose another group than the checkpoint's.

    Raises:
        ConfigError: checkpoints of different groups in one sweep.
        CheckpointError: the checkpoint's configuration lacks a section.
    """
    merged = config.copy()
    choices = HydraConfig.get().runtime.choices
    for name in sections:
        if name not in saved or "groups" not in saved:
            raise CheckpointError(
                f"the checkpoint's configuration has no {name if 'groups' in saved else 'groups'}; "
                "it is damaged: take another checkpoint"
            )
        if name in saved["groups"] and choices[name] != saved["groups"][name]:
            if name in _chosen:
                raise ConfigError(
                    f"this checkpoint has {name}={saved['groups'][name]}, the first one of the "
                    f"sweep {name}={choices[name]}; sweep over checkpoints of one {name}"
                )
            continue
        OmegaConf.update(merged, name, saved[name], merge=True)
    for override in HydraConfig.get().overrides.task:
        key = override.partition("=")[0].lstrip("+")
        option = "." in key or key not in saved["groups"]
        if option and key.partition(".")[0] in sections:
            OmegaConf.update(merged, key, OmegaConf.select(config, key), force_add=True)
    return merged


def refuse_changes(
    now: dict[str, Any], saved: dict[str, Any], allowed: tuple[str, ...], prefix: str = ""
) -> None:
    """Refuse any difference outside ``allowed`` keys.

    Raises:
        ConfigError: naming the option, what the checkpoint has and what is asked for.
    """
    for key in now:
        full = prefix + key
        if full in allowed:
            continue
        if isinstance(now[key], dict) and isinstance(saved.get(key), dict):
            refuse_changes(now[key], saved[key], allowed, f"{full}.")
        elif now[key] != saved.get(key):
            raise ConfigError(
                f"{full} cannot change when a run is resumed: the checkpoint has "
                f"{saved.get(key)}, asked for is {now[key]}; leave the option out, or start a "
                "new run without resume="
            )
