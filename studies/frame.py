"""Results as tidy frames: a row per task, or per law and unit; means and differences of costs.

A unit is what a cost belongs to: a sequence, a pair of vehicles, a person. Units of one cluster
share agents or time, and are resampled together.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from nnode.calibrate.resampling import DRAWS, group_weights, paired
from nnode.data.store import Store
from studies.options import StudyOptions
from studies.runner import Task, run_tasks
from studies.stores import hash_of


def tidy(tasks: Iterable[Task], results: Mapping[str, Mapping[str, Any]]) -> pd.DataFrame:
    """A row per task, by its key: its function's name as ``task``, its arguments and results."""
    rows = {t.key: {"task": t.function.__name__, **t.arguments, **results[t.key]} for t in tasks}
    return pd.DataFrame(list(rows.values()), index=list(rows))


def computed(
    tasks: list[Task], folder: Path, options: StudyOptions, stores: Mapping[Any, Store], title: str
) -> pd.DataFrame:
    """The :func:`tidy` results of all tasks, which read some prepared data.

    Raises:
        Interrupted, StudyError: as :func:`studies.runner.run_tasks`.
    """
    results = run_tasks(
        tasks,
        folder,
        workers=options.workers or 1,
        fingerprint=hash_of(stores),
        cluster=options.cluster,
        title=title,
    )
    return tidy(tasks, results)


def labelled(rows: Mapping[tuple[Any, ...], Mapping[str, Any]], *names: str) -> pd.DataFrame:
    """A table of rows by labels of several levels."""
    return pd.DataFrame.from_dict(dict(rows), orient="index").rename_axis(list(names))


def by_unit(costs: Any, cluster: Iterable[Any], unit: Iterable[Any] | None = None) -> pd.DataFrame:
    """A column of costs per law, indexed by cluster and unit.

    Args:
        costs: law to a cost per unit.
    """
    cluster = list(cluster)
    names = range(len(cluster)) if unit is None else unit
    index = pd.MultiIndex.from_arrays([cluster, list(names)], names=["cluster", "unit"])
    return pd.DataFrame({law: list(values) for law, values in costs.items()}, index=index)


def clusters(costs: pd.DataFrame) -> np.ndarray:
    """``(U,)`` number of the cluster of each row of :func:`by_unit`."""
    return np.asarray(pd.factorize(costs.index.get_level_values("cluster"))[0])


def means(costs: pd.DataFrame, seed: int) -> pd.DataFrame:
    """Mean cost of each law with its 95 % percentile interval, clusters resampled.

    A law with an infinite cost has no interval.
    """
    weights = group_weights(clusters(costs), DRAWS, np.random.default_rng(seed))
    values = costs.to_numpy(float)
    finite = np.where(np.isfinite(values).all(0), values, np.nan)
    low, high = np.quantile(weights @ finite, [0.025, 0.975], axis=0)
    return pd.DataFrame({"mean": costs.mean(), "low": low, "high": high}, index=costs.columns)


def differences(costs: pd.DataFrame, pairs: Iterable[tuple[str, str]], seed: int) -> pd.DataFrame:
    """Paired differences of mean costs, first minus second, clusters resampled.

    Returns:
        Indexed by both laws: ``difference``, ``low`` and ``high`` of the 95 % interval, two-sided
        ``p`` from random signs of clusters, and ``better``, the share of units on which the first
        has the lower cost. Only the difference and ``better`` where a cost is infinite.
    """
    rows = {}
    for first, second in pairs:
        a, b = (costs[name].to_numpy(float) for name in (first, second))
        if np.isfinite(a).all() and np.isfinite(b).all():
            rows[first, second] = vars(paired(a, b, clusters(costs), seed))
        else:
            rows[first, second] = {
                "difference": a.mean() - b.mean(),
                "better": float((a < b).mean()),
            }
    columns = ["difference", "low", "high", "p", "better"]
    return labelled(rows, "first", "second").reindex(columns=columns)


def versus(costs: pd.DataFrame, reference: str, seed: int) -> pd.DataFrame:
    """Each law's :func:`means`, and its :func:`differences` from one of them.

    Returns:
        ``mean``, ``low``, ``high``; ``minus <reference>``, ``from``, ``to``; ``p``, ``better``.
    """
    away = differences(costs, [(str(law), reference) for law in costs], seed).droplevel("second")
    away.columns = pd.Index([f"minus {reference}", "from", "to", "p", "better"])
    return means(costs, seed).join(away)


def by_number(fits: pd.DataFrame, column: str) -> pd.DataFrame:
    """A row per number of a column of parameters that may be arrays.

    Args:
        fits: whose rows have different labels.

    Returns:
        The other columns, and ``parameter``, ``index`` in its array and ``value``.
    """
    each = fits[column].map(_numbers).explode()
    table = pd.DataFrame(list(each), index=each.index, columns=["parameter", "index", "value"])
    return fits.drop(columns=column).join(table).reset_index(drop=True)


def _numbers(parameters: Mapping[str, Any]) -> list[tuple[str, str, float]]:
    return [
        (name, " ".join(map(str, place)), float(value))
        for name, array in parameters.items()
        for place, value in np.ndenumerate(np.array(array))
    ]
