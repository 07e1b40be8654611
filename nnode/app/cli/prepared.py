"""``data.prepared=FOLDER`` alone: the folder's manifest tells how its data were made."""

from __future__ import annotations

from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from nnode.app.cli.recognised import with_recognised
from nnode.app.cli.saved import in_hydra, keys_given, path_given, plain
from nnode.app.cli.typed import written
from nnode.config import choices
from nnode.data.prepare import NOT_PREPARATION, made_by, refuse_others
from nnode.data.store import Store
from nnode.errors import ConfigError


def prepared_group(overrides: list[str]) -> list[str]:
    """The override that chooses a prepared folder's data set, where the user chooses none.

    Args:
        overrides: as given by the user.

    Raises:
        ConfigError, DataError: the folder holds no store, or does not say how it was made.
    """
    folder = path_given(overrides, "data.prepared")
    if folder is None or any(override.startswith("data=") for override in overrides):
        return []
    return [f"data={_group(_store(folder))}"]


def with_prepared(config: DictConfig) -> DictConfig:
    """``config`` with the options that ``data.prepared`` was prepared with, where that is set; else
    with those that a table is recognised to need.

    Raises:
        ConfigError: another data set was chosen, or options on the command line contradict the
            folder's; named with both values.
        DataError: no store in that folder.
    """
    folder = OmegaConf.select(config, "data.prepared")
    if not in_hydra():
        return config
    if folder is None:
        return with_recognised(config)
    store = _store(folder)
    choice, own = str(HydraConfig.get().runtime.choices["data"]), _group(store)
    # another one of nnode's; a choice of the user's own may be of the same reader
    other = choice != own and choice in choices("data")
    if other or OmegaConf.get_type(config.data) is not made_by(store):
        raise ConfigError(
            f"data.prepared={store.folder} holds data={own}, chosen is data={choice}; leave out "
            f"data={choice} to take the folder, or data.prepared to prepare data={choice}"
        )
    now = OmegaConf.create({"data": plain(config.data)})
    asked = [key for key in keys_given() if key.startswith("data.")]
    refuse_others(store, {key.removeprefix("data."): OmegaConf.select(now, key) for key in asked})
    merged, made = config.copy(), store.manifest["options"]
    for key in made.keys() & config.data.keys() - NOT_PREPARATION:
        OmegaConf.update(merged, f"data.{key}", made[key], merge=False)
    return merged


def _store(folder: str) -> Store:
    return Store(Path(folder).expanduser())


def _group(store: Store) -> str:
    """The group of the folder's data set, that of its reader where the user made his own."""
    reader, name = made_by(store), str(store.manifest["options"].get("name"))
    # the name comes from the folder's manifest: a path in it would lead out of conf/
    known = name in choices("data") and written("data", name)[0] is reader
    return name if known else str(reader().name)
