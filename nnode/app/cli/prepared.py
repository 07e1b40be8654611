"""Options of data that follow from the data: from the manifest of a prepared folder, or from the
columns of a table."""

from __future__ import annotations

from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from nnode.app.cli.saved import in_hydra, keys_given, path_given, plain
from nnode.app.cli.typed import changed_options, plain_options, written
from nnode.config import choices
from nnode.data.check.recognise import NEEDED, UNIT, has_columns, recognised
from nnode.data.prepare import NOT_PREPARATION, made_by, refuse_others
from nnode.data.sequences import say_recognised
from nnode.data.store import Store
from nnode.errors import ConfigError, DataError

#: Options that the recognition considers.
_RECOGNISED = {"columns", "frame_rate", *UNIT.values()}


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


def with_recognised(config: DictConfig) -> DictConfig:
    """``config`` with the recognised columns and units of a table.

    Nothing changes if the table has the columns of its format, with their names or with those in
    ``data.columns``. Given options have priority.

    Raises:
        ConfigError: columns or units are ambiguous, or the table has another format.
    """
    kind = OmegaConf.get_type(config.data)
    group = next((name for name, (schema, _) in NEEDED.items() if schema is kind), None)
    if kind is None or group is None or not in_hydra() or OmegaConf.is_missing(config.data, "path"):
        return config
    place = Path(config.data.path).expanduser()
    if config.data.source is not None and not place.is_file():
        place = Path(config.data.source).expanduser() / place
    defaults, asked = plain_options(kind()), keys_given()
    current = plain(
        OmegaConf.masked_copy(config.data, [key for key in config.data if key in _RECOGNISED])
    )
    given = {k: v for k, v in current.items() if v != defaults[k] or f"data.{k}" in asked}
    if not place.is_file() or has_columns(place, group, given):
        return config
    no_domain = OmegaConf.is_missing(config.data, "domain")
    try:
        recognition = recognised(place, None if no_domain else config.data.domain, given)
    except DataError:
        return config  # the reader's error is more specific
    if recognition.group != group or recognition.table is not None:
        raise ConfigError(
            f"{place} has no columns of data={group}; nnode check {place} prints what reads it"
        )
    say_recognised(recognition)
    merged = config.copy()
    for key, value in changed_options(recognition.options).items():
        if key not in {"path", *given} - {"columns"}:  # columns are completed
            OmegaConf.update(merged, f"data.{key}", value, merge=False)
    return merged
