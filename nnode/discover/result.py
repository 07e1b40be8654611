"""What a diagnosis found, in plain types: the content of ``report.json``."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, Literal

Verdict = Literal["named", "none", "unknown", "indistinguishable", "unconfirmed", "not_testable"]


@dataclass
class Coefficient:
    """An estimate with its interval of 95 %."""

    value: float
    low: float
    high: float
    unit: str


@dataclass
class Profile:
    """How a leader should drive for two effects to be told apart.

    Attributes:
        mean, swing: the speed is mean + swing sin(2 pi t / period), m/s.
        period: s.
        lasts: s that it lasts.
        platoons: about so many open ones tell two effects apart with a probability of 90 %.
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
        p_value: of the hypothesis that it is the true one: held-out residuals with it do not lean
            towards the model with the effect that was chosen.
        separated_by: data that would tell the two apart.
        clusters: about how many open clusters like these would tell them apart with a probability
            of 90 %, if they lean as these do; None where no number would.
        profile: of a leader behind whom the fewest platoons tell them apart; of lanes.
    """

    name: str
    loss: float
    p_value: float
    separated_by: str = ""
    clusters: int | None = None
    profile: Profile | None = None


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
        confirmed: one-sided p-value that sealed clusters do not lean its way.
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
        testable: False where not even the least usual strength would be named, sealed clusters
            included, with a probability of 80 %.
        coefficient: the strength that is limited; ``unit`` is its unit.
        detectable: smallest deviation from neutral that is named with 80 % power; of an effect
            without a strength its setting. Of an effect on an interval, for an interval of the
            usual length and of median precision, which ``reason`` names.
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

    Where agents' own numbers were named: on the last part of each sequence, with numbers from its
    first part.

    Attributes:
        before: of the model as it was given, calibrated on the open sequences.
        after: of the extended model.
        plain, plain_after: of both, calibrated to nothing but the positions of whole open
            sequences: plain calibrations that the effects must beat as well. NaN in crowds, and
            where agents' own numbers were named.
        noise_floor: of the measurement.
        closed: (before - after) / (before - noise_floor).
        definition: of the error, in words; that of each sequence is the same, not yet averaged.
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
    """What is independent of what.

    Attributes:
        open, sealed: numbers of clusters.
        least: open ones that sign flips need, so that any effect can reach the level.
        least_sealed: sealed ones that a confirmation needs.
        enough: about how many clusters in all would do.
        why: what makes sequences one cluster.
        simultaneous: what was found out of clusters that were there at one time.
        note: what must be known of the sealed ones; empty: nothing.
    """

    open: int
    sealed: int
    least: int
    least_sealed: int
    enough: int
    why: str
    simultaneous: str
    note: str = ""


@dataclass
class FirstScreen:
    """The first look at all effects of the population.

    Attributes:
        p_value: the least one, with regard to all effects; None where there is none to look for.
        effect: whose it is.
        clusters: that the flips come from.
        floor: no p-value can be below this.
        leads: of the effects that explain most: name, share of the squared residuals explained,
            p-value. A description where there are too few clusters.
    """

    p_value: float | None
    effect: str
    clusters: int
    floor: float
    leads: list[dict[str, Any]] = field(default_factory=list)


@dataclass
class Confirmation:
    """What the sealed clusters say.

    Attributes:
        p_value: one-sided, of the last effect that was confirmed or the first that was not; None
            where none was tried.
        clusters: sealed ones.
        confirmed: None where none was tried.
        reason: why not, in words.
    """

    p_value: float | None
    clusters: int
    confirmed: bool | None
    reason: str = ""


@dataclass
class Agents:
    """What agents have numbers of their own for.

    Attributes:
        name: of the effect.
        strength, low, high: standard deviation of the numbers, or what follows from it, with its
            interval of 95 %; ``unit``.
        p_value: that nobody differs, one-sided, by cluster, corrected for what was tried.
        lasts: s; what lasts longer than this cannot be told from a number of one's own.
        share: of the variance by what it belongs to: recording, sequence, agent, mood.
        lags, common: s, and what parts of an agent's time at that lag have in common.
        later: mean square errors in the last part of the sealed sequences by who predicts, m².
        confirmed: one-sided p-value, by cluster, that own numbers predict the last part better
            than none, and than one number per sequence (the larger of both).
        found: whether it stands out in the open clusters.
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
    """A standard deviation, or a time, of what a law does not explain.

    Attributes:
        name: a parameter that differs between drivers, in % of the typical driver's; ``push``: of
            disturbances of the highest rate; ``push_time``: how long they last; ``measurement``:
            of errors of positions.
        estimate: with its interval of 95 % from ``lower`` to ``upper``, in ``unit``; NaN where the
            data tell none.
        at_bound: ``low`` or ``high`` where it is at the end of what is allowed.
        shrinkage: share of a driver's variance that the data leave, median over drivers.
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
class ComparedLaw:
    """A base law on open clusters.

    Attributes:
        parameters: that were calibrated, their number.
        error: mean square error of positions of whole sequences in clusters that a calibration to
            nothing else left out, m²; in crowds of the clusters that it saw.
        behind: by what share its held-out cost lies above that of the best law, in the mean of
            logarithms over clusters.
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
        clusters: that they were compared on.
        effects: that every law has which has a place for them.
    """

    ranking: list[ComparedLaw]
    refused: dict[str, str]
    clusters: int
    effects: list[str] = field(default_factory=list)

    @property
    def best(self) -> str:
        """The name of the first; empty where none was compared."""
        return self.ranking[0].name if self.ranking else ""


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
    leads: list[NamedEffect]  # found in open clusters, not confirmed by sealed ones
    agents: list[Agents]
    drivers: list[Variation]
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
    not_offered: dict[str, str] = field(default_factory=dict)  # effect to why the law has no place
    laws: Laws | None = None  # base laws compared with each other
    laws_again: Laws | None = None  # the same with the effects that the first of them lacks

    def plain(self) -> dict[str, Any]:
        """Plain types for JSON."""
        return asdict(self)
