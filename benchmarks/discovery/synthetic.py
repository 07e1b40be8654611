"""Synthetic cases with a hidden effect: generate, diagnose, score, and their tables."""

from __future__ import annotations

import time
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest import mock

import pandas as pd

from benchmarks.config import DiscoveryBenchmarkOptions
from benchmarks.discovery import tables
from benchmarks.discovery.figures import uniform_figure
from benchmarks.synthetic_cases import TABLE, WALLS, Case, arms, generate
from benchmarks.synthetic_cases.score import ERROR, score
from nnode.errors import ConfigError, NNodeError
from nnode.pages.page import Block, FigureBlock, Heading, TableBlock, Text

#: Base models by their name in the truth: the term that is calibrated.
TERMS = {"lin": "lin", "log": "log", "sf": "social_force"}


def cases(kind: str, options: DiscoveryBenchmarkOptions, first: int) -> dict[str, Any]:
    """The cases that the options ask for.

    Raises:
        ConfigError: unknown names, or packages of the baselines are missing.
    """
    hidden = [h for domain in options.domains for arm in arms.ARMS for h in arms.hides(domain, arm)]
    for option, known in (
        ("effects", {name for h in hidden for name in h.effects}),
        ("variants", {h.variant for h in hidden}),
    ):
        strange = sorted(set(getattr(options, option) or ()) - known)
        if strange:
            raise ConfigError(
                f"benchmark_discovery.{option}: {strange[0]} is hidden nowhere, expected some of "
                f"{', '.join(sorted(known))}"
            )
    baselines = range(first, first + options.baseline_seeds)
    found = {
        case.key: {
            "case": case.to_dict(),
            "baselines": case.seed in baselines,
            "structure": options.structure,
            "fresh": options.fresh,
        }
        for domain in options.domains
        for arm in options.arms or list(arms.ARMS)
        for case in arms.cases(
            domain,
            arm,
            seeds=range(first, first + getattr(options, _number_of_seeds(arm))),
            strengths=options.strengths,
            noises=[None] if options.noises is None else options.noises,
            sizes=options.sizes,
            effects=options.effects,
            variants=options.variants,
        )
    }
    missing = [name for name in ("pysindy", "sklearn") if find_spec(name) is None]
    if missing and any(arguments["baselines"] for arguments in found.values()):
        raise ConfigError(
            f"benchmark_discovery.baseline_seeds={options.baseline_seeds} needs "
            f"{' and '.join(missing)}: install pysindy and scikit-learn (the extra bench), or give "
            "0 for no baselines"
        )
    return found


def _number_of_seeds(arm: str) -> str:
    """Cases with nothing hidden are many: they show how often something is named by chance."""
    return "nothing_seeds" if arm == "nothing" else "seeds"


def evaluate(
    case: dict[str, Any],
    baselines: bool = False,
    structure: bool = True,
    changed: dict[str, float] | None = None,
    fresh: int = 0,
) -> dict[str, Any]:
    """The score of one diagnosis, and its time. The truth stays outside the diagnosed folder.

    Args:
        case: of :class:`benchmarks.synthetic_cases.Case`, as plain JSON.
        baselines: scores of the baselines as well, by name.
        structure: as in the options of the diagnosis.
        changed: other values of :mod:`nnode.discover.thresholds`, by name.
        fresh: number of further sequences on which the named effects are tested.
    """
    # imported here: all workers read this file, and tests replace the diagnosis
    from benchmarks.discovery.baselines import baselines_on_table
    from benchmarks.discovery.fresh import kept_back, on_fresh
    from nnode.app import discover
    from nnode.discover import thresholds
    from nnode.discover.options import DiscoverOptions
    from nnode.model.effects import CATALOGUE

    what = Case.from_dict(case)
    classes = {effect.name: effect.confusable_group for effect in CATALOGUE.effects.values()}
    with TemporaryDirectory(prefix="nnode-case-") as made, TemporaryDirectory() as given:
        whole = generate(replace(what, n_sequences=what.n_sequences + fresh), Path(made))
        truth = {**whole, "case": case}
        for name in (TABLE, WALLS):
            if (Path(made) / name).exists():
                (Path(made) / name).rename(Path(given) / name)
        model = truth["model"]
        known: dict[str, Any] = {
            "model": {"name": model["name"], "term": TERMS[model["name"]], **model["options"]},
            "walls": Path(given) / WALLS if what.domain == "crowd" else None,
            "leader": model.get("leader", "measured"),
            "seed": what.seed,
        }
        table = Path(given) / TABLE
        back = kept_back(table, fresh)
        options = DiscoverOptions(page=False, replay=False, structure=structure, compare=[])
        start = time.monotonic()
        extra: dict[str, Any] = {"failure": "", "baselines": {}}
        try:
            with mock.patch.dict(vars(thresholds), changed or {}):
                found = discover.diagnose_table(table, what.domain, **known, options=options)
        except NNodeError as error:
            extra["failure"] = f"{type(error).__name__}: {error}"
            report: dict[str, Any] = {"verdict": ERROR, "effects": []}
        else:
            report = found.plain()
        seconds = time.monotonic() - start
        if fresh and not extra["failure"]:
            extra |= on_fresh(back, found, whole, what.domain, known["walls"])
        if baselines and not extra["failure"]:
            extra["baselines"] = {
                name: score(truth, other, classes)
                for name, other in baselines_on_table(table, what.domain, **known).items()
            }
    return {**score(truth, report, classes), **extra, "seconds": seconds}


