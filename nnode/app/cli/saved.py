"""A checkpoint's configuration as the default of the user's options."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from nnode.calibrate.checkpoint import Checkpoint, load_checkpoint
from nnode.config import choices
from nnode.data.options import with_present_names
from nnode.errors import CheckpointError, ConfigError
from nnode.model.laws import CAR_FOLLOWING_LAWS
from nnode.program import configuration, own_choices

GROUPS = ("model", "data", "optimizer", "solver")


#: Place of the calibrated model in the folder of a training or a diagnosis.
BEST = Path("checkpoints") / "best.pt"

#: Groups that were taken from the first checkpoint instead of the user.
_chosen: set[str] = set()


def in_hydra() -> bool:
    """Whether Hydra is running. HydraConfig alone stays initialised after a job."""
    return HydraConfig.initialized() and GlobalHydra.instance().is_initialized()


def composed(name: str, overrides: list[str]) -> DictConfig:
    """The configuration of a command with overrides, including Hydra's part."""
    with initialize_config_dir(str(configuration().absolute()), version_base="1.3"):
        return compose(name, overrides, return_hydra_config=True)


def plain(config: DictConfig) -> dict[str, Any]:
    """A configuration in plain types."""
    return cast(dict[str, Any], OmegaConf.to_container(config, resolve=True, enum_to_str=True))


def options_of(section: DictConfig) -> Any:
    """A section of a configuration as its dataclass of options.

    Raises:
        MissingMandatoryValue: a mandatory option has no value.
    """
    return OmegaConf.to_object(section)


def plain_config(config: DictConfig) -> dict[str, Any]:
    """The composed configuration in plain types, with the chosen groups.

    A configuration that was made without Hydra already contains its groups.
    """
    values = plain(config)
    make_absolute(values.get("data", {}))
    values.pop("resume", None)
    if in_hydra():
        choices = HydraConfig.get().runtime.choices
        values["groups"] = {group: str(choices[group]) for group in GROUPS if group in choices}
    return values


def make_absolute(data: dict[str, Any]) -> None:
    """Make a data set's paths absolute, so that they do not depend on the working directory."""
    for key in ("path", "source", "prepared", "walls", "geometry"):
        place = data.get(key)
        if isinstance(place, str) and Path(place).exists():
            data[key] = str(Path(place).absolute())


def checkpoint_of(run: str | Path) -> Path:
    """The checkpoint in a run's folder; a path to a checkpoint is returned unchanged."""
    place = Path(run).expanduser()
    return place if place.suffix == ".pt" or place.is_file() else place / BEST


def load_run(run: str | Path) -> Checkpoint:
    """The checkpoint of a run, which its folder or its checkpoint names.

    Raises:
        CheckpointError: the checkpoint is missing or damaged.
    """
    return load_checkpoint(checkpoint_of(run))


def path_given(overrides: list[str], option: str) -> str | None:
    """The first path that ``option=PATH`` or ``option=[PATH, ...]`` names."""
    given = [value for key, _, value in (o.partition("=") for o in overrides) if key == option]
    paths = [value.strip("[]").split(",")[0].strip(" '\"") for value in given if value != "null"]
    return next(filter(None, reversed(paths)), None)


def saved_groups(overrides: list[str], option: str, groups: tuple[str, ...] = GROUPS) -> list[str]:
    """Overrides that choose a checkpoint's groups if the user chooses none.

    Args:
        option: option that names the checkpoint or its run.

    Raises:
        CheckpointError: there is no file ``conf/GROUP/NAME.yaml`` for a group's name. The check is
            necessary because Hydra accepts any path as a name, and such a file can run code.
    """
    path = path_given(overrides, option)
    if path is None:
        return []
    # a training is resumed from a checkpoint, since its folder has several
    checkpoint = load_checkpoint(path) if option == "resume" else load_run(path)
    saved = checkpoint.config.get("groups", {})
    given = {override.partition("=")[0] for override in overrides}
    chosen = [group for group in groups if group in saved.keys() - given]
    for group in chosen:
        available = choices(group)
        if saved[group] not in [*available, *own_choices(group)]:
            raise CheckpointError(
                f"{path} was made with {group}={str(saved[group])[:80]!r}, and there is no such "
                f"file in conf/{group}, which has {', '.join(available)}; give {group}=NAME "
                f"yourself, or name the folder with the file {group}/NAME.yaml with --config-dir"
            )
    _chosen.update(chosen)
    return [f"{group}={saved[group]}" for group in chosen]


