"""Tables of a diagnosis' page.

A table is given by its rows, heading to what it shows there. The heading is also the name of the
column in the CSV file.
"""

from __future__ import annotations

import math
from typing import Any

import pandas as pd

from nnode.data.quality import KINDS
from nnode.diagnosis.report.files import amount, estimate, in_unit
from nnode.diagnosis.result import Alternative, Diagnosis, Laws, NamedEffect
from nnode.model.term import short_names
from nnode.pages.page import TableBlock
from nnode.pages.tables import NOTHING

#: Largest number of faults and of sequences on the page; the CSV file contains all.
LISTED = 30


def _table(name: str, rows: list[dict[str, Any]], caption: str, **options: Any) -> TableBlock:
    full = pd.DataFrame(rows)
    if len(full) > LISTED:
        caption += f" The first {LISTED} of {len(full)} rows; the CSV file contains all."
    filled = [head for head in full if not full[head].eq(NOTHING).all()]
    return TableBlock(name, full[filled].head(LISTED), caption, **{"full": full, **options})


def _unit(unit: str) -> str:
    return in_unit(unit).strip() or NOTHING


def _percent(share: float | None) -> str:
    if share is None or math.isnan(share):
        return NOTHING
    return f"{100 * share:.0f} %".replace("-", "−")


def coefficients_table(effects: list[NamedEffect], name: str = "coefficients") -> TableBlock:
    """The coefficients of some effects."""
    return _table(
        name,
        [
            {
                "effect": effect.name,
                "coefficient": key,
                "value": value,
                "95 % from": low,
                "to": high,
                "unit": _unit(c.unit),
                "where": effect.where,
                "p": amount(effect.combined, 2),
                "p, confirmation": amount(effect.confirmed, 2),
            }
            for effect in effects
            for key, c in effect.coefficients.items()
            for value, low, high in [estimate(c)]
        ],
        "Coefficients with 95 % intervals. *p*: of exploration and confirmation clusters together, "
        "and of the confirmation clusters alone.",
    )


_ERRORS = {
    "traffic": "mean square error of whole sequences, with the same parameters for all drivers, in "
    "exploration clusters that were left out of the calibration.",
    "crowd": "mean square error in the exploration clusters, which were used in the calibration.",
}


#: The head of the column by which laws are ranked, and its explanation.
_CRITERIA = {
    "cost": (
        "held-out cost above the best (%)",
        "*Held-out cost*: mean log error after removing autocorrelation, each cluster left out in "
        "turn; lower is better.",
    ),
    "likelihood": (
        "likelihood below the best (%)",
        "*Likelihood*: of one measured position, geometric mean. Parameters of a law may differ "
        "between agents, and the number of parameters is penalised (BIC).",
    ),
}


def laws_table(laws: Laws, name: str, domain: str) -> TableBlock:
    """Base laws, the best first."""
    effects = f", with {', '.join(laws.effects)} where applicable" if laws.effects else ""
    head, criterion = _CRITERIA["likelihood" if laws.likelihood else "cost"]
    return _table(
        name,
        [
            {
                "law": law.name,
                "parameters": law.parameters,
                head: amount(100 * law.behind),
                "p": amount(law.p_value, 2),
                "error (m²)": amount(law.error),
                "parameters at": ", ".join(
                    f"{key.partition('.')[2] or key} {amount(value)}{in_unit(unit)}"
                    for key, (value, unit) in law.values.items()
                ),
            }
            for law in laws.ranking
        ],
        f"Base laws on {laws.clusters} exploration clusters{effects}. {criterion} "
        f"*p*: one-sided, for the law being as good as the first one. *Error*: {_ERRORS[domain]}",
    )


def clusters_table(d: Diagnosis) -> TableBlock:
    """The numbers of clusters, and the numbers that are needed."""
    c = d.clusters
    return _table(
        "clusters",
        [
            dict(zip(("clusters", "available", "required", "in order to"), row, strict=True))
            for row in (
                ("exploration", c.exploration, c.least_exploration, "name an effect"),
                ("confirmation", c.confirmation, c.least_confirmation, "confirm an effect"),
            )
        ],
        "Numbers of independent clusters.",
    )


def screen_table(d: Diagnosis) -> TableBlock:
    """The effects that explain most in the exploration sequences."""
    fixed = ("name", "share", "p_value")
    return _table(
        "screen",
        [
            {
                "effect": row["name"],
                "share of the squared residuals": _percent(row["share"]),
                "p": amount(row["p_value"], 2),
                "change": ", ".join(
                    f"{key} {amount(value)}" for key, value in row.items() if key not in fixed
                ),
            }
            for row in d.screen.strongest
        ],
        "Effects that explain most of the exploration sequences, by linear response. *Change*: "
        f"difference of the coefficient from its neutral value. No p can be below "
        f"{amount(d.screen.floor, 2)} with this number of clusters.",
    )