def blocks(rows: list[dict[str, Any]]) -> list[Block]:
    """Requirements, level, and tables by arm, method, effect and coefficient."""
    frame, coefficients = tables.frame_of(rows), tables.coefficients_of(rows)
    arm = {"right": "right", "false name": "wrong", "hypotheses": "hypothesis"}
    arm |= {name: name for name in ("unknown", "blamed", "failed")}
    exact = {"exact": "exact", "among equals": "among_equals", "right class": "class_right"}
    exact |= {"false name": "wrong", "unknown": "unknown", "nothing named": "nothing"}
    found: list[Block] = [
        Heading("Required and reached"),
        TableBlock(
            "criteria",
            tables.criteria(frame, coefficients),
            "Shares of cases, or medians, at the most frequent noise and number of sequences; of "
            "medium strength unless stated otherwise. *closure* is the part of the cost that the "
            "diagnosis removes, relative to the true model. Where nothing is hidden: the "
            "probability of so many rejections or more if the test keeps its level.",
        ),
        *_level(frame),
        Heading("By arm"),
        Text("\n".join(f"- `{name}`: {what}" for name, what in arms.ARMS.items())),
        TableBlock(
            "arms",
            tables.summary(frame, ["domain", "arm", "variant", "strength"], arm),
            "Percent of the cases; *right* is the right answer of the arm, *blamed*: a sequence "
            "without faults was reported.",
            digits=0,
        ),
    ]
    asked = frame[frame["exact"].notna()]
    medians = {"closure (median)": "closure", "s (median)": "seconds"}
    by_effect = tables.summary(asked, ["domain", "arm", "strength", "hidden"], exact, medians)
    errors = {"absolute (median)": "absolute", "relative (median)": "relative"}
    errors["relative to the effect's size (median)"] = "of_size"
    by_coefficient = tables.summary(
        coefficients, ["domain", "effect", "coefficient"], {"covered (%)": "covered"}, errors
    )
    named = pd.crosstab([frame["domain"], frame["hidden"]], frame["first"])
    sizes = asked.assign(exact=asked["exact"].astype(float)).pivot_table(
        index=["domain", "noise"], columns="n_sequences", values="exact"
    )
    for name, heading, table, caption, full in (
        ("methods", "Baselines", tables.by_method(rows), "Percent of the same cases.", None),
        ("effects", "By effect", by_effect, "Percent of the cases.", None),
        ("sizes", "Noise (m) and number of sequences", sizes, "Share of exact names.", None),
        ("coefficients", "Coefficients", by_coefficient, "Errors and coverage.", coefficients),
        ("confusion", "First names (columns) by hidden effect", named, "Cases.", None),
    ):
        if len(table):
            found += [Heading(heading), TableBlock(name, table, caption, full=full)]
    verdicts = pd.crosstab([frame["domain"], frame["arm"]], frame["verdict"])
    caption = "How often each verdict was given; the file holds one line per case."
    return [*found, Heading("Every case"), TableBlock("verdicts", verdicts, caption, full=frame)]


def _level(frame: pd.DataFrame) -> list[Block]:
    """Rejections and names where nothing is hidden."""
    level = tables.level(frame)
    if level.empty:
        return []
    found: list[Block] = [
        Heading("Level"),
        TableBlock(
            "level",
            level,
            "Cases with nothing hidden in which the first screen rejects at 5 %, and in which "
            "something is named. p: one-sided binomial test against 5 %; below 2.5 % the test does "
            "not keep its level.",
            digits={
                **dict.fromkeys(level.columns, 0),
                **{"noise, m": 2, "first screen, p": 3, "final names, p": 3},
            },
        ),
    ]
    for domain in dict.fromkeys(frame["domain"]):
        values = tables.screens(frame, domain)
        if values:
            found.append(
                FigureBlock(
                    f"level_{domain}",
                    uniform_figure(values),
                    f"First screens in {domain} where nothing is hidden: family-wise p-values in "
                    "their order against those expected of uniform ones, with the exact pointwise "
                    "band of 95 %.",
                    f"Quantiles of the first screen's p-values in {domain} against uniform ones.",
                )
            )
    return found
