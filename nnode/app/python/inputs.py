"""What is handed over in Python in place of a configuration: tables, and choices by their names."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as ListLike
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, cast

import pandas as pd
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException, ValidationError

from nnode.app.cli.mistakes import unknown_option, wrong_value
from nnode.app.cli.typed import plain_options, written
from nnode.app.python.words import python_words
from nnode.calibrate.checkpoint import Checkpoint
from nnode.calibrate.options import TrainerOptions
from nnode.data.check.recognise import NEEDED, has_columns, recognised
from nnode.data.dataset import Source
from nnode.data.options import DataOptions, with_present_names
from nnode.data.prepare import FORMATS
from nnode.data.readers.columns import Table as DataTable
from nnode.data.readers.table import TableOptions
from nnode.data.sequences import Sequences, say_recognised
from nnode.data.store import Store
from nnode.errors import ConfigError
from nnode.model.laws import LAW_MODELS
from nnode.program import configuration

#: Models by their names: those of ``conf/model``, and the laws of the package.
MODELS: dict[str, dict[str, Any]] = {
    "lin": {"term": "lin"},
    "log": {"term": "log"},
    "n2": {"term": "network_speed", "hidden": 2},
    "n4": {"term": "network_speed", "hidden": 4},
    "n10": {"term": "network_speed", "hidden": 10},
    **LAW_MODELS,
    "formula": {"term": "formula"},
    "sf": {"term": "social_force"},
    "nn": {"term": "network_force"},
}

Table = str | Path | pd.DataFrame


def model_options(
    model: str | Mapping[str, Any],
    leader: str | None = None,
    effects: ListLike[str | Mapping[str, Any]] = (),
) -> dict[str, Any]:
    """A model's options with the defaults of its schema.

    Args:
        model: a name as in ``conf/model``, or options with their ``term``.
        leader: of a traffic model that does not say so itself; None: its default.
        effects: in place of those that the options name.

    Raises:
        ConfigError: an unknown name, term or option.
    """
    from nnode.config import SCHEMAS

    given = named(model)
    term = str(given.get("term", ""))
    schema = SCHEMAS.get(("model", f"{term}_schema"))
    if schema is None:
        known = sorted({node.term for (group, _), node in SCHEMAS.items() if group == "model"})
        raise ConfigError(f"model.term={term} is unknown, expected one of {', '.join(known)}")
    if hasattr(schema, "leader") and leader is not None:
        given.setdefault("leader", leader)
    if effects:
        given["effects"] = list(effects)
    found = OmegaConf.to_container(merged("model", schema, given), enum_to_str=True)
    assert isinstance(found, dict)
    return {str(key): value for key, value in found.items()}


def merged(section: str, schema: Any, *given: Mapping[str, Any]) -> DictConfig:
    """Options of a schema with the values that are given.

    Raises:
        ConfigError: an option that there is not, or a value of another type.
    """
    try:
        return cast(DictConfig, OmegaConf.merge(OmegaConf.structured(schema), *given))
    except OmegaConfBaseException as error:
        said = str(error).splitlines()[0]
        key = str(error.full_key or _culprit(schema, given))
        known = OmegaConf.create({section: OmegaConf.structured(schema)})
        if not isinstance(error, ValidationError):
            raise unknown_option(f"{section}.{key}", known, "nnode", "") from error
        every = OmegaConf.merge(*given)
        value = OmegaConf.select(every, key)
        full = f"{section}.{key}"
        raise wrong_value(full, f"{full}={value}", said, known) from error
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{section}: {str(error).splitlines()[0]}") from error


def _culprit(schema: Any, given: tuple[Mapping[str, Any], ...]) -> str:
    """The option whose value is of another type than it must be."""
    for options in given:
        for key, value in options.items():
            try:
                OmegaConf.merge(OmegaConf.structured(schema), {key: value})
            except OmegaConfBaseException:
                return str(key)
    return ""


def choice(
    group: str, chosen: str | Mapping[str, Any], more: Mapping[str, Any] | None = None
) -> DictConfig:
    """Options of a solver, an optimiser or the trainer.

    Args:
        chosen: a name, or options with their ``name``; of the trainer options alone.
        more: further options.

    Raises:
        ConfigError: an unknown name or option.
    """
    from nnode.config import SCHEMAS

    given = {"name": chosen} if isinstance(chosen, str) else dict(chosen)
    if group == "trainer":
        return merged(group, TrainerOptions, given)
    known = {key.removesuffix("_schema"): of for (own, key), of in SCHEMAS.items() if own == group}
    name = str(given.get("name", ""))
    if name not in known:
        raise ConfigError(f"{group}={name} is unknown, expected one of {', '.join(known)}")
    return merged(group, known[name], given, more or {})


def named(model: str | Mapping[str, Any]) -> dict[str, Any]:
    """A model's options by its name.

    Raises:
        ConfigError: an unknown name.
    """
    if not isinstance(model, str):
        return {"name": model.get("term", ""), **model}
    if model not in MODELS:
        raise ConfigError(f"model={model} is unknown, expected one of {', '.join(MODELS)}")
    return {"name": model, **MODELS[model]}


def sequences(
    table: pd.DataFrame | str | Path | Sequences | None = None,
    *,
    data: str | None = None,
    **options: Any,
) -> Sequences:
    """Trajectories of a table, or of a data set that nnode knows, as a list of sequences.

    Columns and units of a table are recognised by their names and by what they hold, as
    :func:`nnode.check` does; a line says what was recognised. What ``options`` say wins.

    Args:
        table: a data frame, or the path of one; None for data sets that say where they are.
        data: how it is read, a name as in ``conf/data``: ``table``, ``pairs``, ``vehicles``,
            ``esimas``, ...; None: as the table shows.
        options: of those data, as on the command line behind ``data.``: ``columns={...}``,
            ``walls="walls.csv"``, ``recording="1-1_1"``, ``faults="keep"``, ...

    Raises:
        NNodeError: unknown data or options, a table that does not fit, with the row, or one whose
            columns or units may be two things; names both.
    """
    with python_words():
        if isinstance(table, Sequences):
            refuse_reading(data, options)
            return table
        if table is None and data is None:
            raise ConfigError("there is no table: give one, or name a data set: data='esimas'")
        source, found = read_options(table, data, options)
        return Sequences.of(source, found)


def refuse_reading(data: str | None, options: Mapping[str, Any]) -> None:
    """Refuse options of reading for what was read already.

    Raises:
        ConfigError: names them.
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
    """The options that read a table, and what they read: None the file that they name.

    Args:
        data: the group of the options; None: as the table shows.
        given: options that win over what is recognised.

    Raises:
        NNodeError: see :func:`sequences`.
    """
    if table is None:
        return None, data_options(str(data), given)
    if data is not None and (data not in NEEDED or has_columns(table, data, given)):
        return table, data_options(data, given, in_memory=True)
    found = recognised(table, given.get("domain"), given)
    if data not in (None, found.group):
        return table, data_options(str(data), given, in_memory=True)
    say_recognised(found)
    values, own = plain_options(found.options), plain_options(type(found.options)())
    known = {k: v for k, v in values.items() if v != own[k] and k != "name"}
    more = {k: v for k, v in given.items() if k not in ("columns", "domain")}
    options = data_options(found.group, {**known, **more}, in_memory=True)
    return found.table, options


