"""Tables of a diagnosis' page."""

from __future__ import annotations

import math
from typing import Any

import pandas as pd

from nnode.data.quality import KINDS
from nnode.discover.report.files import amount, estimate, in_unit
from nnode.discover.result import Alternative, Diagnosis, Laws, NamedEffect
from nnode.model.term import short_names
from nnode.pages.page import TableBlock

#: Largest number of faults on the page; the CSV file contains all.
LISTED = 30


def _table(name: str, rows: list[dict[str, Any]], caption: str, **options: Any) -> TableBlock:
    return TableBlock(name, pd.DataFrame(rows), caption, **options)


def coefficients_table(effects: list[NamedEffect], name: str = "coefficients") -> TableBlock:
    """The coefficients of some effects."""
    rows = [
        {
            "effect": effect.name,
            "coefficient": coefficient,
            **dict(zip(("value", "95 % from", "to"), estimate(c), strict=True)),
            "unit": _unit(c.unit),
            "where": effect.where,
            "p on sealed clusters": amount(effect.confirmed, 2),
        }
        for effect in effects
        for coefficient, c in effect.coefficients.items()
    ]
    return _table(
        name, rows, "Coefficients with 95 % intervals; one-sided p on the sealed clusters."
    )


_ERRORS = {
    "traffic": "The errors are mean squares over whole paths in open clusters that calibrations to "
    "nothing else left out: not those of the sealed sequences.",
    "crowd": "The errors are mean squares in the open clusters that the calibration saw: not those "
    "of the sealed sequences.",
}


def laws_table(laws: Laws, name: str, domain: str) -> TableBlock:
    """Base laws, the best first."""
    rows = [
        {
            "law": law.name,
            "parameters": law.parameters,
            "held-out cost above the best (%)": amount(100 * law.behind),
            "p": amount(law.p_value, 2),
            "error on left-out open clusters (m²)": amount(law.error),
            "calibrated": ", ".join(
                f"{name.partition('.')[2] or name} {amount(value)}{in_unit(unit)}"
                for name, (value, unit) in law.values.items()
            ),
        }
        for law in laws.ranking
    ]
    restriction = ""
    if laws.effects:
        restriction = f", those that have a place for it with {', '.join(laws.effects)}"
    return _table(
        name,
        rows,
        f"Base laws on the open sequences{restriction}. *held-out cost*: of whitened "
        "residuals, mean of logarithms over clusters; *p*: one-sided, that the law is as good as "
        f"the first. {_ERRORS[domain]}",
    )


def clusters_table(d: Diagnosis) -> TableBlock:
    """The numbers of clusters, and the numbers that are needed."""
    c = d.clusters
    rows = [
        {"clusters": "open", "there are": c.open, "it takes": c.least, "to": "name any effect"},
        {"clusters": "sealed", "there are": c.sealed, "it takes": c.least_sealed, "to": "confirm"},
    ]
    return _table("clusters", rows, "Clusters are what is taken as independent.")


def screen_table(d: Diagnosis) -> TableBlock:
    """The effects that explain most in the exploration sequences."""
    rows = [
        {
            "effect": score["name"],
            "share of the squared residuals": _percent(score["share"]),
            "p": amount(score["p_value"], 2),
            "about": ", ".join(
                f"{name} {amount(value)}"
                for name, value in score.items()
                if name not in ("name", "share", "p_value")
            ),
        }
        for score in d.screen.leads
    ]
    return _table(
        "screen",
        rows,
        "What explains most of the open sequences, by linear response; *about*: by how much the "
        "coefficient would differ from no effect. Where the floor allows no small p, a large one "
        "says nothing.",
    )


def agents_table(d: Diagnosis) -> TableBlock:
    """Agent-specific parameters and their variance components."""
    rows = [
        {
            "effect": a.name,
            "strength": f"{amount(a.strength, 2)} [{amount(a.low, 2)}, {amount(a.high, 2)}]",
            "unit": _unit(a.unit),
            "p": amount(a.p_value, 2),
            **{who: "–" if share is None else _percent(share) for who, share in a.share.items()},
            "p on sealed clusters": amount(a.confirmed, 2),
        }
        for a in d.agents
    ]
    return _table(
        "agents",
        rows,
        "Numbers of agents, estimated in parts of their time. *strength*: what a number carries "
        "over any time. The variance by what it belongs to: the recording, the sequence, the "
        "agent, and moods that pass.",
    )


