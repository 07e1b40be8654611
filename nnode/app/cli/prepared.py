"""``data.prepared=FOLDER`` alone: the folder's manifest tells how its data were made."""

from __future__ import annotations

from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from nnode.app.cli.saved import in_hydra, path_given
from nnode.config import SCHEMAS
from nnode.data.prepare import NOT_PREPARATION, made_by, refuse_others
from nnode.data.store import Store
from nnode.errors import ConfigError


def prepared_group(overrides: list[str], conf: Path) -> list[str]:
    """The override that chooses a prepared folder's data set, where the user chooses none.

    Args:
        overrides: as given by the user.
        conf: the folder of the configuration.

    Raises:
        ConfigError, DataError: the folder holds no store, or does not say how it was made.
    """
    folder = path_given(overrides, "data.prepared")
    chosen = any(override.partition("=")[0] == "data" for override in overrides)
    if folder is None or chosen:
        return []
    return [f"data={_group(_store(folder), conf)}"]


def with_prepared(config: DictConfig) -> DictConfig:
    """``config`` with the options that ``data.prepared`` was prepared with, where that is set.

    Raises:
        ConfigError: another data set was chosen, or options on the command line contradict the
            folder's; named with both values.
        DataError: no store in that folder.
    """
    folder = OmegaConf.select(config, "data.prepared")
    if folder is None or not in_hydra():
        return config
    store = _store(folder)
    made = store.manifest["options"]
    _refuse_group(config, store)
    plain = OmegaConf.to_container(config.data, resolve=True, enum_to_str=True)
    now = OmegaConf.create(plain)
    asked = {}
    for override in HydraConfig.get().overrides.task:
        key = override.lstrip("+").partition("=")[0]
        if key.startswith("data."):
            key = key.removeprefix("data.")
            value = OmegaConf.select(now, key)
            asked[key] = OmegaConf.to_container(value) if OmegaConf.is_config(value) else value
    refuse_others(store, asked)
    merged = config.copy()
    for key in made.keys() & config.data.keys() - NOT_PREPARATION:
        OmegaConf.update(merged, f"data.{key}", made[key], merge=False)
    return merged


def _store(folder: str) -> Store:
    return Store(Path(folder).expanduser())


def _refuse_group(config: DictConfig, store: Store) -> None:
    """Refuse a data set that is not the folder's."""
    runtime = HydraConfig.get().runtime
    (conf,) = (Path(source.path) for source in runtime.config_sources if source.provider == "main")
    choice, own = str(runtime.choices["data"]), _group(store, conf)
    other = choice != own and choice in _groups(conf)
    if other or OmegaConf.get_type(config.data) is not made_by(store):
        raise ConfigError(
            f"data.prepared={store.folder} holds data={own}, chosen is data={choice}; leave out "
            f"data={choice} to take the folder, or data.prepared to prepare data={choice}"
        )


def _group(store: Store, conf: Path) -> str:
    """The group of the folder's data set, that of its reader where the user made his own."""
    reader, name = made_by(store), str(store.manifest["options"].get("name"))
    return name if _groups(conf).get(name) is reader else str(reader().name)


def _groups(conf: Path) -> dict[str, type | None]:
    """Every data set's options class."""
    found = {}
    for path in (conf / "data").glob("*.yaml"):
        config = OmegaConf.load(path)
        schema = str(OmegaConf.select(config, "defaults[0]", default=""))
        found[path.stem] = SCHEMAS.get(("data", schema))
    return found