def data_options(data: str, given: Mapping[str, Any], *, in_memory: bool = False) -> DataOptions:
    """Options of a data set by its name in ``conf/data``.

    Args:
        given: those that are not left as they are there.
        in_memory: whether the table is handed over, so that no path has to be given.

    Raises:
        ConfigError: an unknown data set or option, or one that must be given.
    """
    known = {path.stem for path in (configuration() / "data").glob("*.yaml")}
    if data not in known:
        near = get_close_matches(data, known, n=1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise ConfigError(
            f"data={data} is unknown, expected one of {', '.join(sorted(known))}{hint}"
        )
    schema, own = written("data", data)
    found = merged("data", schema, own, given)
    if in_memory and OmegaConf.is_missing(found, "path"):
        found.path = ""
    try:
        return cast(DataOptions, OmegaConf.to_object(found))
    except MissingMandatoryValue as error:
        raise ConfigError(f"data.{error.full_key} is not set; give it a value") from None


def data_of(given: Sequences) -> DataOptions:
    """The options that sequences were read with; of others those of a table without a path."""
    reader, told = given.manifest.get("reader"), given.manifest.get("options")
    schema = next((kind for kind in FORMATS if kind.__name__ == reader), None)
    if schema is None or told is None:
        return TableOptions(domain=given.domain, path="")
    told = with_present_names(told)
    return cast(DataOptions, OmegaConf.to_object(merged("data", schema, told)))


def data_used(checkpoint: Checkpoint) -> Source:
    """The data that a run was calibrated to, read again from their files.

    Raises:
        ConfigError: the run does not tell where they are.
        DataError: they are no longer there.
    """
    reader, told = checkpoint.manifest.get("reader"), checkpoint.config["data"]
    schema = next((kind for kind in FORMATS if kind.__name__ == reader), None)
    if schema is None or told.get("path") == "":
        raise ConfigError("the run's data were a table in memory; give it again, as data=TABLE")
    told = with_present_names(told)
    options = cast(DataOptions, OmegaConf.to_object(merged("data", schema, told)))
    if options.prepared is not None:
        return Store(Path(options.prepared).expanduser())
    return Sequences.of(None, options)


def table_options(
    data: Table,
    domain: str | None,
    walls: str | Path | None,
    folder: Path | None,
    more: Mapping[str, Any] | None = None,
) -> tuple[pd.DataFrame | DataTable | str | Path | None, DataOptions]:
    """A table as a data set, see :func:`read_options`; a data frame becomes a file where there is
    a folder for it."""
    given = {"domain": domain, "walls": None if walls is None else str(Path(walls).absolute())}
    given = {**{k: v for k, v in given.items() if v is not None}, **(more or {})}
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
