"""One sequence as an Arrow table, and back: the columns of the project's own tidy table."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from nnode.data.sequence import Sequence

_AXES = ("x", "y")
_TEXT = ("sequence", "recording", "agent", "kind", "group")
#: Columns of vectors, without the axis that follows: the sequence's field, and its unit.
_VECTORS = {
    "": ("x", "m"),
    "v": ("v", "m/s"),
    "dest_": ("destination", "m"),
    "preferred_": ("preferred", "m/s"),
}


def schema(dims: int) -> pa.Schema:
    """Columns of the table for ``dims`` space dimensions; units stand in the metadata."""
    vectors = {
        prefix: {prefix + axis: unit for axis in _AXES[:dims]}
        for prefix, (_, unit) in _VECTORS.items()
    }
    units = {"sequence": "", "recording": "", "time": "s", "agent": "", **vectors[""]}
    units |= {**vectors["v"], "length": "m", "kind": "", "group": "", **vectors["dest_"]}
    units |= vectors["preferred_"] if dims > 1 else {}
    return pa.schema(
        pa.field(name, pa.float64(), metadata={"unit": unit})
        if unit
        else pa.field(name, pa.string())
        for name, unit in units.items()
    )


def open_writer(path: Path, dims: int) -> pq.ParquetWriter:
    """Open a table for writing, one call of ``write_table`` per sequence."""
    # Checksums let a reader notice a flipped bit, which the format alone does not.
    return pq.ParquetWriter(
        path,
        schema(dims),
        compression="zstd",
        use_dictionary=list(_TEXT),
        write_page_checksum=True,
    )


def to_table(item: Sequence) -> pa.Table:
    """The rows of one sequence, agents fastest; what the sequence has not stays empty."""
    k, n, dims = item.x.shape
    rows = k * n
    columns: dict[str, Any] = {
        "sequence": [item.name] * rows,
        "recording": [item.recording] * rows,
        "time": np.repeat(item.time, n),
        "agent": list(item.agents or map(str, range(n))) * k,
        "length": None if item.length is None else np.tile(item.length, k),
        "kind": list(item.kind) * k if item.kind else None,
        "group": list(item.group) * k if item.group else None,
    }
    for prefix, (field, _) in _VECTORS.items():
        values = getattr(item, field)
        for d, axis in enumerate(_AXES[:dims]):
            # destinations and preferred velocities are those of all times
            columns[prefix + axis] = (
                None if values is None else np.broadcast_to(values[..., d], (k, n)).ravel()
            )
    fields = schema(dims)
    arrays = [
        pa.nulls(rows, field.type)
        if columns[field.name] is None
        else pa.array(columns[field.name], field.type, from_pandas=False)
        for field in fields
    ]
    return pa.Table.from_arrays(arrays, schema=fields)


def to_sequence(table: pa.Table, entry: dict[str, Any], walls: np.ndarray | None) -> Sequence:
    """The sequence that a row group holds.

    Args:
        table: the row group.
        entry: what the manifest's index says about the sequence.
        walls: ``(W, 4)`` m, which the table does not hold.

    Raises:
        ValueError: the rows are not those that the index promises.
    """
    k, n = entry["n_samples"], entry["n_agents"]
    if table.num_rows != k * n or table["sequence"][0].as_py() != entry["name"]:
        raise ValueError(f"expected {k * n} rows of {entry['name']}, found {table.num_rows} rows")

    def numbers(name: str) -> np.ndarray | None:
        column = table[name]
        if column.null_count == table.num_rows:
            return None
        if column.null_count:
            raise ValueError(f"column {name} holds {column.null_count} empty cells")
        return np.array(column.to_numpy()).reshape(k, n)

    def vectors(prefix: str) -> np.ndarray | None:
        columns = [numbers(prefix + a) for a in _AXES if prefix + a in table.column_names]
        known_columns = [column for column in columns if column is not None]
        return np.stack(known_columns, axis=-1) if known_columns else None

    def names(name: str) -> tuple[str, ...] | None:
        values = table[name].slice(0, n).to_pylist()
        return None if None in values else tuple(values)

    time, of_agents = numbers("time"), {"length": numbers("length")}
    values = {field: vectors(prefix) for prefix, (field, _) in _VECTORS.items()}
    if time is None or values["x"] is None:
        raise ValueError("the columns of times or positions are empty")
    of_agents |= {field: values.pop(field) for field in ("destination", "preferred")}
    fields = values | {k: None if v is None else v[0].copy() for k, v in of_agents.items()}
    return Sequence(
        name=entry["name"],
        recording=entry["recording"],
        site=entry.get("site", ""),
        split=entry.get("split", ""),
        time=time[:, 0].copy(),
        agents=(names("agent") or ()) if entry["agents"] else (),
        kind=names("kind"),
        group=names("group"),
        walls=walls,
        **fields,
    )
