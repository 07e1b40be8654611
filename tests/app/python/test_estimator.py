"""``nnode.Calibrator`` and ``nnode.fit``: estimates, results, and agreement with the command."""

from __future__ import annotations

import pickle
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from scipy.stats import norm
from scipy.stats import t as students_t

import nnode
from nnode.app.python.inputs import model_options
from nnode.calibrate.cost import Convention
from nnode.calibrate.evaluate import evaluate
from nnode.config import choices
from nnode.data.sequence import collate
from nnode.errors import ConfigError, DataError, NotFittedError
from nnode.model import Traffic, make_law
from nnode.model.laws import CAR_FOLLOWING_LAWS, PEDESTRIAN_LAWS
from nnode.plots.traffic import measured_speeds
from tests.app.conftest import Script, read_json
from tests.app.following import TRUE, pairs, table


@pytest.fixture(scope="module")
def tidy() -> pd.DataFrame:
    return table(platoons=5, seconds=8.0)


@pytest.fixture(scope="module")
def fitted(tidy: pd.DataFrame) -> nnode.Calibrator:
    return nnode.Calibrator("lin", leader="measured", epochs=4).fit(tidy)


@pytest.fixture(scope="module")
def idm(tidy: pd.DataFrame) -> nnode.Calibration:
    """A calibration with a held-out part."""
    return nnode.fit(tidy, "traffic", model="idm")


def test_idm_parameters_are_recovered() -> None:
    # the pairs were simulated with ballistic steps
    calibrator = nnode.Calibrator("idm", method="ballistic").fit(pairs(number=6, seconds=30.0))
    for name, value in TRUE.items():
        row = calibrator.parameters_.loc[f"idm.{name}"]
        assert row["estimate"] == pytest.approx(value, rel=1e-4)
        assert row["lower"] <= value * (1 + 1e-4)
        assert row["upper"] >= value * (1 - 1e-4)
    assert calibrator.parameters_.unit["idm.T"] == "s"
    assert calibrator.result_.clusters == 6
    assert calibrator.score(pairs(number=2, seconds=20.0, seed=5)) == pytest.approx(0, abs=1e-3)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("arguments", "options"),
    [
        ({"model": "idm"}, "model=idm"),
        ({"model": "helly", "drivers": "alone"}, "model=helly trainer.drivers=alone"),
        (
            {
                "model": "lin",
                "optimizer": "adadelta",
                "solver": "torchdiffeq",
                "epochs": 2,
                "dt": 0.05,
                "effects": ["relative_speed"],
            },
            "model=lin solver.dt=0.05 trainer.max_epochs=2 model.effects=[relative_speed]",
        ),
        (
            {"model": "ovm", "optimizer": "lbfgs", "cost": "gap", "epochs": 3},
            "model=ovm optimizer=lbfgs trainer.cost=gap trainer.max_epochs=3",
        ),
    ],
    ids=["idm", "alone", "lin", "ovm"],
)
def test_command_and_python_give_the_same_numbers(
    script: Script, tmp_path: Path, tidy: pd.DataFrame, arguments: dict[str, Any], options: str
) -> None:
    tidy.to_parquet(tmp_path / "table.parquet")
    done = script(
        "train",
        *options.split(),
        "data=table",
        f"data.path={tmp_path / 'table.parquet'}",
        "data.domain=traffic",
        "seed=3",
        folder=tmp_path,
    )
    written = read_json(tmp_path / "result.json")
    calibrator = nnode.Calibrator(**arguments, heldout=0.2, seed=3).fit(tidy)
    result = calibrator.result_.plain(written["paths"])
    assert set(result) == set(written)
    del result["summary"]["seconds"], written["summary"]["seconds"]
    assert _numbers(result) == pytest.approx(_numbers(written), rel=1e-12, abs=0, nan_ok=True)
    assert calibrator.cost_ == pytest.approx(written["summary"]["cost_train"], rel=1e-12)
    assert calibrator.n_iter_ == written["history"][-1]["epoch"]
    assert calibrator.result_.summary() in done.stdout
    assert "not in compiled code" not in done.stdout + done.stderr
    separate, path = calibrator.result_.separate, tmp_path / "separate_parameters.csv"
    assert (separate is not None) == path.exists() == ("drivers" in arguments)
    if separate is not None:
        pd.testing.assert_frame_equal(separate, pd.read_csv(path, keep_default_na=False))


def _numbers(value: Any, name: str = "") -> dict[str, float]:
    """All numbers of nested mappings and lists, by their path."""
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        return {k: v for key, item in items for k, v in _numbers(item, f"{name}/{key}").items()}
    return {name: float(value)} if isinstance(value, int | float) else {}


