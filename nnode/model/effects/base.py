"""What an effect is: a term that a model may lack, with all that is needed to look for it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from nnode.data.sequence import Batch, Domain
from nnode.model.formula import contribution, effect_increment
from nnode.model.laws import Law, entries
from nnode.model.scene import Scene
from nnode.model.system import System
from nnode.model.term import Interval, State, Term


@dataclass(frozen=True)
class Probe:
    """An effect of small strength, whose trace in the simulated paths the data are searched for.

    Attributes:
        options: of the effect, with its strengths at their neutral values where it has these.
        steps: strength to the amount by which it is varied. Each one gives one direction; the
            directions of a probe are looked for together. Empty: the one direction is what the
            effect with these options changes as a whole.
    """

    options: dict[str, Any]
    steps: dict[str, float]


@dataclass(frozen=True)
class Strength:
    """A parameter that is neutral where there is no effect, and to which its trace is
    proportional as long as it is weak.

    Attributes:
        neutral: its value without the effect.
        step: a small but visible amount.
        range: what is plausible; also the admissible set.
        unit: of the parameter.
        min_effect_size: the least distance from the neutral value that one would expect. Data in
            which it would not stand out do not test the effect; None takes the farthest end of the
            range.
    """

    neutral: float
    step: float
    range: Interval
    unit: str
    min_effect_size: float | None = None

    @property
    def expected(self) -> float:
        """A distance from the neutral value that an effect should have to be worth a test."""
        if self.min_effect_size is not None:
            return self.min_effect_size
        return max(abs(self.range.low - self.neutral), self.range.high - self.neutral)

    def at(self, amount: float) -> float:
        """The value that differs from the neutral one by an amount, or the nearest plausible."""
        return float(np.clip(self.neutral + amount, self.range.low, self.range.high))


@dataclass(frozen=True)
class Setting:
    """A parameter without a neutral value: a place, a range, a time constant.

    Attributes:
        value: where a search starts that knows nothing better.
        range: what is plausible; also the admissible set.
        unit: of the parameter.
    """

    value: float
    range: Interval
    unit: str


class Effect(Term):
    """A named effect: a term with strengths, settings, and the probes that are looked for.

    A subclass states its class attributes, with a rule per order or :meth:`forward`; all parameters
    are calibrated. The constructor takes each parameter by keyword.

    Class attributes:
        domain: ``traffic`` or ``crowd``.
        strengths: parameter name to :class:`Strength`; may be empty, see :class:`Probe`.
        settings: parameter name to :class:`Setting`.
        tried: one setting to the values, or one strength to the amounts, of a probe each; empty:
            there is one probe, of all strengths at the settings' own values.
        of_drivers: whether it says no more than that drivers differ.
        acts_on: what of the laws of people it changes, ``force`` or ``drive``, see
            :class:`nnode.model.terms.Rule`; empty: it acts on every model.
        rank: place in the sum of terms; one that modifies the sum before it comes later.
        confusable_group: name of the class of effects that data often cannot tell apart from it;
            empty: none.
        distinguishing_data: what data would.
        contains: names of effects that are special cases of this one.
        consecutive: the probes are neighbouring intervals of one quantity, and an effect on
            several of them is the sum of their traces. ``a`` and ``b`` are the interval's ends.
        covariate: ``kind``, ``group`` or ``length``: the property of an agent by which it acts. It
            may be fixed within every recording; then recordings are the units of evidence.
        individual: every agent has a strength of its own, with mean zero over the agents; the
            reported strength is their standard deviation.
        searched_orders: orders of the laws in which a diagnosis looks for it.
        built_into_laws: whether other laws of its domain contain something like it, so that finding
            it in one of them is right where another law is nearer to the truth.
        sets_desired_speed: whether it gives people a preferred speed, which some of their laws
            have.
    """

    domain: ClassVar[Domain]
    strengths: ClassVar[dict[str, Strength]] = {}
    settings: ClassVar[dict[str, Setting]] = {}
    tried: ClassVar[dict[str, tuple[float, ...]]] = {}
    acts_on: ClassVar[str] = ""
    rank: ClassVar[int] = 0
    confusable_group: ClassVar[str] = ""
    distinguishing_data: ClassVar[str] = ""
    contains: ClassVar[tuple[str, ...]] = ()
    consecutive: ClassVar[bool] = False
    covariate: ClassVar[str | None] = None
    individual: ClassVar[bool] = False
    of_drivers: ClassVar[bool] = False
    searched_orders: ClassVar[tuple[int, ...]] = (1, 2)
    built_into_laws: ClassVar[bool] = False
    sets_desired_speed: ClassVar[bool] = False

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if "forward" in vars(cls) and "rules" not in vars(cls):
            cls.rules = {}  # its code replaces the rules of the class that it derives from

    def __init__(self, **values: float) -> None:
        super().__init__()
        unknown = sorted(set(values) - set(self.strengths) - set(self.settings))
        if unknown:
            raise ValueError(
                f"effect {self.name} has no parameter {', '.join(unknown)}; it has "
                f"{', '.join([*self.strengths, *self.settings])}"
            )
        parameters: dict[str, Strength | Setting] = {**self.strengths, **self.settings}
        for name, given in parameters.items():
            # a time constant has no neutral value: the nearest plausible one is its default
            usual = given.at(0.0) if isinstance(given, Strength) else given.value
            self.declare(name, values.get(name, usual), unit=given.unit, bounds=given.range)

    def forward(self, state: State) -> Tensor:
        """``(B, N, D + M)`` what its rule adds to the rate, and the rates of its M states.

        An effect without a rule defines its own ``(B, N, D)``.

        Raises:
            ValueError: the model lacks the term that it acts on.
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
        """Whether it adds states to the model's."""
        return any(rule.memory for rule in cls.rules.values())

    @classmethod
    def finds(cls, terms: Iterable[object]) -> bool:
        """Whether these terms have what it acts on."""
        laws = (term for term in terms if isinstance(term, Law))
        return not cls.acts_on or any(getattr(law.formulas, cls.acts_on) for law in laws)

    @classmethod
    def applies(cls, batch: Batch, system: System) -> bool:
        """Whether it can act on ``system``, and ``batch`` can show it."""
        return cls.finds(system.terms)

    @classmethod
    def probes(cls, batch: Batch, system: System) -> list[Probe]:
        """What is looked for in the data of ``batch`` by ``system``; empty: it cannot act there."""
        steps = {name: strength.step for name, strength in cls.strengths.items()}
        if not cls.applies(batch, system):
            return []
        for name, values in cls.tried.items():
            if name in cls.settings:
                return [Probe({name: value}, steps) for value in values]
            return [Probe({}, {name: value}) for value in values]
        return [Probe({}, steps)]

    def options(self) -> dict[str, Any]:
        """What builds this effect again, in plain numbers."""
        return {
            name: float(getattr(self, name).detach()) for name in (*self.strengths, *self.settings)
        }