def drivers_table(d: Diagnosis) -> TableBlock:
    """Variances between drivers and over time."""
    labels = {
        "push": "pushes",
        "push_time": "time that pushes last",
        "measurement": "measured positions",
    }
    rows = [
        {
            "what": labels.get(variation.name, f"{variation.name} between drivers"),
            "standard deviation or time": amount(variation.estimate),
            "95 % interval": "not estimable"
            if math.isnan(variation.lower)
            else f"[{amount(variation.lower)}, {amount(variation.upper)}]",
            "unit": _unit(variation.unit),
            "left open per driver": _percent(variation.shrinkage),
        }
        for variation in d.drivers
    ]
    return _table(
        "drivers",
        rows,
        "Estimated together with the law. Parameters that are not listed do not differ between "
        "drivers as far as these data tell. *Pushes*: what drives speeds (first order) or "
        "accelerations (second order) away from the law for some time. *Left open per driver*: the "
        "share of the variance between drivers that a driver's own data leave, in the median.",
    )


def later_table(d: Diagnosis) -> TableBlock:
    """Errors in the last part of the confirmation sequences, by model."""
    rows = [
        {
            "effect": estimate.name,
            "who predicts": "the model without effects" if who == "base" else who,
            "mean square error (m²)": amount(error),
        }
        for estimate in d.agents
        for who, error in estimate.later.items()
    ]
    return _table(
        "later",
        rows,
        "The last 40 % of each sealed sequence, simulated from the state in which they begin. "
        "Numbers and mean velocities come from the first 40 %, their variance from open "
        "sequences.",
    )


def effects_table(d: Diagnosis) -> TableBlock:
    """The effects that were added, in their order."""
    rows = [
        {
            "effect": effect.name,
            "formula": effect.formula,
            "p": amount(effect.p_value, 2),
            "held-out gain": _percent(effect.gain),
            "source": effect.source,
        }
        for effect in d.effects
    ]
    return _table(
        "effects",
        rows,
        "In the order in which they were added. *p*: how often pure chance scores as high, with "
        "regard to all effects that were looked for. *Held-out gain*: share of the "
        "squared residuals, without their autocorrelation, that the effect removed when it was "
        "added, on open sequences it was not calibrated on.",
    )


def alternatives_table(d: Diagnosis) -> TableBlock:
    """The alternatives to the named effects."""
    rows = [
        {
            "chosen": effect.name,
            "as good": alternative.name,
            "loss relative to the chosen": amount(alternative.loss, 4),
            "p": amount(alternative.p_value, 2),
            "what would tell them apart": _apart(alternative),
            "or so many open clusters": "–"
            if alternative.clusters is None
            else alternative.clusters,
        }
        for effect in d.effects
        for alternative in effect.alternatives
    ]
    return _table(
        "alternatives",
        rows,
        "Effects that the data do not tell from it. *p*: of the hypothesis that the other is "
        "as good. Take none of them for granted before such data are there. *open clusters*: that "
        "tell the two apart with a probability of 90 %, if the difference that was seen is the "
        f"true one; there are {d.clusters.open}. *a leader*: of those whose speed goes "
        "up and down evenly, within measured speeds and 2 m/s², the one behind whom both "
        "calibrated models differ most beyond what their own parameters can mend.",
    )


def _apart(alternative: Alternative) -> str:
    profile = alternative.profile
    leader = (
        ""
        if profile is None
        else (
            f"{profile.platoons} platoons of {profile.lasts:g} s behind a leader who drives from "
            f"{profile.mean - profile.swing:.0f} to {profile.mean + profile.swing:.0f} m/s and "
            f"back every {profile.period:g} s"
        )
    )
    return "; ".join(part for part in (alternative.separated_by, leader) if part) or "–"


def gap_table(d: Diagnosis) -> TableBlock:
    """The error on the confirmation sequences."""
    rows = [
        {"": what, "mean square error (m²)": amount(value)}
        for what, value in (
            (f"{d.model} without effects", d.gap.before),
            *([(f"{d.model} with effects", d.gap.after)] if d.effects else []),
            (f"{d.model} without effects, calibrated to whole paths alone", d.gap.plain),
            *([(f"{d.model} with effects, calibrated so", d.gap.plain_after)] if d.effects else []),
            ("noise of the measurement", d.gap.noise_floor),
        )
        if not math.isnan(value)
    ]
    return _table(
        "gap",
        rows,
        "Mean square error on the sealed sequences. The noise of the measurement is what no model "
        "can explain.",
    )


