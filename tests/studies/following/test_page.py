"""The page from synthetic results, whose figures are known."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pandas as pd
import pytest

from nnode.data.sequence import collate
from nnode.pages.page import TableBlock, write_page
from studies.following import printed, stability
from studies.following.data import LEADERS, PAIRS, PLATOONS
from studies.following.results import Study
from studies.following.study import after, blocks, training
from studies.following.tasks import EVERY, OBJECTIVES, costs_of, key, named
from studies.frame import tidy
from studies.options import FollowingStudyOptions
from studies.runner import Task
from tests.studies.following.test_fit import helly_pairs

#: Held-out and test error of each candidate, m.
ERRORS = {"idm": (5.0, 3.0), "helly": (4.5, 3.2), "idm + memory": (4.0, 2.8)}
MAKES = list(printed.platoon_errors)


def synthetic_results() -> dict[str, dict[str, Any]]:
    result: dict[str, dict[str, Any]] = {
        "floor": {"costs": [1.0] * 6, "limits": [[]] * 5 + [["v0"]]},
        "reproduced-platoon": {"law": printed.platoon_errors, "stopped": printed.platoon_errors},
        "reproduced-pairs": {
            f"{law} {o}": [value] * 20
            for law, row in printed.errors.items()
            for o, value in zip(printed.objectives, row, strict=True)
        },
    }
    for name, (held, test) in ERRORS.items():
        cost = costs_of(EVERY[name], collate(helly_pairs(1)))
        row, values = cost.start.tolist(), named(cost, cost.start)
        noise = 0.1 * np.arange(6)
        result[f"cv-{key(name)}"] = {
            "row": row,
            "parameters": values,
            "limits": [],
            "clusters": [0, 0, 1, 1, 2, 2],
            "train": (noise + held - 0.5).tolist(),
            "heldout": {o: (noise + held).tolist() for o in OBJECTIVES},
        }
        result[f"test-{key(name)}"] = {"costs": (noise + test).tolist()}
        result[f"objectives-{key(name)}"] = {
            o: {
                "reached": {x: 1.0 + (x != o) for x in OBJECTIVES},
                "parameters": values,
                "limits": [],
            }
            for o in OBJECTIVES
        }
        factors = np.array([0.5, 0.8, 1.0, 1.25, 2.0])
        rise = np.log(factors) ** 2
        result[f"precision-{key(name)}"] = {
            "names": list(values),
            "row": row,
            "half": [0.2] * len(row),
            "correlation": np.eye(len(row)).tolist(),
            "profiles": {
                n: {
                    "values": (factors * v).tolist(),
                    "rise": rise.tolist(),
                    "low": (rise - 0.1).tolist(),
                    "high": (rise + 0.1).tolist(),
                }
                for n, v in values.items()
            },
        }
    idm = result["cv-idm"]["parameters"]
    result["halves"] = {
        "names": list(idm),
        "centre": list(idm.values()),
        "spread": [0.1] * 5,
        "between": [1.0] * 5,
        "pooled": [4.0] * 6,
        "alone": [6.0] * 6,
        "shrunk": [3.0] * 6,
        "strengths": [0.1, 1.0],
        "clusters": [0, 0, 1, 1, 2, 2],
    }
    for name, fold, heldout in (("idm", 2.0, 3.0), ("helly", 3.0, 1.0)):
        result[f"platoon-{name}"] = {
            "makes": MAKES,
            "chosen": [fold] * 4,
            "train": [fold] * 4,
            "heldout": [heldout] * 4,
            "parameters": [idm] * 4,
            "limits": [[]] * 4,
        }
    result["runs"] = {
        "runs": ["a", "a", "b", "b"],
        "makes": MAKES,
        "settings": ["min", "max", "none", "min"],
        "costs": [1.0] * 4,
        "limits": [[]] * 4,
        "parameters": [{**idm, "T": T} for T in (0.8, 2.5, 1.5, 1.0)],
    }
    rows = {"both": [30, 1.2, 2, 1.3, 1.7], "HV": [30, 1.0, 2, 1.3, 1.7], "CAV": [30, 1.5, 2, 1, 2]}
    result["leaders"] = {
        "names": list(idm),
        "kinds": ["HV", "CAV"] * 3,
        "clusters": [0, 0, 1, 1, 2, 2],
        "rows": rows,
        "speed": [10.0] * 6,
        "gap": [20.0] * 6,
        "without": {k: [[x + d for x in row] for d in (-0.01, 0, 0.01)] for k, row in rows.items()},
        "heldout": {k: [1.0] * 6 for k in rows},
        "costs": {k: [1.0] * 6 for k in rows},
    }
    return result


@pytest.fixture
def study(monkeypatch: pytest.MonkeyPatch) -> Study:
    store = SimpleNamespace(folder="", manifest={"files": {}})
    stores = cast(Any, dict.fromkeys((PAIRS, PLATOONS, LEADERS), store))
    monkeypatch.setattr(Study, "pairs", lambda self, test=False: tuple(helly_pairs()))
    monkeypatch.setattr(stability, "platoon", lambda *args, **extra: np.full(11, 0.05))
    options, results = FollowingStudyOptions(), synthetic_results()

    def done(tasks: list[Task]) -> pd.DataFrame:
        return tidy([task for task in tasks if task.key in results], results)

    result = Study(options, stores, done(training(options, stores)))
    result.results = pd.concat([result.results, done(after(result))])
    return result


@pytest.mark.thorough
def test_tables(study: Study, tmp_path: Path) -> None:
    page = blocks(study)
    tables = {b.name: b.frame for b in page if isinstance(b, TableBlock)}
    assert study.order == ["idm + memory", "helly", "idm"] == list(tables["candidates"].index)
    difference = tables["candidates"].loc["idm + memory", ["minus idm", "from", "to"]]
    assert list(difference) == pytest.approx([-1.0, -1.0, -1.0])
    assert tables["test"].loc["idm + memory", "test"] == pytest.approx(3.05)
    assert tables["test"].loc["helly", "minus idm"] == pytest.approx(0.2)
    assert tables["published"]["difference"].abs().max() == pytest.approx(0)
    # chosen by the first 70 % only
    assert list(tables["platoon"].index[:2]) == ["idm", "helly"]
    assert tables["platoon"].loc["idm", "last 30 %"] == pytest.approx(3.0)
    assert tables["platoon"].loc["chosen by follower", "last 30 %"] == pytest.approx(3.0)
    assert tables["drivers"].loc["shrunk", "minus pooled"] == pytest.approx(-1)
    assert tables["time_gaps"].loc["ACC, min", "median"] == pytest.approx(0.9)
    ends = tables["leaders"][["from", "to"]].astype(float).prod(axis=1)
    assert list(ends.index[ends > 0]) == ["T", "a", "b"]
    paths = write_page(page, tmp_path, title="Car following")
    assert all(path.stat().st_size for path in paths)


def test_keys_of_tasks_are_unique(study: Study) -> None:
    first, later = training(study.options, study.stores), after(study)
    assert {task.key for task in first} == {f"cv-{key(name)}" for name in EVERY}
    keys = [task.key for task in (*first, *later)]
    assert len(set(keys)) == len(keys)
    assert {"precision-idm", "precision-idm-memory"} < set(keys)