class IndividualEffect(Effect):
    """An effect with a number for every agent that is estimated beside the parameters.

    Class attributes:
        in_equation: whether its strengths stand in the equation; otherwise they describe the
            distribution of the agents' numbers alone, and are not calibrated.

    Args:
        people: sequence name to the numbers of its agents; without them there is no effect.
        values: the parameters.
    """

    individual = True
    in_equation: ClassVar[bool] = True

    def __init__(self, people: dict[str, list[float]] | None = None, **values: float) -> None:
        super().__init__(**values)
        self.people = {str(k): [float(own) for own in v] for k, v in (people or {}).items()}
        for name in () if self.in_equation else self.strengths:
            self.idle(name)

    def options(self) -> dict[str, Any]:
        return {**super().options(), "people": self.people}

    @classmethod
    def directions(cls, options: dict[str, Any]) -> list[tuple[dict[str, Any], float]]:
        """The amounts that are fitted to an agent; :meth:`person` makes his number of them.

        Args:
            options: settings.

        Returns:
            Per amount the values of an effect, and an agent's number in it, with which the effect
            on him is that of one unit of the amount. By default the number is the one amount.
        """
        return [(options, 1.0)]

    @classmethod
    def person(cls, numbers: np.ndarray, options: dict[str, Any]) -> float:
        """An agent's number, from the amounts of the directions that were fitted to him."""
        return float(numbers[0])

    @classmethod
    def spread(cls, sigma: float) -> float:
        """The strength, from the standard deviation of the amounts of each direction."""
        return sigma

    def inputs(self, scene: Scene) -> dict[str, Tensor]:
        """The rule's first input is the agents' numbers; a second one, where they are known."""
        (rule, *_) = self.rules.values()
        return dict(zip(rule.inputs, self.known(scene, scene.length), strict=False))

    def known(self, scene: Scene, like: Tensor) -> tuple[Tensor, Tensor]:
        """``(B, N)`` the agents' numbers (0 where unknown), and 1 where they are known."""
        # many simulations may share a name; the first row of the tables is nobody's
        numbers = torch.zeros(len(self.people) + 1, scene.agent.shape[1], dtype=like.dtype)
        known = torch.zeros_like(numbers)
        rows = {}
        for row, (name, own) in enumerate(self.people.items(), start=1):
            rows[name] = row
            numbers[row, : len(own)] = torch.tensor(own, dtype=like.dtype)[: numbers.shape[1]]
            known[row, : len(own)] = 1.0
        index = torch.tensor([rows.get(name, 0) for name in scene.names])
        return numbers[index].to(like.device), known[index].to(like.device)


@dataclass(frozen=True)
class Catalogue:
    """Effects by name, in the order of their place in the sum."""

    effects: dict[str, type[Effect]] = field(default_factory=dict)

    def add(self, effect: type[Effect]) -> type[Effect]:
        """Make an effect known; usable as a class decorator.

        Raises:
            ValueError: its name is taken.
        """
        if effect.name in self.effects:
            raise ValueError(f"there is an effect named {effect.name} already")
        self.effects[effect.name] = effect
        return effect

    def of(self, domain: Domain, order: int = 1, *, every: bool = False) -> list[type[Effect]]:
        """The effects of a domain that a diagnosis looks for in laws of an order, or every one."""
        own = [effect for effect in self.effects.values() if effect.domain == domain]
        found = [effect for effect in own if every or order in effect.searched_orders]
        return sorted(found, key=lambda effect: effect.rank)


#: Every effect that models can be given by name.
CATALOGUE = Catalogue()
