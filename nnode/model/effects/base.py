"""Effects: terms that a model may lack, with what a diagnosis needs to search for them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from nnode.data.sequence import Batch, Domain
from nnode.model.formula import contribution, effect_increment
from nnode.model.laws import Law, entries, packaged
from nnode.model.scene import Scene
from nnode.model.system import System
from nnode.model.term import Interval, State, Term
from nnode.model.terms import Rule


@dataclass(frozen=True)
class Probe:
    """A weak version of an effect. The data are searched for its change of the simulated paths.

    Attributes:
        options: the effect's options, with strengths at their neutral values.
        steps: strength to the amount by which it is varied. Each strength gives one direction,
            and the directions of a probe are tested together. If empty, the one direction is the
            whole change by the effect with these options.
    """

    options: dict[str, Any]
    steps: dict[str, float]


@dataclass(frozen=True)
class Strength:
    """A parameter with a neutral value, at which the effect vanishes. The change of simulated
    paths is proportional to a small distance from it.

    Attributes:
        neutral: the value without the effect.
        step: a small amount that visibly changes paths.
        range: plausible values; also the admissible set.
        unit: unit of the parameter.
        min_effect_size: the smallest distance from the neutral value that a diagnosis should be
            able to detect; None takes the farthest end of the range.
    """

    neutral: float
    step: float
    range: Interval
    unit: str
    min_effect_size: float | None = None

    @property
    def expected(self) -> float:
        """The distance from the neutral value that a test must be able to detect."""
        if self.min_effect_size is not None:
            return self.min_effect_size
        return max(abs(self.range.low - self.neutral), self.range.high - self.neutral)

    def at(self, amount: float) -> float:
        """The plausible value that is nearest to the neutral value plus an amount."""
        return float(np.clip(self.neutral + amount, self.range.low, self.range.high))


@dataclass(frozen=True)
class Setting:
    """A parameter without a neutral value, such as a place, a range or a time constant.

    Attributes:
        value: default start value of a search.
        range: plausible values; also the admissible set.
        unit: unit of the parameter.
    """

    value: float
    range: Interval
    unit: str


P = TypeVar("P", Strength, Setting)


class Effect(Term):
    """A named effect: a term with strengths, settings, and probes for a diagnosis.

    A subclass defines the class attributes, and a rule per order or :meth:`forward`. All
    parameters are calibrated. The constructor takes each parameter by keyword.

    Class attributes:
        domain: ``traffic`` or ``crowd``.
        strengths: parameter name to :class:`Strength`; may be empty, see :class:`Probe`.
        settings: parameter name to :class:`Setting`.
        tried: one setting to its values, or one strength to its amounts, with one probe each. If
            empty, one probe has all strengths and the settings' default values.
        of_drivers: whether the effect only describes differences between agents.
        acts_on: the part of a pedestrian law that it changes, ``force`` or ``drive``, see
            :class:`nnode.model.terms.Rule`; empty if it acts on every model.
        min_agents: smallest number of agents of a sequence in which it can be detected.
        rank: position in the sum of terms. An effect with a greater rank is added later and
            modifies the sum of the effects before it.
        confusable_group: name of the group of effects that data often cannot distinguish from it;
            empty for none.
        distinguishing_data: data that would distinguish them.
        contains: names of effects that are special cases of this one.
        consecutive: whether the probes are neighbouring intervals of one quantity, with the ends
            ``a`` and ``b``. The change by an effect on several intervals is the sum of theirs.
        overlapping: whether the score test lets neighbouring intervals overlap, because the ends of
            the effect may lie anywhere within them.
        covariate: ``kind``, ``group`` or ``length``: the property of an agent by which it acts. If
            it is constant within every recording, recordings are the units of evidence.
        searched_orders: orders of the laws for which a diagnosis tests the effect.
        built_into_laws: whether other laws of its domain contain a similar effect. A diagnosis
            may then report it correctly where another law is closer to the truth.
        sets_desired_speed: whether it gives people a preferred speed, as some pedestrian laws do.
    """

    domain: ClassVar[Domain]
    strengths: ClassVar[dict[str, Strength]] = {}
    settings: ClassVar[dict[str, Setting]] = {}
    tried: ClassVar[dict[str, tuple[float, ...]]] = {}
    acts_on: ClassVar[str] = ""
    min_agents: ClassVar[int] = 1
    rank: ClassVar[int] = 0
    confusable_group: ClassVar[str] = ""
    distinguishing_data: ClassVar[str] = ""
    contains: ClassVar[tuple[str, ...]] = ()
    consecutive: ClassVar[bool] = False
    overlapping: ClassVar[bool] = False
    covariate: ClassVar[str | None] = None
    of_drivers: ClassVar[bool] = False
    searched_orders: ClassVar[tuple[int, ...]] = (1, 2)
    built_into_laws: ClassVar[bool] = False
    sets_desired_speed: ClassVar[bool] = False

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if "forward" in vars(cls) and "rules" not in vars(cls):
            cls.rules = {}  # the code replaces the inherited rules

    def __init__(self, **values: float) -> None:
        super().__init__()
        unknown = sorted(set(values) - set(self.strengths) - set(self.settings))
        if unknown:
            raise ValueError(
                f"effect {self.name} has no parameter {', '.join(unknown)}; it has "
                f"{', '.join([*self.strengths, *self.settings])}"
            )
        parameters: dict[str, Strength | Setting] = {**self.strengths, **self.settings}
        for name, declared in parameters.items():
            # a strength's neutral value may be implausible, as 0 for a time constant
            default = declared.at(0.0) if isinstance(declared, Strength) else declared.value
            self.declare(name, values.get(name, default), unit=declared.unit, bounds=declared.range)

    def forward(self, state: State) -> Tensor:
        """``(B, N, D + M)``: the rule's addition to the rate, then the rates of the M states.

        An effect without a rule overrides this method and returns ``(B, N, D)``.

        Raises:
            ValueError: the model lacks the term that the effect acts on.
        """
        if not self.finds(state.terms):
            names = [name for name, entry in entries().items() if entry.get(self.acts_on)]
            raise ValueError(
                f"effect {self.name} changes the {self.acts_on} of a law, but the model has none; "
                f"add {' or '.join(names)} to its terms"
            )
        return (
            contribution(self, state) if self.domain == "crowd" else effect_increment(self, state)
        )

    @classmethod
    def remembers(cls) -> bool:
        """Whether it adds states to the model."""
        return any(rule.memory for rule in cls.rules.values())

    @classmethod
    def finds(cls, terms: Iterable[object]) -> bool:
        """Whether one of the terms has the part that the effect acts on."""
        laws = (term for term in terms if isinstance(term, Law))
        return not cls.acts_on or any(getattr(law.formulas, cls.acts_on) for law in laws)

    @classmethod
    def applies(cls, batch: Batch, system: System) -> bool:
        """Whether it can act on ``system`` and be detected in ``batch``.

        An effect on a speed whose formula calls the law needs a law of the gap.
        """
        law, rule = system.find(Law), cls.rules.get(system.order)
        callable_law = law is not None and (law.of_gap or system.order > 1)
        if rule is not None and rule.calls_law and not callable_law:
            return False
        enough = int(batch.agent.sum(1).max()) >= cls.min_agents
        return enough and cls.finds(system.terms)

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        """The probes of the effect for ``batch`` and ``system``; empty if it cannot act there."""
        steps = {name: strength.step for name, strength in cls.strengths.items()}
        if not cls.applies(batch, system):
            return []
        for name, values in cls.tried.items():
            if name in cls.settings:
                return [Probe({name: value}, steps) for value in values]
            return [Probe({}, {name: value}) for value in values]
        return [Probe({}, steps)]

    def options(self) -> dict[str, Any]:
        """The constructor's arguments that rebuild this effect, as plain numbers."""
        return {
            name: float(getattr(self, name).detach()) for name in (*self.strengths, *self.settings)
        }


