"""Recognition of a table's columns and units on the command line."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from nnode.app.cli.saved import in_hydra, keys_given, plain
from nnode.app.cli.typed import changed_options, plain_options
from nnode.data.check.recognise import NEEDED, UNIT, has_columns, recognised
from nnode.data.sequences import say_recognised
from nnode.errors import ConfigError, DataError


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
        OmegaConf.masked_copy(config.data, [key for key in config.data if key in _SAID])
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


#: Options that the recognition considers.
_SAID = {"columns", "frame_rate", *UNIT.values()}
