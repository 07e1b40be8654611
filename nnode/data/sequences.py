"""Sequences in memory: a list to index, divide and look at, measured or simulated."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Iterator, Mapping
from collections.abc import Sequence as ListLike
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np
import pandas as pd
from platformdirs import user_cache_path

from nnode.data._arrow import to_table
from nnode.data.check.recognise import Recognised, recognised
from nnode.data.clusters import clusters, index_of
from nnode.data.cut import LaneOptions
from nnode.data.options import DataOptions
from nnode.data.prepare import format_of, judge
from nnode.data.readers.columns import Table
from nnode.data.readers.recordings import reading
from nnode.data.sequence import Domain, Sequence, check_interval
from nnode.errors import ConfigError, DataError

if TYPE_CHECKING:
    from xarray import Dataset

log = logging.getLogger(__name__)

#: Units of the columns of :meth:`Sequences.to_dataframe`.
UNITS = {"time": "s", "x": "m", "y": "m", "vx": "m/s", "vy": "m/s", "length": "m"}

#: Sequences that a notebook shows.
_SHOWN = 8


class Sequences:
    """Measured or simulated trajectories, one :class:`Sequence` after another.

    A sequence is a sample in the words of scikit-learn: ``X[3]`` is one sequence, ``X[:5]``,
    ``X[[0, 2]]`` and ``X[mask]`` are several. :attr:`groups` are what its splitters call groups.

    Args:
        items: of one domain, with unique names.
        manifest: where they come from.

    Attributes:
        manifest: as given.
        index: per sequence what splits and clusters need to know, see
            :func:`nnode.data.clusters.index_of`.

    Raises:
        DataError: no sequence, two of one name, lanes beside crowds, or a sampling interval that
            no recording has.
    """

    def __init__(self, items: Iterable[Sequence], manifest: Mapping[str, Any] | None = None):
        self._items = tuple(items)
        self.manifest = dict(manifest or {})
        wrong = [item for item in self._items if not isinstance(item, Sequence)]
        if wrong or not self._items:
            what = f"an entry of type {type(wrong[0]).__name__}" if wrong else "nothing"
            raise DataError(
                f"expected a data frame, the path of a table, or sequences, found {what}; "
                "nnode.sequences(table) makes them"
            )
        names = [item.name for item in self._items]
        twice = sorted({name for name in names if names.count(name) > 1}) if names else []
        if twice:
            raise DataError(f"two sequences are named {twice[0]}; names must be unique")
        for item in self._items:
            check_interval(item.dt, f"sequence {item.name}", "give its times in seconds")
        if len({item.x.shape[2] for item in self._items}) > 1:
            raise DataError("sequences of lanes and of crowds cannot stand in one list")
        self.index = index_of(self._items)

    @classmethod
    def of(cls, source: Any, options: DataOptions | None = None) -> Sequences:
        """Sequences from whatever holds them, faulty ones sorted out as the options say.

        Args:
            source: sequences; a data frame; the path of a table; None: what the options name.
            options: of the data; by default as names and numbers show, see
                :func:`nnode.data.check.recognise.recognised` and ``docs/data.md``.

        Raises:
            NNodeError: what is no such table; with the row, or what was expected.
        """
        if isinstance(source, cls):
            return source
        if not isinstance(source, pd.DataFrame | Table | str | Path) and source is not None:
            if not isinstance(source, Iterable):
                raise DataError(
                    f"expected a data frame, the path of a table, or sequences, found "
                    f"{type(source).__name__}"
                )
            return cls(source)
        if options is None:
            if source is None:
                raise ConfigError(
                    "there is no table: give one, or name a data set, as in data='esimas'"
                )
            if isinstance(source, Table):
                source = source.frame
            with reading("the table" if isinstance(source, pd.DataFrame) else source):
                recognised_source = recognised(source)
            say_recognised(recognised_source)
            source, options = recognised_source.table, recognised_source.options
        if source is not None and not isinstance(source, pd.DataFrame | Table):
            if not hasattr(options, "path"):
                raise ConfigError(f"data={options.name} is no table: leave the path out")
            options = replace(options, path=str(Path(source).expanduser()))  # type: ignore[call-arg]
        memory = isinstance(source, pd.DataFrame | Table)
        with reading("the table" if memory or source is None else source):
            files = _files(options, source if memory else None)
            judged = judge(options, files, format_of(options).sequences(files, options))
        return cls(judged.kept, judged.manifest)

    @property
    def domain(self) -> Domain:
        """``traffic`` or ``crowd``."""
        return "traffic" if self._items[0].x.shape[2] == 1 else "crowd"

    @property
    def groups(self) -> np.ndarray:
        """``(S,)`` number of the cluster of each sequence: those that share an agent are one."""
        return clusters(self.index)

    def __len__(self) -> int:
        return len(self._items)

    def __iter__(self) -> Iterator[Sequence]:
        return iter(self._items)

    @overload
    def __getitem__(self, key: int) -> Sequence: ...
    @overload
    def __getitem__(self, key: slice | ListLike[int] | np.ndarray) -> Sequences: ...
    def __getitem__(self, key: Any) -> Sequence | Sequences:
        if isinstance(key, int | np.integer):
            return self._items[key]
        if isinstance(key, slice):
            return Sequences(self._items[key], self.manifest)
        places = np.arange(len(self))[np.asarray(key)]
        return Sequences((self._items[i] for i in places), self.manifest)

    def score(self, measured: Any) -> float:
        """How near these trajectories are to measured ones: minus the root mean square distance, m.

        Over all agents and all samples after the first, where a simulation starts: the RMSE that
        ``nnode evaluate`` prints, so that higher is better and 0 the best. Leaders are left out
        where the model was given their measured paths (``manifest["led"]``).

        Args:
            measured: sequences, or a table, with the same sequences and agents.

        Raises:
            DataError: they are others.
        """
        simulated = {item.name: item for item in self._items}
        total, number = 0.0, 0
        for other in Sequences.of(measured):
            mine = simulated.get(other.name)
            if mine is None or mine.x.shape != other.x.shape:
                raise DataError(
                    f"sequence {other.name} is not among the simulated ones, or has other agents "
                    "or times; score what was predicted from the same table"
                )
            free = slice(-1) if self.manifest.get("led") else slice(None)
            away = ((mine.x - other.x)[1:, free] ** 2).sum(-1)
            total, number = total + float(away.sum()), number + away.size
        return -float(np.sqrt(total / max(number, 1)))

    def to_dataframe(self) -> pd.DataFrame:
        """A tidy table in SI units, one row per sequence, time and agent.

        Columns are those that ``data=table`` reads, with speeds ``vx``, ``vy`` where they are
        known. ``sequence``, ``time`` and ``agent`` are the keys of the table that was read.
        """
        tables = [to_table(item).to_pandas().dropna(axis=1, how="all") for item in self._items]
        table = pd.concat(tables, ignore_index=True)
        run = table["recording"] + "/"
        pairs = zip(table["sequence"], run, strict=True)
        table["sequence"] = [name.removeprefix(prefix) for name, prefix in pairs]
        for key in ("sequence", "agent"):
            if all(re.fullmatch(r"0|[1-9]\d{0,17}", name) for name in table[key].unique()):
                table[key] = table[key].astype("int64")
        goals = [key for key in table if str(key).startswith("dest_")]
        return table.drop(columns=goals) if self.domain == "traffic" else table

    def to_xarray(self) -> Dataset:
        """Positions, and speeds where they are known, with sequence, sample and agent as axes.

        Shorter sequences are filled up with NaN. Needs xarray: ``pip install 'nnode[xarray]'``.
        """
        from nnode.files import xarray

        xarray()  # says how to install it where it is missing
        tables = [
            to_table(s)
            .to_pandas()
            .assign(
                sample=np.repeat(np.arange(s.n_samples), s.n_agents),
                place=np.tile(np.arange(s.n_agents), s.n_samples),
            )
            for s in self._items
        ]
        table = pd.concat(tables).set_index(["sequence", "sample", "place"])
        keys = [key for key in ("x", "y", "vx", "vy") if key in table and table[key].notna().any()]
        data = table[[*keys, "time", "agent"]].to_xarray()
        names = [s.name for s in self._items]
        data = data.reindex(sequence=names).assign_coords(sequence=names)
        data["time"] = data["time"].max("place")
        data["agent"] = data["agent"].isel(sample=0).fillna("")
        for key in (*keys, "time"):
            data[key].attrs["units"] = UNITS[key]
        return data.set_coords(["time", "agent"]).drop_vars(["sample", "place"])

    def _about(self) -> str:
        number = int(self.groups.max()) + 1
        kind = "vehicles in lanes" if self.domain == "traffic" else "people"
        return (
            f"{len(self)} sequence{'s' * (len(self) > 1)} of {kind}, {number} "
            f"cluster{'s' * (number > 1)} of those that share an agent"
        )

    def __repr__(self) -> str:
        return f"<nnode.Sequences: {self._about()}>"

    def _repr_html_(self) -> str:
        rows = [
            (s.name, s.n_agents, s.n_samples, s.dt, s.time[0], s.time[-1])
            for s in self._items[:_SHOWN]
        ]
        heads = ["sequence", "agents", "samples", "step (s)", "from (s)", "to (s)"]
        table = pd.DataFrame(rows, columns=heads).to_html(index=False, border=0)
        others = f"<p>and {len(self) - _SHOWN} more</p>" if len(self) > _SHOWN else ""
        return f"<p>{escape(self._about())}</p>{table}{others}"


def say_recognised(source: Recognised) -> None:
    """Tell how a table is read, where its names or units are not those of its format."""
    if source.line:
        log.warning("%s", source.line)


def _files(options: DataOptions, frame: pd.DataFrame | Table | None) -> dict[str, Any]:
    """What a format reads: files, or a table in memory."""
    layout = format_of(options)
    if frame is None:
        cache = str(user_cache_path("nnode") / "raw")
        return layout.files(replace(options, download=options.download or cache))
    if layout.tables:
        return layout.files(options, frame if isinstance(frame, Table) else Table(frame))
    lanes = "lanes of another program" if isinstance(options, LaneOptions) else "files"
    raise ConfigError(
        f"data={options.name} are {lanes} and no data frame; give their path, or rename the "
        "columns and take data='table', 'pairs' or 'vehicles'"
    )