def test_predict_keeps_keys_starts_and_leaders(
    tidy: pd.DataFrame, fitted: nnode.Calibrator
) -> None:
    prediction = fitted.predict(tidy).to_dataframe()
    table = tidy.merge(prediction, on=["sequence", "time", "agent"], suffixes=("", "_simulated"))
    assert len(table) == len(tidy) == len(prediction)
    start, leader = table[table.time == 0.0], table[table.agent % 10 == 2]
    assert (start.x == start.x_simulated).all()
    assert (leader.x == leader.x_simulated).all()  # leader="measured"
    assert (table.x - table.x_simulated).abs().max() > 0.1


def test_score_equals_the_rmse_of_an_evaluation(
    tidy: pd.DataFrame, fitted: nnode.Calibrator
) -> None:
    measured = nnode.sequences(tidy)
    solver, model = fitted.result_.solver, fitted.model_
    metrics = evaluate(lambda b: solver(model, b), [collate(measured)], Convention.integral)
    assert fitted.score(tidy) == pytest.approx(-metrics.rmse, rel=1e-9)
    assert fitted.predict(tidy).score(tidy) == fitted.score(measured)
    assert nnode.sequences(tidy).score(tidy) == 0.0
    with pytest.raises(DataError, match="score what was predicted from the same table"):
        fitted.predict(measured[:2]).score(tidy)


def test_fit_changes_no_argument_and_no_torch_setting(tidy: pd.DataFrame) -> None:
    before, threads = tidy.copy(), torch.get_num_threads()
    torch.set_num_threads(2)
    model = Traffic([make_law("lin", v0=30.0, L=5.0)], leader="measured").double()
    calibrator = nnode.Calibrator(model, epochs=2)
    assert calibrator.fit(tidy) is calibrator
    assert torch.get_num_threads() == 2
    torch.set_num_threads(threads)
    pd.testing.assert_frame_equal(tidy, before)
    assert calibrator.model is model
    assert float(model.physical()["lin.v0"][0]) == pytest.approx(30.0)
    by_name = nnode.Calibrator("lin", leader="measured", epochs=2).fit(tidy)
    assert calibrator.parameters_.estimate.to_dict() == by_name.parameters_.estimate.to_dict()
    with pytest.raises(ConfigError, match="was built by hand"):
        calibrator.result_.save("never.pt")


def test_fit_is_deterministic_and_can_be_pickled(
    tidy: pd.DataFrame, fitted: nnode.Calibrator
) -> None:
    repeated = nnode.Calibrator(**fitted.get_params()).fit(list(nnode.sequences(tidy)))
    assert repeated.parameters_.equals(fitted.parameters_)
    copied = pickle.loads(pickle.dumps(fitted))
    assert copied.score(tidy) == fitted.score(tidy)
    assert copied.get_params() == fitted.get_params()


def test_predictions_of_a_subset_are_unchanged(
    tidy: pd.DataFrame, fitted: nnode.Calibrator
) -> None:
    sequences = nnode.sequences(tidy)
    paths = {s.name: s.x for s in fitted.predict(sequences)}
    for part in (sequences[[3, 1]], sequences[4:]):
        for s in fitted.predict(part):
            assert s.x == pytest.approx(paths[s.name], rel=1e-12)


def test_results_are_displayed_and_saved(
    idm: nnode.Calibration, fitted: nnode.Calibrator, tmp_path: Path
) -> None:
    assert re.search(r"idm, calibrated\n  cost of a training sequence: .* m² s\n", repr(idm))
    assert re.search(r"<td>\d+\.\d+</td>\s*<td>s</td>", idm._repr_html_())
    assert "lower" in idm._repr_html_()
    assert "lower" not in fitted._repr_html_()  # Adadelta gives no intervals
    assert repr(fitted) == "Calibrator(model='lin', leader='measured', epochs=4)"
    frame = idm.to_dataframe()
    assert list(frame.columns[:5]) == ["parameter", "estimate", "lower", "upper", "unit"]
    curve = idm.plot().axes[0].lines[0].get_xydata()
    assert np.isfinite(np.asarray(curve)).all()
    model = nnode.load(idm.save(tmp_path / "idm.pt"))
    for name, (value, _) in model.physical().items():
        assert float(value) == idm.parameters.estimate[name]


def test_intervals_use_student_s_t_quantiles(tidy: pd.DataFrame) -> None:
    run = nnode.Calibrator("idm", drivers="none").fit(tidy).result_
    narrow, table = run.conf_int(alpha=0.5), run.parameters
    half = students_t.ppf(0.75, table["df"]) * table["std_error"]
    assert (narrow.upper - table.estimate).to_numpy() == pytest.approx(half.to_numpy(), rel=1e-9)
    assert run.plot().axes[0].get_ylabel() == "equilibrium speed (m/s)"


