"""The benchmark of the diagnosis, with a stand-in for the diagnosis."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from omegaconf import OmegaConf

from nnode.app import benchmark_discovery_tables as tables
from nnode.app import discover
from nnode.app.benchmark_discovery import benchmark_discovery, cases_of
from nnode.config import DiscoveryBenchmarkConfig, DiscoveryBenchmarkOptions
from nnode.errors import ConfigError, DataError

CALLS: list[dict[str, Any]] = []


def stand_in(path: Path, domain: str, **given: Any) -> dict[str, Any]:
    """Names relative speed whatever there is, and sees no data with faults."""
    assert {p.name for p in path.parent.iterdir()} <= {"trajectories.csv", "walls.csv"}
    CALLS.append({"domain": domain, **given})
    table = pd.read_csv(path)
    names = sorted(f"trajectories/{name}" for name in table["sequence"].unique())
    if table["x"].groupby([table["sequence"], table["agent"]]).diff().abs().max() > 6.5:
        raise DataError("too far within one step")
    kappa = {"value": 0.4, "low": 0.0, "high": 1.0, "unit": "1"}
    return {
        "verdict": "named",
        "effects": [
            {"name": "relative_speed", "coefficients": {"kappa": kappa}, "alternatives": []}
        ],
        "data_faults": [],
        "not_testable": [],
        "gap": {"before": 2.0, "after": 1.0, "noise_floor": 0.0, "closed": 0.5},
        "split": {"open": names[1:], "sealed": names[:1]},
        "seconds": {"name": 0.1},
    }


@pytest.fixture(autouse=True)
def diagnosis(monkeypatch: pytest.MonkeyPatch) -> None:
    CALLS.clear()
    monkeypatch.setattr(discover, "diagnose_table", stand_in)


def config(**options: Any) -> Any:
    given = {
        "workers": 1,
        "seeds": 1,
        "nothing_seeds": 1,
        "sizes": [3],
        "strengths": ["full"],
        "peer_seeds": 0,
    }
    chosen = DiscoveryBenchmarkOptions(**{**given, **options})
    return OmegaConf.structured(DiscoveryBenchmarkConfig(benchmark_discovery=chosen))


def run(folder: Path, **options: Any) -> pd.DataFrame:
    benchmark_discovery(config(**options), folder)
    return pd.read_csv(folder / "verdicts.csv", keep_default_na=False)


def test_named_effects_are_scored_and_summed_up(tmp_path):
    effects = ["relative_speed", "time_gap"]
    rows = run(tmp_path, domains=["traffic"], arms=["single"], effects=effects).set_index("hidden")
    assert rows.loc["relative_speed", "exact"]
    assert not rows.loc["time_gap", "exact"]
    assert rows.loc["time_gap", "class_right"]
    for file in ("benchmark.html", "benchmark.md", "coefficients.csv"):
        assert (tmp_path / file).is_file()
    criteria = pd.read_csv(tmp_path / "criteria.csv").set_index("measure")
    assert criteria.loc["one effect: exact name", "reached"] == 0.5
    assert criteria.loc["one effect: right class", "met"]


def test_weak_effects_and_other_noise_do_not_count_for_the_headline(tmp_path):
    asked = {"domains": ["traffic"], "arms": ["single"], "effects": ["relative_speed", "inertia"]}
    run(tmp_path, **asked, strengths=["medium"])
    run(tmp_path, **asked, strengths=["weak"])
    run(tmp_path, **{**asked, "effects": ["inertia"]}, strengths=["medium"], noises=[0.3])
    found = pd.read_csv(tmp_path / "criteria.csv").set_index("measure")
    for measure in ("one effect: exact name", "one weak effect: exact name"):
        assert tuple(found.loc[measure, ["reached", "cases"]]) == (0.5, 2)
    assert found.loc["one weak effect: any wrong name", "reached"] == 0.5
    rows = pd.read_csv(tmp_path / "verdicts.csv")
    assert len(rows) == 5
    rows["named"] = "relative_speed"
    shown = tables.confusion(rows.assign(hidden=rows["strength"]), "traffic")
    assert list(shown.index) == ["medium"]


def test_false_names_and_failures_are_counted(tmp_path):
    rows = run(tmp_path, domains=["traffic"], arms=["nothing", "fault"])
    jumped = rows.set_index("variant").loc["jump"]
    assert (jumped["verdict"], jumped["failure"]) == ("error", "DataError: too far within one step")
    assert (rows.loc[rows["arm"] == "nothing", "false_names"] == "relative_speed").all()
    criteria = pd.read_csv(tmp_path / "criteria.csv").set_index("measure")
    assert criteria.loc["nothing hidden: any effect named", "reached"] == 1.0
    assert not criteria.loc["nothing hidden: any effect named", "met"]
    assert criteria.loc["faults of the data: located", "reached"] == 0.0


def test_the_diagnosis_is_told_what_it_has_to_know_and_no_more(tmp_path):
    effects = ["leader_speed", "drift"]
    run(tmp_path, arms=["single"], effects=effects, noises=[0.0])
    crowd, traffic = sorted(CALLS, key=lambda call: call["domain"])
    assert traffic["leader"] == "constant"
    assert traffic["model"]["term"] in ("lin", "log")
    assert traffic["walls"] is None
    assert crowd["model"] == {
        "name": "sf", "term": "social_force", "B": 0.3, "r": 0.25, "tau": 0.5
    }  # fmt: skip
    assert crowd["walls"].name == "walls.csv"


def test_a_second_run_computes_nothing_again(tmp_path):
    asked = {"domains": ["traffic"], "arms": ["single"], "effects": ["inertia"], "noises": [0.0]}
    run(tmp_path, **asked)
    assert len(CALLS) == 1
    rows = run(tmp_path, **{**asked, "noises": [0.0, 0.1]})
    assert len(CALLS) == 2
    assert sorted(rows["noise"]) == [0.0, 0.1]
    assert (tmp_path / "figures" / "map_traffic.png").is_file()


def test_the_page_shows_what_earlier_runs_have_left(tmp_path):
    run(tmp_path, domains=["traffic"], arms=["single"], effects=["time_gap"])
    rows = run(tmp_path, domains=["traffic"], arms=["single"], effects=["relative_speed"])
    assert sorted(rows["hidden"]) == ["relative_speed", "time_gap"]


def test_headline_holds_what_was_asked_for():
    found = cases_of(DiscoveryBenchmarkOptions())
    for domain in ("traffic", "crowd"):
        part = [case for case in found if case.domain == domain]
        assert sum(case.arm == "nothing" for case in part) >= 200
        singles = [case.effects for case in part if case.arm == "single"]
        assert len(singles) == 10 * len(set(singles))
        assert len({case.effects for case in part if case.arm == "outside"}) >= 4
    assert len({case.key for case in found}) == len(found)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"domains": ["ships"]}, "domain=ships"),
        ({"arms": ["solo"]}, "arm=solo"),
        ({"effects": ["telepathy"]}, "telepathy is hidden nowhere"),
        ({"arms": ["nothing"], "effects": ["drift"]}, "has no case"),
        ({"seeds": 0}, "at least 1"),
        ({"workers": 0}, "at least 1"),
    ],
)
def test_options_that_make_no_sense_are_refused(tmp_path, options, message):
    with pytest.raises(ConfigError, match=message):
        benchmark_discovery(config(**options), tmp_path)


def test_wilson_intervals_are_those_of_the_textbook():
    # Agresti & Coull 1998: 0 of 10 gives an upper limit of 1.96² / (10 + 1.96²)
    low, high = tables.wilson(0.0, 10)
    assert low == 0.0
    assert high == pytest.approx(1.96**2 / (10 + 1.96**2))
    low, high = tables.wilson(0.5, 100)
    assert low == pytest.approx(1 - high)
