"""Tables of a diagnosis' page.

A table is given by its columns: the heading, and what a row shows there. The heading is also the
name of the column in the CSV file; ``heads`` are other words for the page.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from operator import attrgetter
from typing import Any

import pandas as pd

from nnode.data.quality import KINDS
from nnode.discover.report.files import amount, estimate, in_unit
from nnode.discover.result import Agents, Alternative, Diagnosis, Laws, NamedEffect
from nnode.model.term import short_names
from nnode.pages.page import TableBlock
from nnode.pages.tables import NOTHING

#: Largest number of faults and of sequences on the page; the CSV file contains all.
LISTED = 30

#: What a row shows in a column: an attribute of it, or a function of it.
Column = str | Callable[[Any], Any]


def _table(
    name: str, rows: Iterable[Any], columns: Mapping[str, Column], caption: str, **options: Any
) -> TableBlock:
    cells = {
        head: attrgetter(shown) if isinstance(shown, str) else shown
        for head, shown in columns.items()
    }
    full = pd.DataFrame([{head: cell(row) for head, cell in cells.items()} for row in rows])
    if len(full) > LISTED:
        caption += f" The first {LISTED} of {len(full)} rows; the CSV file contains all."
    filled = [head for head in full if not full[head].eq(NOTHING).all()]
    return TableBlock(name, full[filled].head(LISTED), caption, **{"full": full, **options})


def _p(row: Any) -> str:
    return amount(row.p_value, 2)


def _p_confirmation(row: Any) -> str:
    return amount(row.confirmed, 2)


def _unit(row: Any) -> str:
    return in_unit(row.unit).strip() or NOTHING


def _percent(share: float | None) -> str:
    if share is None or math.isnan(share):
        return NOTHING
    return f"{100 * share:.0f} %".replace("-", "−")


def coefficients_table(effects: list[NamedEffect], name: str = "coefficients") -> TableBlock:
    """The coefficients of some effects."""
    return _table(
        name,
        [(effect, key, c) for effect in effects for key, c in effect.coefficients.items()],
        {
            "effect": lambda row: row[0].name,
            "coefficient": lambda row: row[1],
            "value": lambda row: estimate(row[2])[0],
            "95 % from": lambda row: estimate(row[2])[1],
            "to": lambda row: estimate(row[2])[2],
            "unit": lambda row: _unit(row[2]),
            "where": lambda row: row[0].where,
            "p combined": lambda row: amount(row[0].combined, 2),
            "p on sealed clusters": lambda row: _p_confirmation(row[0]),
        },
        "Coefficients with 95 % intervals. *p*: of exploration and confirmation clusters together, "
        "and of the confirmation clusters alone.",
        heads={"p combined": "p", "p on sealed clusters": "p, confirmation"},
    )


_ERRORS = {
    "traffic": "mean square error of whole sequences in exploration clusters that were left out of "
    "the calibration.",
    "crowd": "mean square error in the exploration clusters, which were used in the calibration.",
}


def laws_table(laws: Laws, name: str, domain: str) -> TableBlock:
    """Base laws, the best first."""
    effects = f", with {', '.join(laws.effects)} where applicable" if laws.effects else ""
    return _table(
        name,
        laws.ranking,
        {
            "law": "name",
            "parameters": "parameters",
            "held-out cost above the best (%)": lambda law: amount(100 * law.behind),
            "p": _p,
            "error on left-out open clusters (m²)": lambda law: amount(law.error),
            "calibrated": lambda law: ", ".join(
                f"{key.partition('.')[2] or key} {amount(value)}{in_unit(unit)}"
                for key, (value, unit) in law.values.items()
            ),
        },
        f"Base laws on {laws.clusters} exploration clusters{effects}. *Held-out cost*: mean log "
        "error after removing autocorrelation, each cluster left out in turn; lower is better. "
        f"*p*: one-sided, for the law being as good as the first one. *Error*: {_ERRORS[domain]}",
        heads={"error on left-out open clusters (m²)": "error (m²)", "calibrated": "parameters at"},
    )


def clusters_table(d: Diagnosis) -> TableBlock:
    """The numbers of clusters, and the numbers that are needed."""
    c = d.clusters
    return _table(
        "clusters",
        [
            ("exploration", c.open, c.least, "name an effect"),
            ("confirmation", c.sealed, c.least_sealed, "confirm an effect"),
        ],
        {
            "clusters": lambda row: row[0],
            "there are": lambda row: row[1],
            "it takes": lambda row: row[2],
            "to": lambda row: row[3],
        },
        "Numbers of independent clusters.",
        heads={"there are": "available", "it takes": "required", "to": "in order to"},
    )


def screen_table(d: Diagnosis) -> TableBlock:
    """The effects that explain most in the exploration sequences."""
    fixed = ("name", "share", "p_value")
    return _table(
        "screen",
        d.screen.leads,
        {
            "effect": lambda row: row["name"],
            "share of the squared residuals": lambda row: _percent(row["share"]),
            "p": lambda row: amount(row["p_value"], 2),
            "about": lambda row: ", ".join(
                f"{key} {amount(value)}" for key, value in row.items() if key not in fixed
            ),
        },
        "Effects that explain most of the exploration sequences, by linear response. *Change*: "
        f"difference of the coefficient from its neutral value. No p can be below "
        f"{amount(d.screen.floor, 2)} with this number of clusters.",
        heads={"about": "change"},
    )


def _share(part: str, agents: Agents) -> str:
    return _percent(agents.share.get(part))


def agents_table(d: Diagnosis) -> TableBlock:
    """Agent-specific parameters and their variance components."""
    parts = list(dict.fromkeys(part for row in d.agents for part in row.share))
    return _table(
        "agents",
        d.agents,
        {
            "effect": "name",
            "strength": lambda a: (
                f"{amount(a.strength, 2)} [{amount(a.low, 2)}, {amount(a.high, 2)}]"
            ),
            "unit": _unit,
            "p": _p,
            **{part: partial(_share, part) for part in parts},
            "p on sealed clusters": _p_confirmation,
            "separable from (s)": lambda a: amount(a.lasts, 2),
            "named": lambda a: "yes" if a.named else f"no: {a.reason}",
        },
        "Agent-specific parameters. *Strength*: standard deviation between agents, with its 95 % "
        "interval. *Recording*, *sequence*, *agent*, *transient*: shares of the variance. A "
        "deviation that lasts longer than *separable from* cannot be distinguished from a constant "
        "difference between agents.",
        heads={"p on sealed clusters": "p, confirmation", "mood": "transient"},
    )


_VARIATIONS = {
    "push": "process noise",
    "push_time": "correlation time of the process noise",
    "measurement": "measurement error of positions",
}


def drivers_table(d: Diagnosis) -> TableBlock:
    """Variances between drivers and over time."""
    return _table(
        "drivers",
        d.drivers,
        {
            "what": lambda row: _VARIATIONS.get(row.name, f"{row.name} between drivers"),
            "standard deviation or time": lambda row: amount(row.estimate),
            "95 % interval": lambda row: (
                "not estimable"
                if math.isnan(row.lower)
                else f"[{amount(row.lower)}, {amount(row.upper)}]"
            ),
            "unit": _unit,
            "left open per driver": lambda row: _percent(row.shrinkage),
        },
        "Standard deviations between drivers and over time, estimated together with the law. "
        "Parameters that are not listed do not differ significantly between drivers. The process "
        "noise acts on speeds (laws of first order) or accelerations (second order). "
        "*Posterior variance*: of a driver's parameter, relative to the variance between drivers "
        "(median).",
        heads={
            "what": "quantity",
            "standard deviation or time": "estimate",
            "left open per driver": "posterior variance",
        },
    )


def later_table(d: Diagnosis) -> TableBlock:
    """Errors in the last part of the confirmation sequences, by model."""
    return _table(
        "later",
        [(row.name, who, error) for row in d.agents for who, error in row.later.items()],
        {
            "effect": lambda row: row[0],
            "who predicts": lambda row: "without effects" if row[1] == "base" else row[1],
            "mean square error (m²)": lambda row: amount(row[2]),
        },
        "Errors in the last 40 % of each confirmation sequence, simulated from the state at its "
        "start. Agent-specific parameters and mean velocities come from the first 40 %.",
        heads={"who predicts": "model"},
    )


def effects_table(d: Diagnosis) -> TableBlock:
    """The effects that were added, in their order."""
    return _table(
        "effects",
        d.effects,
        {
            "effect": "name",
            "formula": "formula",
            "p": _p,
            "held-out gain": lambda effect: _percent(effect.gain),
            "source": "source",
        },
        "Effects in the order in which they were added. *p*: of the score test, corrected for all "
        "candidate effects. *Held-out gain*: share of the squared residuals, without their "
        "autocorrelation, that the effect removes in exploration clusters that were left out of "
        "the calibration.",
    )


def alternatives_table(d: Diagnosis) -> TableBlock:
    """The alternatives to the named effects."""
    return _table(
        "alternatives",
        [(effect.name, other) for effect in d.effects for other in effect.alternatives],
        {
            "chosen": lambda row: row[0],
            "as good": lambda row: row[1].name,
            "loss relative to the chosen": lambda row: amount(row[1].loss, 4),
            "p": lambda row: _p(row[1]),
            "what would tell them apart": lambda row: _apart(row[1]),
            "or so many open clusters": lambda row: (
                NOTHING if row[1].clusters is None else row[1].clusters
            ),
        },
        "Effects that the data cannot distinguish from the chosen one. *p*: for the alternative "
        "being the true effect. *Clusters*: exploration clusters that distinguish both with a "
        f"power of 90 %, at the observed difference; {d.clusters.open} are available. A *leader* "
        "has a sinusoidal speed within the measured speeds and 2 m/s².",
        heads={
            "as good": "alternative",
            "what would tell them apart": "data that distinguish both",
            "or so many open clusters": "clusters",
        },
    )


def _apart(alternative: Alternative) -> str:
    p = alternative.profile
    leader = (
        f"{p.platoons} platoons of {p.lasts:g} s behind a leader between {p.mean - p.swing:.0f} "
        f"and {p.mean + p.swing:.0f} m/s with a period of {p.period:g} s"
        if p
        else ""
    )
    return "; ".join(part for part in (alternative.separated_by, leader) if part) or NOTHING


def gap_table(d: Diagnosis) -> TableBlock:
    """The error on the confirmation sequences."""
    gap, extended = d.gap, bool(d.effects)
    rows = [
        (d.model, gap.before),
        (f"{d.model} with effects", gap.after if extended else math.nan),
        (f"{d.model}, least squares on whole paths", gap.plain),
        (
            f"{d.model} with effects, least squares on whole paths",
            gap.plain_after if extended else math.nan,
        ),
        ("measurement noise", gap.noise_floor),
    ]
    return _table(
        "gap",
        [row for row in rows if not math.isnan(row[1])],
        {"": lambda row: row[0], "mean square error (m²)": lambda row: amount(row[1])},
        "Mean square error of positions on the confirmation sequences.",
    )


def confirmation_table(d: Diagnosis) -> TableBlock:
    """The errors of the individual confirmation sequences."""
    columns: dict[str, Column] = {
        "sequence": lambda row: row["name"],
        "without effects (m²)": lambda row: amount(row["before"]),
        "with effects (m²)": lambda row: amount(row["after"]),
    }
    if not d.effects:
        columns.pop("with effects (m²)")
    return _table(
        "sealed",
        d.sealed,
        columns,
        "Mean square error of each confirmation sequence.",
        full=pd.DataFrame(d.sealed).rename(columns={"name": "sequence"}),
    )


def base_table(d: Diagnosis) -> TableBlock:
    """The change of the model's parameters when effects are added."""
    short = short_names(d.base)
    columns: dict[str, Column] = {
        "parameter": lambda row: short[row[0]],
        "alone": lambda row: amount(row[1].get("before"), 4),
        "with effects": lambda row: amount(row[1].get("after"), 4),
        "unit": lambda row: in_unit(row[1].get("unit", "")).strip() or NOTHING,
    }
    if not d.effects:
        columns.pop("with effects")
    return _table(
        "parameters",
        d.base.items(),
        columns,
        f"Calibrated parameters of {d.model}. If effects are added, a parameter changes that "
        "compensated for their absence.",
        heads={"alone": "without effects"},
    )


