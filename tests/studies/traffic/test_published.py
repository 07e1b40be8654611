"""The published page's numbers, recomputed from its parameters."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from nnode.calibrate.cost import sequence_costs
from nnode.data.sequence import collate
from nnode.model.build import build_model
from nnode.model.system import System
from nnode.simulation import FusedSolver, Solver, TorchdiffeqSolver
from studies.crowd.data import prepared
from studies.crowd.tasks import system_of
from studies.options import CrowdStudyOptions
from studies.traffic import printed
from studies.traffic.tasks import Problem, model_options, recording

PUBLISHED = Path(__file__).parents[3] / "docs" / "studies" / "traffic"
DT = 0.002


@pytest.fixture(scope="module")
def parameters() -> pd.DataFrame:
    return pd.read_csv(PUBLISHED / "parameters.csv", dtype={"index": str}, keep_default_na=False)


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    return pd.read_csv(PUBLISHED / "table_2.csv", index_col=0)


def calibrated(parameters: pd.DataFrame, model: str, name: str) -> System:
    """The model with the published parameters of one recording."""
    p = parameters
    chosen = p[
        (p.optimizer == "bfgs")
        & (p.faults == "keep")
        & (p.box == "")
        & (p.model == model)
        & (p.recording == name)
    ]
    system = build_model(model_options(model))
    values_by_name = dict(system.named_parameters())
    assert len(chosen) == sum(value.numel() for value in values_by_name.values())
    with torch.no_grad():
        for row in chosen.itertuples():
            place = tuple(int(i) for i in str(row.index_).split()) if row.index_ else ()
            values_by_name[f"terms.0.{row.parameter}"][place] = float(row.value)
    return system


def mean_cost(system: System, folder: str, name: str, model: str, solver: Solver) -> float:
    batch = Problem(recording(folder, name), model).batch
    with torch.no_grad():
        return float(sequence_costs(solver(system, batch), batch).mean())


@pytest.mark.parametrize("model", ["lin", "log", "n2", "n4", "n10"])
def test_published_costs_follow_from_the_parameters(
    model: str, parameters: pd.DataFrame, table: pd.DataFrame, esimas: str
) -> None:
    renamed = parameters.rename(columns={"index": "index_"})
    for name in printed.recordings:
        system = calibrated(renamed, model, name)
        cost = mean_cost(system, esimas, name, model, FusedSolver(DT))
        assert cost == pytest.approx(table.loc[model, name], rel=1e-6), name
    # by another solver for the smallest recording
    system = calibrated(renamed, model, "3-1_2")
    cost = mean_cost(system, esimas, "3-1_2", model, TorchdiffeqSolver("euler", "discrete", DT))
    assert cost == pytest.approx(table.loc[model, "3-1_2"], rel=1e-6)


def test_averages_of_the_table(table: pd.DataFrame) -> None:
    pd.testing.assert_series_equal(
        table[list(printed.recordings)].mean(axis=1), table["average"], check_names=False
    )


@pytest.mark.thorough
@pytest.mark.parametrize(("model", "label"), [("sf", "SF"), ("nn", "NN")])
def test_published_crowd_costs_follow_from_the_parameters(
    model: str, label: str, real_data: Path, tmp_path: Path
) -> None:
    folder = PUBLISHED.parent / "crowd"
    table = pd.read_csv(folder / "crowd_costs.csv", index_col=0)
    rows = pd.read_csv(folder / "parameters.csv")
    rows = rows[(rows.model == model) & (rows["trained on"] == "all") & (rows["horizon (s)"] == 1)]
    options = CrowdStudyOptions(source=str(real_data))
    batch = collate(prepared(options, tmp_path, "main", 1.0))

    def cost(system: System, solver: Solver) -> float:
        with torch.no_grad():
            return float(sequence_costs(solver(system, batch), batch).mean())

    systems = [system_of(model, row["value"].to_list()) for _, row in rows.groupby("start")]
    costs = [cost(system, FusedSolver()) for system in systems]
    # the best one by another solver as well
    best = systems[int(np.argmin(costs))]
    repeated = cost(best, TorchdiffeqSolver("euler", "discrete"))
    assert repeated == pytest.approx(table.loc[label, "here (m² s)"], rel=1e-6)
    assert min(costs) == pytest.approx(table.loc[label, "here (m² s)"], rel=1e-6)
    assert 25 * min(costs) == pytest.approx(table.loc[label, "here (m²)"], rel=1e-6)


@pytest.mark.parametrize("study", ["traffic", "crowd"])
def test_pages_are_self_contained(study: str) -> None:
    folder = PUBLISHED.parent / study
    html = (folder / "study.html").read_text()
    assert not re.search(r'(src|href)="(?!data:|#)', html)
    links = re.findall(r"\]\(([^)#][^)]*)\)", (folder / "study.md").read_text())
    assert links
    for path in links:
        assert (folder / path.split("#")[0]).is_file() or path.startswith("https://"), path
