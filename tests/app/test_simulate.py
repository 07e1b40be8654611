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
from tests.app.conftest import ROOT, Script, read_json
from tests.app.following import table
from tests.docs.test_tutorials import blocks

SAMPLES = 39


@pytest.fixture(scope="module")
def simulated(idm_run: Path) -> nnode.Simulated:
    return nnode.simulate(idm_run, samples=SAMPLES)


@pytest.mark.thorough
def test_command_samples_and_scores_a_run(
    script: Script, idm_run: Path, simulated: nnode.Simulated, tmp_path: Path
) -> None:
    script("simulate", f"run={idm_run}", f"samples={SAMPLES}", folder=tmp_path)
    result = read_json(tmp_path / "scores.json")
    assert result["sequences"] == 2
    assert set(result["scores"]) == {"idm", "idm, no noise", "constant_speed"}
    assert result["scores"]["idm, no noise"]["coverage_position_95"]["mean"] < 0.5
    near, far = (result["scores"][k]["crps_position_m"]["mean"] for k in ("idm", "constant_speed"))
    assert near < 0.5 * far
    assert (tmp_path / "bands.png").stat().st_size > 10_000
    store = prepare(
        TableOptions(domain="traffic", path=str(tmp_path / "samples.parquet")),
        tmp_path / "prepared",
    )
    assert len(store) == 2 * SAMPLES
    assert store[0].n_agents == 3
    assert store[0].name.endswith("~1")
    # Python gives the same result
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
def test_invalid_options_are_refused(
    script: Script, idm_run: Path, tmp_path: Path, option: str, words: str
) -> None:
    done = script("simulate", f"run={idm_run}", option, folder=tmp_path, status=2)
    assert words in done.stderr
    assert "noise of idm" not in done.stdout


@pytest.mark.thorough
def test_simulate_in_python(simulated: nnode.Simulated, tmp_path: Path) -> None:
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
    # leaders keep their measured paths
    first = result.trajectories[0]
    sequence = int(first.name.rpartition("/")[2].partition("~")[0])
    leader = drives[(drives["sequence"] == sequence) & (drives["agent"] == int(first.agents[-1]))]
    np.testing.assert_allclose(first.x[:, -1, 0], leader["x"], atol=1e-9)
    assert "noise of idm: " in repr(result)
    assert "<table" in result._repr_html_()
    paths = result.write(tmp_path / "out", format=None)
    assert [path.name for path in paths] == ["scores.json", "bands.png"]
    *_, path = result.write(tmp_path / "out", format="fcd")
    assert path.name == "samples.xml.gz"
    options = SumoOptions(path=str(path), dt=first.dt, min_vehicles=2, window=None)
    positions = {s.recording: s.x for s in read_sumo(path, options)}
    assert len(positions) == len(result.trajectories)
    for s in result.trajectories:
        lane = s.name.replace("/", "_")
        np.testing.assert_allclose(positions[f"samples_{lane}"], s.x, rtol=0, atol=1e-9)
    # `simulated` has the same calibration and another seed
    assert not np.array_equal(simulated.trajectories[0].x, first.x)
    assert simulated.trajectories[0].name.rpartition("/")[2] == first.name.rpartition("/")[2]


@pytest.mark.thorough
def test_drivers_are_drawn_from_their_estimates() -> None:
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


def test_missing_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"no checkpoint .*best\.pt"):
        nnode.simulate(tmp_path / "none")


@pytest.mark.thorough
def test_python_code_of_the_documentation(
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
    """People abreast who relax to their desired speeds, with random accelerations."""
    rng, rows, step = np.random.default_rng(0), [], 0.1
    for k in range(number):
        desired = np.stack([1.3 + 0.1 * rng.normal(size=people), np.zeros(people)], -1)
        x = np.stack([np.zeros(people), 1.5 * np.arange(people)], -1)
        v, push = desired.copy(), 0.4 * rng.normal(size=(people, 2))
        for i in range(round(seconds / step) + 1):
            rows += [(k, step * i, f"{k}-{n}", *x[n]) for n in range(people)]
            x, v = x + step * v, v + step * ((desired - v) / 0.5 + push)
            push = 0.9 * push + 0.4 * np.sqrt(1 - 0.9**2) * rng.normal(size=push.shape)
    return pd.DataFrame(rows, columns=["sequence", "time", "agent", "x", "y"])


@pytest.mark.thorough
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
    score = {key: means["crps_position_m"].mean for key, means in result.means.items()}
    assert result.crps.mean == score[name] < score[f"{name}, no noise"]
    assert score[name] < score["constant_speed"]
    assert "crps_nearest_m" in result.means[name]
    # only 4 sequences of 4 people
    assert result.coverage[0.95].mean > 0.75
    assert {"x", "y", "vx", "vy"} <= set(result.to_dataframe())
    assert "m/s²" in repr(result)
    names = {path.name for path in result.write(tmp_path / "out")}
    assert names == {"scores.json", "bands.png", "samples.parquet", "walls.csv"}
    path, walls = (str(tmp_path / "out" / name) for name in ("samples.parquet", "walls.csv"))
    store = prepare(TableOptions(domain="crowd", path=path, walls=walls), tmp_path / "prepared")
    assert len(store) == SAMPLES * len(result.sampling.indices)
    np.testing.assert_array_equal(store[5].x, result.trajectories[5].x)
    assert store[5].walls is not None
    sample = result.trajectories[5]
    folder = tmp_path / "text"
    assert len(result.write(folder, format="pedpy")) == 2 + len(store)
    text = folder / "pedpy" / "samples" / f"{sample.name.replace('/', '_')}.txt"
    seconds = float(sample.time[-1] - sample.time[0])
    (walkway,) = read_walkway(text, WalkwayOptions(path=str(text), t_seq=seconds))
    np.testing.assert_allclose(walkway.x, sample.x, rtol=0, atol=5.1e-7)  # six digits are written
    with pytest.raises(ConfigError, match="format=fcd is not for crowd"):
        result.write(folder, format="fcd")