def agents_table(d: Diagnosis) -> TableBlock:
    """Agent-specific parameters and their variance components."""
    parts = list(dict.fromkeys(part for row in d.agents for part in row.share))
    return _table(
        "agents",
        [
            {
                "effect": a.name,
                "strength": f"{amount(a.strength, 2)} [{amount(a.low, 2)}, {amount(a.high, 2)}]",
                "unit": _unit(a.unit),
                "p": amount(a.p_value, 2),
                **{part: _percent(a.share.get(part)) for part in parts},
                "p, confirmation": amount(a.confirmed, 2),
                "separable from (s)": amount(a.lasts, 2),
                "named": "yes" if a.named else f"no: {a.reason}",
            }
            for a in d.agents
        ],
        "Agent-specific parameters. *Strength*: standard deviation between agents, with its 95 % "
        "interval. *Recording*, *sequence*, *agent*, *transient*: shares of the variance. A "
        "deviation that lasts longer than *separable from* cannot be distinguished from a constant "
        "difference between agents.",
    )


_VARIATIONS = {
    "push": "process noise",
    "push_time": "correlation time of the process noise",
    "measurement": "measurement error of positions",
    "lasting_error": "autocorrelated measurement error of positions",
    "lasting_error_time": "correlation time of this error",
    "sway": "sway from side to side",
    "sway_along": "sway along the direction of walking",
    "sway_frequency": "frequency of the sway from side to side",
    "sway_time": "correlation time of the sway",
}
#: What agents are called.
_AGENTS = {"traffic": ("driver", "drivers"), "crowd": ("person", "people")}


def drivers_table(d: Diagnosis) -> TableBlock:
    """Variances between agents and over time."""
    agent, agents = _AGENTS[d.domain]
    return _table(
        "drivers",
        [
            {
                "quantity": _VARIATIONS.get(row.name, f"{row.name} between {agents}"),
                "estimate": amount(row.estimate),
                "95 % interval": "not estimable"
                if math.isnan(row.lower)
                else f"[{amount(row.lower)}, {amount(row.upper)}]",
                "unit": _unit(row.unit),
                "posterior variance": _percent(row.shrinkage),
            }
            for row in d.drivers
        ],
        f"Standard deviations between {agents} and over time, estimated together with the law. "
        f"No differences between {agents} were found, or sought, in parameters that are not "
        "listed. The process noise acts on speeds (laws of first order) or accelerations (second "
        "order). Measurement errors and sway that were estimated before have no interval. "
        f"*Posterior variance*: of the parameter of a {agent}, relative to the variance between "
        f"{agents} (median).",
    )


def later_table(d: Diagnosis) -> TableBlock:
    """Errors in the last part of the confirmation sequences, by model."""
    return _table(
        "later",
        [
            {
                "effect": row.name,
                "model": "without effects" if who == "base" else who,
                "mean square error (m²)": amount(error),
            }
            for row in d.agents
            for who, error in row.later.items()
        ],
        "Errors in the last 40 % of each confirmation sequence, simulated from the state at its "
        "start. Agent-specific parameters and mean velocities come from the first 40 %.",
    )


def effects_table(d: Diagnosis) -> TableBlock:
    """The effects that were added, in their order."""
    return _table(
        "effects",
        [
            {
                "effect": effect.name,
                "formula": effect.formula,
                "p": amount(effect.p_value, 2),
                "held-out gain": _percent(effect.gain),
                "source": effect.source,
            }
            for effect in d.effects
        ],
        "Effects in the order in which they were added. *p*: of the score test, corrected for all "
        "candidate effects. *Held-out gain*: share of the squared residuals, without their "
        "autocorrelation, that the effect removes in exploration clusters that were left out of "
        "the calibration.",
    )


def alternatives_table(d: Diagnosis) -> TableBlock:
    """The alternatives to the named effects."""
    return _table(
        "alternatives",
        [
            {
                "chosen": effect.name,
                "alternative": other.name,
                "loss relative to the chosen": amount(other.loss, 4),
                "p": amount(other.p_value, 2),
                "data that distinguish both": _distinguishing_data(other),
                "clusters": NOTHING if other.clusters is None else other.clusters,
            }
            for effect in d.effects
            for other in effect.alternatives
        ],
        "Effects that the data cannot distinguish from the chosen one. *p*: for the alternative "
        "being the true effect. *Clusters*: exploration clusters that distinguish both with a "
        f"power of 90 %, at the observed difference; {d.clusters.exploration} are available. A "
        "*leader* has a sinusoidal speed within the measured speeds and 2 m/s².",
    )


