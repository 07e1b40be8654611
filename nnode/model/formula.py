"""The formula of a model, made from what its terms say of themselves."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, cast

import torch
from torch import Tensor

from nnode.model.crowd_dynamics import CrowdDynamics
from nnode.model.expression import Expr, const, substitute, symbol
from nnode.model.lane_dynamics import UNITS, LaneDynamics, add_effect
from nnode.model.lane_rates import LaneRates
from nnode.model.names import check_names
from nnode.model.scene import Scene
from nnode.model.steps import stepped
from nnode.model.tensors import Code, computed
from nnode.model.term import State, Term


class Law(Term):
    """A term that others change.

    Attributes:
        order: 1: it says a speed; 2: an acceleration.
        step: its own method of stepping; None: that of its order.
    """

    order = 1
    step: str | None = None

    @property
    def has_formula(self) -> bool:
        """Whether it has a formula, or code that a formula can call."""
        return rule_of(self) is not None

    def code(self) -> dict[str, Code]:
        """What calls in its formula stand for, by name."""
        return {}

    def lane(self, owner: str) -> LaneDynamics:
        """Its formula, by symbols that begin with the owner's name."""
        raise NotImplementedError  # pragma: no cover - every law defines its own

    def speed(self, gap: Tensor) -> Tensor:
        """Speed, m/s, at a gap, m, elementwise: of a law of second order that in equilibrium."""
        raise NotImplementedError  # pragma: no cover - every law defines its own

    def evaluated(self, values: Mapping[str, Tensor]) -> Tensor:
        """What its formula says of the quantities in it."""
        lane = lane_of([self])
        assert lane is not None, "a law without a formula defines its speed"
        assert lane.law is not None
        return self.computed([substitute(lane.law, lane.fixed)], values)[0]

    def computed(self, formulas: Sequence[Expr], values: Mapping[str, Tensor]) -> list[Tensor]:
        """Formulas of its parameters and of other quantities."""
        lane = lane_of([self])
        assert lane is not None
        own = dict(zip(lane.owned, values_of(lane, own_values([self], lane)), strict=True))
        return computed(formulas, {**own, **values})


def rule_of(term: Term) -> Any:
    """What a term says of itself, a rule of its domain; None where its class, or one between it
    and the one that says so, is code of its own."""
    if "rule" in vars(term):
        return term.rule
    for kind in type(term).__mro__:
        if "rule" in vars(kind):
            return vars(kind)["rule"]
        if _CODE & set(vars(kind)):
            return None
    return None


def _effect_rule(term: Term, order: int) -> Any:
    """What an effect does to a law of an order."""
    return rule_of(term) if order == 1 else term.second


def begins(term: Term, order: int) -> bool:
    """Whether the start of a term's states is a formula."""
    rule = rule_of(term) if isinstance(term, Law) else _effect_rule(term, order)
    return bool(rule) and bool(rule.delayed or any(len(s) > 2 for s in rule.states.values()))


#: What computes a term.
_CODE = {
    "forward", "speed", "memory_rate", "pair_force", "wall_force", "pairs", "components",
}  # fmt: skip


def lane_of(terms: Sequence[Term]) -> LaneDynamics | None:
    """The formula of a lane with these terms; None where one is code without a formula."""
    if not terms or not isinstance(terms[0], Law) or not terms[0].has_formula:
        return None
    order = terms[0].order
    if any(isinstance(e, Law) or _effect_rule(e, order) is None for e in terms[1:]):
        return None
    key = tuple(term.shape for term in terms)
    if key not in _KNOWN:
        _KNOWN[key] = _made(terms)
    return _KNOWN[key]


#: What terms say of their formulas to the formula of all.
_KNOWN: dict[tuple[Any, ...], LaneDynamics] = {}


