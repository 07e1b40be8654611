"""The page of the benchmark of the diagnosis."""

from __future__ import annotations

from typing import Any

import pandas as pd

from nnode.app import benchmark_discovery_tables as tables
from nnode.groundtruth import ARMS
from nnode.machine import how_made
from nnode.pages.page import Block, FigureBlock, Heading, Provenance, TableBlock, Text
from nnode.plots.benchmark_discovery import confusion_figure, map_figure

TITLE = "The diagnosis against hidden truths"
SUBTITLE = (
    "Synthetic measured trajectories in which an effect is hidden; the truth is opened after the "
    "diagnosis has ended."
)
_PACKAGES = ("torch", "numba", "numpy", "scipy")


def blocks_of(rows: list[dict[str, Any]], seconds: float, workers: int) -> list[Block]:
    """The page's blocks.

    Args:
        rows: one per case, as :func:`nnode.app.benchmark_discovery_task.diagnose_case` gives it.
        seconds: that this run took.
        workers: processes.
    """
    frame, coefficients = tables.frame_of(rows), tables.coefficients_of(rows)
    blocks: list[Block] = [
        Heading("What was asked for and what was reached"),
        TableBlock(
            "criteria",
            tables.criteria(frame, coefficients),
            "Shares of cases, or medians, at the noise and the number of sequences that most cases "
            "have; of medium strength where not said otherwise. *closure* is the share of what the "
            "truth itself closes of the sealed gap.",
        ),
        Heading("By arm"),
        Text("\n".join(f"- `{name}`: {what}" for name, what in ARMS.items())),
        TableBlock(
            "arms",
            tables.by_arm(frame),
            "Percent of the cases; *right* is what the arm asks for, with its interval of 95 %.",
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
                "Percent of the same cases, and medians. The peers choose columns of the "
                "diagnosis's own library, on its residuals and its split, and what they choose is "
                "calibrated in the same way; effects with a number per agent are not among the "
                "columns, and cases that hide one are left out.",
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
                "Percent of the cases in which exactly the hidden effects were named, or effects "
                "of their classes.",
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
        _made(frame, seconds, workers),
    ]
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
                "*unknown* is the verdict without a name.",
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


def _made(frame: pd.DataFrame, seconds: float, workers: int) -> Provenance:
    return Provenance(
        {
            "Cases": str(len(frame)),
            "Time": f"{seconds:.0f} s in this run with {workers} worker process(es); one diagnosis "
            f"{frame['seconds'].median():.1f} s (median), {frame['seconds'].max():.1f} s (most)",
            **how_made(_PACKAGES),
        }
    )