def test_results_convert_to_xarray(
    tidy: pd.DataFrame, idm: nnode.Calibration, fitted: nnode.Calibrator
) -> None:
    pytest.importorskip("xarray")
    dataset = idm.to_xarray()
    assert float(dataset.estimate.sel(parameter="idm.T")) == idm.parameters.estimate["idm.T"]
    variance = dataset.correlation.sel(parameter="idm.T", other="idm.T")
    assert float(variance) == pytest.approx(1.0)
    assert dataset.cost_train.sizes["epoch"] == len(idm.history)
    paths = fitted.predict(tidy).to_xarray()
    assert paths.x.dims == ("sequence", "sample", "place")
    assert paths.x.attrs["units"] == "m"


def test_invalid_calls_raise(tidy: pd.DataFrame) -> None:
    with pytest.raises(NotFittedError, match=r"call fit\(table\) first"):
        nnode.Calibrator().predict(tidy)
    for options, message in (
        ({"model": "idn"}, "model=idn is unknown"),
        ({"optimizer": "newton"}, "optimizer=newton is unknown, expected one of adadelta"),
        ({"solver": "fast"}, "solver=fast is unknown"),
        ({"cost": "gaps"}, "trainer.cost=gaps: expected one of integral.*did you mean gap"),
        ({"epochs": -1}, "trainer.max_epochs=-1 must be at least 0"),
        ({"leader": "none"}, "model.leader=none: expected one of"),
        ({"model": "sf"}, "model=sf is a crowd model"),
        ({"effects": ["inerta"]}, "did you mean inertia"),
    ):
        with pytest.raises(ConfigError, match=message):
            nnode.Calibrator(**options).fit(tidy)
    with pytest.raises(ConfigError, match="did you mean optimizer"):
        nnode.Calibrator().set_params(optimiser="lbfgs")
    with pytest.raises(DataError, match="agent"):
        nnode.fit(tidy.drop(columns="agent"), "traffic")
    with pytest.raises(DataError, match="row 8: column 'x' holds 'here'"):
        nnode.Calibrator().fit(tidy.assign(x=tidy.x.astype(object).where(tidy.index != 7, "here")))
    for no_table in (3, [], np.zeros((3, 2))):
        for function in (nnode.Calibrator().fit, nnode.fit, nnode.sequences, nnode.diagnose):
            with pytest.raises(DataError, match="expected a data frame"):
                function(no_table)


def test_fit_of_a_subset_of_sequences(tidy: pd.DataFrame) -> None:
    part = list(nnode.sequences(tidy, domain="traffic"))[:3]
    run = nnode.fit(part, model="lin", epochs=1, heldout=0.0)
    assert {f"table/{name}" for name in run.residuals().sequence} == {s.name for s in part}


@pytest.mark.thorough
@pytest.mark.filterwarnings("error")
def test_anonymous_pairs_are_clusters() -> None:
    """Several pairs have intervals; a single pair has none, and the summary gives the reason."""
    sequences = nnode.sequences(pairs(6, 20.0).drop(columns=["follower", "leader"]))
    fitted = nnode.Calibrator("idm").fit(sequences)
    assert fitted.result_.clusters == len(sequences) == 6
    assert np.isfinite(fitted.parameters_[["lower", "upper"]].to_numpy(dtype=float)).all()
    single = nnode.Calibrator("idm").fit(sequences[:1])
    assert "no intervals: the training sequences are one cluster" in single.result_.summary()
    assert single.parameters_.lower.isna().all()


@pytest.mark.thorough
@pytest.mark.real
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("file", "columns", "T", "s0"),
    [
        (
            "ngsim_events/events.parquet",
            {"pair": "event", "v_follower": "speed", "v_leader": "leader_speed"},
            1.054,
            1.404,
        ),
        (
            "waymo_pairs/hv_av_2.parquet",
            {"time": "t", "pair": "event", "run": "split"},
            1.455,
            4.981,
        ),
    ],
)
def test_intervals_hold_published_estimates(
    real_data: Path, file: str, columns: dict[str, str], T: float, s0: float
) -> None:
    sequences = nnode.sequences(real_data / file, data="pairs", columns=columns)
    result = nnode.Calibrator("idm").fit(sequences).parameters_
    free = result[result.at_bound == ""]
    assert set(free.index) >= {"idm.T", "idm.s0", "idm.a", "idm.b"}
    assert np.isfinite(free[["lower", "upper"]].to_numpy(dtype=float)).all()
    for name, value in (("idm.T", T), ("idm.s0", s0)):
        assert result.lower[name] < value < result.upper[name]


