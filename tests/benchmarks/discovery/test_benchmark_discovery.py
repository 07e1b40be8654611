"""The benchmark of the diagnosis, with a substitute for the diagnosis."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest
from omegaconf import OmegaConf

from benchmarks.config import DiscoveryBenchmarkConfig, DiscoveryBenchmarkOptions
from benchmarks.discovery import synthetic
from benchmarks.discovery.run import benchmark_discovery
from benchmarks.discovery.verdicts import share
from benchmarks.synthetic_cases.case import first_seed
from nnode.app import discover
from nnode.diagnosis import thresholds
from nnode.errors import ConfigError, DataError

CALLS: list[dict[str, Any]] = []
TRAFFIC = {"domains": ["traffic"], "arms": ["single"]}


def relative_speed(path: Path, domain: str, **given: Any) -> SimpleNamespace:
    """A diagnosis that always reports relative speed and refuses data with jumps."""
    assert {p.name for p in path.parent.iterdir()} <= {"trajectories.csv", "walls.csv"}
    values = {name: v for name, v in vars(thresholds).items() if name.isupper()}
    CALLS.append({"domain": domain, "thresholds": values, **given})
    table = pd.read_csv(path)
    if table["x"].groupby([table["sequence"], table["agent"]]).diff().abs().max() > 6.5:
        raise DataError("too far within one step")
    kappa = {"value": 0.4, "low": 0.0, "high": 1.0, "unit": "1"}
    report = {
        "verdict": "named",
        "effects": [
            {"name": "relative_speed", "coefficients": {"kappa": kappa}, "alternatives": []}
        ],
        "gap": {"before": 2.0, "after": 1.0, "closed": 0.5},
    }
    return SimpleNamespace(plain=lambda: report)


@pytest.fixture(autouse=True)
def diagnosis(monkeypatch: pytest.MonkeyPatch) -> None:
    CALLS.clear()
    monkeypatch.setattr(discover, "diagnose_table", relative_speed)


def run(folder: Path, **options: Any) -> pd.DataFrame:
    small = {"workers": 1, "seeds": 1, "nothing_seeds": 1, "sizes": [3], "strengths": ["full"]}
    chosen = DiscoveryBenchmarkOptions(**{**small, "baseline_seeds": 0, **options})
    config = DiscoveryBenchmarkConfig(benchmark_discovery=chosen)
    benchmark_discovery(OmegaConf.structured(config), folder)
    return pd.read_csv(folder / "synthetic.csv", keep_default_na=False)


def test_effects_are_scored_and_finished_cases_are_kept(tmp_path):
    run(tmp_path, **TRAFFIC, effects=["time_gap"])
    rows = run(tmp_path, **TRAFFIC, effects=["relative_speed", "time_gap"]).set_index("hidden")
    assert len(CALLS) == 2
    assert rows.loc["relative_speed", "exact"]
    assert rows.loc["time_gap", ["exact", "class_right"]].tolist() == [False, True]
    assert list(pd.read_csv(tmp_path / "coefficients.csv")["covered"]) == [True]
    assert (tmp_path / "benchmark.html").is_file()
    page = (tmp_path / "benchmark.md").read_text()
    assert "| traffic | single | plain | full |" in page
    assert "1 of 2 (50 %, 1–99 %)" in page


def test_false_effects_and_failures_are_counted(tmp_path):
    rows = run(tmp_path, domains=["traffic"], arms=["nothing", "fault"], variants=["white", "jump"])
    jumped = rows.set_index("variant").loc["jump"]
    assert (jumped["verdict"], jumped["failure"]) == ("error", "DataError: too far within one step")
    assert jumped["located"] == "False"
    assert (rows.loc[rows["arm"] == "nothing", "false_names"] == "relative_speed").all()


def test_seeds_of_a_commit(tmp_path):
    run(tmp_path, **TRAFFIC, effects=["inertia"], first_seed=3)
    assert "development" in (tmp_path / "benchmark.md").read_text()
    commit = "0" * 40
    rows = run(tmp_path, **TRAFFIC, effects=["inertia"], seeds_of=commit)
    # cases of other seeds are excluded
    assert list(rows["seed"]) == [first_seed(commit)]
    page = (tmp_path / "benchmark.md").read_text()
    assert f"from the hash of the commit that froze the rules, {commit}" in page
    assert "development" not in page


def test_diagnosis_gets_the_base_model_only(tmp_path):
    run(tmp_path, arms=["single"], effects=["inertia", "drift"], noises=[0.0])
    crowd, traffic = sorted(CALLS, key=lambda call: call["domain"])
    assert traffic["model"]["term"] in ("lin", "log")
    assert traffic["walls"] is None
    assert crowd["model"] == {"name": "sf", "term": "social_force", "B": 0.3, "r": 0.25, "tau": 0.5}
    assert crowd["walls"].name == "walls.csv"


def test_default_cases_contain_all_arms():
    cases = synthetic.cases("synthetic", DiscoveryBenchmarkOptions(baseline_seeds=0), 0)
    for domain in ("traffic", "crowd"):
        part = [a["case"] for a in cases.values() if a["case"]["domain"] == domain]
        nothing = [case["variant"] for case in part if case["arm"] == "nothing"]
        assert len(nothing) == 400 * len(set(nothing)) >= 1600
        singles = [case["effects"][0] for case in part if case["arm"] == "single"]
        assert len(singles) == 10 * len(set(singles))
        assert len({case["effects"][0] for case in part if case["arm"] == "outside"}) >= 4


@pytest.mark.thorough
def test_thresholds_are_halved_and_doubled(tmp_path):
    rows = run(tmp_path, **TRAFFIC, kinds=["rules"], effects=["inertia"])
    number = sum(name.isupper() for name in vars(thresholds))
    assert len(set(rows["thresholds"])) == len(rows) == 1 + 2 * number
    assert len({str(call["thresholds"]) for call in CALLS}) == len(CALLS) == len(rows)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kinds": ["ships"]}, "expected some of synthetic, rules"),
        ({"domains": ["ships"]}, "domain=ships"),
        ({"arms": ["solo"]}, "arm=solo"),
        ({"effects": ["telepathy"]}, "telepathy is hidden nowhere"),
        ({"arms": ["nothing"], "effects": ["inertia"]}, "has no case"),
        ({"domains": ["crowd"], "variants": ["recording"]}, "recording is hidden nowhere"),
        ({"seeds_of": "314307e"}, "is no full hash"),
        ({"seeds_of": "0" * 40, "first_seed": 5}, "first_seed=5 beside seeds_of"),
        ({"seeds": 0}, "at least 1"),
        ({"workers": 0}, "at least 1"),
        ({"baseline_seeds": 2}, "baseline_seeds=2 needs pysindy: install .* or give 0"),
    ],
)
def test_invalid_options_are_refused(tmp_path, monkeypatch, options, message):
    monkeypatch.setattr(synthetic, "find_spec", lambda name: None if name == "pysindy" else name)
    with pytest.raises(ConfigError, match=message):
        run(tmp_path, **{**TRAFFIC, **options})
    assert not CALLS


def test_shares_have_exact_intervals() -> None:
    # Clopper and Pearson 1934: the upper limit of 0 of 10 is 1 - 0.025^(1/10)
    limit = 100 * (1 - 0.025**0.1)
    assert share(pd.Series([False] * 10 + [None])) == f"0 of 10 (0 %, 0–{limit:.0f} %)"
    assert share(pd.Series([None], dtype=object)) == "–"
