"""The formula of a model, composed from the rules of its terms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import torch
from torch import Tensor

from nnode.errors import ConfigError
from nnode.model.crowd_formula import rates_of as crowd_rates
from nnode.model.expression import const, symbol
from nnode.model.lane_rates import LaneRates
from nnode.model.laws import Law, parameters_of
from nnode.model.names import check_names
from nnode.model.scene import Scene
from nnode.model.steps import stepped
from nnode.model.term import State, Term, numbered
from nnode.model.terms import CrowdDynamics, D, LaneDynamics, add_term, parameter_values

#: The terms' shapes to the composed formula.
_FORMULAS: dict[tuple[Any, ...], Any] = {}


def lane_of(terms: Sequence[Term]) -> LaneDynamics | None:
    """The formula of a lane with these terms; None where one is code without a formula."""
    law = terms[0] if terms else None
    if not isinstance(law, Law) or any(isinstance(term, Law) for term in terms[1:]):
        return None
    if not _are_formulas(terms, law.order):
        return None
    return _composed(LaneDynamics(order=law.order), terms)


def crowd_of(terms: Sequence[Term]) -> CrowdDynamics | None:
    """The formula of a crowd with these terms; None where one is code without a formula."""
    if not _are_formulas(terms, 2):
        return None
    law = _composed(CrowdDynamics(), terms)
    return law if law.is_formula else None


def added_to(laws: Sequence[Term], effects: Sequence[Term], called: bool = False) -> CrowdDynamics:
    """The formula of the accelerations that effects add to a crowd's laws.

    Args:
        called: whether networks of laws stay calls; otherwise they are written out.
    """
    return _composed(CrowdDynamics(), [*laws, *effects], called, increment=True)


def _are_formulas(terms: Sequence[Term], order: int) -> bool:
    return all(term.rule_for(order) is not None for term in terms)


def _composed(empty: D, terms: Sequence[Term], called: bool = False, increment: bool = False) -> D:
    """The flat formulas of terms, added to an empty model.

    Args:
        called: whether networks of laws stay calls; otherwise they are written out.
        increment: whether the rate is only that of a crowd's effects.
    """
    key = (called, increment, *(term.shape for term in terms))
    if key not in _FORMULAS:
        model: Any = empty
        named = list(zip(range(len(terms)), terms, owners(terms), strict=True))
        # laws come first, so that effects can use them whatever the order of the terms
        for place, term, owner in named:
            if isinstance(term, Law):
                model = with_term(model, term, owner, place, called)
        if increment:
            model = replace(model, rate=(const(0), const(0)))
        for place, term, owner in named:
            if not isinstance(term, Law):
                model = with_term(model, term, owner, place)
        _FORMULAS[key] = model.flat()
    formula: D = _FORMULAS[key]
    return formula


def with_term(model: Any, term: Term, owner: str, place: int, called: bool = False) -> Any:
    """The formulas of a model with an additional term.

    Args:
        owner: name of the term in the model; prefix of its symbols.
        place: index of the term in the model.
        called: whether networks of laws stay calls; otherwise they are written out.
    """
    if isinstance(term, Law):
        return term.written(model, owner, place, called=called)
    rule = term.rule_for(2 if isinstance(model, CrowdDynamics) else model.order)
    if rule is None:
        raise NotImplementedError(f"{type(term).__name__} defines neither a rule nor forward")
    return add_term(model, owner, rule, *parameters_of(term, owner, place), place)


def inputs_of(terms: Sequence[Any], lane: LaneDynamics, scene: Scene) -> dict[str, Tensor]:
    """Symbol to the values ``(B, N)`` of vehicles' properties from the data."""
    inputs = {"length_1": _length_ahead(scene)} if "length_1" in lane.symbols else {}
    for name, (place, part) in lane.inputs.items():
        inputs[name] = terms[place].inputs(scene)[part]
    return inputs


def _length_ahead(scene: Scene) -> Tensor:
    """``(B, N)`` length of the vehicle ahead, m. The mean of the known lengths replaces an unknown
    one; without any known length it is 0."""
    length = torch.where(torch.isfinite(scene.length), scene.length, scene.mean_length)
    return torch.cat([length[:, 1:], torch.zeros_like(length[:, :1])], 1)


def owners(terms: Sequence[Term]) -> list[str]:
    """The name of each term; repeated names are numbered from the second on.

    Raises:
        ConfigError: a name that a formula cannot contain.
    """
    names = [term.name for term in terms]
    check_names("terms", names)
    return numbered(names)


