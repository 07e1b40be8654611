"""Page templates, tidy frames and options of studies; quick studies of the recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import pandas as pd
import pytest

from nnode.errors import ConfigError
from nnode.pages.page import FigureBlock, Heading, TableBlock, Text
from nnode.plots.style import new_figure
from studies import command, frame, page
from studies.options import CrowdStudyOptions, StudyOptions, TrafficStudyOptions, checked
from studies.runner import Task
from tests.studies.work import square

TEMPLATE = """
## First

Of {{ number | digits }} numbers.
{% call table("t", study, digits={"": 1, "b": 3}, lowest=["a"], head=2) %}
Two
rows.
{% endcall %}
### Second
{% call figure("f", drawn, "A line.") %}A figure.{% endcall %}
End.
"""
TABLE = pd.DataFrame({"a": [3.0, 2.0, 1.0], "b": [1.0, 2.0, 3.0]}, index=["x", "y", "z"])


@pytest.fixture
def loader(monkeypatch: pytest.MonkeyPatch) -> None:
    templates = jinja2.DictLoader({"page.md.j2": TEMPLATE})
    monkeypatch.setattr(page, "PackageLoader", lambda *_: templates)


def test_blocks_of_a_template(loader: None) -> None:
    blocks = page.page("x", TABLE, number=2.0, drawn=new_figure(1, 1))
    first, text, table, second, figure, end = blocks
    assert (first, second) == (Heading("First", 2), Heading("Second", 3))
    assert (text, end) == (Text("Of 2.00 numbers."), Text("End."))
    assert isinstance(table, TableBlock)
    assert (table.caption, table.digits) == ("Two rows.", {"a": 1, "b": 3})
    assert len(table.frame) == 2
    assert table.full is TABLE
    assert table.bold is not None
    assert table.bold["a"].tolist() == [False, True]
    assert isinstance(figure, FigureBlock)
    assert (figure.caption, figure.alt) == ("A figure.", "A line.")


def test_missing_template_value_is_an_error(loader: None) -> None:
    with pytest.raises(jinja2.UndefinedError, match="number"):
        page.page("x", TABLE)


def test_bold_cells_are_the_lowest_of_rows_or_columns() -> None:
    assert page.lowest_cells(TABLE, ["a"], ["x", "y"])["a"].tolist() == [False, True, False]
    assert page.lowest_cells(TABLE, ["a", "b"], axis=1).to_numpy().tolist() == [
        [False, True],
        [True, True],
        [True, False],
    ]


def test_tidy_frames() -> None:
    tasks = [Task(f"k{x}", square, {"x": x}) for x in (1, 2)]
    frames = frame.tidy(tasks, {"k1": {"y": 1}, "k2": {"y": 4}})
    assert frames.to_dict("index") == {
        "k1": {"task": "square", "x": 1, "y": 1},
        "k2": {"task": "square", "x": 2, "y": 4},
    }
    fits = pd.DataFrame({"law": ["a", "b"], "row": [{"v": 3.0, "w": [[1.0, 2.0]]}, {"v": 4.0}]})
    assert frame.by_number(fits, "row").to_numpy().tolist() == [
        ["a", "v", "", 3.0],
        ["a", "w", "0 0", 1.0],
        ["a", "w", "0 1", 2.0],
        ["b", "v", "", 4.0],
    ]


def test_means_and_differences_resample_clusters() -> None:
    cluster = np.repeat(np.arange(40), 3)
    noise = np.random.default_rng(0).normal(size=40)[cluster]
    costs = frame.by_unit({"a": 2 + noise, "b": 1 + noise, "c": np.inf + 0 * noise}, cluster)
    mean = frame.means(costs, 0)
    # the standard error follows from 40 clusters, not from 120 units
    half_width = 1.96 * noise[::3].std() / np.sqrt(40)
    assert mean.loc["a", "high"] - mean.loc["a", "mean"] == pytest.approx(half_width, rel=0.1)
    assert np.isnan(mean.loc["c", "low"])
    differences = frame.differences(costs, [("a", "b"), ("c", "b")], 0)
    first = differences.loc[("a", "b")]
    assert list(first[["difference", "low", "high", "better"]]) == pytest.approx([1, 1, 1, 0])
    assert first["p"] < 1e-3
    assert differences.loc[("c", "b"), "difference"] == np.inf
    assert np.isnan(differences.loc[("c", "b"), "low"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (TrafficStudyOptions(restarts=0), "study.restarts=0 must be at least 1"),
        (TrafficStudyOptions(folds=1), "study.folds=1 must be at least 2"),
        (TrafficStudyOptions(box=0.0), "study.box=0.0 must be positive"),
        (TrafficStudyOptions(workers=0), "study.workers=0 must be at least 1"),
        (CrowdStudyOptions(horizons=[]), r"study.horizons=\[\] must be positive"),
        (CrowdStudyOptions(horizons=[1.0, 0.0]), "study.horizons=.* must be positive"),
    ],
)
def test_options_out_of_range_are_refused(options: StudyOptions, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        checked(options)


def test_quick_options() -> None:
    quick = checked(CrowdStudyOptions(quick=True, horizons=[3.0, 1.0, 2.0], restarts=5))
    assert (quick.horizons, quick.restarts, quick.folds) == ([1.0, 3.0], 1, 2)
    assert checked(CrowdStudyOptions(horizons=[3.0, 1.0, 3.0])).horizons == [1.0, 3.0]


@pytest.mark.slow
@pytest.mark.parametrize("name", command.STUDIES)
def test_quick_study_writes_its_page(name: str, real_data: Path, tmp_path: Path) -> None:
    from omegaconf import OmegaConf

    from nnode.config import SCHEMAS

    schema: Any = SCHEMAS["study", f"{name}_study_schema"]
    options = OmegaConf.structured(schema(source=str(real_data), quick=True, workers=2))
    command.study(OmegaConf.create({"study": options}), tmp_path)
    assert "## Replay" in (tmp_path / "quick" / "study.md").read_text() or name == "prediction"
