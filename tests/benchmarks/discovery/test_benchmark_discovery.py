"""The benchmark of the diagnosis, with a stand-in for the diagnosis."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest
from omegaconf import OmegaConf

from benchmarks.config import DiscoveryBenchmarkConfig, DiscoveryBenchmarkOptions
from benchmarks.discovery import criteria, level, tables
from benchmarks.discovery import run as module
from benchmarks.discovery.run import benchmark_discovery, cases_of
from benchmarks.synthetic_cases.arms import first_seed
from nnode.app import discover
from nnode.errors import ConfigError, DataError

CALLS: list[dict[str, Any]] = []


def stand_in(path: Path, domain: str, **given: Any) -> SimpleNamespace:
    """Names relative speed whatever there is, and sees no data with faults."""
    assert {p.name for p in path.parent.iterdir()} <= {"trajectories.csv", "walls.csv"}
    CALLS.append({"domain": domain, **given})
    table = pd.read_csv(path)
    names = sorted(f"trajectories/{name}" for name in table["sequence"].unique())
    if table["x"].groupby([table["sequence"], table["agent"]]).diff().abs().max() > 6.5:
        raise DataError("too far within one step")
    kappa = {"value": 0.4, "low": 0.0, "high": 1.0, "unit": "1"}
    report = {
        "verdict": "named",
        "effects": [
            {"name": "relative_speed", "coefficients": {"kappa": kappa}, "alternatives": []}
        ],
        "data_faults": [],
        "not_testable": [],
        "screen": {"p_value": 0.01, "effect": "relative_speed", "clusters": 2, "floor": 0.25},
        "clusters": {"open": 2, "sealed": 1},
        "gap": {"before": 2.0, "after": 1.0, "noise_floor": 0.0, "closed": 0.5},
        "split": {"open": names[1:], "sealed": names[:1]},
        "seconds": {"name": 0.1},
    }
    return SimpleNamespace(plain=lambda: report)


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
    found = pd.read_csv(tmp_path / "criteria.csv").set_index("measure")
    assert found.loc["one effect: exact name", "reached"] == 0.5
    assert found.loc["one effect: right class", "met"]


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


def test_peers_without_their_packages_are_refused_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "find_spec", lambda name: None if name == "pysindy" else name)
    asked = {"domains": ["traffic"], "arms": ["single"], "effects": ["inertia"]}
    with pytest.raises(ConfigError, match=r"peer_seeds=2 needs pysindy: install .* or give 0"):
        run(tmp_path, **asked, peer_seeds=2)
    assert not CALLS
    assert len(run(tmp_path, **asked)) == 1


def test_kin_comes_from_the_catalogue(tmp_path):
    rows = run(tmp_path, domains=["traffic"], arms=["single"], effects=["multi_anticipation"])
    assert list(rows["class_right"].astype(bool)) == [True]


def test_false_names_and_failures_are_counted(tmp_path):
    rows = run(tmp_path, domains=["traffic"], arms=["nothing", "fault"], variants=["white", "jump"])
    jumped = rows.set_index("variant").loc["jump"]
    assert (jumped["verdict"], jumped["failure"]) == ("error", "DataError: too far within one step")
    assert (rows.loc[rows["arm"] == "nothing", "false_names"] == "relative_speed").all()
    found = pd.read_csv(tmp_path / "criteria.csv").set_index("measure")
    assert found.loc["nothing hidden, white: p of final names above 5 %", "reached"] == 0.05
    assert found.loc["faults of the data: located", "reached"] == 0.0


def test_null_arms_run_by_themselves_and_show_their_level(tmp_path):
    rows = run(tmp_path, arms=["nothing"], variants=["white", "windows"], nothing_seeds=2)
    assert sorted(rows["variant"] + " " + rows["domain"]) == sorted(
        2 * ["white traffic", "windows traffic", "white crowd", "windows crowd"]
    )
    assert set(rows["screen_p"]) == {0.01}
    shown = pd.read_csv(tmp_path / "level.csv").set_index(["domain", "variant"])
    for key in shown.index:
        assert tuple(shown.loc[key, ["cases", "first screen", "final names"]]) == (2, 2, 2)
        assert shown.loc[key, "first screen, p"] == pytest.approx(0.05**2)
        assert (tmp_path / "figures" / f"level_{key[0]}.png").is_file()
    found = pd.read_csv(tmp_path / "criteria.csv").set_index(["domain", "measure"])
    row = found.loc[("crowd", "nothing hidden, windows: p of first screen above 5 %")]
    assert (row["cases"], row["met"]) == (2, False)


def null_rows(number: int, rejected: int, **more: Any) -> pd.DataFrame:
    """Made-up cases with nothing hidden."""
    return pd.DataFrame(
        {
            "domain": "traffic",
            "arm": "nothing",
            "variant": "white",
            "noise": 0.05,
            "n_sequences": 20,
            "clusters_open": 15,
            "verdict": "none",
            "screen_p": [0.01] * rejected + [0.6] * (number - rejected),
            "screen_false": [True] * rejected + [False] * (number - rejected),
            "false_names": "",
            "leads": "",
            **more,
        },
        index=range(number),
    )


def test_a_gate_is_held_to_5_percent_by_a_one_sided_test():
    # of 400 cases 20 are expected; 29 or more have a probability of 3.2 %, 30 of 2.0 %
    for rejected, met in ((29, True), (30, False)):
        rows = level.criteria(null_rows(400, rejected))
        assert [(row["cases"], row["met"]) for row in rows] == [(400, met), (400, True)]
    # what was not screened is no case of the screen's
    untested = null_rows(8, 0, screen_p=None, screen_false=None, verdict="not_testable")
    (row,) = level.criteria(untested)
    assert "final names" in row["measure"]
    assert level.level(untested)["not testable"].tolist() == [8]
    # a lead is shown and is no name
    leads = level.level(null_rows(8, 8, verdict="none", leads="inertia"))
    assert leads[["first screen", "final names", "hypotheses"]].to_numpy().tolist() == [[8, 0, 8]]


def test_other_sizes_have_lines_but_no_criteria_of_their_own():
    both = pd.concat([null_rows(3, 0), null_rows(2, 0, n_sequences=5)], ignore_index=True)
    assert level.level(both)["runs"].tolist() == [20, 5]
    assert [row["cases"] for row in level.criteria(both)] == [3, 3]


def measured(**columns: Any) -> pd.DataFrame:
    """Criteria of made-up cases."""
    given = {
        "key": "k",
        "domain": "crowd",
        "arm": "pair",
        "variant": "plain",
        "strength": "medium",
        "noise": 0.01,
        "n_sequences": 20,
        "hidden": "drift+obstacle",
        "verdict": "named",
        "exact": False,
        "class_right": True,
        "among_equals": False,
        "found": 2,
        "false_names": "",
        "unknown": False,
        "right": False,
        "faults_hidden": 0,
        "faults_located": 0,
        "faults_false": 0,
        "closure": None,
        "overlap": None,
        "worse": None,
        **columns,
    }
    rows = pd.DataFrame(given, index=[0])
    return criteria.criteria(rows, tables.coefficients_of([])).set_index("measure")


def test_two_effects_and_a_third_are_not_both_and_nothing_else():
    found = measured(false_names="sliding_friction")
    assert found.loc["two effects: both named, and nothing else", "reached"] == 0.0


def test_near_misses_equals_and_blamed_sequences_have_criteria():
    near = measured(arm="near_miss", exact=True, found=1)
    assert near.loc["near misses: exact name", "met"]
    equal = measured(arm="single", verdict="indistinguishable", among_equals=True)
    assert equal.loc["indistinguishable: the right one is listed", "reached"] == 1.0
    assert equal.loc["one effect: exact name", "reached"] == 0.0
    blamed = measured(faults_false=1)
    assert not blamed.loc["sound sequences: none is blamed", "met"]
    outside = measured(arm="outside", exact=None, verdict="indistinguishable", false_names="drift")
    assert outside.loc["outside the catalogue: a wrong name", "reached"] == 1.0


def test_coefficients_of_crowds_are_held_to_the_same_bound():
    rows = pd.DataFrame({"key": ["k"], "domain": "crowd", "relative": [0.07], "covered": [True]})
    base = measured().reset_index()
    assert "coefficients: median relative error" not in set(base["measure"])
    frame = pd.DataFrame(
        {
            "key": ["k"],
            "domain": "crowd",
            "arm": "single",
            "variant": "plain",
            "strength": "medium",
            "noise": 0.01,
            "n_sequences": 20,
            "hidden": "drift",
            "verdict": "named",
            "exact": True,
            "class_right": True,
            "among_equals": False,
            "false_names": "",
            "unknown": False,
            "right": True,
            "faults_hidden": 0,
            "faults_located": 0,
            "faults_false": 0,
            "closure": None,
            "overlap": None,
            "worse": None,
        }
    )
    found = criteria.criteria(frame, rows).set_index("measure")
    assert not found.loc["coefficients: median relative error", "met"]


def test_published_seeds_follow_from_a_commit_and_the_page_says_so(tmp_path):
    asked = {"domains": ["traffic"], "arms": ["single"], "effects": ["inertia"]}
    run(tmp_path, **asked, first_seed=3)
    assert "3 to 3, development" in (tmp_path / "benchmark.md").read_text()
    commit = "0" * 40
    rows = run(tmp_path, **asked, seeds_of=commit)
    # cases of other seeds are not mixed in
    assert list(rows["seed"]) == [first_seed(commit)]
    said = (tmp_path / "benchmark.md").read_text()
    assert f"from the hash of the commit that froze the rules, {commit}" in said
    assert "development" not in said


def test_the_diagnosis_is_told_what_it_has_to_know_and_no_more(tmp_path):
    effects = ["leader_speed", "drift"]
    run(tmp_path, arms=["single"], effects=effects, noises=[0.0])
    crowd, traffic = sorted(CALLS, key=lambda call: call["domain"])
    assert traffic["leader"] == "constant"
    assert traffic["model"]["term"] in ("lin", "log")
    assert traffic["walls"] is None
    assert crowd["model"] == {"name": "sf", "term": "social_force", "B": 0.3, "r": 0.25, "tau": 0.5}
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
        nothing = [case.variant for case in part if case.arm == "nothing"]
        assert len(nothing) == 400 * len(set(nothing)) >= 1600
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
        ({"domains": ["crowd"], "variants": ["recording"]}, "recording is hidden nowhere"),
        ({"seeds_of": "314307e"}, "is no full hash"),
        ({"seeds_of": "0" * 40, "first_seed": 5}, "first_seed=5 beside seeds_of"),
        ({"seeds": 0}, "at least 1"),
        ({"workers": 0}, "at least 1"),
    ],
)
def test_options_that_make_no_sense_are_refused(tmp_path, options, message):
    with pytest.raises(ConfigError, match=message):
        benchmark_discovery(config(**options), tmp_path)


def test_intervals_of_shares_are_exact():
    # none of 10: the upper limit p has (1 - p)^10 = 2.5 %
    assert tables.interval(pd.Series([False] * 10)) == f"0–{100 * (1 - 0.025**0.1):.0f}"