def faults_table(d: Diagnosis) -> TableBlock:
    """Faults of the measurement."""
    return _table(
        "data_faults",
        d.data_faults,
        {
            "kind": "kind",
            "sequence": "sequence",
            "agents": lambda fault: ", ".join(fault.agents) or NOTHING,
            "clock time (s)": lambda fault: NOTHING if fault.time is None else f"{fault.time:.2f}",
            "what": lambda fault: fault.detail or KINDS.get(fault.kind, ""),
        },
        "Faults of the measurement. Agents without a name in the data are numbered within their "
        "sequence from 0, in a lane from the last vehicle.",
        heads={"what": "description"},
    )


def places_table(d: Diagnosis, unit: str) -> TableBlock:
    """Where the model deviates from the data."""
    return _table(
        "places",
        d.places,
        {
            "variable": "variable",
            "from": lambda place: amount(place.low),
            "to": lambda place: amount(place.high),
            "unit": _unit,
            f"deviation ({unit})": lambda place: (
                f"{amount(place.deviation)} ± {amount(place.error, 2)}"
            ),
            "share of the excess": lambda place: _percent(place.share),
            "p": _p,
        },
        "Intervals in which a term is missing from the model without effects. *Missing term*: "
        "weighted mean and standard error. *Share*: of the squared error above the measurement "
        "noise that the curve removes. *p*: corrected for all variables and intervals. One cause "
        "usually appears in several variables.",
        heads={f"deviation ({unit})": f"missing term ({unit})", "share of the excess": "share"},
    )