def _made(terms: Sequence[Term]) -> LaneDynamics:
    names = owners(terms)
    assert isinstance(terms[0], Law)
    lane = terms[0].lane(names[0])
    for i, (term, owner) in enumerate(zip(terms[1:], names[1:], strict=True), start=1):
        lane = with_effect(lane, term, owner, i)
    return lane.flat()


def with_effect(lane: LaneDynamics, term: Term, owner: str, place: int) -> LaneDynamics:
    """A lane's formula with that of one term more.

    Args:
        place: of the term in the model.
    """
    parameters, owned, units = parameters_of(term, owner, place)
    rule = _effect_rule(term, lane.order)
    assert rule is not None
    return add_effect(lane, owner, rule, parameters, owned, units, whose=place)


def inputs_of(terms: Sequence[Any], lane: LaneDynamics, scene: Scene) -> dict[str, Tensor]:
    """Symbol to ``(B, N)`` values of what vehicles have from the data, for a lane's formula."""
    found = {"length_1": _length_ahead(scene)} if "length_1" in lane.symbols else {}
    for name, (place, part) in lane.inputs.items():
        found[name] = terms[place].inputs(scene)[part]
    return found


def _length_ahead(scene: Scene) -> Tensor:
    """``(B, N)`` m; the mean of those that are known where it is not, 0 where none is."""
    length = torch.where(torch.isfinite(scene.length), scene.length, scene.mean_length)
    return torch.cat([length[:, 1:], torch.zeros_like(length[:, :1])], 1)


def values_of(lane: LaneDynamics | CrowdDynamics, parameters: Mapping[str, Tensor]) -> list[Tensor]:
    """Of the parameters' symbols, in their order, from the model's parameters by name; what stands
    before the parameters' own axes stays."""
    found = []
    for name, place, size in lane.owned.values():
        value = parameters[name]
        found.append(value if size is None else value.flatten(value.ndim - size)[..., place])
    return found


def own_values(terms: Sequence[Term], lane: LaneDynamics | CrowdDynamics) -> dict[str, Tensor]:
    """The terms' parameters that a lane's formula needs, by their names in the model."""
    found = {}
    for name, _, _ in lane.owned.values():
        _, place, path = name.split(".", 2)
        value: Any = terms[int(place)]
        for part in path.split("."):
            value = getattr(value, part)  # may be a tensor in place of a parameter
        found[name] = value
    return found


def owners(terms: Sequence[Term]) -> list[str]:
    """The name of each term; of several of one name the second is numbered.

    Raises:
        ConfigError: a name that cannot stand in a formula.
    """
    check_names("terms", [term.name for term in terms])
    seen: Counter[str] = Counter()
    found = []
    for term in terms:
        seen[term.name] += 1
        found.append(term.name if seen[term.name] == 1 else f"{term.name}_{seen[term.name]}")
    return found


def parameters_of(
    term: Term, owner: str, place: int
) -> tuple[dict[str, Expr], dict[str, Any], dict[str, str]]:
    """Of a term's scalar parameters: symbols by name, where they are, and their units."""
    names = term.scalars
    parameters: dict[str, Expr] = {name: symbol(f"{owner}__{name}") for name in names}
    owned = {f"{owner}__{name}": (f"terms.{place}.{name}", 0, None) for name in names}
    units = {f"{owner}__{name}": term.units.get(name, "*") for name in names}
    return parameters, owned, units