def _distinguishing_data(alternative: Alternative) -> str:
    p = alternative.profile
    leader = (
        f"{p.platoons} platoons of {p.lasts:g} s behind a leader between {p.mean - p.swing:.0f} "
        f"and {p.mean + p.swing:.0f} m/s with a period of {p.period:g} s"
        if p
        else ""
    )
    return "; ".join(filter(None, (alternative.distinguishing_data, leader))) or NOTHING


def gap_table(d: Diagnosis) -> TableBlock:
    """The error on the confirmation sequences."""
    gap, errors = d.gap, {}
    for method, before, after in (
        ("", gap.before, gap.after),
        (", least squares on whole paths", gap.plain, gap.plain_after),
    ):
        errors[f"{d.model}{method}"] = before
        errors[f"{d.model} with effects{method}"] = after if d.effects else math.nan
    errors["measurement noise"] = gap.noise_floor
    return _table(
        "gap",
        [
            {"": name, "mean square error (m²)": amount(error)}
            for name, error in errors.items()
            if not math.isnan(error)
        ],
        "Mean square error of positions on the confirmation sequences.",
    )


def confirmation_table(d: Diagnosis) -> TableBlock:
    """The errors of the individual confirmation sequences."""
    return _table(
        "confirmation",
        [
            {
                "sequence": row["name"],
                "without effects (m²)": amount(row["before"]),
                **({"with effects (m²)": amount(row["after"])} if d.effects else {}),
            }
            for row in d.confirmation_errors
        ],
        "Mean square error of each confirmation sequence.",
        full=pd.DataFrame(d.confirmation_errors).rename(columns={"name": "sequence"}),
    )


def base_table(d: Diagnosis) -> TableBlock:
    """The change of the model's parameters when effects are added."""
    short = short_names(d.base)
    return _table(
        "parameters",
        [
            {
                "parameter": short[name],
                "without effects": amount(entry.get("before"), 4),
                **({"with effects": amount(entry.get("after"), 4)} if d.effects else {}),
                "unit": _unit(entry.get("unit", "")),
            }
            for name, entry in d.base.items()
        ],
        f"Calibrated parameters of {d.model}. If effects are added, a parameter changes that "
        "compensated for their absence.",
    )


def faults_table(d: Diagnosis) -> TableBlock:
    """Faults of the measurement."""
    return _table(
        "data_faults",
        [
            {
                "kind": fault.kind,
                "sequence": fault.sequence,
                "agents": ", ".join(fault.agents) or NOTHING,
                "clock time (s)": NOTHING if fault.time is None else f"{fault.time:.2f}",
                "description": fault.detail or KINDS.get(fault.kind, ""),
            }
            for fault in d.data_faults
        ],
        "Faults of the measurement. Agents without a name in the data are numbered within their "
        "sequence from 0, in a lane from the last vehicle.",
    )


def places_table(d: Diagnosis, unit: str) -> TableBlock:
    """Where the model deviates from the data."""
    return _table(
        "places",
        [
            {
                "variable": place.variable,
                "from": amount(place.low),
                "to": amount(place.high),
                "unit": _unit(place.unit),
                f"missing term ({unit})": f"{amount(place.deviation)} ± {amount(place.error, 2)}",
                "share": _percent(place.share),
                "p": amount(place.p_value, 2),
            }
            for place in d.places
        ],
        "Intervals in which a term is missing from the model without effects. *Missing term*: "
        "weighted mean and standard error. *Share*: of the squared error above the measurement "
        "noise that the curve removes. *p*: corrected for all variables and intervals. One cause "
        "usually appears in several variables.",
    )


def absent_table(d: Diagnosis) -> TableBlock:
    """Effects that are absent, with bounds."""
    return _table(
        "absent",
        [
            {
                "effect": absence.name,
                "coefficient": absence.coefficient,
                "upper bound": amount(absence.bound),
                "detectable": amount(absence.detectable),
                "unit": _unit(absence.unit),
                "remark": absence.reason or NOTHING,
            }
            for absence in d.absences
            if absence.testable
        ],
        "Effects that were tested and not found. *Upper bound*: a larger deviation from no effect "
        "is excluded with 95 % confidence. *Detectable*: smallest deviation that is named and "
        "confirmed with a power of 80 %.",
    )


def not_testable_table(d: Diagnosis) -> TableBlock:
    """Effects that are not testable with these data."""
    by_name = {absence.name: absence for absence in d.absences if not absence.testable}
    return _table(
        "not_testable",
        [
            {
                "effect": name,
                "coefficient": absence.coefficient if absence else NOTHING,
                "detectable": amount(absence.detectable if absence else None),
                "unit": _unit(absence.unit if absence else ""),
                "reason": (absence.reason if absence else "")
                or "the data contain no variation that would show it",
            }
            for name in dict.fromkeys([*by_name, *d.not_testable])
            for absence in [by_name.get(name)]
        ],
        "Effects that these data cannot test: at the smallest usual strength, the power is below "
        "80 %. The diagnosis makes no statement about them.",
    )
