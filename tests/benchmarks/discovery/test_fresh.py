"""What was named, on sequences of the same truth that nobody was given."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pandas as pd
import pytest

from benchmarks.discovery.fresh import kept_back, on_fresh
from benchmarks.synthetic_cases import TABLE, Case, generate
from nnode.app.python.report import Report
from nnode.model.build import build_model
from nnode.model.effects import CATALOGUE
from nnode.model.extend import extended

NUMBER = 12


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    folder = tmp_path_factory.mktemp("case")
    case = Case(
        domain="traffic",
        arm="single",
        effects=("speed_zone",),
        strength="medium",
        seed=5,
        n_sequences=NUMBER + 8,
        noise=0.05,
    )
    return generate(case, folder), folder / TABLE


def reported(truth: dict[str, Any], alpha: float) -> Report:
    """A report that names the truth's zone with a factor."""
    law, (effect,) = truth["base"], truth["effects"]
    name = truth["model"]["name"]
    options = {"term": name, "name": name, "leader": "measured", "L_min": 1.0}
    values = {key: one["value"] for key, one in effect["coefficients"].items()}
    zone = CATALOGUE.effects["speed_zone"](**{**values, "alpha": alpha})
    model, _ = extended(build_model({**options, **law}), zone)
    diagnosis = SimpleNamespace(
        effects=[SimpleNamespace(name="speed_zone")],
        base={
            f"{truth['model']['name']}.{name}": {"before": value}
            for name, value in truth["recalibrated"].items()
        },
    )
    found = Report(diagnosis=cast(Any, diagnosis), model=model)
    object.__setattr__(found, "plain", lambda: {})
    return found


def test_the_truth_closes_the_gap_and_its_opposite_widens_it(
    made: tuple[dict[str, Any], Path],
) -> None:
    truth, table = made
    whole = pd.read_csv(table)
    back = kept_back(table, 8)
    rest = pd.read_csv(table)
    assert rest["sequence"].nunique() == NUMBER
    assert not set(back["sequence"]) & set(rest["sequence"])
    assert len(back) + len(rest) == len(whole)
    assert kept_back(table, 0).empty

    alpha = truth["effects"][0]["coefficients"]["alpha"]["value"]
    right = on_fresh(back, reported(truth, alpha), truth, "traffic", None)
    assert right["fresh_worse"] is False
    # the truth's own costs come from the generator, which shares no code with this
    assert right["fresh_closure"] == pytest.approx(1.0, abs=0.1)
    wrong = on_fresh(back, reported(truth, 2 - alpha), truth, "traffic", None)
    assert wrong["fresh_before"] == right["fresh_before"]
    assert wrong["fresh_worse"] is True


def test_nothing_named_is_not_tried(made: tuple[dict[str, Any], Path]) -> None:
    report = SimpleNamespace(diagnosis=SimpleNamespace(effects=[]))
    found = on_fresh(pd.DataFrame(), cast(Report, report), made[0], "traffic", None)
    assert set(found.values()) == {None}