def absent_table(d: Diagnosis) -> TableBlock:
    """Effects that are absent, with bounds."""
    return _table(
        "absent",
        [absence for absence in d.absences if absence.testable],
        {
            "effect": "name",
            "coefficient": "coefficient",
            "absent to within": lambda absence: amount(absence.bound),
            "would be found from": lambda absence: amount(absence.detectable),
            "unit": _unit,
            "remark": lambda absence: absence.reason or NOTHING,
        },
        "Effects that were tested and not found. *Upper bound*: a larger deviation from no effect "
        "is excluded with 95 % confidence. *Detectable*: smallest deviation that is named and "
        "confirmed with a power of 80 %.",
        heads={"absent to within": "upper bound", "would be found from": "detectable"},
    )


def not_testable_table(d: Diagnosis) -> TableBlock:
    """Effects that are not testable with these data."""
    by_name = {absence.name: absence for absence in d.absences if not absence.testable}
    names = dict.fromkeys([*by_name, *d.not_testable])
    return _table(
        "not_testable",
        [(name, by_name.get(name)) for name in names],
        {
            "effect": lambda row: row[0],
            "coefficient": lambda row: row[1].coefficient if row[1] else NOTHING,
            "would be found from": lambda row: amount(row[1].detectable) if row[1] else NOTHING,
            "unit": lambda row: _unit(row[1]) if row[1] else NOTHING,
            "why": lambda row: (
                (row[1] and row[1].reason) or "the data contain no variation that would show it"
            ),
        },
        "Effects that these data cannot test: at the smallest usual strength, the power is below "
        "80 %. The diagnosis makes no statement about them.",
        heads={"would be found from": "detectable", "why": "reason"},
    )