def symbols_of(
    terms: Sequence[Term],
    lane: LaneDynamics,
    scene: Scene,
    parameters: Mapping[str, Tensor] | None = None,
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Values of a lane's symbols that do not change: those that are the same for all vehicles,
    and ``(N, B)`` of what vehicles have from the data.

    Args:
        parameters: by their symbols; None: the terms' own.
    """
    values = dict(parameters or {})
    if parameters is None:
        values = dict(zip(lane.owned, values_of(lane, own_values(terms, lane)), strict=True))
    values |= {"start": scene.start, "dt": scene.start.new_tensor(scene.step)}
    return values, {name: value.T for name, value in inputs_of(terms, lane, scene).items()}


def rates_of(
    terms: Sequence[Term], lane: LaneDynamics, y: Tensor, t: Tensor, scene: Scene, measured: bool,
    more: Mapping[str, Tensor] | None = None, parameters: Mapping[str, Tensor] | None = None,
) -> Tensor:  # fmt: skip
    """``(B, N, M)`` rates of a lane's states, by PyTorch.

    Args:
        measured: whether leaders drive as they were measured.
        more: further symbols' values ``(B, N)``.
        parameters: see :func:`symbols_of`.
    """
    values, inputs = symbols_of(terms, lane, scene, parameters)
    inputs |= {name: value.T for name, value in (more or {}).items()}
    code = terms[0].code() if isinstance(terms[0], Law) else None
    law, masks = stepped(lane, scene.method), (scene.follower.T, scene.leader.T)
    rates, states = LaneRates(law, values, inputs, *masks, code), y.movedim((-1, 1), (0, 1))
    lead = None
    if measured or "measured" in lane.symbols:
        lead = scene.measured_rate_at(t)[..., 0].T
    symbols = rates.symbols(t, states, lead)
    found: Tensor = rates(states, symbols, lead if measured else None)
    return found.movedim((0, 1), (-1, 1))


def effect_increment(term: Term, state: State) -> Tensor:
    """``(B, N, 1 + M)`` what one effect changes of the sum of the terms before it, and the rates
    of its states: for models with other terms that are code."""
    assert state.system is not None
    before = torch.zeros_like(state.x) if state.rate is None else state.rate
    law = state.system.terms[0]
    if rule_of(term) is None:
        raise NotImplementedError(f"{type(term).__name__} defines neither a rule nor forward")
    key = (law.shape, term.shape)
    if key not in _BEYOND:
        before_it, units = symbol("before"), {**UNITS, "before": "m/s"}
        alone = LaneDynamics(1, {"x": before_it}, before_it, None, {}, {}, units)
        if isinstance(law, Law) and law.has_formula:
            own = law.lane(law.name)
            alone = replace(own, rates=alone.rates, leader=before_it, units={**own.units, **units})
        _BEYOND[key] = with_effect(alone, term, term.name, 1).flat()
    y = state.x if state.memory is None else torch.cat([state.x, state.memory], -1)
    more = {"before": before[..., 0]}
    found = rates_of([cast(Term, law), term], _BEYOND[key], y, state.t, state.scene, False, more)
    followers = state.scene.follower | state.scene.leader
    change = torch.where(followers, found[..., 0] - before[..., 0], 0.0)
    return torch.cat([change[..., None], found[..., 1:]], -1)


#: A law and an effect to the formula of what the effect changes.
_BEYOND: dict[tuple[Any, ...], LaneDynamics] = {}


def starts_of(
    terms: Sequence[Term], lane: LaneDynamics, x: Tensor, v: Tensor, scene: Scene,
    parameters: Mapping[str, Tensor] | None = None,
) -> dict[str, Tensor]:  # fmt: skip
    """``(B, N)`` values at the start of a lane's added states, of those whose start is a formula.

    Args:
        x, v: ``(B, N, 1)`` measured at the start.
        parameters: by their symbols; None: the terms' own.
    """
    if not lane.starts:
        return {}
    start = [x, v][: lane.order]
    y = torch.cat([*start, x.new_zeros(*x.shape[:2], len(lane.rates) - lane.order)], -1)
    zero = y.new_tensor(0.0)
    found = rates_of(terms, _starts(lane), y, zero, scene, False, parameters=parameters)
    return {name: found[..., i] for i, name in enumerate(lane.rates) if name in lane.starts}


@cache
def _starts(lane: LaneDynamics) -> LaneDynamics:
    """A lane whose rates are the starts of its states, also those of leaders."""
    zero = const(0)
    rates = {state: lane.starts.get(state, zero) for state in lane.rates}
    return replace(lane, rates=rates, leads={})
