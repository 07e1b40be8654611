"""What a diagnosis found, in plain types: the content of ``report.json``."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, Literal

Verdict = Literal["named", "none", "unknown", "indistinguishable", "data_fault"]


@dataclass
class Coefficient:
    """An estimate with its interval of 95 %."""

    value: float
    low: float
    high: float
    unit: str


@dataclass
class Alternative:
    """An effect that explains the data nearly as well.

    Attributes:
        name: of the effect.
        loss: its held-out cost over that of the effect that was chosen.
        p_value: of the hypothesis that it is as good.
        separated_by: data that would tell the two apart.
    """

    name: str
    loss: float
    p_value: float
    separated_by: str = ""


@dataclass
class NamedEffect:
    """An effect that was added.

    Attributes:
        name, formula, source: of the effect.
        coefficients: its parameters.
        where: where it acts, in words.
        alternatives: effects that the data cannot tell from it.
        p_value: of its score, with regard to all effects that were looked for.
        gain: held-out share of the whitened cost that it removed when it was added.
    """

    name: str
    formula: str
    source: str
    coefficients: dict[str, Coefficient]
    where: str
    alternatives: list[Alternative] = field(default_factory=list)
    p_value: float = float("nan")
    gain: float = float("nan")


@dataclass
class DataFault:
    """A fault of the measurement that the diagnosis did without."""

    kind: str
    sequence: str
    agents: list[str]
    time: float | None
    detail: str = ""


@dataclass
class Absence:
    """An effect that was not found.

    Attributes:
        name: of the effect.
        testable: False where not even the least usual strength would stand out in the data.
        coefficient: the strength that is limited; ``unit`` is its unit.
        detectable: smallest deviation from neutral found with 80 % power.
        bound: it is absent to within this deviation (95 %); None where not testable.
        reason: in words.
    """

    name: str
    testable: bool
    coefficient: str
    unit: str
    detectable: float | None
    bound: float | None
    reason: str = ""


@dataclass
class Place:
    """Where simulation and measurement part, for one variable.

    Attributes:
        variable: gap, speed, position, ...
        unit: of the variable.
        low, high: the interval that stands out.
        deviation, error: mean deviation there and its standard error, m/s or m/s².
        share: of the excess cost.
        p_value: with regard to all variables and intervals.
        curve: binned deviations: ``at``, ``deviation``, ``error``, one number per bin.
    """

    variable: str
    unit: str
    low: float
    high: float
    deviation: float
    error: float
    share: float
    p_value: float
    curve: dict[str, list[float]] = field(default_factory=dict)


@dataclass
class Gap:
    """Mean square error of positions on the sealed sequences, m².

    Attributes:
        before: of the model as it was given, calibrated on the open sequences.
        after: of the extended model.
        noise_floor: of the measurement.
        closed: (before - after) / (before - noise_floor).
    """

    before: float
    after: float
    noise_floor: float
    closed: float


@dataclass
class Structure:
    """What is left where nothing in the catalogue passes.

    Attributes:
        variables: on which it depends, the strongest first.
        gain: share of the squared errors of positions that are left that a flexible fit removes.
        hint: a symbolic form, as a hint only.
        curve: the flexible fit in the first variable: ``at``, ``deviation``.
        unit: of the first variable.
    """

    variables: list[str]
    gain: float
    hint: str
    curve: dict[str, list[float]]
    unit: str = ""


@dataclass
class Diagnosis:
    """The whole of a diagnosis; see the classes of its parts."""

    verdict: Verdict
    domain: str
    model: str
    effects: list[NamedEffect]
    data_faults: list[DataFault]
    not_testable: list[str]
    absences: list[Absence]
    places: list[Place]
    unknown: Structure | None
    gap: Gap
    base: dict[str, dict[str, Any]]  # term.parameter: before, after, unit
    split: dict[str, list[str]]  # open and sealed sequences, by name
    notes: list[str]
    seconds: dict[str, float]
    sealed: list[dict[str, Any]] = field(default_factory=list)  # name, before, after of each

    def plain(self) -> dict[str, Any]:
        """Plain types for JSON."""
        return asdict(self)
