"""The page's part on optimisers, steps and optimality."""

from __future__ import annotations

import numpy as np
import pandas as pd

from nnode.pages.page import Block, FigureBlock, Heading, TableBlock, Text
from studies.traffic.figures import descents
from studies.traffic.results import AVERAGE, ORDER, Study, cell

#: A cost gradient takes the time of about so many simulations, which the figure counts.
GRADIENT = 3


def optimizer_blocks(study: Study) -> list[Block]:
    """Stochastic descent, consensus and quasi-Newton; residuals; the Euler step."""
    options = study.options
    ours, descent = study.costs(), study.costs("descent")
    consensus = study.costs("consensus")
    table = pd.DataFrame(
        {
            "BFGS, many starts": ours[AVERAGE],
            "ADADELTA": descent[AVERAGE],
            "consensus": consensus[AVERAGE],
            "at the start": [_start(study, model) for model in ORDER],
        }
    )
    table.index.name = "model"
    ahead = [m for m in ORDER if cell(table, m, "consensus") < cell(table, m, "ADADELTA")]
    spent = options.particles * options.consensus_steps
    paid = GRADIENT * 2 * options.descent_steps
    text = (
        "The paper leaves the comparison with consensus-based optimisation to future work. With "
        f"{spent} simulations per recording, against {options.descent_steps} noisy ADADELTA "
        f"updates of two runs (about as long as {paid} simulations), it ends lower for "
        f"{', '.join(ahead) or 'no model'}."
    )
    curves = {
        model: {
            "ADADELTA": _curve(study, "descent", model, GRADIENT * 2),
            "consensus": _curve(study, "consensus", model, 1),
        }
        for model in ORDER
    }
    return [
        Heading("Optimisers"),
        Text(text),
        TableBlock("optimizers", table, "Average cost (m² s) by optimiser."),
        FigureBlock(
            "descents",
            descents(curves),
            "Average cost above the least one known, against the number of simulations; a "
            f"gradient counts as {GRADIENT}.",
            "Five panels, falling curves of two optimisers.",
        ),
        _residuals(study),
        *_steps(study),
    ]


def _start(study: Study, model: str) -> float:
    return float(
        np.mean([study.one("descent", n, model)["history"][0][1] for n in study.recordings()])
    )


def _curve(study: Study, kind: str, model: str, factor: int) -> np.ndarray:
    """Simulations, and the average cost above the least known, of the best run by recording."""
    names = study.recordings()
    histories = [np.array(study.one(kind, n, model)["history"]) for n in names]
    known = [
        min(study.one(k, n, model)["cost"] for k in ("fit", "descent", "consensus")) for n in names
    ]
    average = np.mean([h[:, 1] - k for h, k in zip(histories, known, strict=True)], axis=0)
    return np.stack([np.maximum(histories[0][:, 0] * factor, 1), average.clip(min=1e-6)], 1)


def _residuals(study: Study) -> TableBlock:
    names = study.recordings()
    table = pd.DataFrame(
        {
            label: [
                float(np.median([study.one(kind, n, m)["residual"] for n in names])) for m in ORDER
            ]
            for label, kind in (
                ("BFGS, many starts", "fit"),
                ("ADADELTA", "descent"),
                ("consensus", "consensus"),
            )
        },
        index=pd.Index(ORDER, name="model"),
    )
    return TableBlock(
        "residuals",
        table,
        "First-order optimality residual at the solutions, median over recordings: the relative "
        "fall of J that the projected gradient promises per relative change of one parameter; 0 "
        "at an exact solution. Costs of networks with free weights have steep, narrow valleys, "
        "in which a cost close to the least goes with a large gradient.",
        digits=6,
    )


def _steps(study: Study) -> list[Block]:
    names = study.recordings()
    steps = [float(step) for step in study.one("fit", names[0], "lin")["steps"]]
    rows = {}
    for model in ORDER:
        found = [study.one("fit", n, model) for n in names]
        own = {
            h: float(np.median([one["steps"][f"{h:g}"] / one["cost"] for one in found])) - 1
            for h in steps
        }
        rows[model] = {f"{h:g} s": 100 * own[h] for h in sorted(steps, reverse=True)}
    table = pd.DataFrame(rows).T.rename_axis("model")
    return [
        Heading("The step of Euler's method"),
        TableBlock(
            "steps",
            table,
            "How much the cost changes (%, median over recordings) when the solution found with "
            f"{study.options.dt:g} s is simulated with another step. Data are sampled every 0.2 s.",
            digits=2,
        ),
    ]
