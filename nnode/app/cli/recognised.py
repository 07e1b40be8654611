"""Columns and units of a table on the command line, where its names are not those of its format."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from nnode.app.cli.saved import in_hydra, keys_given, plain
from nnode.app.cli.typed import plain_options
from nnode.data.check.recognise import NEEDED, UNIT, has_columns, recognised
from nnode.data.sequences import say_recognised
from nnode.errors import ConfigError, DataError


def with_recognised(config: DictConfig) -> DictConfig:
    """``config`` with the columns and units that a table is recognised to have.

    Nothing changes where the table has the columns of its format, under their own names or under
    those that ``data.columns`` gives. What is given wins.

    Raises:
        ConfigError: columns or units that may be two things, or a table of another format.
    """
    kind = OmegaConf.get_type(config.data)
    group = next((name for name, (own, _) in NEEDED.items() if own is kind), None)
    if kind is None or group is None or not in_hydra() or OmegaConf.is_missing(config.data, "path"):
        return config
    place = Path(config.data.path).expanduser()
    if config.data.source is not None and not place.is_file():
        place = Path(config.data.source).expanduser() / place
    usual, asked = plain_options(kind()), keys_given()
    now = plain(OmegaConf.masked_copy(config.data, [key for key in config.data if key in _SAID]))
    given = {k: v for k, v in now.items() if v != usual[k] or f"data.{k}" in asked}
    if not place.is_file() or has_columns(place, group, given):
        return config
    known = OmegaConf.is_missing(config.data, "domain")
    try:
        found = recognised(place, None if known else config.data.domain, given)
    except DataError:
        return config  # the reader's own words are nearer to what was asked for
    if found.group != group or found.table is not None:
        raise ConfigError(
            f"{place} has no columns of data={group}; nnode check {place} prints what reads it"
        )
    say_recognised(found)
    merged = config.copy()
    for key, value in plain_options(found.options).items():
        if key not in ("path", "name") and value != usual[key] and key not in given.keys() - _OWN:
            OmegaConf.update(merged, f"data.{key}", value, merge=False)
    return merged


#: Options that recognition takes into account, and the one that it completes.
_SAID = {"columns", "frame_rate", *UNIT.values()}
_OWN = {"columns"}
