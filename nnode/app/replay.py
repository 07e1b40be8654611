"""Pages with animated trajectories, for an evaluated model and for user's tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from nnode.app.python.inputs import Table
from nnode.app.saved_run import SavedRun
from nnode.data.readers.columns import Table as DataTable
from nnode.data.readers.table import TableOptions, read_table
from nnode.data.sequence import Sequence, evenly
from nnode.diagnosis.report.replay import zone_of
from nnode.errors import DataError
from nnode.exchange.trajectories import simulated as simulated_by
from nnode.model.effects import Effect
from nnode.model.extend import effects_of
from nnode.pages.page import write_player
from nnode.pages.replay import MOST, ReplayBlock, Scene, Zone

_CAPTION = (
    "Outlines are measured agents. Arrows lead from the simulated to the measured position. The "
    "player opens on the sequence with the median error."
)


def replay(
    measured: Table,
    simulated: Table | Mapping[str, Table],
    path: str | Path,
    *,
    domain: str,
    walls: str | Path | None = None,
    zones: Iterable[Zone] = (),
) -> Path:
    """Write a page on which measured and simulated agents move side by side.

    Sequences and agents are matched by name. Simulations are interpolated linearly to the measured
    times.

    Args:
        measured: CSV or Parquet, or a data frame, with ``sequence, time, agent, x`` and, for a
            crowd, ``y``, SI units; see ``docs/data.md``.
        simulated: the same for a simulation, or title to the same for several simulations.
        path: path of the page, ``.html``, which needs no other file.
        domain: ``traffic`` or ``crowd``.
        walls: CSV with x1, y1, x2, y2, m.
        zones: places or times to shade.

    Returns:
        The path.

    Raises:
        NNodeError: a table has the wrong form, the tables have no common sequence, or the path
            cannot be written to.
    """
    tables = dict(simulated) if isinstance(simulated, Mapping) else {"simulated": simulated}
    real = _read(measured, domain, walls)
    models = {
        title: {s.name.rpartition("/")[2]: s for s in _read(table, domain, None)}
        for title, table in tables.items()
    }
    scenes = []
    for s in real:
        name = s.name.rpartition("/")[2]
        if all(name in sequences_of for sequences_of in models.values()):
            positions = {
                title: _at(sequences_of[name], s) for title, sequences_of in models.items()
            }
            scenes.append(Scene(s, positions))
    if not scenes:
        example = real[0].name.rpartition("/")[2]
        others = ", ".join(
            sorted({name for sequences_of in models.values() for name in sequences_of})[:5]
        )
        raise DataError(
            f"no sequence is both measured and simulated: those measured are called {example} and "
            "the "
            f"like, those simulated {others}; give both tables the same names in column 'sequence'"
        )
    block = ReplayBlock("replay", scenes, _CAPTION, _alt(scenes), list(zones), len(real))
    return write_player(block, Path(path), title="Measured and simulated")


def _read(table: Table, domain: str, walls: str | Path | None) -> list[Sequence]:
    source = DataTable(table) if isinstance(table, pd.DataFrame) else Path(table).expanduser()
    bounds = None if walls is None else Path(walls).expanduser()
    return read_table(source, TableOptions(domain=domain, path=""), bounds)


def _at(simulated: Sequence, measured: Sequence) -> np.ndarray:
    """Simulated positions of the measured agents at the measured times; NaN where missing."""
    x = np.full_like(measured.x, np.nan)
    place = {name: i for i, name in enumerate(simulated.agents)}
    for n, agent in enumerate(measured.agents):
        if agent in place:
            for d in range(x.shape[2]):
                x[:, n, d] = np.interp(
                    measured.time,
                    simulated.time,
                    simulated.x[:, place[agent], d],
                    left=np.nan,
                    right=np.nan,
                )
    return x


def write_replay(path: Path, run: SavedRun) -> Path:
    """Write a page with measured and simulated trajectories of a run's sequences.

    At most :data:`nnode.pages.replay.MOST` sequences are shown.
    """
    measured = [run.source[i] for i in evenly(run.indices, MOST)]
    simulations = simulated_by(run.simulate, measured, dtype=run.dtype, device=run.device)
    led = run.model.leader_measured
    scenes = [
        Scene(s, {run.name: path_of_model.x}, led=led)
        for s, path_of_model in zip(measured, simulations, strict=True)
    ]
    zones = [zone for effect in effects_of(run.model) if (zone := _zone(effect)) is not None]
    block = ReplayBlock("replay", scenes, _CAPTION, _alt(scenes), zones, len(run.indices))
    return write_player(block, path, title=f"{run.name}, measured and simulated")


def _zone(effect: Effect) -> Zone | None:
    options, settings = effect.options(), effect.settings
    at = {name: float(options[name]) for name in settings}
    return zone_of(effect.name, at, settings["a"].unit if "a" in settings else "")


def _alt(scenes: list[Scene]) -> str:
    return f"Player of {len(scenes)} sequences: agents as measured and as simulated."
