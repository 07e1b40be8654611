"""The result of a diagnosis in plain types: the content of ``report.json``."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, Literal

Verdict = Literal["named", "none", "unknown", "indistinguishable", "not_testable"]


@dataclass
class Coefficient:
    """An estimate with its 95 % interval."""

    value: float
    low: float
    high: float
    unit: str


@dataclass
class Profile:
    """A speed profile of a leader that distinguishes two effects.

    Attributes:
        mean, swing: the speed is mean + swing sin(2 pi t / period), m/s.
        period: s.
        lasts: duration, s.
        platoons: approximate number of exploration platoons for a power of 90 %.
    """

    mean: float
    swing: float
    period: float
    lasts: float
    platoons: int


@dataclass
class Alternative:
    """An effect that explains the data nearly as well.

    Attributes:
        name: of the effect.
        loss: its held-out cost over that of the effect that was chosen.
        p_value: of the hypothesis that it is the true effect, by a J test on held-out residuals
            against the model with the chosen effect.
        distinguishing_data: data that would distinguish the two.
        clusters: approximate number of similar exploration clusters that distinguishes them with a
            power of 90 %; None if no number would.
        profile: the leader's speed profile that needs the fewest platoons; in lanes only.
    """

    name: str
    loss: float
    p_value: float
    distinguishing_data: str = ""
    clusters: int | None = None
    profile: Profile | None = None


@dataclass
class NamedEffect:
    """An effect that was added.

    Attributes:
        name, formula, source: of the effect.
        coefficients: its parameters.
        where: where it acts, in words.
        alternatives: effects that the data cannot distinguish from it.
        p_value: of its score test, corrected for all candidate effects.
        gain: held-out share of the whitened cost that it removed when it was added.
        confirmed: one-sided p-value of its score test on the confirmation clusters.
        combined: p-value of exploration and confirmation clusters together.
    """

    name: str
    formula: str
    source: str
    coefficients: dict[str, Coefficient]
    where: str
    alternatives: list[Alternative] = field(default_factory=list)
    p_value: float = float("nan")
    gain: float = float("nan")
    confirmed: float = float("nan")
    combined: float = float("nan")


@dataclass
class DataFault:
    """A fault of the measurement; its sequence was left out."""

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
        testable: whether the expected strength would be named and confirmed with a power of 80 %.
        coefficient: the bounded strength; ``unit`` is its unit.
        detectable: smallest deviation from neutral that is named with 80 % power; of an effect
            without a strength its setting. Of an effect on an interval, for an interval of the
            usual length and of median precision, which ``reason`` names.
        bound: it is absent to within this deviation (95 %); None if not testable.
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
    """Where the model deviates from the data, for one variable.

    Attributes:
        variable: gap, speed, position, ...
        unit: of the variable.
        low, high: the interval with a significant deviation.
        deviation, error: mean deviation in this interval and its standard error, m/s or m/s².
        share: of the excess cost.
        p_value: corrected for all variables and intervals.
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
    """Mean square error of positions on the confirmation sequences, m².

    If agent-specific parameters were named, it is the error on the last part of each sequence, with
    parameters from its first part.

    Attributes:
        before: of the model as it was given, calibrated on the exploration sequences.
        after: of the extended model.
        plain, plain_after: of both models after ordinary calibrations to the positions of whole
            exploration sequences, as a further baseline. NaN in crowds, and if agent-specific
            parameters were named.
        noise_floor: of the measurement.
        closed: (before - after) / (before - noise_floor).
        definition: of the error, in words.
    """

    before: float
    after: float
    noise_floor: float
    closed: float
    plain: float = float("nan")
    plain_after: float = float("nan")
    definition: str = ""


@dataclass
class Clusters:
    """The independent clusters.

    Attributes:
        exploration, confirmation: numbers of clusters.
        least: exploration clusters that sign flips need to reach the level.
        least_confirmation: confirmation clusters that a confirmation needs.
        enough: approximate total number of clusters that would be sufficient.
        why: the definition of a cluster, in words.
        simultaneous: the test of simultaneous clusters, in words.
        note: a restriction of the confirmation set; empty: none.
    """

    exploration: int
    confirmation: int
    least_exploration: int
    least_confirmation: int
    enough: int
    why: str
    simultaneous: str
    note: str = ""


@dataclass
class FirstScreen:
    """The score tests of all population effects against the calibrated model.

    Attributes:
        p_value: the smallest one, corrected for all effects; None without candidates.
        effect: the effect with this p-value.
        clusters: number of clusters of the sign flips.
        floor: the smallest possible p-value.
        strongest: of the effects that explain most: name, share of the squared residuals explained,
            p-value. With too few clusters, they are descriptive.
    """

    p_value: float | None
    effect: str
    clusters: int
    floor: float
    strongest: list[dict[str, Any]] = field(default_factory=list)


@dataclass
class Confirmation:
    """The test on the confirmation clusters.

    Attributes:
        p_value: one-sided, of the effect with the weakest evidence; None if none was tested.
        clusters: number of confirmation clusters.
        confirmed: None if none was tested.
        reason: why not, in words.
    """

    p_value: float | None
    clusters: int
    confirmed: bool | None
    reason: str = ""


