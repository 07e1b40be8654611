"""The page of the study of car following. Every claim in its text is computed from the results."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pandas as pd

from nnode.calibrate.resampling import Paired
from nnode.data.sequence import Sequence
from nnode.pages.page import Block, FigureBlock, Heading, Provenance, TableBlock, Text
from studies.following import figures as plots
from studies.following import printed
from studies.following.candidates import DECAY, EVERY, REFERENCE
from studies.following.data import gap_of
from studies.following.page_platoons import leader_blocks, platoon_blocks
from studies.following.page_precision import precision_blocks
from studies.following.page_stability import stability_blocks
from studies.following.results import Study, interval
from studies.replay import player, scenes, spread

#: Pairs in the player.
FEW = 10


def blocks(study: Study) -> list[Block]:
    """The page in its order."""
    return [
        *_summary(study),
        *_published(study),
        *_cross_validated(study),
        *_test(study),
        *precision_blocks(study),
        *stability_blocks(study),
        *platoon_blocks(study),
        *leader_blocks(study),
        *_replay(study),
        _parameters(study),
        Provenance(
            {
                f"SHA-256 of {file['name']}": file["sha256"]
                for store in study.stores.values()
                for file in store.manifest["files"].values()
            }
        ),
    ]


def said(difference: Paired, unit: str = "m") -> str:
    """A paired difference in words."""
    return (
        f"{difference.difference:+.2f} {unit} ({difference.low:+.2f} to {difference.high:+.2f})"
    ).replace("-", "−")


def _summary(study: Study) -> list[Block]:
    best, idm = study.best, float(study.heldout(REFERENCE).mean())
    by_pair = study.against_reference(best, by_pair=True)
    test, reference = study.tested(best), study.tested(REFERENCE)
    least = min(min(row) for row in printed.ERRORS.values())
    low, high = interval(test, np.arange(len(test)), study.options.seed)
    text = (
        f"Of {len(study.names)} candidates, *{best}* has the least cross-validated error on the "
        f"{len(study.clusters)} training pairs: {study.heldout(best).mean():.2f} m, {idm:.2f} m "
        f"for {REFERENCE}; the paired difference is {said(by_pair)} with pairs resampled, "
        f"{said(study.against_reference(best))} with clusters. On the {len(test)} test pairs, "
        f"looked at once, it reaches {test.mean():.2f} m ({low:.2f} to {high:.2f}), {REFERENCE} "
        f"{reference.mean():.2f} m; the least that the replication package prints is "
        f"{least:.2f} m."
    )
    return [Heading("In short"), Text(text)]


def _published(study: Study) -> list[Block]:
    found = study.found["reproduced-pairs"]
    rows = {}
    for law, theirs in printed.ERRORS.items():
        for objective, value in zip(printed.OBJECTIVES, theirs, strict=True):
            ours = float(np.mean(found[f"{law} {objective}"]))
            rows[(law, objective)] = {"printed": value, "here": ours, "difference": ours - value}
    table = pd.DataFrame(rows).T
    table.index.names = ["law", "minimised"]
    worst = float(table["difference"].abs().max())
    return [
        Heading("Published numbers, reproduced"),
        TableBlock(
            "published",
            table,
            "Mean over the 20 test pairs of the root mean square error of the gap (m), all samples "
            "counted: the replication package's figures, and what the published parameters give "
            "here, with ballistic steps of 0.1 s and the acceleration clipped as there. The "
            f"largest difference is {worst:.1g} m.",
            digits=4,
        ),
    ]


def _cross_validated(study: Study) -> list[Block]:
    floor = study.found["floor"]
    rows = {}
    for name in sorted(study.names, key=lambda n: float(study.heldout(n).mean())):
        one, values = study.one("cv", name), study.heldout(name)
        away = study.against_reference(name)
        low, high = interval(values, study.clusters, study.options.seed)
        rows[name] = {
            "numbers": len(one["row"]),
            "train": float(np.mean(one["train"]["spacing"])),
            "held out": float(values.mean()),
            "low": low,
            "high": high,
            f"minus {REFERENCE}": away.difference,
            "from": away.low,
            "to": away.high,
            "better": away.better,
            "at a limit": ", ".join(one["limits"]),
        }
    table = pd.DataFrame(rows).T
    table.index.name = "candidate"
    bold = pd.DataFrame(False, index=table.index, columns=table.columns)
    bold.loc[study.best, "held out"] = True
    parts = len(study.clusters)
    text = (
        f"The {parts} training pairs are {study.clusters.max() + 1} clusters of pairs that share a "
        f"vehicle; {study.options.folds} folds keep clusters together. Candidates, limits (wide: "
        "those of the shelf), starts and the penalty on networks' weights "
        f"({DECAY:g} m times their squares) were fixed before any test pair was looked at, but for "
        "an earlier trial that had seen what idm, helly and idm with memory reach on them. "
        "Looking two vehicles ahead is no candidate: a pair has no second one. "
        "The floor, every pair with numbers of its own, is "
        f"{np.mean(floor['costs']):.2f} m for {REFERENCE} on the pairs that it is calibrated on."
    )
    left = [name for name in EVERY if name not in study.names]
    if left:
        text += f" Listed, and not calibrated for this page: {', '.join(left)}."
    order = list(table.index)
    differences = {
        "held out, clusters resampled": _rows(study.against_reference(n) for n in order),
        "test, pairs resampled": _rows(study.test_against(n) for n in order),
    }
    objectives = pd.DataFrame(
        {
            n: {o: float(study.heldout(n, o).mean()) for o in study.one("cv", n)["heldout"]}
            for n in order
        }
    ).T
    objectives.index.name = "candidate"
    objectives.columns = pd.Index(_WITH_UNITS[o] for o in objectives.columns)
    return [
        Heading("Which law: cross-validated"),
        Text(text),
        TableBlock(
            "candidates",
            table,
            "Mean root mean square error of the gap (m) on training pairs: calibrated on all, and "
            "held out; 95 % intervals, clusters resampled. *Better*: share of the pairs on which "
            f"the candidate has the lower error than {REFERENCE}. *At a limit*: parameters that "
            "ended at the edge of what is allowed: such numbers are not measured. ∞: it blew up on "
            "a pair.",
            bold=bold,
        ),
        FigureBlock(
            "candidates",
            plots.errors(order, differences, "m", REFERENCE),
            f"Errors of the gap minus those of {REFERENCE} on the same pairs, with 95 % intervals; "
            "what lies beyond the frame stands in the tables.",
            "Differences of all candidates to the reference, held out and on test pairs.",
        ),
        TableBlock(
            "objectives_heldout",
            objectives,
            "All objectives on held-out training pairs; the mean root mean square error of the gap "
            "was minimised.",
            digits=3,
        ),
    ]


_WITH_UNITS = {
    "spacing": "gap, RMSE (m)",
    "gap": "gap, MSE (m²)",
    "relative_gap": "relative gap, MSE",
    "log_gap": "log of the gap, MSE",
    "speed": "speed, MSE (m²/s²)",
}


def _rows(found: Iterable[Paired]) -> np.ndarray:
    return np.array([[one.difference, one.low, one.high] for one in found])


def _test(study: Study) -> list[Block]:
    rows = {}
    for name in sorted(study.names, key=lambda n: float(study.heldout(n).mean())):
        values = study.tested(name)
        away = study.test_against(name)
        low, high = interval(values, np.arange(len(values)), study.options.seed)
        rows[name] = {
            "held out": float(study.heldout(name).mean()),
            "test": float(values.mean()),
            "low": low,
            "high": high,
            f"minus {REFERENCE}": away.difference,
            "from": away.low,
            "to": away.high,
            "p": away.p,
        }
    for law, theirs in printed.ERRORS.items():
        for objective, value in zip(printed.OBJECTIVES, theirs, strict=True):
            rows[f"{law}, printed ({objective})"] = {"test": value}
    table = pd.DataFrame(rows).T
    table.index.name = "candidate"
    figures = {
        side: tuple(
            np.array([one[i] for one in map(_even, study.pairs(side == "test"))]) for i in (0, 1)
        )
        for side in ("train", "test")
    }
    gap = {side: float(values[1].mean()) for side, values in figures.items()}
    speed = {side: float(values[0].mean()) for side, values in figures.items()}
    spread = float(np.std(study.tested(REFERENCE), ddof=1))
    number = len(study.tested(REFERENCE))
    away = study.tested(study.best) - study.tested(REFERENCE)
    seen = 2.8 * float(np.std(away, ddof=1)) / np.sqrt(number)
    shared = study.shared
    growth = np.corrcoef(figures["train"][1], study.one("cv", REFERENCE)["train"]["spacing"])[0, 1]
    lower = sum(bool(study.tested(n).mean() < study.heldout(n).mean()) for n in study.names)
    text = (
        f"Test pairs are denser: their mean gap is {gap['test']:.1f} m at {speed['test']:.1f} m/s, "
        f"that of the training pairs {gap['train']:.1f} m at {speed['train']:.1f} m/s. Errors grow "
        f"with gaps (correlation {growth:.2f} over the training pairs, {REFERENCE}); test errors "
        f"lie below held-out ones for {lower} of {len(study.names)} candidates, and nothing can be "
        "concluded from that. "
        f"Single pairs spread by {spread:.2f} m around the mean error of {REFERENCE}: {number} "
        f"pairs tell one law's mean to ± {1.96 * spread / np.sqrt(number):.2f} m. Paired, they see "
        f"a difference of {seen:.2f} m four times out of five (as that between *{study.best}* and "
        f"{REFERENCE} spreads); smaller ones between candidates are not for {number} pairs to "
        f"settle. {shared} of the test pairs share{'s' if shared == 1 else ''} a vehicle with a "
        "training pair."
    )
    return [
        Heading("The test pairs, once"),
        Text(text),
        TableBlock(
            "test",
            table,
            "Mean root mean square error of the gap (m), held out on training pairs and on the "
            "test pairs, with 95 % intervals, pairs resampled, and two-sided p from random signs; "
            "not corrected for the number of candidates.",
            digits={"p": 3},
        ),
        FigureBlock(
            "sides",
            plots.sides(figures),  # type: ignore[arg-type]
            "Mean speed and gap of every pair on both sides of the published division.",
            "Scatter of mean gaps and speeds of training and test pairs.",
        ),
    ]


def _even(pair: Sequence) -> tuple[float, float]:
    """Mean speed of the follower, m/s, and mean gap, m."""
    return float(np.mean(pair.velocity()[:, 0])), float(gap_of(pair).mean())


def _replay(study: Study) -> list[Block]:
    pairs = study.pairs(test=True)
    systems = {name: study.system(name) for name in dict.fromkeys((REFERENCE, study.best))}
    what = (
        f"Some of the test pairs, the leader as measured, beside {' and '.join(systems)} as "
        "calibrated to all training pairs."
    )
    found = scenes(spread(pairs, FEW), systems)
    return [Heading("Replay"), player("replay", found, what, len(pairs))]


def _parameters(study: Study) -> Block:
    rows = [
        {"candidate": name, "parameter": parameter, "value": value}
        for name in study.names
        for parameter, value in study.one("cv", name)["parameters"].items()
    ]
    shown = [row for row in rows if row["candidate"] in (REFERENCE, study.best)]
    known = {name for name in study.names if not (EVERY[name].network or name[0] == "a")}
    return TableBlock(
        "parameters",
        pd.DataFrame([row for row in shown if row["candidate"] in known] or rows[:8]),
        "Calibrated on all training pairs (SI units); the CSV holds those of every candidate.",
        digits=3,
        full=pd.DataFrame(rows),
    )
