"""What is handed over in Python in place of a configuration: tables, and choices by their names."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as ListLike
from difflib import get_close_matches
from pathlib import Path
from typing import Any, cast

import pandas as pd
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue

from nnode.app.cli.typed import written
from nnode.calibrate.checkpoint import Checkpoint
from nnode.calibrate.options import TrainerOptions
from nnode.data.dataset import Source
from nnode.data.options import DataOptions, TableOptions
from nnode.data.prepare import FORMATS
from nnode.data.sequences import Sequences, columns, seen_options
from nnode.data.store import Store
from nnode.errors import ConfigError
from nnode.models.field import FIELD, NEURONS
from nnode.models.field_crowd import PEOPLE
from nnode.program import configuration

#: Models by the names that ``conf/model`` gives them.
MODELS: dict[str, dict[str, Any]] = {
    "lin": {"term": "lin"},
    "log": {"term": "log"},
    "n2": {"term": "network_speed", "hidden": 2},
    "n4": {"term": "network_speed", "hidden": 4},
    "n10": {"term": "network_speed", "hidden": 10},
    **{
        name: {"term": "formula", "law": law, "network": NEURONS.get(name)}
        for name, law in FIELD.items()
    },
    **{name: {"term": "formula", "law": law} for name, law in PEOPLE.items()},
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
    except Exception as error:  # omegaconf's own errors share no narrower class
        raise ConfigError(f"{section}: {str(error).splitlines()[0]}") from error


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
    table: pd.DataFrame | str | Path | None = None, *, data: str | None = None, **options: Any
) -> Sequences:
    """Trajectories of a table, or of a data set that nnode knows, as a list of sequences.

    Args:
        table: a data frame, or the path of one; None for data sets that say where they are.
        data: how it is read, a name as in ``conf/data``: ``table``, ``pairs``, ``vehicles``,
            ``esimas``, ...; None: as the columns show, in SI units.
        options: of those data, as on the command line behind ``data.``: ``columns={...}``,
            ``walls="walls.csv"``, ``recording="1-1_1"``, ``faults="keep"``, ...

    Raises:
        NNodeError: unknown data or options, or a table that does not fit; with the row.
    """
    given = dict(options)
    if data is None:
        seen = seen_options(table)
        data = seen.name
        if isinstance(seen, TableOptions):
            given.setdefault("domain", seen.domain)
    return Sequences.of(table, data_options(data, given, in_memory=table is not None))


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
    options = cast(DataOptions, OmegaConf.to_object(merged("data", schema, told)))
    if options.prepared is not None:
        return Store(Path(options.prepared).expanduser())
    return Sequences.of(None, options)


def table_options(
    data: Table, domain: str | None, walls: str | Path | None, folder: Path | None
) -> TableOptions:
    """A tidy table as a data set; a data frame becomes a file where there is a folder for it."""
    path = "" if isinstance(data, pd.DataFrame) else str(Path(data).expanduser().absolute())
    if isinstance(data, pd.DataFrame) and folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        path = str((folder / "table.parquet").absolute())
        data.to_parquet(path, index=False)
    if domain is None:
        domain = "crowd" if "y" in columns(data) else "traffic"
    return TableOptions(
        domain=domain, path=path, walls=None if walls is None else str(Path(walls).absolute())
    )
