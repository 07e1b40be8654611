"""The page of the benchmark of the diagnosis."""

from __future__ import annotations

from typing import Any

import pandas as pd

from benchmarks.discovery import level, tables
from benchmarks.discovery.criteria import criteria
from benchmarks.discovery.figures import confusion_figure, map_figure, uniform_figure
from benchmarks.synthetic_cases import ARMS
from nnode.machine import how_made
from nnode.pages.page import Block, FigureBlock, Heading, Provenance, TableBlock, Text

TITLE = "The diagnosis against hidden truths"
SUBTITLE = (
    "Synthetic measured trajectories in which an effect is hidden; the truth is opened after the "
    "diagnosis has ended."
)
_DIGITS = {"noise, m": 2, "first screen, p": 3, "final names, p": 3}
_PACKAGES = ("torch", "numba", "numpy", "scipy", "scikit-learn", "pysindy")


def blocks_of(rows: list[dict[str, Any]], seconds: float, workers: int, code: str) -> list[Block]:
    """The page's blocks.

    Args:
        rows: one per case, as :func:`benchmarks.discovery.task.diagnose_case` gives it.
        seconds: that this run took.
        workers: processes.
        code: digest of the code that the rows are of.
    """
    frame, coefficients = tables.frame_of(rows), tables.coefficients_of(rows)
    blocks: list[Block] = [
        Heading("What was asked for and what was reached"),
        TableBlock(
            "criteria",
            criteria(frame, coefficients),
            "Shares of cases, or medians, at the noise and the number of sequences that most cases "
            "have; of medium strength where not said otherwise. *closure* is the share of what the "
            "truth itself closes of the sealed gap. Where nothing is hidden: the probability of so "
            "many rejections or more if a gate keeps its level.",
        ),
        *_level(frame),
        Heading("By arm"),
        Text("\n".join(f"- `{name}`: {what}" for name, what in ARMS.items())),
        TableBlock(
            "arms",
            tables.by_arm(frame),
            "Percent of the cases; *right* is what the arm asks for, with its interval of 95 % "
            "(Clopper and Pearson). What is *unconfirmed* is a lead, not a name; *false faults*: a "
            "sound sequence was blamed.",
            digits=0,
        ),
    ]
    methods = tables.by_method(rows)
    if len(methods):
        blocks += [
            Heading("Beside its peers"),
            TableBlock(
                "methods",
                methods,
                "Percent of the same cases, and medians. The peers are those of scikit-learn and "
                "pysindy. They choose columns of the diagnosis's own library, on its residuals and "
                "its split, and what they choose is calibrated in the same way; effects with a "
                "number per agent are not among the columns, and cases that hide one are left out.",
                digits={**dict.fromkeys(methods.columns, 0), "closure (median)": 2},
            ),
        ]
    effects = tables.by_effect(frame)
    if len(effects):
        blocks += [
            Heading("By effect"),
            TableBlock(
                "effects",
                effects,
                "Percent of the cases in which exactly the hidden effects were named; were listed "
                "as indistinguishable, or among their equals; were named by effects of their "
                "classes; or were exactly the leads that sealed clusters did not confirm.",
                digits={
                    **dict.fromkeys(effects.columns, 0),
                    "closure (median)": 2,
                    "s (median)": 1,
                },
            ),
        ]
    blocks += [block for name in dict.fromkeys(frame["domain"]) for block in _figures(frame, name)]
    if len(coefficients):
        blocks += [
            Heading("Coefficients"),
            TableBlock(
                "coefficients",
                tables.by_coefficient(coefficients),
                "Errors in percent of the true value, in percent of its distance from the value "
                "that means no effect, and in the coefficient's unit; percent of the intervals of "
                "95 % that hold the truth.",
                digits={"estimates": 0, "covered": 0, "absolute (median)": 3},
                full=coefficients,
            ),
        ]
    blocks += [
        Heading("Every case"),
        TableBlock(
            "verdicts",
            _verdicts(frame),
            "How often each verdict was given, by arm; the file holds one line per case.",
            full=frame,
        ),
        _made(frame, seconds, workers, code),
    ]
    return blocks


def _level(frame: pd.DataFrame) -> list[Block]:
    """What chance does where nothing is hidden."""
    found = level.level(frame)
    if found.empty:
        return []
    blocks: list[Block] = [
        Heading("Level"),
        TableBlock(
            "level",
            found,
            "Cases with nothing hidden in which the first screen rejects at 5 %, and in which "
            "something is named in the end. p: one-sided binomial test against 5 %; below 2.5 % "
            "the gate does not keep its level. Leads that sealed clusters did not confirm "
            "(*unconfirmed*) are no names. Heterogeneity is neither where agents do differ.",
            digits={**dict.fromkeys(found.columns, 0), **_DIGITS},
        ),
    ]
    for domain in dict.fromkeys(frame["domain"]):
        values = level.screens(frame, domain)
        if values:
            blocks.append(
                FigureBlock(
                    f"level_{domain}",
                    uniform_figure(values),
                    f"First screens in {domain} where nothing is hidden: family-wise p-values in "
                    "their order against those expected of uniform ones, with the exact pointwise "
                    "band of 95 %. On the line or above it a p-value is what it says, or larger.",
                    f"Quantiles of the first screen's p-values in {domain} against uniform ones.",
                )
            )
    return blocks


def _verdicts(frame: pd.DataFrame) -> pd.DataFrame:
    return pd.crosstab([frame["domain"], frame["arm"]], frame["verdict"])


def _figures(frame: pd.DataFrame, domain: str) -> list[Block]:
    """The confusion matrix of a domain and, where several were run, the map."""
    blocks: list[Block] = []
    shares = tables.confusion(frame, domain)
    if len(shares):
        blocks += [
            Heading(f"What was named for what: {domain}"),
            FigureBlock(
                f"confusion_{domain}",
                confusion_figure(shares),
                "Percent of the cases of each row. Effects in brackets are not in the catalogue; "
                "*unknown* and *unconfirmed* are verdicts without a name.",
                f"Matrix of hidden and first named effects in {domain}.",
            ),
        ]
    where = tables.over_noise_and_size(frame, domain)
    if where.size > 1:
        blocks += [
            Heading(f"Noise and sample size: {domain}"),
            FigureBlock(
                f"map_{domain}",
                map_figure(where),
                "Percent of the cases with one hidden effect in which exactly this was named.",
                f"Share of exact names over noise and number of sequences in {domain}.",
            ),
        ]
    return blocks


def _made(frame: pd.DataFrame, seconds: float, workers: int, code: str) -> Provenance:
    commit = frame["seeds_of"].iloc[0]
    seeds = f"{frame['seed'].min()} to {frame['seed'].max()}"
    return Provenance(
        {
            "Cases": str(len(frame)),
            "Seeds": f"{seeds}, development: rules may have changed after a look at these cases"
            if commit is None
            else f"{seeds}, from the hash of the commit that froze the rules, {commit}",
            "Code": f"digest {code}",
            "Time": f"{seconds:.0f} s in this run with {workers} worker process(es); one diagnosis "
            f"{frame['seconds'].median():.1f} s (median), {frame['seconds'].max():.1f} s (most)",
            **how_made(_PACKAGES),
        }
    )