def symbols_of(
    terms: Sequence[Term],
    lane: LaneDynamics,
    scene: Scene,
    parameters: Mapping[str, Tensor] | None = None,
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Values of a lane's constant symbols: those that all vehicles share, and ``(N, B)`` vehicles'
    properties from the data.

    Args:
        parameters: symbol to value; None takes the terms' parameters.
    """
    values = parameter_values(terms, lane) if parameters is None else dict(parameters)
    values |= {"start": scene.start, "dt": scene.start.new_tensor(scene.step)}
    return values, {name: value.T for name, value in inputs_of(terms, lane, scene).items()}


def rates_of(
    terms: Sequence[Term],
    lane: LaneDynamics,
    y: Tensor,
    t: Tensor,
    scene: Scene,
    measured: bool,
    extra_inputs: Mapping[str, Tensor] | None = None,
    parameters: Mapping[str, Tensor] | None = None,
) -> Tensor:
    """``(B, N, M)`` rates of a lane's states, by PyTorch.

    Args:
        measured: whether leaders follow their measured paths.
        extra_inputs: additional symbols to their values ``(B, N)``.
        parameters: see :func:`symbols_of`.
    """
    values, inputs = symbols_of(terms, lane, scene, parameters)
    inputs |= {name: value.T for name, value in (extra_inputs or {}).items()}
    code = terms[0].code() if isinstance(terms[0], Law) else None
    law, masks = stepped(lane, scene.method), (scene.follower.T, scene.leader.T)
    rates, states = LaneRates(law, values, inputs, *masks, code), y.movedim((-1, 1), (0, 1))
    lead = None
    if measured or "measured" in lane.symbols:
        lead = scene.measured_rate_at(t)[..., 0].T
    symbols = rates.symbols(t, states, lead)
    values_by_state: Tensor = rates(states, symbols, lead if measured else None)
    return values_by_state.movedim((0, 1), (-1, 1))


def effect_alone(law: Term, term: Term) -> LaneDynamics:
    """The formula of a law and one effect, for models with other terms that are code.

    The symbol ``before`` is the sum of the terms before the effect.

    Raises:
        ConfigError: the effect changes a law of the gap, and the model has none.
    """
    key = ("increment", law.shape, term.shape)
    if key not in _FORMULAS:
        alone, before = LaneDynamics(order=1), symbol("before")
        if isinstance(law, Law) and law.rule is not None:
            alone = with_term(LaneDynamics(order=law.order), law, law.name, 0)
        elif (rule := term.rule_for(1)) is not None and rule.calls_law:
            raise ConfigError(
                f"effect {term.name} modifies the law of the gap and needs a model with one; "
                "derive the model's own term from FollowTheLeader, or leave the effect out"
            )
        units = {**alone.units, "before": "m/s"}
        alone = replace(alone, rates={"x": before}, leader=before, units=units)
        _FORMULAS[key] = with_term(alone, term, term.name, 1).flat()
    formula: LaneDynamics = _FORMULAS[key]
    return formula


def effect_increment(term: Term, state: State) -> Tensor:
    """``(B, N, 1 + M)``: one effect's change of the sum of the terms before it, then the rates of
    its states; for models with other terms that are code."""
    before = torch.zeros_like(state.x) if state.rate is None else state.rate
    law = state.terms[0]
    y = state.x if state.memory is None else torch.cat([state.x, state.memory], -1)
    extra_inputs, lane = {"before": before[..., 0]}, effect_alone(law, term)
    rates = rates_of([law, term], lane, y, state.t, state.scene, False, extra_inputs)
    followers = state.scene.follower | state.scene.leader
    change = torch.where(followers, rates[..., 0] - before[..., 0], 0.0)
    return torch.cat([change[..., None], rates[..., 1:]], -1)


def contribution(term: Term, state: State) -> Tensor:
    """``(B, N, 2)`` m/s²: the acceleration that one effect adds by its rule."""
    laws = [t for t in state.terms if isinstance(t, Law)]
    code = {name: call for law in laws for name, call in law.code().items()}
    return crowd_rates([*laws, term], added_to(laws, [term], called=True), state, code)


def starts_of(
    terms: Sequence[Term],
    lane: LaneDynamics,
    x: Tensor,
    v: Tensor,
    scene: Scene,
    parameters: Mapping[str, Tensor] | None = None,
) -> dict[str, Tensor]:
    """Added state to its values ``(B, N)`` at the start.

    Args:
        x, v: ``(B, N, 1)`` measured positions, m, and speeds, m/s, at the start.
        parameters: symbol to value; None takes the terms' parameters.
    """
    if not lane.starts:
        return {}
    y = torch.cat([x, v, x.new_zeros(*x.shape[:2], len(lane.starts))], -1)
    zero = y.new_tensor(0.0)
    starts = rates_of(terms, _starts(lane), y, zero, scene, False, parameters=parameters)
    return {name: starts[..., i] for i, name in enumerate(lane.starts, start=2)}


@cache
def _starts(lane: LaneDynamics) -> LaneDynamics:
    """A lane whose rates are the start values of added states, for leaders as well."""
    rates = {"x": const(0), "v": const(0), **lane.starts}
    return replace(lane, rates=rates, leader=const(0), leader_rates={}, chained={})
