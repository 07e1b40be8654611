"""What is handed over in Python in place of a configuration: a table, and a model by its name."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from omegaconf import OmegaConf

from nnode.data.options import TableOptions
from nnode.errors import ConfigError
from nnode.models.field import FIELD, NEURONS
from nnode.models.field_crowd import PEOPLE

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


def model_options(model: str | Mapping[str, Any], leader: str) -> dict[str, Any]:
    """A model's options with the defaults of its schema.

    Args:
        model: a name as in ``conf/model``, or options with their ``term``.
        leader: of a traffic model that does not say so itself.

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
    if hasattr(schema, "leader"):
        given.setdefault("leader", leader)
    try:
        merged = OmegaConf.merge(OmegaConf.structured(schema), given)
    except Exception as error:  # omegaconf's own errors share no narrower class
        raise ConfigError(f"model: {str(error).splitlines()[0]}") from error
    found = OmegaConf.to_container(merged, enum_to_str=True)
    assert isinstance(found, dict)
    return {str(key): value for key, value in found.items()}


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


def table_options(data: Table, domain: str, walls: str | Path | None, folder: Path) -> TableOptions:
    """A table as a data set; one that is no file yet becomes one in ``folder``."""
    if isinstance(data, pd.DataFrame):
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / "table.parquet"
        data.to_parquet(path, index=False)
    else:
        path = Path(data)
    return TableOptions(
        domain=domain,
        path=str(path.absolute()),
        walls=None if walls is None else str(Path(walls).absolute()),
    )
