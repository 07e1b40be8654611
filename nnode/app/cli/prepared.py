"""The options of prepared data, which ``data.prepared=FOLDER`` takes from the folder's manifest."""

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
    """The override that chooses a prepared folder's data set if the user chooses none.

    Args:
        overrides: the user's overrides.

    Raises:
        ConfigError, DataError: the folder has no store, or no record of its preparation.
    """
    folder = path_given(overrides, "data.prepared")
    if folder is None or any(override.startswith("data=") for override in overrides):
        return []
    return [f"data={_group(_store(folder))}"]


def with_prepared(config: DictConfig) -> DictConfig:
    """``config`` with the options of the preparation of ``data.prepared``, if that is set; or else
    with the options that are recognised for a table.

    Raises:
        ConfigError: another data set is chosen, or an option on the command line contradicts the
            folder's; the message states both values.
        DataError: the folder has no store.
    """
    folder = OmegaConf.select(config, "data.prepared")
    if not in_hydra():
        return config
    if folder is None:
        return with_recognised(config)
    store = _store(folder)
    choice, group = str(HydraConfig.get().runtime.choices["data"]), _group(store)
    # a user's own choice may have the same reader
    other = choice != group and choice in choices("data")
    if other or OmegaConf.get_type(config.data) is not made_by(store):
        raise ConfigError(
            f"data.prepared={store.folder} holds data={group}, chosen is data={choice}; leave out "
            f"data={choice} to take the folder, or data.prepared to prepare data={choice}"
        )
    current = OmegaConf.create({"data": plain(config.data)})
    given_keys = [key for key in keys_given() if key.startswith("data.")]
    refuse_others(
        store, {key.removeprefix("data."): OmegaConf.select(current, key) for key in given_keys}
    )
    merged, made = config.copy(), store.manifest["options"]
    for key in made.keys() & config.data.keys() - NOT_PREPARATION:
        OmegaConf.update(merged, f"data.{key}", made[key], merge=False)
    return merged


def _store(folder: str) -> Store:
    return Store(Path(folder).expanduser())


def _group(store: Store) -> str:
    """The group of the folder's data set, or of its reader if the data set is user-defined."""
    reader, name = made_by(store), str(store.manifest["options"].get("name"))
    # the name comes from the folder's manifest: a path in it would lead out of conf/
    is_nnodes = name in choices("data") and written("data", name)[0] is reader
    return name if is_nnodes else str(reader().name)