def confirmation_table(d: Diagnosis) -> TableBlock:
    """The errors of the individual confirmation sequences."""
    rows = [
        {
            "sequence": row["name"],
            "without effects (m²)": amount(row["before"]),
            **({"with effects (m²)": amount(row["after"])} if d.effects else {}),
        }
        for row in d.sealed
    ]
    full = pd.DataFrame(d.sealed).rename(columns={"name": "sequence"})
    cut = f" The first {LISTED} of {len(rows)}; the file has all." if len(rows) > LISTED else ""
    return TableBlock(
        "sealed",
        pd.DataFrame(rows).head(LISTED),
        "Mean square error of each sealed sequence. The errors before and after are their means."
        f"{cut}",
        full=full,
    )


def base_table(d: Diagnosis) -> TableBlock:
    """The change of the model's parameters when effects are added."""
    short = short_names(d.base)
    rows = [
        {
            "parameter": short[name],
            "alone": amount(values.get("before"), 4),
            "with effects": amount(values.get("after"), 4),
            "unit": _unit(values.get("unit", "")),
        }
        for name, values in d.base.items()
    ]
    return _table(
        "parameters",
        rows,
        f"Parameters of {d.model}, calibrated alone and together with the effects. Where they "
        "differ, they had been standing in for what was missing.",
    )


def faults_table(d: Diagnosis) -> TableBlock:
    """Faults of the measurement."""
    rows = [
        {
            "kind": fault.kind,
            "sequence": fault.sequence,
            "agents": ", ".join(fault.agents) or "–",
            "clock time (s)": "–" if fault.time is None else f"{fault.time:.2f}",
            "what": fault.detail or KINDS.get(fault.kind, ""),
        }
        for fault in d.data_faults
    ]
    cut = f" The first {LISTED} of {len(rows)}; the file has all." if len(rows) > LISTED else ""
    frame = pd.DataFrame(rows)
    return TableBlock(
        "data_faults",
        frame.head(LISTED),
        "Faults of the measurement. Where the data have no names for the agents, they are "
        f"numbered in their sequence from 0 on, in a lane from the hindmost.{cut}",
        full=frame,
    )


def places_table(d: Diagnosis, unit: str) -> TableBlock:
    """Where the model deviates from the data."""
    rows = [
        {
            "variable": place.variable,
            "from": amount(place.low),
            "to": amount(place.high),
            "unit": _unit(place.unit),
            f"deviation ({unit})": f"{amount(place.deviation)} ± {amount(place.error, 2)}",
            "share of the excess": _percent(place.share),
            "p": amount(place.p_value, 2),
        }
        for place in d.places
    ]
    return _table(
        "places",
        rows,
        "Where the calibrated model and the measurement part, before anything was added: measured "
        "minus simulated, with its standard error; the share of the error above the noise that "
        "lies there; *p* with regard to all variables and intervals. One cause shows in several "
        "variables.",
    )


def absent_table(d: Diagnosis) -> TableBlock:
    """Effects that are absent, with bounds."""
    rows = [
        {
            "effect": absence.name,
            "coefficient": absence.coefficient,
            "absent to within": amount(absence.bound),
            "would be found from": amount(absence.detectable),
            "unit": _unit(absence.unit),
            "remark": absence.reason or "–",
        }
        for absence in d.absences
        if absence.testable
    ]
    if all(row["remark"] == "–" for row in rows):
        rows = [{key: row[key] for key in row if key != "remark"} for row in rows]
    return _table(
        "absent",
        rows,
        "Effects that were looked for and not found. *Absent to within*: a larger deviation from "
        "no effect is excluded with 95 % confidence. *Would be found from*: the smallest one that "
        "is named with a probability of 80 %, confirmation on sealed clusters included.",
    )


def not_testable_table(d: Diagnosis) -> TableBlock:
    """Effects that are not testable with these data."""
    by_name = {absence.name: absence for absence in d.absences if not absence.testable}
    names = list(dict.fromkeys([*by_name, *d.not_testable]))
    rows = []
    for name in names:
        absence = by_name.get(name)
        needed = amount(absence.detectable) if absence else "–"
        rows.append(
            {
                "effect": name,
                "coefficient": absence.coefficient if absence else "–",
                "would be found from": needed,
                "unit": _unit(absence.unit) if absence else "–",
                "why": (absence.reason if absence else "") or "the data do not excite it",
            }
        )
    return _table(
        "not_testable",
        rows,
        "Effects that would not be named with these data, confirmation on sealed clusters "
        "included, with a probability of 80 % even at the least usual strength: that they were "
        "not found says nothing about them.",
    )


def _unit(unit: str) -> str:
    return in_unit(unit).strip() or "–"


def _percent(share: float) -> str:
    return "–" if share != share else f"{100 * share:.0f} %".replace("-", "−")