class IndividualEffect(Effect):
    """An effect with one estimated number per agent in addition to its parameters.

    The numbers have mean zero over the agents. The reported strength is their standard deviation.

    Class attributes:
        in_equation: whether its strengths occur in the equation. Otherwise they only describe the
            distribution of the agents' numbers, and are not calibrated.

    Args:
        people: sequence name to the numbers of its agents; the effect vanishes without them.
        values: the parameters.
    """

    in_equation: ClassVar[bool] = True

    def __init__(self, people: dict[str, list[float]] | None = None, **values: float) -> None:
        super().__init__(**values)
        self.people = {str(k): [float(number) for number in v] for k, v in (people or {}).items()}
        for name in () if self.in_equation else self.strengths:
            self.idle(name)

    def options(self) -> dict[str, Any]:
        return {**super().options(), "people": self.people}

    @classmethod
    def directions(cls, options: dict[str, Any]) -> list[tuple[dict[str, Any], float]]:
        """The directions along which amounts are fitted to each agent.

        :meth:`person` computes the agent's number from the amounts.

        Args:
            options: settings.

        Returns:
            Per direction the options of an effect and the agent's number, for which the effect on
            the agent is that of one unit of the amount. By default there is one direction, and
            the amount is the number.
        """
        return [(options, 1.0)]

    @classmethod
    def person(cls, numbers: np.ndarray, options: dict[str, Any]) -> float:
        """An agent's number, from the amounts that were fitted to the agent."""
        return float(numbers[0])

    def inputs(self, scene: Scene) -> dict[str, Tensor]:
        """The rule's first input is the agents' numbers, its second is 1 where they are known."""
        (rule, *_) = self.rules.values()
        return dict(zip(rule.inputs, self.agent_numbers(scene, scene.length), strict=False))

    def agent_numbers(self, scene: Scene, like: Tensor) -> tuple[Tensor, Tensor]:
        """``(B, N)``: the agents' numbers (0 where unknown), and 1 where they are known."""
        # many simulations may share a name; row 0 is for sequences without numbers
        numbers = torch.zeros(len(self.people) + 1, scene.agent.shape[1], dtype=like.dtype)
        is_known = torch.zeros_like(numbers)
        rows = {}
        for row, (name, values) in enumerate(self.people.items(), start=1):
            rows[name] = row
            numbers[row, : len(values)] = torch.tensor(values, dtype=like.dtype)[: numbers.shape[1]]
            is_known[row, : len(values)] = 1.0
        index = torch.tensor([rows.get(name, 0) for name in scene.names])
        return numbers[index].to(like.device), is_known[index].to(like.device)


