"""``nnode simulate`` and ``nnode.simulate`` from a table to scores."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import nnode
from nnode.data.prepare import prepare
from nnode.data.readers.jupedsim import WalkwayOptions, read_walkway
from nnode.data.readers.sumo import SumoOptions, read_sumo
from nnode.data.readers.table import TableOptions
from nnode.errors import CheckpointError, ConfigError
from tests.app import different
from tests.app.conftest import ROOT, Script
from tests.app.following import table
from tests.docs.test_tutorials import blocks

SAMPLES = 39


@pytest.fixture(scope="module")
def simulated(idm_run: Path) -> nnode.Simulated:
    return nnode.simulate(idm_run, samples=SAMPLES)


@pytest.mark.thorough
def test_a_run_is_sampled_and_scored(
    script: Script, idm_run: Path, simulated: nnode.Simulated, tmp_path: Path
) -> None:
    script("simulate", f"run={idm_run}", f"samples={SAMPLES}", f"hydra.run.dir={tmp_path}")
    result = json.loads((tmp_path / "scores.json").read_text())
    assert result["sequences"] == 2
    assert set(result["scores"]) == {"idm", "idm, no noise", "constant_speed"}
    assert result["scores"]["idm, no noise"]["coverage_position_95"]["mean"] < 0.5
    near, far = (result["scores"][k]["crps_position_m"]["mean"] for k in ("idm", "constant_speed"))
    assert near < 0.5 * far
    assert (tmp_path / "bands.png").stat().st_size > 10_000
    store = prepare(
        TableOptions(domain="traffic", path=str(tmp_path / "samples.parquet")), tmp_path / "again"
    )
    assert len(store) == 2 * SAMPLES
    assert store[0].n_agents == 3
    assert store[0].name.endswith("~1")
    # in Python it is the same work
    assert json.loads(json.dumps(simulated.plain())) == result
    assert [s.name.rpartition("/")[2] for s in simulated.trajectories] == [
        s.name.rpartition("/")[2] for s in store
    ]
    np.testing.assert_array_equal(simulated.trajectories[3].x, store[3].x)


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("samples=10", "samples=10: a band of 95 % needs at least 39"),
        ("format=pedpy", "format=pedpy is not for traffic; for traffic take one of parquet, csv"),
    ],
)
def test_wrong_options_are_refused_at_once(
    script: Script, idm_run: Path, tmp_path: Path, option: str, words: str
) -> None:
    done = script("simulate", f"run={idm_run}", option, f"hydra.run.dir={tmp_path}", status=2)
    assert words in done.stderr
    assert "noise of idm" not in done.stdout


@pytest.mark.thorough
def test_in_python_it_is_an_object(simulated: nnode.Simulated, tmp_path: Path) -> None:
    drives = table(10, 10.0)
    run = nnode.fit(drives, "traffic", model="idm", epochs=2, drivers="none")
    with pytest.raises(ConfigError, match="a table in memory; give it again, as data=TABLE"):
        nnode.simulate(run)
    result = nnode.simulate(run, drives, samples=SAMPLES, seed=3)
    assert isinstance(result, nnode.Simulated)
    assert (result.model, result.part, result.run, result.trained_on) == ("idm", "heldout", "", 0)
    assert result.crps == result.means["idm"]["crps_position_m"]
    assert result.scores.loc[("idm", "crps_position_m"), "mean"] == result.crps.mean
    assert result.crps.mean < result.means["constant_speed"]["crps_position_m"].mean
    assert result.coverage[0.5].mean <= result.coverage[0.95].mean
    samples = result.to_dataframe()
    assert set(samples) >= {"sequence", "time", "agent", "x", "length"}
    assert samples["sequence"].nunique() == SAMPLES * len(result.sampling.indices)
    # who leads is where he was measured
    first = result.trajectories[0]
    own = drives[drives["sequence"] == int(first.name.rpartition("/")[2].partition("~")[0])]
    lead = own.loc[own["agent"] == int(first.agents[-1]), "x"]
    np.testing.assert_allclose(first.x[:, -1, 0], lead, atol=1e-9)
    assert "noise of idm: " in repr(result)
    assert "<table" in result._repr_html_()
    paths = result.write(tmp_path / "out", format=None)
    assert [path.name for path in paths] == ["scores.json", "bands.png"]
    *_, path = result.write(tmp_path / "out", format="fcd")
    assert path.name == "samples.xml.gz"
    options = SumoOptions(path=str(path), dt=first.dt, min_vehicles=2, window=None)
    again = {s.recording: s.x for s in read_sumo(path, options)}
    assert len(again) == len(result.trajectories)
    for s in result.trajectories:
        lane = s.name.replace("/", "_")
        np.testing.assert_allclose(again[f"samples_{lane}"], s.x, rtol=0, atol=1e-9)
    # the same calibration by the command, sampled with another seed
    assert not np.array_equal(simulated.trajectories[0].x, first.x)
    assert simulated.trajectories[0].name.rpartition("/")[2] == first.name.rpartition("/")[2]


@pytest.mark.thorough
def test_drivers_are_drawn_as_they_were_estimated() -> None:
    drives = different.table(1, platoons=8, cars=3, seconds=10.0, noise=0.05, differ={"T": 0.15})[0]
    run = nnode.fit(drives, "traffic", model="idm", drivers=["T"])
    assert run.drivers is not None
    simulated = nnode.simulate(run, drives, samples=SAMPLES)
    noise, estimates = simulated.noise["idm"].noise, run.drivers.variability["estimate"]
    assert dict(noise.parameters) == {"idm.T": estimates["T"] / 100}
    assert (noise.sigma, noise.tau) == (estimates["push"], estimates["push_time"])
    assert noise.measurement == pytest.approx(estimates["measurement"] ** 2)
    assert "between drivers idm.T ± " in repr(simulated)
    assert simulated.crps.mean < simulated.means["idm, no noise"]["crps_position_m"].mean


def test_a_run_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"no checkpoint .*best\.pt"):
        nnode.simulate(tmp_path / "none")


@pytest.mark.thorough
def test_the_lines_of_the_page(
    idm_run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (text,) = (t for lang, t in blocks(ROOT / "docs" / "sampling.md") if lang == "python")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(compile(text.replace('"RUN"', repr(str(idm_run))), "sampling.md", "exec"), names)
    assert "noise of idm: " in capsys.readouterr().out
    assert {path.name for path in (tmp_path / "runs" / "samples").iterdir()} == {
        "scores.json",
        "bands.png",
        "samples.parquet",
    }


def walks(number: int = 10, people: int = 4, seconds: float = 8.0) -> pd.DataFrame:
    """People abreast who return to a speed of their own within half a second, and are pushed."""
    rng, rows, step = np.random.default_rng(0), [], 0.1
    for k in range(number):
        wish = np.stack([1.3 + 0.1 * rng.normal(size=people), np.zeros(people)], -1)
        x = np.stack([np.zeros(people), 1.5 * np.arange(people)], -1)
        v, push = wish.copy(), 0.4 * rng.normal(size=(people, 2))
        for i in range(round(seconds / step) + 1):
            rows += [(k, step * i, f"{k}-{n}", *x[n]) for n in range(people)]
            x, v = x + step * v, v + step * ((wish - v) / 0.5 + push)
            push = 0.9 * push + 0.4 * np.sqrt(1 - 0.9**2) * rng.normal(size=push.shape)
    return pd.DataFrame(rows, columns=["sequence", "time", "agent", "x", "y"])


@pytest.mark.thorough  # their law is compiled
def test_people_are_sampled(tmp_path: Path) -> None:
    table = walks()
    (tmp_path / "walls.csv").write_text("x1,y1,x2,y2\n-5,-3,30,-3\n")
    model = {"term": "social_force", "desired": "direction"}
    run = nnode.fit(
        table, "crowd", model=model, walls=tmp_path / "walls.csv", epochs=2, heldout=0.4
    )
    data = nnode.sequences(table, data="table", domain="crowd", walls=str(tmp_path / "walls.csv"))
    result = nnode.simulate(run, data, samples=SAMPLES)
    name = result.model
    score = {key: own["crps_position_m"].mean for key, own in result.means.items()}
    assert result.crps.mean == score[name] < score[f"{name}, no noise"]
    assert score[name] < score["constant_speed"]
    assert "crps_nearest_m" in result.means[name]
    # of 4 sequences with 4 people: far from none and from the band of 50 %
    assert result.coverage[0.95].mean > 0.75
    assert {"x", "y", "vx", "vy"} <= set(result.to_dataframe())
    assert "m/s²" in repr(result)
    names = {path.name for path in result.write(tmp_path / "out")}
    assert names == {"scores.json", "bands.png", "samples.parquet", "walls.csv"}
    again = TableOptions(
        domain="crowd",
        path=str(tmp_path / "out" / "samples.parquet"),
        walls=str(tmp_path / "out" / "walls.csv"),
    )
    store = prepare(again, tmp_path / "again")
    assert len(store) == SAMPLES * len(result.sampling.indices)
    np.testing.assert_array_equal(store[5].x, result.trajectories[5].x)
    assert store[5].walls is not None
    one = result.trajectories[5]
    folder = tmp_path / "text"
    assert len(result.write(folder, format="pedpy")) == 2 + len(store)
    path = folder / "pedpy" / "samples" / f"{one.name.replace('/', '_')}.txt"
    seconds = float(one.time[-1] - one.time[0])
    (back,) = read_walkway(path, WalkwayOptions(path=str(path), t_seq=seconds))
    np.testing.assert_allclose(back.x, one.x, rtol=0, atol=5.1e-7)  # six digits are written
    with pytest.raises(ConfigError, match="format=fcd is not for crowd"):
        result.write(folder, format="fcd")