def field_groups(overrides: list[str]) -> list[str]:
    """Overrides that choose compiled code and Gauss-Newton for car-following laws if the user does
    not choose a solver and an optimiser. The paper's models keep the paper's methods."""
    pairs = (override.lstrip("+").partition("=") for override in overrides)
    chosen = {key: value for key, _, value in pairs}
    if "experiment" in chosen or not CAR_FOLLOWING_LAWS.keys() >= set(
        chosen.get("model", "").split(",")
    ):
        return []
    wanted = {"solver": "fused", "optimizer": "gauss_newton"}
    return [f"{group}={choice}" for group, choice in wanted.items() if group not in chosen]


def train_groups(overrides: list[str]) -> list[str]:
    """The groups that ``nnode train`` chooses for the user, from a checkpoint or for a law."""
    return saved_groups(overrides, option="resume") or field_groups(overrides)


def keys_given() -> list[str]:
    """Names of the options on this job's command line."""
    return [override.partition("=")[0].lstrip("+") for override in HydraConfig.get().overrides.task]


def merge_saved(config: DictConfig, saved: dict[str, Any], sections: tuple[str, ...]) -> DictConfig:
    """``config`` with ``sections`` of a checkpoint, and with the user's options in them.

    A section does not change if the user chose another group than the checkpoint's.

    Raises:
        ConfigError: a sweep has checkpoints of different groups.
        CheckpointError: the checkpoint's configuration lacks a section.
    """
    merged = config.copy()
    if lacking := {"groups", *sections} - saved.keys():
        raise CheckpointError(
            f"the checkpoint's configuration has no {', '.join(sorted(lacking))}; it is damaged: "
            "take another checkpoint"
        )
    choices, saved_choices = HydraConfig.get().runtime.choices, saved["groups"]
    for name in sections:
        if name not in saved_choices or choices[name] == saved_choices[name]:
            saved_options = with_present_names(saved[name]) if name == "data" else saved[name]
            OmegaConf.update(merged, name, saved_options, merge=True)
            if isinstance(saved[name], dict) and "law" in saved[name]:
                # a law's description is replaced as a whole, without the present file's entries
                OmegaConf.update(merged, f"{name}.law", saved[name]["law"], merge=False)
        elif name in _chosen:
            raise ConfigError(
                f"this checkpoint has {name}={saved_choices[name]}, the first one of the sweep "
                f"{name}={choices[name]}; sweep over checkpoints of one {name}"
            )
    for key in keys_given():
        if key not in saved_choices and key.partition(".")[0] in sections:
            OmegaConf.update(merged, key, OmegaConf.select(config, key), force_add=True)
    return merged


def refuse_changes(
    now: dict[str, Any], saved: dict[str, Any], allowed: tuple[str, ...], prefix: str = ""
) -> None:
    """Refuse any difference outside ``allowed`` keys.

    Options that the checkpoint's version did not have are compared only if they are given.

    Raises:
        ConfigError: an option differs; the message states both values.
    """
    for key, value in now.items():
        full, had = prefix + key, saved.get(key)
        if key not in saved and full not in keys_given():
            continue
        if isinstance(value, dict) and isinstance(had, dict):
            refuse_changes(value, had, allowed, f"{full}.")
        elif full not in allowed and value != had:
            raise ConfigError(
                f"{full} cannot change when a run is resumed: the checkpoint has {had}, asked for "
                f"is {value}; leave the option out, or start a new run without resume="
            )
