"""The formula of a model, made from what its terms say of themselves."""

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
from nnode.model.terms import CrowdDynamics, LaneDynamics, add_term, own_values, values_of

#: What terms say of their formulas to the formula of all.
_KNOWN: dict[tuple[Any, ...], Any] = {}


def lane_of(terms: Sequence[Term]) -> LaneDynamics | None:
    """The formula of a lane with these terms; None where one is code without a formula."""
    if not terms or not isinstance(terms[0], Law) or terms[0].rule is None:
        return None
    order = terms[0].order
    if any(isinstance(e, Law) or e.rule_for(order) is None for e in terms[1:]):
        return None
    key = tuple(term.shape for term in terms)
    if key not in _KNOWN:
        lane = LaneDynamics(order=order)
        for place, (term, owner) in enumerate(zip(terms, owners(terms), strict=True)):
            lane = with_term(lane, term, owner, place)
        _KNOWN[key] = lane.flat()
    found: LaneDynamics = _KNOWN[key]
    return found


def crowd_of(terms: Sequence[Term]) -> CrowdDynamics | None:
    """The formula of a crowd with these terms; None where one is code without a formula."""
    if any(term.rule_for(2) is None for term in terms):
        return None
    key = tuple(term.shape for term in terms)
    if key not in _KNOWN:
        law, names = CrowdDynamics(), owners(terms)
        # a law is known to effects wherever it stands
        for i, term in sorted(enumerate(terms), key=lambda it: not isinstance(it[1], Law)):
            law = with_term(law, term, names[i], i)
        _KNOWN[key] = law.flat() if law.is_formula else None
    found: CrowdDynamics | None = _KNOWN[key]
    return found


def with_term(model: Any, term: Term, owner: str, place: int, called: bool = False) -> Any:
    """The formulas of a model with those of one term more.

    Args:
        owner: name of the term in the model; symbols begin with it.
        place: of the term in the model.
        called: whether networks of laws stay functions.
    """
    if isinstance(term, Law):
        return term.written(model, owner, place, called=called)
    rule = term.rule_for(2 if isinstance(model, CrowdDynamics) else model.order)
    if rule is None:
        raise NotImplementedError(f"{type(term).__name__} defines neither a rule nor forward")
    return add_term(model, owner, rule, *parameters_of(term, owner, place), place)


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


def owners(terms: Sequence[Term]) -> list[str]:
    """The name of each term; of several of one name the second is numbered.

    Raises:
        ConfigError: a name that cannot stand in a formula.
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
    terms: Sequence[Term],
    lane: LaneDynamics,
    y: Tensor,
    t: Tensor,
    scene: Scene,
    measured: bool,
    more: Mapping[str, Tensor] | None = None,
    parameters: Mapping[str, Tensor] | None = None,
) -> Tensor:
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


def effect_alone(law: Term, term: Term) -> LaneDynamics:
    """The formula of one effect beside a law, where other terms are code: ``before`` is the sum of
    the terms before it.

    Raises:
        ConfigError: the effect changes a law of the gap, and the model has none.
    """
    key = ("increment", law.shape, term.shape)
    if key not in _KNOWN:
        alone, before = LaneDynamics(order=1), symbol("before")
        if isinstance(law, Law) and law.rule is not None:
            alone = with_term(LaneDynamics(order=law.order), law, law.name, 0)
        elif "law(" in str(term.rule_for(1)):
            raise ConfigError(
                f"effect {term.name} modifies the law of the gap and needs a model with one; "
                "derive the model's own term from FollowTheLeader, or leave the effect out"
            )
        units = {**alone.units, "before": "m/s"}
        alone = replace(alone, rates={"x": before}, leader=before, units=units)
        _KNOWN[key] = with_term(alone, term, term.name, 1).flat()
    found: LaneDynamics = _KNOWN[key]
    return found


def effect_increment(term: Term, state: State) -> Tensor:
    """``(B, N, 1 + M)`` what one effect changes of the sum of the terms before it, and the rates
    of its states: for models with other terms that are code."""
    before = torch.zeros_like(state.x) if state.rate is None else state.rate
    law = state.terms[0]
    y = state.x if state.memory is None else torch.cat([state.x, state.memory], -1)
    more, lane = {"before": before[..., 0]}, effect_alone(law, term)
    found = rates_of([law, term], lane, y, state.t, state.scene, False, more)
    followers = state.scene.follower | state.scene.leader
    change = torch.where(followers, found[..., 0] - before[..., 0], 0.0)
    return torch.cat([change[..., None], found[..., 1:]], -1)


def added_to(laws: Sequence[Term], effects: Sequence[Term], called: bool = False) -> CrowdDynamics:
    """The formula of what effects add to a crowd's laws.

    Args:
        called: whether networks of laws stay functions.
    """
    terms = [*laws, *effects]
    key = ("added", len(laws), called, *(t.shape for t in terms))
    if key not in _KNOWN:
        model, names = CrowdDynamics(), owners(terms)
        for i, law in enumerate(laws):
            model = with_term(model, law, names[i], i, called)
        model = replace(model, rate=(const(0), const(0)))
        for i, effect in enumerate(effects, start=len(laws)):
            model = with_term(model, effect, names[i], i)
        _KNOWN[key] = model.flat()
    found: CrowdDynamics = _KNOWN[key]
    return found


def contribution(term: Term, state: State) -> Tensor:
    """``(B, N, 2)`` m/s²: what one effect adds to the accelerations, by its rule."""
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
    """``(B, N)`` values at the start of a lane's added states.

    Args:
        x, v: ``(B, N, 1)`` measured at the start.
        parameters: by their symbols; None: the terms' own.
    """
    if not lane.starts:
        return {}
    y = torch.cat([x, v, x.new_zeros(*x.shape[:2], len(lane.starts))], -1)
    zero = y.new_tensor(0.0)
    found = rates_of(terms, _starts(lane), y, zero, scene, False, parameters=parameters)
    return {name: found[..., i] for i, name in enumerate(lane.starts, start=2)}


@cache
def _starts(lane: LaneDynamics) -> LaneDynamics:
    """Starts in the place of rates, also those of leaders; positions and speeds are measured."""
    rates = {"x": const(0), "v": const(0), **lane.starts}
    return replace(lane, rates=rates, leader=const(0), leads={}, chained={})
