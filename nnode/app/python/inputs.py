"""Arguments of the Python interface in place of a configuration: tables, and names of choices."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from collections.abc import Sequence as ListLike
from dataclasses import replace
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any, cast

import pandas as pd
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigKeyError, MissingMandatoryValue, OmegaConfBaseException

from nnode.app.cli.mistakes import unknown_option, wrong_value
from nnode.app.cli.saved import options_of, plain
from nnode.app.cli.typed import changed_options, written
from nnode.calibrate.checkpoint import Checkpoint
from nnode.data.check.recognise import NEEDED, has_columns, recognised
from nnode.data.dataset import Source
from nnode.data.options import DataOptions, with_present_names
from nnode.data.prepare import FORMATS
from nnode.data.readers.columns import Table as DataTable
from nnode.data.readers.table import TableOptions
from nnode.data.sequence import Sequence
from nnode.data.sequences import Sequences, say_recognised
from nnode.data.store import Store
from nnode.errors import ConfigError, unknown_value

Table = str | Path | pd.DataFrame


def model_options(
    model: str | Mapping[str, Any],
    leader: str | None = None,
    effects: ListLike[str | Mapping[str, Any]] = (),
) -> dict[str, Any]:
    """A model's options with the defaults of its schema.

    Args:
        model: a name as in ``conf/model``, or options with their ``term``.
        leader: leader of a traffic model whose options have none; None takes the default.
        effects: effects in place of those in the options.

    Raises:
        ConfigError: an unknown name, term or option.
    """
    schema, values = _schema_and_values("model", model)
    given = {**values}
    if hasattr(schema, "leader") and leader is not None:
        given.setdefault("leader", leader)
    if effects:
        given["effects"] = list(effects)
    return plain(merged("model", schema, given))


def merged(section: str, schema: Any, *given: Mapping[str, Any]) -> DictConfig:
    """Options of a schema with given values.

    Raises:
        ConfigError: an unknown option, or a value of the wrong type.
    """
    options = OmegaConf.structured(schema)
    for values in given:
        plain_values = OmegaConf.to_container(values) if OmegaConf.is_config(values) else values
        for key, value in cast(Mapping[str, Any], plain_values).items():
            try:
                options.merge_with({key: value})
            except OmegaConfBaseException as error:
                path = str(error.full_key or key)
                full, config = f"{section}.{path}", OmegaConf.create({section: options})
                if isinstance(error, ConfigKeyError):
                    raise unknown_option(full, config, "nnode", "") from error
                culprit = reduce(getitem, path.split(".")[1:], value)
                message = str(error).splitlines()[0]
                raise wrong_value(full, f"{full}={culprit}", message, config) from error
    return cast(DictConfig, options)


def choice(
    group: str, chosen: str | Mapping[str, Any], further: Mapping[str, Any] | None = None
) -> DictConfig:
    """Options of a solver or an optimiser.

    Args:
        chosen: a name, or options with their ``name``.
        further: further options.

    Raises:
        ConfigError: an unknown name or option.
    """
    return merged(group, *_schema_and_values(group, chosen), further or {})


def _schema_and_values(
    group: str, chosen: str | Mapping[str, Any]
) -> tuple[Any, Mapping[Any, Any]]:
    """The schema of a choice, and its values: those of its name, or given ones.

    Raises:
        ConfigError: an unknown name or term.
    """
    if isinstance(chosen, str):
        return written(group, chosen)
    from nnode.config import SCHEMAS

    key = "term" if group == "model" else "name"
    kind = str(chosen.get(key, ""))
    schema = SCHEMAS.get((group, f"{kind}_schema"))
    if schema is None:
        names = [name for section, name in SCHEMAS if section == group]
        kinds = sorted(n.removesuffix("_schema") for n in names if n.endswith("_schema"))
        raise unknown_value(f"{group}.{key}", kind, kinds)
    return schema, {"name": kind, **chosen}


def sequences(
    table: pd.DataFrame | str | Path | Iterable[Sequence] | None = None,
    *,
    data: str | None = None,
    **options: Any,
) -> Sequences:
    """Trajectories of a table, or of a data set that nnode knows, as a list of sequences.

    Columns and units of a table are recognised by their names and contents, as by
    :func:`nnode.check`. A printed line states what was recognised. Given ``options`` have priority.

    Args:
        table: a data frame, the path of a table, or sequences, such as part of those of another
            call; None for data sets with known places.
        data: format, a name as in ``conf/data``: ``table``, ``pairs``, ``vehicles``, ``esimas``,
            ...; None recognises it.
        options: options of the data, as on the command line after ``data.``: ``columns={...}``,
            ``walls="walls.csv"``, ``recording="1-1_1"``, ``faults="keep"``, ...

    Raises:
        NNodeError: data or options are unknown; the table is invalid, with the row; or its columns
            or units are ambiguous, with both possibilities.
    """
    if table is not None and not isinstance(table, Table | DataTable):
        refuse_reading(data, options)
        return Sequences.of(table)
    if table is None and data is None:
        raise ConfigError("there is no table: give one, or name a data set: data='esimas'")
    return Sequences.of(*read_options(table, data, options))


def refuse_reading(data: str | None, options: Mapping[str, Any]) -> None:
    """Refuse reading options for sequences that have been read.

    Raises:
        ConfigError: an option is given.
    """
    given = [name for name, value in {"data": data, **options}.items() if value is not None]
    if given:
        raise ConfigError(
            f"{', '.join(given)}: these sequences are read already; give the table, or give the "
            "options to nnode.sequences(table, ...)"
        )


def read_options(
    table: pd.DataFrame | str | Path | None, data: str | None, given: Mapping[str, Any]
) -> tuple[pd.DataFrame | DataTable | str | Path | None, DataOptions]:
    """The source and the options for reading a table. The source None is the options' path.

    Args:
        data: group of the options; None recognises it.
        given: options with priority over recognised ones.

    Raises:
        NNodeError: see :func:`sequences`.
    """
    if table is None:
        return None, data_options(str(data), given)
    if data is not None and (data not in NEEDED or has_columns(table, data, given)):
        return table, data_options(data, given, in_memory=True)
    recognition = recognised(table, given.get("domain"), given)
    if data not in (None, recognition.group):
        return table, data_options(str(data), given, in_memory=True)
    say_recognised(recognition)
    options = changed_options(recognition.options)
    options |= {k: v for k, v in given.items() if k not in ("columns", "domain")}
    return recognition.table, data_options(recognition.group, options, in_memory=True)


def data_options(data: str, given: Mapping[str, Any], *, in_memory: bool = False) -> DataOptions:
    """Options of a data set by its name in ``conf/data``.

    Args:
        given: options that replace the file's.
        in_memory: whether the table is in memory and needs no path.

    Raises:
        ConfigError: the data set or an option is unknown, or a mandatory option is missing.
    """
    schema, defaults = written("data", data)
    options = merged("data", schema, defaults, given)
    if in_memory and OmegaConf.is_missing(options, "path"):
        options.path = ""
    try:
        return cast(DataOptions, options_of(options))
    except MissingMandatoryValue as error:
        raise ConfigError(f"data.{error.full_key} is not set; give it a value") from None


def data_of(given: Sequences) -> DataOptions:
    """The options with which sequences were read, or those of a table without a path."""
    options = _saved_options(given.manifest, given.manifest.get("options"))
    return options or TableOptions(domain=given.domain, path="")


def _saved_options(
    manifest: Mapping[str, Any], values: Mapping[str, Any] | None
) -> DataOptions | None:
    """Saved options of the reader that a manifest names; None if there is no such reader."""
    schema = next((kind for kind in FORMATS if kind.__name__ == manifest.get("reader")), None)
    if schema is None or values is None:
        return None
    return cast(DataOptions, options_of(merged("data", schema, with_present_names(values))))


def data_used(checkpoint: Checkpoint) -> Source:
    """The data of a run's calibration, read again from their files.

    Raises:
        ConfigError: the run's data were a table in memory.
        DataError: the files are missing.
    """
    values = checkpoint.config["data"]
    in_memory = values.get("path") == ""
    options = None if in_memory else _saved_options(checkpoint.manifest, values)
    if options is None:
        raise ConfigError("the run's data were a table in memory; give it again, as data=TABLE")
    if options.prepared is not None:
        return Store(Path(options.prepared).expanduser())
    return Sequences.of(None, options)


def table_options(
    data: Table,
    domain: str | None,
    walls: str | Path | None,
    folder: Path | None,
    further: Mapping[str, Any] | None = None,
) -> tuple[pd.DataFrame | DataTable | str | Path | None, DataOptions]:
    """A table as a data set, see :func:`read_options`. With ``folder``, a data frame is written to
    a file."""
    given = {"domain": domain, "walls": None if walls is None else str(Path(walls).absolute())}
    given = {**{k: v for k, v in given.items() if v is not None}, **(further or {})}
    table = data if isinstance(data, pd.DataFrame) else str(Path(data).expanduser().absolute())
    source, options = read_options(table, None, given)
    if isinstance(source, str | Path):
        options.path = str(source)  # type: ignore[attr-defined]
    frame = source.frame if isinstance(source, DataTable) else source
    if isinstance(frame, pd.DataFrame) and folder is not None and hasattr(options, "columns"):
        folder.mkdir(parents=True, exist_ok=True)
        path = str((folder / "table.parquet").absolute())
        frame.to_parquet(path, index=False)
        return None, replace(options, path=path)  # type: ignore[call-arg]
    return source, options
