"""The demonstration: ``python -m nnode.app.demo FOLDER``, which ``make demo`` runs.

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
from nnode.discover.options import DiscoverOptions
from nnode.discover.report.files import amount, interval
from nnode.errors import NNodeError
from nnode.files import write_text
from nnode.machine import how_made
from nnode.pages.page import (
    Block,
    FigureBlock,
    Heading,
    Provenance,
    TableBlock,
    Text,
    write_page,
)
from nnode.plots import force_figure, measured_gaps, speed_curves
from nnode.plots.style import with_unit
from nnode.simulation.base import DEFAULT_STEP

#: Steps of Euler's scheme of the compared calibrations, s: the paper's, and ten times that.
STEPS = (DEFAULT_STEP["traffic", 1], 10 * DEFAULT_STEP["traffic", 1])
#: Force that counts as zero, N.
_WEAK = 0.1
#: Name of the page in the demonstration's folder.
PAGE = "demo"


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
    truth = SlowZone()
    raw = demo_data(folder / "raw", seed, platoons)
    _step("1/6 A table of platoons")
    data = _data(raw["table"], truth, platoons)
    _step("2/6 Check of the table")
    checked = _checked(raw["table"], folder)
    _step("3/6 Calibration without a hidden effect: truth and estimate")
    calibration = _calibration(raw["nothing_hidden"], truth, folder)
    # a second process works on the last two steps, but not while calibrations are timed
    with ProcessPoolExecutor(1, get_context("spawn")) as second:
        diagnosed = second.submit(_printed, _diagnosed, raw["nothing_hidden"], None)
        trained = second.submit(_printed, _trained, raw["juelich"], folder / "crowd", epochs)
        _step("4/6 Diagnosis with a hidden slow zone")
        report = _diagnosed(raw["table"], folder / "diagnosis")
        lacking = _lacking(report, truth)
        _step("5/6 Diagnosis without a hidden effect")
        nothing, printed = diagnosed.result()
        print(printed, end="")
        absent = _absent(nothing)
        _step("6/6 Forces between people, learned by networks")
        print(trained.result()[1], end="")
    crowd = _crowd(raw["juelich"], folder / "crowd")
    seconds = time.monotonic() - start
    facts = how_made(("torch", "numpy", "scipy", "matplotlib"))
    page, *_ = write_page(
        [
            *_summary(report, nothing, truth),
            *data,
            *checked,
            *calibration,
            *lacking,
            *absent,
            *crowd,
            *_USER_TABLE,
            Provenance({**facts, "Seed of the data": f"{seed}", "Time": f"{seconds:.0f} s"}),
        ],
        folder,
        title="nnode: a missing effect, found in a table of platoons",
        subtitle="One table of synthetic platoons contains a hidden slow zone, and the diagnosis "
        f"names **{_names(report)}**. The second table contains none, and the diagnosis names "
        f"**{_names(nothing)}**.",
        stem=PAGE,
    )
    _step("Results")
    for what, path in {
        "checkpoints": f"{folder}/*/checkpoints/best.pt",
        "force plots": f"{folder}/figures/law.png, {folder}/figures/force.png",
        "loss curves": f"tensorboard --logdir {folder}",
        "diagnosis in full": folder / "diagnosis" / "report.html",
        "your own table": "nnode check mine.csv",
        "time": f"{time.monotonic() - start:.0f} s",
        "page": page,
    }.items():
        print(f"{what + ':':<19}{path}")
    return page


def _printed(work: Callable[..., Any], *arguments: Any) -> tuple[Any, str]:
    """The result of a function, and what it prints, which is not shown."""
    with redirect_stdout(StringIO()) as text:
        result = work(*arguments)
    return result, text.getvalue()


def _step(title: str) -> None:
    print(f"\n== {title}", flush=True)


def _summary(report: Report, nothing: Report, truth: SlowZone) -> list[Block]:
    gap = report.gap
    lines = [
        f"**With a hidden slow zone:** {report.sentence}",
        f"**Without a hidden effect:** {nothing.sentence} {_missed(nothing)}",
    ]
    if report.effects:
        hidden = f"alpha = {truth.alpha:g}, a = {truth.a:g} m, b = {truth.b:g} m"
        named = "; ".join(f"{effect.name}: {interval(effect)}" for effect in report.effects)
        lines.insert(1, f"**Estimate:** {named}. **Hidden:** {hidden}.")
    figure = report.plot("map")
    for ax in figure.axes[: 1 + bool(report.effects)]:
        for place in (truth.a, truth.b):
            ax.axhline(place, color="black", linewidth=0.9, linestyle="--")
    errors = f"error on confirmation platoons: {amount(gap.before)} m²"
    if report.effects:
        errors += f" before, {amount(gap.after)} m² after; noise floor {amount(gap.noise_floor)} m²"
    figure.suptitle(errors, fontsize=10)
    return [
        Text("\n".join(f"- {line}" for line in lines)),
        FigureBlock(
            "map",
            figure,
            "Measured minus simulated speed of all platoons by time and position, for the "
            "calibrated law without and with the effect that the diagnosis adds. Dashed lines are "
            "the edges of the hidden zone, which are unknown to the diagnosis. All drivers are "
            "simulated with the parameters of the typical driver for two seconds at a time, so "
            "differences between drivers remain. The law without the effect was also fitted to "
            "data in the zone, so it deviates outside the zone as well. Grey: no vehicle.",
            f"Two space-time maps; {errors}.",
        ),
    ]


def _names(report: Report) -> str:
    return ", ".join(effect.name for effect in report.effects) or "nothing"


# -- data and check --------------------------------------------------------------------------------


def _data(path: Path, truth: SlowZone, platoons: int) -> list[Block]:
    table = pd.read_csv(path)
    words = (
        f"{platoons} platoons of {table.agent.nunique() // platoons} cars, {len(table)} positions. "
        f"Each car follows dx/dt = v0 (1 − L/gap) with L = {truth.L:g} m; drivers differ in v0 "
        f"(mean {truth.v0:g} m/s, standard deviation {100 * truth.drivers:g} %). Positions carry "
        f"an error of {truth.noise:g} m. The hidden zone lies between {truth.a:g} and "
        f"{truth.b:g} m, where all cars drive at {truth.alpha:g} times this speed."
    )
    print(words)
    print(table.head(3).to_string(index=False))
    return [
        Heading("The table"),
        Text(words + " A second table has the same drivers, leaders and errors without a zone."),
        TableBlock("rows", table.head(3), "First rows. Times are in s, positions in m."),
    ]


def _checked(path: Path, folder: Path) -> list[Block]:
    check = nnode.check(path)
    check.write(folder / "check")
    print(check)
    rows = [(finding.level, finding.kind, finding.text) for finding in check.findings]
    return [
        Heading("Check"),
        Text(f"```sh\nnnode check {path}\n```"),
        TableBlock(
            "findings",
            pd.DataFrame(rows, columns=["level", "kind", "finding"]),
            "Findings of `nnode check`. The page `check/check.html` contains the details.",
        ),
    ]


# -- calibration -----------------------------------------------------------------------------------


def _calibration(path: Path, truth: SlowZone, folder: Path) -> list[Block]:
    run = nnode.fit(path, "traffic", model="lin", leader="measured", drivers="auto", heldout=0.0)
    assert run.drivers is not None
    checkpoint = run.save(folder / "calibration" / "checkpoints" / "best.pt")
    write_text(folder / "calibration" / "summary.txt", run.summary())
    rows = {
        "v0 of the median driver (m/s)": (truth.v0, *_row(run.parameters, "lin.v0")),
        "L (m)": (truth.L, *_row(run.parameters, "lin.L")),
    }
    variability = run.drivers.variability
    if "v0" in variability.index:
        rows["v0 between drivers (%)"] = (100 * truth.drivers, *_row(variability, "v0"))
    rows["error of positions (m)"] = (truth.noise, *_row(variability, "measurement"))
    estimates = _with_truth(rows)
    print(estimates.to_string())
    compared = _compared(path)
    print(compared.to_string())
    sequences = nnode.sequences(path, domain="traffic")
    law = speed_curves({"lin": nnode.load(checkpoint)}, measured_gaps(sequences))
    return [
        Heading("Calibration"),
        Text(
            "```python\nrun = nnode.fit(table, 'traffic', model='lin', leader='measured', "
            "drivers='auto')\n```\n\nThe law is correct for the table without a zone. All "
            f"{run.fit.sequences} platoons are used. Parameters that differ between drivers, "
            f"selected by the marginal likelihood: {', '.join(run.drivers.differ) or 'none'}."
        ),
        TableBlock(
            "estimates",
            estimates,
            "Truth and estimate with 95 % intervals by platoons. *Covered*: the interval contains "
            "the truth.",
            digits=3,
        ),
        FigureBlock(
            "law",
            law,
            "Speed of the median driver by gap, and the measured gaps.",
            "Speed against gap, with a histogram of measured gaps.",
        ),
        Heading("Comparison with SciPy", 3),
        Text(
            "Both programs solve the same least-squares problem: two parameters that all drivers "
            "share, residuals of the positions of all followers, platoons simulated behind the "
            "measured leader from the first measured positions, Euler's method with the same step, "
            "and the same start (v0 = 30 m/s, L = 5 m). SciPy's `least_squares` uses its default "
            "method (trust region) and tolerances, a vectorised simulation in NumPy, and finite "
            "differences. nnode uses the Gauss–Newton method with compiled exact derivatives. Wall "
            "times are measured from the data in memory to the result, for nnode with intervals."
        ),
        TableBlock(
            "scipy",
            compared,
            "Results of one run each. *First call*: includes compilation, or loading of earlier "
            "compiled code. All drivers share their parameters, unlike in the calibration above.",
            digits={"v0 (m/s)": 4, "L (m)": 4, "RMSE (m)": 5},
        ),
    ]


def _row(table: pd.DataFrame, name: str) -> tuple[float, float, float]:
    estimate, lower, upper = (float(table[key][name]) for key in ("estimate", "lower", "upper"))
    return estimate, lower, upper


def _with_truth(rows: dict[str, tuple[float, float, float, float]]) -> pd.DataFrame:
    """Truth, estimate and interval by name; ``covered`` is a dash without an interval."""
    table = pd.DataFrame(rows, index=["truth", "estimate", "lower", "upper"]).T
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


def _lacking(report: Report, truth: SlowZone) -> list[Block]:
    d, gap = report.diagnosis, report.gap
    hidden = {"alpha": truth.alpha, "a": truth.a, "b": truth.b}
    zone = next((estimate for estimate in report.effects if estimate.name == "speed_zone"), None)
    coefficients = {} if zone is None else zone.coefficients
    rows = {
        with_unit(f"speed_zone.{name}", c.unit): (hidden[name], c.value, c.low, c.high)
        for name, c in coefficients.items()
        if name in hidden
    }
    for name, value in (("v0", truth.v0), ("L", truth.L)):
        entry = d.base[f"lin.{name}"]
        rows[with_unit(name, entry["unit"])] = (value, entry["after"], np.nan, np.nan)
    for row in d.drivers:
        if row.name == "v0":
            values = row.estimate, row.lower, row.upper
            rows["v0 between drivers (%)"] = (100 * truth.drivers, *values)
    table = _with_truth(rows)
    print(table.to_string())
    words = "Truth and estimates with the effects, with 95 % intervals by platoons."
    if zone is not None and "no" in list(table["covered"]):
        words += (
            " Intervals account for measurement errors and drivers and assume the form of the "
            f"effect, `{zone.formula}`. The hidden zone has sharp edges, which shifts the "
            "estimates of its strength and edges. Of the other intervals, 5 % do not contain the "
            "truth by chance."
        )
    at = next((p for p in d.places if p.variable == "position"), None)
    where = ""
    if at is not None:
        where = (
            f" The largest missing term of the law lies between {at.low:.0f} and {at.high:.0f} m "
            f"({amount(at.deviation)} ± {amount(at.error, 2)} m/s to first order)."
        )
        print(where.strip())
    clusters = report.clusters
    return [
        Heading("Diagnosis with a hidden zone"),
        Text(
            "```python\nreport = nnode.diagnose(table, 'traffic', model='lin', folder='runs/mine')"
            f"\n```\n\nThe search uses {clusters.open} exploration platoons, and the test uses "
            f"{clusters.sealed} confirmation platoons.{where} The catalogue contains "
            f"{len(d.absences) + len(d.effects)} effects for this law and these data, including "
            "slow zones. The page `diagnosis/report.html` contains the full diagnosis."
        ),
        TableBlock("effects", table, words, digits=4),
        FigureBlock(
            "sealed",
            report.plot("sealed"),
            f"Errors of the confirmation platoons; mean {amount(gap.before)} m² before, "
            f"{amount(gap.after)} m² after. {gap.definition} Law and effects are calibrated on "
            "exploration platoons, and the deviation of a driver on the confirmation platoon.",
            "Mean square errors of confirmation platoons, in pairs.",
        ),
    ]


def _absent(report: Report) -> list[Block]:
    missed = _missed(report)
    print(missed)
    rows = [
        {
            "effect": absence.name,
            "coefficient": absence.coefficient,
            "detectable": amount(absence.detectable if absence.testable else None),
            "unit": "" if absence.unit == "1" else absence.unit,
            "remark": absence.reason,
        }
        for absence in report.diagnosis.absences
    ]
    return [
        Heading("Diagnosis without a hidden zone"),
        Text(f"{report.sentence} {missed}"),
        TableBlock(
            "absences",
            pd.DataFrame(rows),
            "Effects that were not found. *Detectable*: smallest change of the coefficient, or "
            "setting of an effect without a strength, that is named and confirmed with a power of "
            f"80 %. The search has a level of {100 * DiscoverOptions().alpha:g} % over all "
            "effects, so about this share of tables without a hidden effect yields a false "
            "hypothesis.",
        ),
    ]


def _missed(report: Report) -> str:
    """The sentence on the smallest detectable zone; empty if one was found."""
    zone = next((a for a in report.diagnosis.absences if a.name == "speed_zone"), None)
    if zone is None:
        return ""
    if not zone.testable:
        return f"A slow zone cannot be excluded: {zone.reason}."
    size = amount(100 * (zone.detectable or 0))
    return (
        f"A zone that changes speeds by {size} % or more is named with a power of at least 80 % "
        f"({zone.reason})."
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


def _crowd(path: Path, folder: Path) -> list[Block]:
    costs = json.loads((folder / RESULT).read_text(encoding="utf-8"))["summary"]
    checkpoint = folder / "checkpoints" / "best.pt"
    model, store, forces = nnode.load(checkpoint), Store(folder / "data"), Forces()
    reach = 2 * forces.r + forces.B * np.log(forces.A / _WEAK)
    command = f"nnode train experiment=demo_crowd data.source={path.parents[1]}"
    return [
        Heading("Forces in a crowd"),
        Text(
            f"```sh\n{command}\ntensorboard --logdir {folder}\n```\n\nThe paper's model of a crowd:"
            " networks with one hidden layer represent the forces from people and from walls. They "
            "are calibrated with the gradient of the trajectory error. The mean cost of a training "
            f"sequence decreases from {amount(costs['cost_start'])} to "
            f"{amount(costs['cost_train'])} m² s; that of a held-out sequence is "
            f"{amount(costs['cost_heldout'])} m² s. The force is drawn from the checkpoint; "
            "TensorBoard shows the loss by epoch."
        ),
        FigureBlock(
            "force",
            force_figure(model, [store[i] for i in range(len(store))]),
            "Both components of the force on one of two people who meet head-on, by relative "
            "position. Dots are measured relative positions. The true repulsion is below "
            f"{_WEAK:g} N beyond {reach:.2g} m, so forces at larger distances are errors of this "
            "short calibration.",
            "Contours of both components of a force by relative position.",
        ),
    ]


_USER_TABLE: list[Block] = [
    Heading("Your own table"),
    Text(
        "A CSV file with a row per car and sample is sufficient. Columns and units are "
        "recognised.\n\n"
        "```sh\nnnode check mine.csv\n```\n\n"
        "```python\nimport nnode\n\nreport = nnode.diagnose('mine.csv', model='idm', "
        "folder='runs/mine')\nprint(report.summary())\n```"
    ),
]


if __name__ == "__main__":
    try:
        demo(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/demo"))
    except NNodeError as error:
        sys.exit(f"error: {error}")
