"""Equilibria of the calibrated laws, and whether their platoons are stable."""

from __future__ import annotations

import numpy as np
import pandas as pd

from nnode.model.system import System
from nnode.pages.page import Block, FigureBlock, Heading, TableBlock, Text
from studies.following import figures as plots
from studies.following import stability
from studies.following.candidates import REFERENCE
from studies.following.data import gap_of
from studies.following.results import Study

#: Speeds at which platoons are looked at, m/s.
SPEEDS = (3.0, 6.0, 9.0, 12.0)
#: The speed, m/s, and the period, s, of the swing in the figure.
SHOWN, PERIOD = 6.0, 60.0
#: Nearly even driving: differences of speed, m/s, and accelerations, m/s², below these.
EVEN = (0.5, 0.2)
#: Laws in the figures, where they are there, beside the chosen one.
FIGURED = ("idm", "ovm", "fvdm", "gipps", "helly")


def stability_blocks(study: Study) -> list[Block]:
    """Equilibrium, string stability, amplification."""
    length = float(np.mean([pair.length[1] for pair in study.pairs() if pair.length is not None]))
    systems = {
        name: study.system(name) for name in study.names if not name.startswith(stability.MAPS)
    }
    shown = [n for n in dict.fromkeys((*FIGURED, study.best)) if n in systems]
    return [
        Heading("Equilibria"),
        *_equilibria(study, {n: systems[n] for n in shown}, length),
        Heading("String stability"),
        *_stability(systems, shown, length),
    ]


def _measured(study: Study) -> tuple[np.ndarray, np.ndarray]:
    """Speeds and gaps of training pairs at nearly even driving."""
    speeds, gaps = [], []
    for pair in study.pairs():
        v = pair.velocity()[..., 0]
        rate = np.gradient(v[:, 0], pair.dt)
        even = (np.abs(v[:, 0] - v[:, 1]) < EVEN[0]) & (np.abs(rate) < EVEN[1])
        speeds.append(v[even, 0])
        gaps.append(gap_of(pair)[even])
    return np.concatenate(speeds), np.concatenate(gaps)


def _equilibria(study: Study, systems: dict[str, System], length: float) -> list[Block]:
    v, s = _measured(study)
    speeds = np.linspace(0.25, float(np.quantile(v, 0.995)), 60)
    gaps = {n: stability.equilibrium(one, speeds, length) for n, one in systems.items()}
    table = pd.DataFrame({n: np.interp(SPEEDS, speeds, g) for n, g in gaps.items()}, index=SPEEDS)
    table.index.name = "speed (m/s)"
    table["measured, median"] = [
        float(np.median(s[np.abs(v - x) < 0.5])) if (np.abs(v - x) < 0.5).any() else np.nan
        for x in SPEEDS
    ]
    table["quarter below"] = [
        float(np.quantile(s[np.abs(v - x) < 0.5], 0.25)) if (np.abs(v - x) < 0.5).any() else np.nan
        for x in SPEEDS
    ]
    table["quarter above"] = [
        float(np.quantile(s[np.abs(v - x) < 0.5], 0.75)) if (np.abs(v - x) < 0.5).any() else np.nan
        for x in SPEEDS
    ]
    return [
        FigureBlock(
            "equilibria",
            plots.equilibria(speeds, gaps, (v, s), length),
            f"Points: samples of training pairs with less than {EVEN[0]:g} m/s between the speeds "
            f"and less than {EVEN[1]:g} m/s² of acceleration. Lines: equilibria of the laws as "
            f"calibrated; on the right with vehicles of {length:.1f} m, the pairs' mean.",
            "Equilibrium gap by speed and flow by density of the laws over the data.",
        ),
        TableBlock("equilibrium_gaps", table, "Equilibrium gaps (m) by speed."),
    ]


def _stability(systems: dict[str, System], shown: list[str], length: float) -> list[Block]:
    rows = {}
    gains, along = {}, {}
    for name, system in systems.items():
        gaps = stability.equilibrium(system, np.array(SPEEDS), length)
        row: dict[str, object] = {}
        for v, gap in zip(SPEEDS, gaps, strict=True):
            if not np.isfinite(gap):
                continue
            slope = stability.slopes(system, float(gap), v, length)
            late = stability.lateness(system)
            gain = stability.passed(slope, stability.FREQUENCIES, **late)
            row[f"margin at {v:g} m/s"] = slope.margin
            row[f"most at {v:g} m/s"] = float(gain.max())
            if v == SHOWN and name in shown:
                gains[name] = gain
                w = 2 * np.pi / PERIOD
                swing = stability.platoon(system, v, float(gap), length, w)
                theory = float(stability.passed(slope, np.array([w]), **late)[0])
                along[name] = (swing / swing[0], theory ** np.arange(len(swing)))
        rows[name] = row
    columns = [f"{what} at {v:g} m/s" for v in SPEEDS for what in ("margin", "most")]
    table = pd.DataFrame(rows).T.reindex(columns=columns)
    table.index.name = "candidate"
    unstable = [
        n
        for n in table.index
        if float(np.nanmax(table.loc[n, [c for c in columns if "most" in c]].astype(float))) > 1.001
    ]
    text = (
        "With the slopes of the acceleration f(s, v, Δv) at equilibrium, Δv = v − v of the leader, "
        "a platoon is string stable where f_v²/2 + f_v f_Δv − f_s ≥ 0 (Treiber & Kesting 2013, "
        "chapter 15; Wilson & Ward 2011, there with the slope by the gap's rate, −f_Δv). It "
        "follows from the swing that one follower passes on, |G(iω)|² = (f_s² + f_Δv² ω²) / "
        "((f_s − ω²)² + (f_v + f_Δv)² ω²), being at most 1 at every frequency. An actuator lag "
        "or a delay multiplies the acceleration by a filter; *most* is the largest |G| with it. "
        "A memory of time gaps does not act near equilibrium. Growing swings: "
        f"{', '.join(unstable) or 'none'}. "
        f"{REFERENCE} and its like are calibrated on single pairs, in stop-and-go traffic: a law "
        "that fits these can still be wrong about how swings grow."
    )
    return [
        Text(text),
        TableBlock(
            "stability",
            table,
            "Margin f_v²/2 + f_v f_Δv − f_s (1/s²; without lag and delay, negative: swings grow) "
            "and the largest factor by which one follower passes a swing on.",
            digits=3,
        ),
        FigureBlock(
            "amplification",
            plots.amplification(gains, stability.FREQUENCIES, along),
            f"At {SHOWN:g} m/s: what one follower passes on by the period of the swing, and the "
            f"swing along a platoon behind a leader that swings by 0.05 m/s every {PERIOD:g} s, "
            "simulated and by linear theory.",
            "Gain by period, and amplitude by place in a platoon.",
        ),
    ]