@dataclass(frozen=True)
class Catalogue:
    """The named effects."""

    effects: dict[str, type[Effect]] = field(default_factory=dict)

    def add(self, effect: type[Effect]) -> type[Effect]:
        """Register an effect; usable as a class decorator.

        Raises:
            ValueError: its name is taken.
        """
        if effect.name in self.effects:
            raise ValueError(f"there is an effect named {effect.name} already")
        self.effects[effect.name] = effect
        return effect

    def of(self, domain: Domain, order: int = 1, *, every: bool = False) -> list[type[Effect]]:
        """The effects of a domain by rank: those searched in laws of an order, or every one."""
        of_domain = [effect for effect in self.effects.values() if effect.domain == domain]
        searched = [effect for effect in of_domain if every or order in effect.searched_orders]
        return sorted(searched, key=lambda effect: effect.rank)


#: The effects that models can have by name.
CATALOGUE = Catalogue()


def declare_effects(domain: Domain, file: str, module: dict[str, Any]) -> None:
    """Create the effects that a file of the package declares, and add them to the catalogue.

    Every effect becomes a class of the module, with the name in capitalised words.

    Args:
        domain: the effects' domain.
        file: name of the YAML file, of names to class attributes.
        module: the module's names. A class with the name of the effect has the effect's code, and
            the effect replaces it.
    """
    for name, entry in packaged(f"effects/{file}").items():
        title = name.title().replace("_", "")
        attributes = {key: tuple(v) if isinstance(v, list) else v for key, v in entry.items()}
        attributes |= {
            "__doc__": attributes.pop("about"),
            "__module__": module["__name__"],
            "name": name,
            "domain": domain,
            "rules": {order: Rule(**rule) for order, rule in entry["rules"].items()},
            "strengths": _parameters(Strength, entry.get("strengths", {})),
            "settings": _parameters(Setting, entry.get("settings", {})),
        }
        effect = type(title, (module.get(title, Effect),), attributes)
        module[title] = CATALOGUE.add(cast(type[Effect], effect))


def _parameters(kind: type[P], entries: Mapping[str, Any]) -> dict[str, P]:
    return {
        name: kind(**{**entry, "range": Interval(*entry["range"])})
        for name, entry in entries.items()
    }
