"""Laws: entries of formulas and parameters. The package's laws are files in ``laws/``;
user-defined laws come from ``model.law``."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, cached_property, partial
from importlib.resources import files
from operator import itemgetter
from typing import Any, ClassVar

import torch
import yaml
from torch import Tensor

from nnode.errors import ConfigError
from nnode.model.arrays import Code, Formulas
from nnode.model.crowd_formula import rates_of, settings_of
from nnode.model.expression import Expr, call, const, substitute, symbol, symbols
from nnode.model.names import check_names
from nnode.model.network import FeedForward
from nnode.model.parse import parse
from nnode.model.steps import METHODS
from nnode.model.term import Interval, State, Term
from nnode.model.terms import (
    LARGEST,
    OTHERS,
    POINTS,
    REDUCED,
    SMALLEST,
    CrowdDynamics,
    LaneDynamics,
    Rule,
    add_term,
    parameter_values,
)
from nnode.model.units import in_si

#: Quantities of a lane that are set to 0 for the equilibrium of vehicles at one speed.
_AT_REST = ("dv", "t", "clock", "x", "x_1", "x_2", "v_2", "length_1", "gap_1", "dx_1", "v", "v_1")
#: The time step for figures of laws that map one step to the next, s.
_STEP = 0.1
#: Largest speed of a vehicle, m/s.
FASTEST = 100.0
#: Allowed keys of the description of a user-defined law, of a lane and of a crowd.
_COMMON = ("parameters", "constants", "where")
_KEYS = (*_COMMON, "delayed", "remembered", "states", "step", "rate", "source")
_CROWD_KEYS = (*_COMMON, "rate", "source", *REDUCED)
#: Entries that are mappings.
_MAPPINGS = (*_COMMON, "delayed", "states", *REDUCED)
#: Order of a law to the network that is added to it; inputs are scaled to the size of 1, SI units.
_ADDED = {1: "NN(gap/20)", 2: "NN(gap/20, v/10, dv/2)"}
_PARAMETER = {"value", "low", "high", "unit"}
_ENDS = {"low": "at least", "high": "at most"}


def packaged(file: str) -> Any:
    """The content of a YAML file of the package ``nnode.model``."""
    text = (files("nnode.model") / file).read_text("utf-8")
    return yaml.load(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader))


@cache
def entries() -> dict[str, dict[str, Any]]:
    """The package's laws by name, in the order of their ranks, from their files.

    In addition to the keys of a user-defined law, an entry may have: ``about``, a description in
    one line; ``formula``, the printed formula; ``model``, the entries of the model of this name,
    without which the law is given as ``model.law``; ``options``, the model's options that the law
    takes; ``settings``, fixed quantities that options may set; ``networks``, submodule to the
    functions in formulas that are its outputs; ``hidden``, neurons of their hidden layer;
    ``force``, ``drive``, see :class:`nnode.model.terms.Rule`; ``variants``, option to the entries
    that it changes if it is true. A parameter whose value is a list of two values starts uniform
    between them.
    """
    laws = {
        file.name.removesuffix(".yaml"): packaged(f"laws/{file.name}")
        for file in files("nnode.model.laws").iterdir()
        if file.name.endswith(".yaml")
    }
    return dict(sorted(laws.items(), key=lambda item: (item[1].get("rank", 100), item[0])))


def _of_people(rate: Any) -> bool:
    return isinstance(rate, Mapping) and not {"vx", "vy", "y"}.isdisjoint(rate)


def _descriptions(people: bool) -> dict[str, dict[str, Any]]:
    keys = _CROWD_KEYS if people else _KEYS
    return {
        name: {key: value for key, value in entry.items() if key in keys}
        for name, entry in entries().items()
        if "model" not in entry and _of_people(entry["rate"]) is people
    }


#: Name of a law to its description as ``model.law``.
CAR_FOLLOWING_LAWS = _descriptions(people=False)
PEDESTRIAN_LAWS = _descriptions(people=True)
#: Neurons of the hidden layer of laws that are networks.
NEURONS = {n: entries()[n]["hidden"] for n in CAR_FOLLOWING_LAWS if "hidden" in entries()[n]}
#: Name of a law to the options of the model that consists of it.
LAW_MODELS: dict[str, dict[str, Any]] = {
    name: {"term": "formula", "law": law, "network": NEURONS.get(name)}
    for name, law in (CAR_FOLLOWING_LAWS | PEDESTRIAN_LAWS).items()
}


class Law(Term):
    """A term that effects change: a law of vehicles or people, described by an entry.

    A subclass may define the law by code: it overrides ``speed`` (of a lane, first order) or
    ``forward``.

    Args:
        entry: name of the package's entry, or a description with at least ``parameters`` and
            ``rate``. Parameters are quantities with a unit, ``30 m/s``, or mappings of ``value``,
            ``low`` and ``high``. ``rate`` is ``{x: formula}``, m/s, or ``{v: formula}``, m/s², of
            a lane; ``{vx: formula, vy: formula}``, m/s², or ``{x: formula, y: formula}``, m/s, of
            a crowd. :mod:`nnode.model.terms` lists the names in formulas.
        name: name of the term; by default the entry's.
        hidden: neurons of the hidden layer of networks. If formulas do not call NN, the network
            NN(gap/20, v/10, dv/2) in SI units is added to the rate and starts at 0. None takes
            the entry's value, or no network.
        box: weights stay in [-box, box]; None leaves them free.
        generator: source of random start values.
        options: start values of parameters and values of settings, in SI units and by their names
            (None takes the entry's value), ``L_min`` for the low end of ``L``, and variants.

    Attributes:
        order: 1 if its rate is a speed, 2 if it is an acceleration.
        step: the law's method of stepping, see :mod:`nnode.model.steps`; None takes the default
            of its order. With an effect that remembers steps, ``ballistic`` replaces ``rk4``.
        rule: the law's formulas, which may call its code; None if its ``forward`` is code.
        formulas: the entry's formulas.

    A leader that drives by the law keeps the parameter v0 as its speed in a law of first order,
    and its first speed in a law of second order.

    Raises:
        ConfigError: an entry that is missing, cannot be read, or has the wrong unit.
        ValueError: a setting that is not positive.
    """

    order = 2
    step: str | None = None
    formulas: Rule
    #: Methods of subclasses that replace formulas, to the replaced entry and the method's inputs.
    methods: ClassVar[dict[str, tuple[str, str]]] = {"speed": ("rate", "gap")}
    _calls: dict[str, Callable[..., Expr]]

    def __init__(
        self,
        entry: str | Mapping[str, Any],
        name: str = "",
        *,
        hidden: int | None = None,
        box: float | None = None,
        generator: torch.Generator | None = None,
        **options: Any,
    ) -> None:
        super().__init__()
        self.entry = entry if isinstance(entry, str) else ""
        description = dict(entries()[entry] if isinstance(entry, str) else entry)
        for option, changes in description.pop("variants", {}).items():
            setattr(self, option, bool(options.pop(option, False)))
            if getattr(self, option):
                description |= {
                    key: {**description[key], **value} for key, value in changes.items()
                }
        self.name = str(name or self.entry)  # type: ignore[misc]
        self.source = str(description.get("source", getattr(type(self), "source", "")))  # type: ignore[misc]
        check_names("model.name", [self.name])
        self.networks: dict[str, list[str]] = description.get("networks", {"network": ["NN"]})
        self.network: FeedForward | None = None
        self.formulas = _rule(description)
        self.domain = "crowd" if self.formulas.of_crowd else "traffic"
        self.order, self.step = self.formulas.order, description.get("step")
        if self.step is not None and self.step not in METHODS:
            raise ConfigError(
                f"model.law.step={self.step} is unknown, expected {', '.join(METHODS)}"
            )
        self._declare(description["parameters"], options, generator)
        for setting, quantity in description.get("settings", {}).items():
            value = options.pop(setting, None)
            if value is not None and not value > 0:
                raise ValueError(f"{setting}={value} must be positive")
            setattr(self, setting, in_si(quantity)[0] if value is None else value)
        if options:
            raise ValueError(f"the law {self.name} has no option {', '.join(options)}")
        self._connect(description.get("hidden") if hidden is None else hidden, generator)
        if box is not None:
            weights = (
                n for n, _ in self.named_parameters() if n.partition(".")[0] in self.networks
            )
            self.bounds |= dict.fromkeys(weights, Interval(-box, box))
        text = self.formulas.rate if self.domain == "traffic" else ", ".join(self.formulas.rate)
        self.formula = description.get("formula", getattr(type(self), "formula", text))  # type: ignore[misc]
        self._coded()
        self._key = repr(self.rule)
        self.dynamics()  # raises errors of the formulas

    def _declare(
        self, parameters: Mapping[str, Any], options: dict[str, Any], draws: torch.Generator | None
    ) -> None:
        """Declare the parameters, and remove their start values from ``options``."""
        check_names("model.law.parameters", parameters)
        start_values = {name: options.pop(name, None) for name in parameters}
        for name, quantity in parameters.items():
            if hasattr(self, name):
                raise ConfigError(f"model.law.parameters: {name} cannot be the name of a parameter")
            entry = dict(quantity) if isinstance(quantity, Mapping) else {"value": quantity}
            if not {"value"} <= set(entry) <= _PARAMETER:
                raise ConfigError(
                    f"model.law.parameters.{name}={quantity}: expected a quantity such as 30 m/s, "
                    "or {value: 30 m/s, low: 0 m/s, high: 60 m/s}"
                )
            unit, drawn = entry.pop("unit", None), None
            if self.entry and isinstance(entry["value"], list):
                low, high = (in_si(str(end))[0] for end in entry["value"])
                share = torch.rand((), generator=draws, dtype=torch.float64)
                drawn, entry["value"] = float(low + (high - low) * share), entry["value"][0]
            quantities = {key: in_si(str(value)) for key, value in entry.items()}
            units = {dimension for _, dimension in quantities.values()}
            if len(units) > 1:
                stated = ", ".join(f"{key} {value}" for key, value in entry.items())
                raise ConfigError(
                    f"model.law.parameters.{name} has {stated}: expected quantities with one kind "
                    f"of unit, such as '3 {max(units - {'1'})}'"
                )
            bounds = {key: value for key, (value, _) in quantities.items() if key != "value"}
            within = Interval(**bounds)
            if not within.low <= quantities["value"][0] <= within.high:
                ends = [f"{word} {entry[key]}" for key, word in _ENDS.items() if key in entry]
                raise ConfigError(
                    f"model.law.parameters.{name}.value={entry['value']}: a start value of {name} "
                    f"must be {' and '.join(ends)}"
                )
            if "low" in bounds and options.get(f"{name}_min") is not None:
                bounds["low"] = float(options.pop(f"{name}_min"))
            start = quantities["value"][0] if drawn is None else drawn
            self.declare(
                name,
                start if start_values[name] is None else start_values[name],
                unit=unit or units.pop(),
                bounds=Interval(**bounds) if bounds else None,
            )

    def _connect(self, hidden: int | None, generator: torch.Generator | None) -> None:
        """Create the networks, with the number of inputs that the formulas give them."""
        inputs: dict[str, set[int]] = {name: set() for name in self.networks}

        def count(module: str, *values: Expr) -> Expr:
            inputs[module].add(len(values))
            return const(0)

        functions = {f: partial(count, m) for m, names in self.networks.items() for f in names}
        calls = re.compile(rf"\b({'|'.join(functions)})\s*\(")
        added = not any(calls.search(text) for text in self.formulas.texts)
        if hidden is None:
            if not added and self.domain == "traffic":
                raise ConfigError(
                    f"model.law of {self.name} calls NN, a network: say how many neurons its "
                    "hidden layer has, as model.network=4"
                )
            self.networks = {}
            return
        if added:
            rate = f"{self.formulas.rate} + {_ADDED[self.order]}"
            self.formulas = replace(self.formulas, rate=rate)
        for text in self.formulas.texts:
            if calls.search(text):
                parse(text, None, {**dict.fromkeys(self.formulas.where, const(0)), **functions})
        for module, counts in inputs.items():
            if len(counts) != 1:
                raise ConfigError(
                    f"model.law of {self.name}: {self.networks[module][0]} is called with "
                    f"{sorted(counts) or 'no'} inputs, expected the same number everywhere"
                )
            sizes = (counts.pop(), int(hidden), len(self.networks[module]))
            setattr(self, module, FeedForward(sizes, generator))
        if added:
            assert self.network is not None
            self.network.zero_output_()

    def _coded(self) -> None:
        """Set ``rule``: the formulas, with calls of the methods that a subclass overrides."""
        rule, self._calls = self.formulas, {}
        for method, (entry, inputs) in self.methods.items():
            overridden = getattr(type(self), method) is not getattr(InteractionForce, method)
            replaced = getattr(rule, entry)
            if not overridden or not replaced or (entry == "rate" and self.order == 2):
                continue
            if isinstance(replaced, str):
                self._calls[method] = partial(call, method)
                rule = replace(rule, rate=f"{method}({inputs})")
                continue
            names = [f"{method}_{axis}" for axis in "xy"]
            self._calls |= {name: partial(_output, method, k) for k, name in enumerate(names)}
            sums: Any = {
                part: ("N", f"{f}({inputs})") for part, f in zip(replaced, names, strict=True)
            }
            rule = replace(rule, **{entry: sums})
        coded = type(self).forward not in (Law.forward, InteractionForce.forward)
        self.rule = None if coded else rule

    @property
    def shape(self) -> tuple[Any, ...]:
        return (*self._shape_called, *(getattr(self, module).sizes for module in self.networks))

    @property
    def _shape_called(self) -> tuple[Any, ...]:
        """Key of the formula in which networks stay calls."""
        return (*super().shape, self.name, self._key, *self.units.items())

    def rule_for(self, order: int) -> Rule | None:
        return self.rule

    @cached_property
    def of_gap(self) -> bool:
        """Whether it is a speed that depends only on the gap."""
        if self.domain != "traffic" or self.order != 1 or self.formulas.memory:
            return False
        lane = self.dynamics(called=True)
        return {"gap", *lane.owned}.issuperset(symbols([_law_alone(lane)]))

    def names(self, parameter: str) -> bool:
        """Whether the rate of a vehicle contains a parameter."""
        return f"{self.name}__{parameter}" in symbols([self.dynamics(called=True).law])

    def code(self) -> dict[str, Code]:
        """Name to the function that calls of this name in its formulas evaluate."""
        networks = {
            module: partial(_network_output, getattr(self, module)) for module in self.networks
        }
        return {"speed": self.speed, **{str(k): itemgetter((..., k)) for k in (0, 1)}, **networks}

    def written(
        self, model: Any, owner: str, place: int, rule: Rule | None = None, called: bool = False
    ) -> Any:
        """The formulas of a model with this term.

        Args:
            model: the formulas without it.
            owner: name of the term in the model; prefix of its symbols.
            place: index of the term in the model.
            rule: formulas in place of its own.
            called: whether networks stay calls; otherwise they are written out, neuron by neuron.
        """
        rule = rule or self.rule or self.formulas
        parameters, owned, units = parameters_of(self, owner, place)
        functions = dict(self._calls)
        for module, names in self.networks.items():
            if called:
                functions |= {name: partial(_output, module, k) for k, name in enumerate(names)}
                continue
            network, label, path = (
                getattr(self, module),
                f"{owner}__{module}",
                f"terms.{place}.{module}.",
            )
            functions |= {
                name: partial(_written_output, network, label, path, k)
                for k, name in enumerate(names)
            }
            if any(re.search(rf"\b{name}\s*\(", t) for name in names for t in rule.texts):
                _, weights = network.written([const(0)] * network.sizes[0], label, path)
                owned |= weights
                units |= dict.fromkeys(weights, "*")
        return add_term(model, owner, rule, parameters, owned, units, place, functions)

    def dynamics(self, called: bool = False) -> Any:
        """The formulas of a model of only this law; flat for a crowd."""
        key = (called, *(self._shape_called if called else self.shape))
        if key not in _FORMULAS:
            empty = CrowdDynamics() if self.domain == "crowd" else LaneDynamics(order=self.order)
            formulas = self.written(empty, self.name, 0, self.formulas, called)
            _FORMULAS[key] = formulas.flat() if self.domain == "crowd" else formulas
        return _FORMULAS[key]

    def computed(self, formulas: Sequence[Expr], values: Mapping[str, Tensor]) -> list[Tensor]:
        """The values of formulas of its parameters, settings, networks and other quantities."""
        law = self.dynamics(called=True)
        law_values = parameter_values([self], law)
        like = next(iter(values.values()))
        law_values |= {k: like.new_tensor(value) for k, value in settings_of([self], law).items()}
        return Formulas(formulas)({**law_values, **values}, code=self.code())

    def evaluated(self, values: Mapping[str, Tensor]) -> Tensor:
        """The rate of a vehicle from the values of the quantities in it."""
        return self.computed([_law_alone(self.dynamics(called=True))], values)[0]

    def speed(self, gap: Tensor) -> Tensor:
        """Equilibrium speed, m/s, at a gap, m, elementwise, where all vehicles drive at one speed.

        For a law of second order it is the zero of the acceleration by bisection between 0 and
        100 m/s, or 0 if the acceleration at rest is not positive.
        """
        if self.of_gap:
            speed = self.evaluated({"gap": gap})
            return speed if speed.shape == gap.shape else speed.expand_as(gap)
        zero = torch.zeros_like(gap)
        at_rest = {**dict.fromkeys(_AT_REST, zero), "gap": gap, "x_1": gap, "dt": zero + _STEP}
        lane = self.dynamics(called=True).flat()

        def acceleration_at(v: Tensor) -> Tensor:
            """The law's rate if all vehicles have driven at the speed v."""
            values = {**at_rest, "v": v, "v_1": v, "dx_1": v, **dict.fromkeys(lane.starts, zero)}
            start_values = self.computed(list(lane.starts.values()), values)
            values |= dict(zip(lane.starts, start_values, strict=True))
            return self.evaluated(values).expand_as(gap)

        if self.order == 1:
            return acceleration_at(zero)
        low, high = zero, torch.full_like(gap, FASTEST)
        for _ in range(60):
            middle = (low + high) / 2
            faster = acceleration_at(middle) > 0
            low, high = torch.where(faster, middle, low), torch.where(faster, high, middle)
        return torch.where(acceleration_at(zero) > 0, low, zero)

    def forward(self, state: State) -> Tensor:
        """Its rate by its formulas."""
        if self.domain == "crowd":
            return rates_of([self], self.dynamics(called=True), state, self.code())
        if not self.of_gap:
            raise ConfigError(
                f"the law {self.name} is a formula and cannot be mixed with terms that are code"
            )
        x, scene = state.x[..., 0], state.scene
        speed = self.speed(x[:, 1:] - x[:, :-1])
        ahead = torch.cat([speed, speed.new_zeros(len(speed), 1)], 1)
        v0 = getattr(self, "v0", 0.0)  # without v0, leaders follow their measured paths
        return torch.where(scene.follower, ahead, v0 * scene.leader)[..., None]

    def alone(self) -> Law:
        """The same pedestrian law without other people and walls."""
        law, law_alone = self.dynamics(), copy.copy(self)
        value = {SMALLEST: "nobody", LARGEST: "-nobody"}
        bare: dict[str, Any] = {
            over: {
                n: (law.units[f"{self.name}__{n}"], value.get(over, "0"))
                for n in getattr(self.formulas, over)
            }
            for over in REDUCED
        }
        law_alone.rule = law_alone.formulas = replace(self.formulas, **bare)
        law_alone._key = repr(law_alone.rule)
        return law_alone


#: Shape of a law to its formulas.
_FORMULAS: dict[tuple[Any, ...], Any] = {}


@cache
def _law_alone(lane: LaneDynamics) -> Expr:
    """A law's rate, with fixed quantities as numbers."""
    assert lane.law is not None
    return substitute(lane.law, lane.fixed)


def _network_output(network: FeedForward, *inputs: Tensor) -> Tensor:
    """The outputs of a network, evaluated layer by layer."""
    if len(inputs) == 1:  # faster, and the paper's laws have one input
        joined = inputs[0][..., None]
    else:
        joined = torch.stack(torch.broadcast_tensors(*inputs), -1)
    out: Tensor = network(joined)
    return out


def _output(name: str, number: int, *inputs: Expr) -> Expr:
    """One output of a call of code."""
    return call(str(number), call(name, *inputs))


def _written_output(
    network: FeedForward, label: str, path: str, number: int, *inputs: Expr
) -> Expr:
    """One output of a network as a formula of its neurons."""
    return network.written(list(inputs), label, path)[0][number]


class FollowTheLeader(Law):
    """Base class of lane laws that are code: a subclass defines ``name`` and ``speed``.

    dx_i/dt = W(x_{i+1} - x_i) for followers, dx_N/dt = v0.

    Args:
        v0: m/s, the speed of the leading vehicle.
    """

    v0: Tensor

    def __init__(self, v0: float) -> None:
        entry = {"parameters": {"v0": "30 m/s"}, "rate": {"x": "speed(gap)"}}
        super().__init__(entry, type(self).name, v0=v0)

    def speed(self, gap: Tensor) -> Tensor:
        """W: gap in m to speed in m/s, elementwise."""
        raise NotImplementedError  # pragma: no cover - every law defines its own


class InteractionForce(Law):
    """Forces between people and from walls, averaged as in the paper.

    (1/m) mean over the N people of the pair force + (1/m) mean over the P wall points of the
    wall force. A person counts in N, but exerts a force on itself only with ``self_interaction``.
    The entry defines the forces; a subclass may override ``pair_force`` and ``wall_force``.

    Args:
        mass: m, kg.
        walls: False omits the walls.
        entry: name of the package's entry or a description; None if both forces are code.
        options: options of :class:`Law`.

    Attributes:
        self_interaction: whether the mean over people contains j = i.
    """

    mass: float
    methods: ClassVar[dict[str, tuple[str, str]]] = {
        "pair_force": (OTHERS, "dx, dy, dvx, dvy"),
        "wall_force": (POINTS, "dx, dy, vx, vy, normal_x, normal_y"),
    }

    def __init__(
        self,
        mass: float = 1.0,
        walls: bool = True,
        *,
        entry: str | Mapping[str, Any] | None = None,
        self_interaction: bool = False,
        **options: Any,
    ) -> None:
        self.walls, self.self_interaction = walls, self_interaction
        name = "" if isinstance(entry, str) else type(self).name
        super().__init__(entry or _FORCE, name, mass=mass, **options)

    def _coded(self) -> None:
        if not self.walls:
            nothing = {**self.formulas.where, **dict.fromkeys(self.formulas.points, "0")}
            self.formulas = replace(self.formulas, points={}, where=nothing)
        super()._coded()

    def code(self) -> dict[str, Code]:
        def pair(dx: Tensor, dy: Tensor, dvx: Tensor, dvy: Tensor) -> Tensor:
            return self.pair_force(torch.stack([dx, dy], -1), torch.stack([dvx, dvy], -1))

        return {**super().code(), "pair_force": pair}

    def _force(self, over: str, vectors: Mapping[str, Tensor]) -> Tensor:
        """``(..., 2)`` N: the entry's summands over the others or over wall points.

        Args:
            over: kind of neighbours.
            vectors: name with {} for the axis to vectors ``(..., 2)``.
        """
        sums = self.dynamics(called=True).sums[over]
        if not sums:
            raise NotImplementedError(f"{type(self).__name__} has no force from {over}")
        parts = {
            name.format(c): vectors[name][..., k] for name in vectors for k, c in enumerate("xy")
        }
        return torch.stack(self.computed([*sums.values()], parts), -1)

    def pair_force(self, dx: Tensor, dv: Tensor) -> Tensor:
        """Force on i from j, ``(..., 2)`` N, of x_i - x_j (m) and v_i - v_j (m/s)."""
        return self._force(OTHERS, {"d{}": dx, "dv{}": dv})

    def wall_force(self, dx: Tensor, v: Tensor, normal: Tensor) -> Tensor:
        """Force on i from a wall point, ``(..., 2)`` N, of x_i - x_w (m), v_i (m/s) and the
        wall's unit normal."""
        return self._force(POINTS, {"d{}": dx, "v{}": v, "normal_{}": normal})

    def components(self, state: State) -> dict[str, Tensor]:
        """``pair`` and ``wall`` accelerations, ``(B, N, 2)`` m/s² each."""
        x, v, scene = state.x, state.velocity, state.scene
        other, speed = state.others
        dx, dv = x[:, :, None] - other[:, None], v[:, :, None] - speed[:, None]
        apart = ~torch.eye(x.shape[1], dtype=torch.bool, device=x.device)
        acts = (scene.agent[:, None, :] & apart)[..., None]
        pair = self.pair_force(dx, dv) * (acts / (self.mass * scene.count[..., None]))
        parts = {"pair": pair.sum(2)}
        if self.walls and scene.wall.shape[1]:
            wall, normal, real = scene.walls_of_each()
            dx = x[:, :, None] - wall
            force = self.wall_force(dx, v[:, :, None].expand_as(dx), normal.expand_as(dx))
            parts["wall"] = (force * real[..., None]).sum(2) / (self.mass * scene.wall_count)
        if self.self_interaction:
            zero = torch.zeros_like(x[:1, :1])
            self_force = self.pair_force(zero, zero) / (self.mass * scene.count)
            parts["pair"] = parts["pair"] + self_force
        return parts

    def forward(self, state: State) -> Tensor:
        return sum(self.components(state).values(), torch.zeros_like(state.x))


#: Entry of a force between people that is code.
_FORCE: dict[str, Any] = {
    "parameters": {},
    "settings": {"mass": "1 kg"},
    "others": {"pair_x": "no_force", "pair_y": "no_force"},
    "points": {"wall_x": "no_force", "wall_y": "no_force"},
    "constants": {"no_force": "0 N"},
    "rate": {
        "vx": "pair_x/(mass*people) + wall_x/(mass*points)",
        "vy": "pair_y/(mass*people) + wall_y/(mass*points)",
    },
    "force": ["pair_x", "pair_y"],
}


def make_law(entry: str, **options: Any) -> Law:
    """One of the package's laws, such as ``make_law("lin", v0=20.0, L=7.0)``; see :class:`Law`."""
    if "force" in entries()[entry]:
        return InteractionForce(entry=entry, **options)
    return Law(entry, **options)


def law_from(
    name: str,
    description: Any,
    *,
    network: int | None = None,
    box: float | None = None,
    generator: torch.Generator | None = None,
) -> Law:
    """A law from its description in a configuration or a checkpoint.

    Args:
        name: name of the law.
        description: mapping as of ``model.law``.
        network: neurons of the hidden layer of the network NN; None for no network.
        box: weights stay in [-box, box]; None leaves them free.
        generator: source of the initial weights.

    Raises:
        ConfigError: an entry is missing or unknown, or a formula cannot be used.
    """
    if not isinstance(description, Mapping) or not {"parameters", "rate"} <= set(description):
        raise ConfigError(
            "model.law needs parameters and rate, as in {parameters: {v0: 30 m/s, L: 5 m}, "
            "rate: {x: v0*(1 - L/gap)}}"
        )
    people = _of_people(description["rate"])
    keys = _CROWD_KEYS if people else _KEYS
    unknown = sorted(set(map(str, description)) - set(keys))
    if unknown:
        raise ConfigError(
            f"model.law has the unknown entries {', '.join(unknown)}; there are {', '.join(keys)}"
        )
    for key in _MAPPINGS:
        if not isinstance(description.get(key) or {}, Mapping):
            raise ConfigError(f"model.law.{key} must be a mapping of names, as {{v0: 30 m/s}}")
        check_names(f"model.law.{key}", description.get(key) or {})
    entry = {str(key): value for key, value in description.items()}
    if people:
        return Law(entry, name)
    return Law(entry, name, hidden=network, box=box, generator=generator)


def _rule(entry: Mapping[str, Any]) -> Rule:
    """The formulas of an entry.

    Raises:
        ConfigError: the rate has an invalid form.
    """
    rate = entry["rate"]
    states = sorted(map(str, rate)) if isinstance(rate, Mapping) else []
    if states not in (["v"], ["vx", "vy"], ["x"], ["x", "y"]):
        if {"vx", "vy", "y"}.isdisjoint(states):
            raise ConfigError(
                f"model.law.rate={rate} must be one entry, x: a formula of a speed (first order) "
                "or v: a formula of an acceleration (second order); or vx and vy, of a crowd, or "
                "x and y, of a crowd of first order"
            )
        raise ConfigError(
            f"model.law.rate={rate} must have two entries, vx and vy: formulas of both "
            "components of a person's acceleration; or x and y: of his velocity"
        )
    texts = [str(rate[state]) for state in states]
    leader = {"v": "v", "x": "v0" if "v0" in entry["parameters"] else "measured"}
    reduced: dict[str, Any] = {
        over: {str(k): ("", str(v)) for k, v in (entry.get(over) or {}).items()} for over in REDUCED
    }
    return Rule(
        rate=texts[0] if len(texts) == 1 else (texts[0], texts[1]),
        order=1 if "x" in states else 2,
        leader=leader.get("".join(states), ""),
        states=_triples("states", "[unit, rate, start]", entry),
        delayed=_triples("delayed", "[formula, unit, delay]", entry),
        remembered=int(entry.get("remembered", 0)),
        where={str(k): str(v) for k, v in (entry.get("where") or {}).items()},
        constants={str(k): in_si(str(v)) for k, v in (entry.get("constants") or {}).items()},
        settings={k: in_si(str(v))[1] for k, v in entry.get("settings", {}).items()},
        force=tuple(entry["force"]) if "force" in entry else None,
        drive=entry.get("drive", False),
        **reduced,
    )


def _triples(key: str, wanted: str, entry: Mapping[str, Any]) -> dict[str, tuple[str, str, str]]:
    """The entries of ``states`` or ``delayed``.

    Raises:
        ConfigError: an entry does not have three elements.
    """
    triples = {}
    for name, given in (entry.get(key) or {}).items():
        if isinstance(given, str) or not isinstance(given, Sequence) or len(given) != 3:
            raise ConfigError(f"model.law.{key}.{name}={given} must be {wanted}")
        first, second, third = map(str, given)
        triples[str(name)] = first, second, third
    return triples


def parameters_of(
    term: Term, owner: str, place: int
) -> tuple[dict[str, Expr], dict[str, Any], dict[str, str]]:
    """A term's scalar parameters: name to symbol, symbol to place (see
    :class:`nnode.model.terms.Dynamics`), and symbol to unit."""
    names = term.scalars
    parameters: dict[str, Expr] = {name: symbol(f"{owner}__{name}") for name in names}
    owned = {f"{owner}__{name}": (f"terms.{place}.{name}", 0, None) for name in names}
    units = {f"{owner}__{name}": term.units.get(name, "*") for name in names}
    return parameters, owned, units
