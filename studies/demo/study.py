"""The demonstration: ``python -m studies.demo.study FOLDER``, which ``make demo`` runs.

A table of platoons is checked, a law is calibrated, and a diagnosis finds the effect that the law
lacks. A second diagnosis uses a table without a hidden effect, and networks learn the forces in a
crowd. All printed and shown values come from the results of this run.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import redirect_stdout
from functools import partial
from io import StringIO
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from omegaconf import open_dict
from scipy.optimize import least_squares

import nnode
from nnode.app.cli.runs import RESULT
from nnode.app.cli.saved import GROUPS, composed
from nnode.app.python.report import Report
from nnode.app.train import train
from nnode.config import register
from nnode.data.store import Store
from nnode.data.synthetic import Forces, SlowZone, demo_data
from nnode.diagnosis.options import DiscoverOptions
from nnode.diagnosis.report.files import amount, interval
from nnode.errors import NNodeError
from nnode.files import write_text
from nnode.machine import how_made
from nnode.pages.page import Provenance, write_page
from nnode.plots import force_figure, measured_gaps, speed_curves
from nnode.plots.style import with_unit
from nnode.simulation.base import DEFAULT_STEP
from studies.page import page

#: Steps of Euler's scheme of the compared calibrations, s: the paper's, and ten times that.
STEPS = (DEFAULT_STEP["traffic", 1], 10 * DEFAULT_STEP["traffic", 1])
#: Force that counts as zero, N.
_WEAK = 0.1


def demo(folder: Path, *, seed: int = 0, platoons: int = 20, epochs: int = 60) -> Path:
    """Run the demonstration, and write its page.

    Args:
        folder: folder for data, runs and the page.
        seed: seed of the data.
        platoons: number of platoons in each table.
        epochs: number of epochs for the crowd's networks.

    Returns:
        Path of the page.

    Raises:
        NNodeError: the folder cannot be written to.
    """
    start = time.monotonic()
    truth, forces = SlowZone(), Forces()
    raw = demo_data(folder / "raw", seed, platoons)
    _step("1/6 A table of platoons")
    table = pd.read_csv(raw["table"])
    print(f"{platoons} platoons, {len(table)} positions: {raw['table']}")
    print(table.head(3).to_string(index=False))
    _step("2/6 Check of the table")
    check = nnode.check(raw["table"])
    check.write(folder / "check")
    print(check)
    findings = [(finding.level, finding.kind, finding.text) for finding in check.findings]
    _step("3/6 Calibration without a hidden effect: truth and estimate")
    run, law = _calibrated(raw["nothing_hidden"], folder / "calibration")
    estimates = _estimates(run, truth)
    compared = _compared(raw["nothing_hidden"])
    print(estimates.to_string(), compared.to_string(), sep="\n")
    # a second process works on the last two steps, but not while calibrations are timed
    with ProcessPoolExecutor(1, get_context("spawn")) as second:
        diagnosed = second.submit(_printed, _diagnosed, raw["nothing_hidden"], None)
        trained = second.submit(_printed, _trained, raw["juelich"], folder / "crowd", epochs)
        _step("4/6 Diagnosis with a hidden slow zone")
        report = _diagnosed(raw["table"], folder / "diagnosis")
        effects = _effects(report, truth)
        print(effects.to_string())
        _step("5/6 Diagnosis without a hidden effect")
        nothing, printed = diagnosed.result()
        print(printed, end="")
        _step("6/6 Forces between people, learned by networks")
        print(trained.result()[1], end="")
    crowd, store = folder / "crowd", Store(folder / "crowd" / "data")
    force = force_figure(
        nnode.load(crowd / "checkpoints" / "best.pt"), [store[i] for i in range(len(store))]
    )
    blocks = page(
        "demo",
        rows=table.head(3),
        findings=pd.DataFrame(findings, columns=["level", "kind", "finding"]),
        estimates=estimates,
        scipy=compared,
        effects=effects,
        absences=_absences(nothing),
        deviations=_map(report, truth),
        law=law,
        errors_by_platoon=report.plot("confirmation"),
        force=force,
        truth=truth,
        report=report,
        nothing=nothing,
        run=run,
        cars=table.agent.nunique() // platoons,
        platoons=platoons,
        positions=len(table),
        raw=raw,
        folder=folder,
        zone=next((effect for effect in report.effects if effect.name == "speed_zone"), None),
        place=next((p for p in report.places if p.variable == "position"), None),
        missed=next((a for a in nothing.diagnosis.absences if a.name == "speed_zone"), None),
        costs=json.loads((crowd / RESULT).read_text(encoding="utf-8"))["summary"],
        weak=_WEAK,
        reach=2 * forces.r + forces.B * np.log(forces.A / _WEAK),
        alpha=DiscoverOptions().alpha,
        errors=_errors(report),
        amount=amount,
        interval=interval,
    )
    facts = how_made(("torch", "numpy", "scipy", "matplotlib"))
    seconds = f"{time.monotonic() - start:.0f} s"
    html, *_ = write_page(
        [*blocks, Provenance({**facts, "Seed of the data": f"{seed}", "Time": seconds})],
        folder,
        title="nnode: a missing effect, found in a table of platoons",
        subtitle="One table of synthetic platoons contains a hidden slow zone, and the diagnosis "
        f"names **{_names(report)}**. The second table contains none, and the diagnosis names "
        f"**{_names(nothing)}**.",
        stem="demo",
    )
    _step("Results")
    for what, path in {
        "checkpoints": f"{folder}/*/checkpoints/best.pt",
        "force plots": f"{folder}/figures/law.png, {folder}/figures/force.png",
        "loss curves": f"tensorboard --logdir {folder}",
        "diagnosis in full": folder / "diagnosis" / "report.html",
        "your own table": "nnode check mine.csv",
        "time": f"{time.monotonic() - start:.0f} s",
        "page": html,
    }.items():
        print(f"{what + ':':<19}{path}")
    return html


def _printed(work: Callable[..., Any], *arguments: Any) -> tuple[Any, str]:
    """The result of a function, and what it prints, which is not shown."""
    with redirect_stdout(StringIO()) as text:
        result = work(*arguments)
    return result, text.getvalue()


def _step(title: str) -> None:
    print(f"\n== {title}", flush=True)


def _names(report: Report) -> str:
    return ", ".join(effect.name for effect in report.effects) or "nothing"


# -- calibration -----------------------------------------------------------------------------------


def _calibrated(path: Path, folder: Path) -> tuple[nnode.Calibration, Figure]:
    """The calibrated law, and its speed curve."""
    run = nnode.fit(path, "traffic", model="lin", leader="measured", drivers="auto", heldout=0.0)
    checkpoint = run.save(folder / "checkpoints" / "best.pt")
    write_text(folder / "summary.txt", run.summary())
    gaps = measured_gaps(nnode.sequences(path, domain="traffic"))
    return run, speed_curves({"lin": nnode.load(checkpoint)}, gaps)


def _estimates(run: nnode.Calibration, truth: SlowZone) -> pd.DataFrame:
    assert run.drivers is not None
    variability = run.drivers.variability
    rows = {
        "v0 of the median driver (m/s)": (truth.v0, run.parameters.loc["lin.v0"]),
        "L (m)": (truth.L, run.parameters.loc["lin.L"]),
    }
    if "v0" in variability.index:
        rows["v0 between drivers (%)"] = (100 * truth.drivers, variability.loc["v0"])
    rows["error of positions (m)"] = (truth.noise, variability.loc["measurement"])
    return _with_truth(
        {k: (true, row.estimate, row.lower, row.upper) for k, (true, row) in rows.items()}
    )


def _with_truth(rows: dict[str, tuple[Any, ...]]) -> pd.DataFrame:
    """Truth, estimate and interval by name; ``covered`` is a dash without an interval."""
    table = pd.DataFrame(rows, index=["truth", "estimate", "lower", "upper"], dtype=float).T
    inside = (table["lower"] <= table["truth"]) & (table["truth"] <= table["upper"])
    has_interval = table["lower"].notna() & table["upper"].notna()
    table["covered"] = np.where(has_interval, np.where(inside, "yes", "no"), "–")
    return table


def _compared(path: Path) -> pd.DataFrame:
    """Results of both programs for the pooled problem, with each step."""
    sequences = nnode.sequences(path, domain="traffic")
    x, dt = np.stack([s.x[..., 0] for s in sequences], 1), sequences[0].dt
    start = np.array([30.0, 5.0])
    rows = []
    for step in STEPS:
        calibrator = nnode.Calibrator(
            "lin", leader="measured", optimizer="gauss_newton", method="euler", dt=step
        )
        first, _ = _timed(partial(calibrator.fit, sequences))
        seconds, _ = _timed(partial(calibrator.fit, sequences))
        result = calibrator.result_
        value = result.parameters["estimate"]
        rows.append((step, "nnode", *value, result.fit.rmse, seconds, first))
        residuals = partial(_residuals, x=x, dt=dt, step=step)
        seconds, solution = _timed(partial(least_squares, residuals, start, x_scale=start))
        rmse = float(np.sqrt(np.mean(solution.fun**2)))
        rows.append((step, "SciPy", *solution.x, rmse, seconds, np.nan))
    heads = ["v0 (m/s)", "L (m)", "RMSE (m)", "wall time (s)", "first call (s)"]
    table = pd.DataFrame(rows, columns=["step (s)", "program", *heads])
    return table.set_index(["step (s)", "program"])


def _timed(work: Callable[[], Any]) -> tuple[float, Any]:
    start = time.perf_counter()
    result = work()
    return time.perf_counter() - start, result


def _residuals(row: np.ndarray, x: np.ndarray, dt: float, step: float) -> np.ndarray:
    """Simulated minus measured positions of followers after the first sample, in plain NumPy.

    Args:
        row: v0 and L.
        x: ``(K, B, N)`` measured positions, m; the last car leads, along straight lines between
            its samples.
        dt: sampling interval, s.
        step: time step of Euler's scheme, s.
    """
    v0, length = row
    number = round(dt / step)
    state, path = x[0, :, :-1], []
    for now, after in pairwise(x[:, :, -1:]):
        for k in range(number):
            leader = now + (after - now) * (k / number)
            gap = np.diff(np.concatenate([state, leader], 1))
            state = state + step * v0 * (1 - length / gap)
        path.append(state)
    away: np.ndarray = (np.stack(path) - x[1:, :, :-1]).ravel()
    return away


# -- diagnosis -------------------------------------------------------------------------------------


def _diagnosed(path: Path, folder: Path | None) -> Report:
    options = DiscoverOptions(compare=[], replay=False)  # without comparing laws, to be faster
    report = nnode.diagnose(path, "traffic", model="lin", folder=folder, options=options)
    print(report.sentence)
    return report


def _errors(report: Report) -> str:
    gap = report.gap
    errors = f"error on confirmation platoons: {amount(gap.before)} m²"
    if report.effects:
        errors += f" before, {amount(gap.after)} m² after; noise floor {amount(gap.noise_floor)} m²"
    return errors


def _map(report: Report, truth: SlowZone) -> Figure:
    """The map of deviations, with the edges of the hidden zone."""
    figure = report.plot("map")
    for ax in figure.axes[: 1 + bool(report.effects)]:
        for place in (truth.a, truth.b):
            ax.axhline(place, color="black", linewidth=0.9, linestyle="--")
    figure.suptitle(_errors(report), fontsize=10)
    return figure


def _effects(report: Report, truth: SlowZone) -> pd.DataFrame:
    """Truth and estimates of the model with the effects."""
    hidden = {"alpha": truth.alpha, "a": truth.a, "b": truth.b}
    rows = {
        with_unit(f"speed_zone.{name}", c.unit): (hidden[name], c.value, c.low, c.high)
        for effect in report.effects
        if effect.name == "speed_zone"
        for name, c in effect.coefficients.items()
        if name in hidden
    }
    for name, value in (("v0", truth.v0), ("L", truth.L)):
        entry = report.diagnosis.base[f"lin.{name}"]
        rows[with_unit(name, entry["unit"])] = (value, entry["after"], np.nan, np.nan)
    for row in report.diagnosis.drivers:
        if row.name == "v0":
            values = row.estimate, row.lower, row.upper
            rows["v0 between drivers (%)"] = (100 * truth.drivers, *values)
    return _with_truth(rows)


def _absences(report: Report) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "effect": absence.name,
            "coefficient": absence.coefficient,
            "detectable": amount(absence.detectable if absence.testable else None),
            "unit": "" if absence.unit == "1" else absence.unit,
            "remark": absence.reason,
        }
        for absence in report.diagnosis.absences
    )


# -- crowd -----------------------------------------------------------------------------------------


def _trained(path: Path, folder: Path, epochs: int) -> None:
    register()
    source, options = path.parents[1], ["experiment=demo_crowd", f"trainer.max_epochs={epochs}"]
    config = composed("train", [*options, f"data.source={source.absolute()}"])
    with open_dict(config):
        groups = config.pop("hydra").runtime.choices
        config.groups = {name: groups[name] for name in GROUPS}
    train(config, folder)


if __name__ == "__main__":
    try:
        demo(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/demo"))
    except NNodeError as error:
        sys.exit(f"error: {error}")
