"""What the demonstration's runs found, beside what was put into its recordings."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from nnode.data.synthetic.platoons import SlowZone
from nnode.errors import DataError

#: Parameters of the cars' law in the demonstration's traffic recording.
TRAFFIC = {"v0": 25.0, "L": 6.0}


def beside_truth(folder: Path | str) -> str:
    """Estimates of ``make demo`` and the truth, a line each.

    Args:
        folder: of the demonstration's runs: ``traffic/result.json`` of the calibration and
            ``diagnosis/report.json`` of the diagnosis are read.

    Raises:
        DataError: one of the two files is missing or is no JSON.
    """
    folder = Path(folder)
    calibrated = _read(folder / "traffic" / "result.json")["parameters"]
    report = _read(folder / "diagnosis" / "report.json")
    lines = ["calibration of the linear law on the traffic recording"]
    for name, value in TRAFFIC.items():
        row = calibrated[f"lin.{name}"]
        lines.append(_row(name, row["unit"], value, row["value"], row["low"], row["high"]))
    return "\n".join([*lines, *_diagnosis(report, SlowZone(), folder / "diagnosis")])


def _diagnosis(report: dict[str, Any], truth: SlowZone, folder: Path) -> list[str]:
    number = sum(len(names) for names in report["split"].values())
    hidden = {"speed_zone": {"alpha": truth.alpha, "a": truth.a, "b": truth.b}}
    found = {effect["name"]: effect["coefficients"] for effect in report["effects"]}
    lines = [
        f"diagnosis of the linear law on {number} platoons, among them "
        f"{len(report['split']['sealed'])} held back",
        f"  hidden in the data: {', '.join(hidden)}; drivers whose v0 differ; noise of "
        f"{truth.noise:g} m",
        f"  effects named:      {', '.join(found) or 'none'} (verdict: {report['verdict']})",
    ]
    at = next((one for one in report["places"] if one["variable"] == "position"), None)
    if at is not None:
        lines.append(
            f"  where the law without effects deviates most: between {at['low']:.0f} and "
            f"{at['high']:.0f} m, by {at['deviation']:.2f} ± {at['error']:.2f} m/s (the slow zone "
            f"lies between {truth.a:g} and {truth.b:g} m)"
        )
    for effect, values in hidden.items():
        for name, value in values.items():
            c = found.get(effect, {}).get(name, {"unit": "1"})
            label = f"{effect}.{name}"
            lines.append(_row(label, c["unit"], value, c.get("value"), c.get("low"), c.get("high")))
    for name, value in (("v0", truth.v0), ("L", truth.L)):
        c = report["base"][f"lin.{name}"]
        lines.append(_row(name, c["unit"], value, c["after"]))
    spread = {one["name"]: one for one in report["drivers"]}.get("v0", {})
    ends = (spread.get(key) for key in ("estimate", "lower", "upper"))
    lines.append(_row("v0 between drivers", "%", 100 * truth.drivers, *ends))
    gap = report["gap"]
    lines += [
        "  mean square error on the held-back platoons: "
        f"{gap['before']:.3g} m² before, {gap['after']:.3g} m² after; noise "
        f"{gap['noise_floor']:.2g} m² (truth: {truth.noise**2:.2g} m²)",
        f"  page: {folder / 'report.html'}",
    ]
    return lines


def _row(
    name: str,
    unit: str,
    truth: float,
    value: float | None,
    low: float | None = None,
    high: float | None = None,
) -> str:
    label = name if unit in ("", "1") else f"{name} ({unit})"
    estimate = "not found" if value is None else f"{value:.4g}"
    interval = "" if low is None or high is None else f" [{low:.4g}, {high:.4g}]"
    return f"  {label:<28} truth {truth:<6g} estimate {estimate}{interval}"


def _read(path: Path) -> dict[str, Any]:
    try:
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(f"{path} cannot be read ({error}); run `make demo` first") from error
    return found
