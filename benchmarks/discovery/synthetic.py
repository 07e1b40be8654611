"""Synthetic cases with a hidden effect, also with other thresholds: generate, diagnose, score."""

from __future__ import annotations

import time
from collections.abc import Iterator
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest import mock

from benchmarks.config import DiscoveryBenchmarkOptions
from benchmarks.discovery.baselines import baselines_on_table
from benchmarks.synthetic_cases import ARMS, TABLE, WALLS, Case, generate
from benchmarks.synthetic_cases.case import cases as hidden_cases
from benchmarks.synthetic_cases.case import hidden
from benchmarks.synthetic_cases.score import ERROR, coefficient_rows, score
from nnode.app import discover
from nnode.diagnosis import thresholds
from nnode.diagnosis.options import DiscoverOptions
from nnode.errors import ConfigError, NNodeError
from nnode.model.effects import CATALOGUE

#: Base models by their name in the truth: the term that is calibrated.
TERMS = {"lin": "lin", "log": "log", "sf": "social_force"}
#: No change of the thresholds, see :func:`changes`.
UNCHANGED = "as they are"


def cases(kind: str, options: DiscoveryBenchmarkOptions, first: int) -> dict[str, Any]:
    """The cases that the options ask for; of ``rules`` all with every change of a threshold.

    Raises:
        ConfigError: unknown names, or packages of the baselines are missing.
    """
    pairs = list(product(options.domains, options.arms or ARMS))
    every = [entry for domain in options.domains for arm in ARMS for entry in hidden(domain, arm)]
    for option, expected in (
        ("effects", {name for names, _ in every for name in names}),
        ("variants", {variant for _, variant in every}),
    ):
        strange = sorted(set(getattr(options, option) or ()) - expected)
        if strange:
            raise ConfigError(
                f"benchmark_discovery.{option}: {strange[0]} is hidden nowhere, expected some of "
                f"{', '.join(sorted(expected))}"
            )
    grid = {
        f"{case.key}-{change.replace(' ', '-')}" if kind == "rules" else case.key: {
            "case": case.to_dict(),
            "baselines": case.seed < first + options.baseline_seeds,
            "change": change,
            "values": values,
        }
        for domain, arm in pairs
        for case in hidden_cases(
            domain,
            arm,
            # cases with nothing hidden are many: they show how often chance names something
            seeds=range(
                first, first + (options.nothing_seeds if arm == "nothing" else options.seeds)
            ),
            strengths=options.strengths,
            noises=[None] if options.noises is None else options.noises,
            sizes=options.sizes,
            effects=options.effects,
            variants=options.variants,
        )
        for change, values in (changes() if kind == "rules" else [(UNCHANGED, {})])
    }
    missing = [name for name in ("pysindy", "sklearn") if find_spec(name) is None]
    if missing and any(arguments["baselines"] for arguments in grid.values()):
        raise ConfigError(
            f"benchmark_discovery.baseline_seeds={options.baseline_seeds} needs "
            f"{' and '.join(missing)}: install pysindy and scikit-learn (the extra bench), or give "
            "0 for no baselines"
        )
    return grid


def changes() -> Iterator[tuple[str, dict[str, float]]]:
    """Each threshold of the diagnosis halved and doubled; of one near 1 its distance to 1."""
    yield UNCHANGED, {}
    for name, default in vars(thresholds).items():
        if not name.isupper():
            continue
        for word, factor in (("halved", 0.5), ("doubled", 2.0)):
            near_one = 0.5 < default < 1
            value = 1 - factor * (1 - default) if near_one else factor * default
            # a share of 1 is no share: the distance to 1 is halved instead
            value = value if name == "PRIOR" or value < 1 else (1 + default) / 2
            yield f"{name} {word}", {name: value}


def evaluate(
    case: dict[str, Any],
    baselines: bool = False,
    change: str = UNCHANGED,
    values: dict[str, float] | None = None,
) -> dict[str, list[dict[str, Any]]]:
    """The score of one diagnosis, and its time. The truth stays outside the diagnosed folder.

    Args:
        case: of :class:`benchmarks.synthetic_cases.Case`, as plain JSON.
        baselines: scores of the baselines as well.
        change: name of a change of thresholds. values: their values, by name.
    """
    subject = Case(**case)
    classes = {effect.name: effect.confusable_group for effect in CATALOGUE.effects.values()}
    reports: dict[str, dict[str, Any]] = {}
    with TemporaryDirectory(prefix="nnode-case-") as made, TemporaryDirectory() as given:
        truth = generate(subject, Path(made))
        for path in Path(made).glob("*.csv"):
            path.rename(Path(given) / path.name)
        model = truth["model"]
        options: dict[str, Any] = {
            "model": {"name": model["name"], "term": TERMS[model["name"]], **model["options"]},
            "walls": Path(given) / WALLS if subject.domain == "crowd" else None,
            "seed": subject.seed,
        }
        table, start, failure = Path(given) / TABLE, time.monotonic(), ""
        try:
            with mock.patch.dict(vars(thresholds), values or {}):
                reports["diagnosis"] = discover.diagnose_table(
                    table,
                    subject.domain,
                    **options,
                    options=DiscoverOptions(page=False, replay=False, compare=[]),
                ).plain()
        except NNodeError as error:
            failure = f"{type(error).__name__}: {error}"
            reports["diagnosis"] = {"verdict": ERROR}
        seconds = time.monotonic() - start
        if baselines and not failure:
            reports |= baselines_on_table(table, subject.domain, **options)
    rows = [
        {"method": method, "thresholds": change, **score(truth, report, classes)}
        for method, report in reports.items()
    ]
    rows[0] |= {"seconds": seconds, "failed": bool(failure), "failure": failure}
    coefficients = coefficient_rows(truth["effects"], reports["diagnosis"].get("effects", []))
    return {
        "synthetic": rows,
        "coefficients": [{"domain": subject.domain, **row} for row in coefficients],
    }