@dataclass
class Agents:
    """An effect with agent-specific parameters.

    Attributes:
        name: of the effect.
        strength, low, high: standard deviation between agents, or a function of it, with its 95 %
            interval; ``unit``.
        p_value: one-sided, of no difference between agents, by cluster, corrected for all tests.
        lasts: s, the longest time constant of a transient deviation that is separable from a
            constant difference.
        share: variance components as shares: recording, sequence, agent, transient.
        lags, common: s, and the autocovariance at these lags.
        later: mean square errors in the last part of the confirmation sequences by model, m².
        confirmed: one-sided p-value, by cluster, that agent-specific parameters do not predict the
            last part better than none, or than one per sequence (the larger of both).
        found: whether the difference is significant in the exploration clusters.
        named: whether it was confirmed as well.
        reason: why not, in words.
    """

    name: str
    strength: float
    low: float
    high: float
    unit: str
    p_value: float
    lasts: float
    share: dict[str, float | None]
    lags: list[float]
    common: list[float]
    later: dict[str, float]
    confirmed: float
    found: bool
    named: bool
    reason: str = ""


@dataclass
class Variation:
    """A standard deviation, or a correlation time, of a mixed-effects model.

    Attributes:
        name: a parameter that differs between agents, in % of the typical agent's; ``push``: of
            disturbances of the highest rate; ``push_time``: their correlation time;
            ``measurement``: of errors of positions; ``lasting_error``, ``lasting_error_time``: of
            their autocorrelated part, if there is one.
        estimate: with its 95 % interval from ``lower`` to ``upper``, in ``unit``; NaN if it is not
            estimated.
        at_bound: ``low`` or ``high`` if it is at a bound.
        shrinkage: posterior over prior variance of a driver's deviation, median over drivers.
    """

    name: str
    estimate: float
    lower: float
    upper: float
    unit: str
    at_bound: str
    shrinkage: float


@dataclass
class Structure:
    """Unexplained structure: deviations that no effect of the catalogue explains.

    Attributes:
        variables: on which it depends, the strongest first.
        gain: share of the remaining squared errors of positions that a nonparametric fit removes.
        hint: a symbolic form, as a hint only.
        curve: the nonparametric fit in the first variable: ``at``, ``deviation``.
        unit: of the first variable.
    """

    variables: list[str]
    gain: float
    hint: str
    curve: dict[str, list[float]]
    unit: str = ""


@dataclass
class ComparedLaw:
    """A base law on the exploration clusters.

    Attributes:
        parameters: number of calibrated parameters.
        error: mean square error of positions of whole sequences, m², in left-out clusters, with
            the same parameters for all drivers; in crowds, in the calibration clusters.
        behind: share by which its held-out cost exceeds that of the best law, in the mean of
            logarithms over clusters; or by which the best law's likelihood of a position exceeds
            this one's, see :class:`Laws`.
        p_value: one-sided, paired by cluster, that it is as good as the best law.
        values: parameter to value and unit.
    """

    name: str
    parameters: int
    error: float
    behind: float
    p_value: float
    values: dict[str, tuple[float, str]]


@dataclass
class Laws:
    """Base laws, the best first.

    Attributes:
        refused: law to the reason why it was not compared.
        clusters: number of clusters of the comparison.
        effects: that were added to every law to which they apply.
        likelihood: whether laws were compared by their marginal likelihoods, with drivers who
            differ; otherwise by costs of left-out clusters.
        nearest: the name of the law that was diagnosed as the best one: that of the first, unless
            the comparison does not reject the requested law.
    """

    ranking: list[ComparedLaw]
    refused: dict[str, str]
    clusters: int
    effects: list[str] = field(default_factory=list)
    likelihood: bool = False
    nearest: str = ""

    @property
    def best(self) -> str:
        """The name of the first; empty if none was compared."""
        return self.ranking[0].name if self.ranking else ""

    @property
    def p_values(self) -> dict[str, float]:
        """Of the compared laws, by name."""
        return {law.name: law.p_value for law in self.ranking}


@dataclass
class Diagnosis:
    """The whole of a diagnosis; see the classes of its parts."""

    verdict: Verdict
    domain: str
    model: str
    clusters: Clusters
    screen: FirstScreen
    confirmation: Confirmation
    effects: list[NamedEffect]
    hypotheses: list[NamedEffect]  # selected in exploration clusters, not confirmed
    agents: list[Agents]
    drivers: list[Variation]
    data_faults: list[DataFault]
    not_testable: list[str]
    absences: list[Absence]
    places: list[Place]
    unknown: Structure | None
    gap: Gap
    base: dict[str, dict[str, Any]]  # term.parameter: before, after, unit
    split: dict[str, list[str]]  # names of exploration and confirmation sequences
    notes: list[str]
    seconds: dict[str, float]
    # name, before, after of each confirmation sequence
    confirmation_errors: list[dict[str, Any]] = field(default_factory=list)
    not_offered: dict[str, str] = field(default_factory=dict)  # effect to why it does not apply
    law_at_bounds: list[str] = field(default_factory=list)  # parameters that show the law is wrong
    laws: Laws | None = None  # the comparison of base laws
    laws_again: Laws | None = None  # the comparison with the effects that the best of them lacks

    def plain(self) -> dict[str, Any]:
        """Plain types for JSON."""
        return asdict(self)