def test_fit_holds_out_a_part(idm: nnode.Calibration) -> None:
    assert len(idm.checkpoint.split["heldout"]) == 1
    assert idm.cost_heldout < idm.heldout_start
    assert "cost of a held-out sequence" in idm.summary()


def test_model_names_are_those_of_the_configuration() -> None:
    built_in = {"lin", "log", "n2", "n4", "n10", "formula", "sf", "nn"}
    expected = choices("model")
    assert built_in | set(CAR_FOLLOWING_LAWS) | set(PEDESTRIAN_LAWS) == set(expected)
    assert all(model_options(name)["name"] == name for name in expected)
    with pytest.raises(ConfigError, match="model=lwr is unknown, expected one of a10, a2"):
        model_options("lwr")


def test_fit_statistics_agree_with_the_residuals(fitted: nnode.Calibrator) -> None:
    run = fitted.result_
    error = run.residuals().residual
    fit = run.fit
    assert fit.observations == len(error)
    assert fit.rmse == pytest.approx(np.sqrt((error**2).mean()))
    log_likelihood = norm.logpdf(error, scale=np.sqrt((error**2).mean())).sum()
    assert fit.log_likelihood == pytest.approx(log_likelihood)
    number = len(run.parameters) + 1
    assert fit.aic == pytest.approx(2 * number - 2 * log_likelihood)
    assert fit.bic == pytest.approx(number * np.log(len(error)) - 2 * log_likelihood)
    tracks = error.groupby([run.residuals().sequence, run.residuals().agent])
    lagged = pd.DataFrame({"now": error, "before": tracks.shift()}).dropna()
    assert fit.autocorrelation == pytest.approx(
        (lagged.now @ lagged.before)
        / np.sqrt((lagged.now @ lagged.now) * (lagged.before @ lagged.before))
    )
    assert "RMSE (m)" in run.summary()
    network = replace(run, parameters=run.parameters.iloc[:0])
    assert "std err" in run.summary()
    assert all(words not in network.summary() for words in ("std err", "Empty"))


def test_residuals_omit_starts_and_measured_leaders(
    tidy: pd.DataFrame, fitted: nnode.Calibrator
) -> None:
    rows = fitted.result_.residuals()
    starts = tidy.groupby("sequence").time.min()
    assert (rows.time > rows.sequence.astype(int).map(starts)).all()
    leaders = tidy.loc[tidy.groupby(["sequence", "time"]).x.idxmax()]
    measured = {*zip(leaders.sequence, leaders.agent, strict=True)}
    simulated = {*zip(rows.sequence.astype(int), rows.agent.astype(int), strict=True)}
    assert not simulated & measured
    assert len(simulated) == tidy.groupby("sequence").agent.nunique().sum() - len(measured)


def test_confidence_level_of_intervals(idm: nnode.Calibration) -> None:
    wide, narrow = idm.parameters[["lower", "upper"]].astype(float), idm.conf_int(0.5)
    pd.testing.assert_frame_equal(idm.conf_int(), wide, check_exact=False, rtol=1e-9)
    finite = wide.lower.notna()
    assert finite.any()
    assert (narrow.lower > wide.lower)[finite].all()
    assert (narrow.upper < wide.upper)[finite].all()
    with pytest.raises(ConfigError, match="alpha=5: expected a number between 0 and 1"):
        idm.conf_int(5)


def test_plot_shows_the_measured_gaps(tidy: pd.DataFrame, fitted: nnode.Calibrator) -> None:
    figure = fitted.result_.plot()
    (points,) = (c for ax in figure.axes for c in ax.collections if c.get_gid() == "measured")
    gaps = np.asarray(points.get_offsets())[:, 0]
    measured = tidy.sort_values("x").groupby(["sequence", "time"]).x.diff().dropna().to_numpy()
    assert np.abs(measured[:, None] - gaps).min(axis=0).max() < 1e-6
    assert figure.axes[0].get_ylabel() == "speed W (m/s)"


@pytest.mark.parametrize(("law", "shift"), [("lin", 0.0), ("idm", 4.5)])
def test_measured_points_use_net_gaps_where_the_law_does(
    tidy: pd.DataFrame, law: str, shift: float
) -> None:
    model = Traffic([make_law(law)])
    without_length, with_length = (
        measured_speeds(list(nnode.sequences(table)), model)[:, 0]
        for table in (tidy.drop(columns="length"), tidy.assign(length=4.5))
    )
    assert with_length == pytest.approx(without_length - shift)
