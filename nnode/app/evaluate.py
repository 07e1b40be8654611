"""Errors of a checkpoint and of baselines: ``nnode evaluate``."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
from omegaconf import DictConfig

from nnode.app.cli.saved import load_run
from nnode.app.saved_run import SavedRun
from nnode.calibrate.evaluate import Metrics, Simulate, baselines, evaluate
from nnode.errors import printable
from nnode.files import write_json
from nnode.progress import Stages


def evaluate_checkpoint(config: DictConfig, folder: Path) -> None:
    """Write ``metrics.json`` and ``replay.html``, and print errors of the model and baselines.

    For lanes, the errors of every follower are printed and written as well.

    Raises:
        NNodeError: the checkpoint or the data do not exist, or the data have another domain.
    """
    checkpoint = load_run(config.checkpoint)
    run = SavedRun.of_command(checkpoint, config, folder)
    if run.trained is None:
        print(
            "These files are divided into other sequences than in the training, so the evaluated "
            "sequences may contain training data."
        )
    elif run.trained and run.part != "train":
        print(f"{run.trained} of the {len(run.indices)} sequences were trained on")
    others = baselines(run.model, run.solver, checkpoint.free_speed)

    def measured(title: str, simulate: Simulate) -> Metrics:
        stages.begin(title)
        return evaluate(simulate, run.batches(), run.convention)

    shares = {run.name: 1.0, **{f"baseline {key}": 0.5 for key in others}}
    with Stages("evaluating", shares) as stages:
        metrics = measured(run.name, run.simulate)
        errors = {key: measured(f"baseline {key}", other) for key, other in others.items()}
    write_json(
        folder / "metrics.json",
        {
            **metrics.plain(),
            "model": run.name,
            "data": run.data,
            "part": run.part,
            "trained_on": run.trained,
            "unit": run.convention.unit,
            # the usual name in car following
            **({"spacing_rmse": metrics.objectives["spacing"]} if metrics.objectives else {}),
            "parameters": {k: float(v) for k, (v, _) in run.model.physical().items()},
            "free_speed": checkpoint.free_speed,
            "baselines": {key: error.plain() for key, error in errors.items()},
        },
    )
    _print(
        {run.name: metrics, **errors},
        f"{run.data}, {run.part}: {metrics.sequences} sequences",
        run.convention.unit,
    )
    if run.model.domain == "traffic":
        from nnode.app.followers import follower_errors, write_followers  # loads Matplotlib

        rows = follower_errors(run.simulate, run.batches(), run.source.index)
        if len(rows):
            write_followers(rows, folder)
    print(f"metrics: {folder / 'metrics.json'}")
    if config.replay:
        from nnode.app.replay import write_replay  # loads Matplotlib, which takes a second

        with Stages("drawing", {"drawing": 1.0}) as stages:
            stages.begin("drawing")
            path = write_replay(folder / "replay.html", run)
        print(f"replay: {path}")


def _print(rows: dict[str, Metrics], title: str, unit: str) -> None:
    last = next(iter(rows.values())).horizons
    shown = sorted({len(last) // 4, len(last) // 2, len(last) - 1} & set(range(len(last))))
    table = pd.DataFrame.from_dict(
        {
            printable(name): {
                f"J ({unit})": m.J,
                "RMSE (m)": m.rmse,
                "final displacement (m)": m.final_displacement,
                "collisions (%)": 100 * m.collisions,
                **{f"RMSE at {last[i]['t']:g} s": m.horizons[i]["rmse"] for i in shown},
            }
            for name, m in rows.items()
        },
        orient="index",
    )
    print(title, table.to_string(float_format="{:.4g}".format), sep="\n")
