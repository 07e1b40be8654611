"""Errors of a checkpoint and of baselines: ``nnode evaluate``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from nnode.app.cli.prepared import with_prepared
from nnode.app.cli.saved import merge_saved, options_of
from nnode.app.training import (
    build_solver,
    set_threads,
    source_hashes,
    started,
    straight_loader,
    stream,
)
from nnode.calibrate.checkpoint import Checkpoint, load_checkpoint
from nnode.calibrate.cost import Convention
from nnode.calibrate.distributed import World
from nnode.calibrate.evaluate import Metrics, Simulate, baselines, evaluate
from nnode.calibrate.options import Device, SolverOptions
from nnode.data.dataset import Source
from nnode.data.options import DataOptions
from nnode.data.prepare import NOT_PREPARATION, open_data
from nnode.errors import ConfigError, unknown_value
from nnode.files import write_json
from nnode.progress import Stages

PARTS = ("auto", "heldout", "train", "unseen", "all")


def choose(store: Source, checkpoint: Checkpoint, part: str) -> tuple[str, list[int], int | None]:
    """Select the sequences of a store for an evaluation.

    ``heldout`` and ``train`` are the checkpoint's parts. ``unseen`` are sequences that it neither
    trained on nor dropped. ``auto`` takes the held-out sequences if there are any, or else the
    unseen ones, or else all.

    Returns:
        The part, its positions in the store, and the number of trained sequences among them, which
        is None if the same files were cut into sequences in another way.

    Raises:
        ConfigError: an unknown part, or a part without sequences.
    """
    if part not in PARTS:
        raise unknown_value("part", part, PARTS)
    before = set(source_hashes(checkpoint.manifest).values())
    shared = bool(before & set(source_hashes(store.manifest).values()))
    comparable = not shared or _cut_alike(store.manifest, checkpoint.manifest)
    parts = {
        name: set(checkpoint.split.get(name, [])) if shared and comparable else set()
        for name in ("heldout", "train", "dropped")
    }
    names = [entry["name"] for entry in store.index]
    indices = {
        "heldout": [i for i, name in enumerate(names) if name in parts["heldout"]],
        "train": [i for i, name in enumerate(names) if name in parts["train"]],
        "unseen": [
            i
            for i, n in enumerate(names)
            if comparable and n not in parts["train"] | parts["dropped"]
        ],
        "all": list(range(len(store))),
    }
    if part == "auto":
        part = next(name for name in ("heldout", "unseen", "all") if indices[name])
    if not indices[part]:
        raise ConfigError(
            f"part={part}: these data have no such sequences of the checkpoint; use part=all"
        )
    trained = len(set(indices[part]) & set(indices["train"])) if comparable else None
    return part, indices[part], trained


def _cut_alike(*manifests: dict[str, Any]) -> bool:
    """Whether files were cut into sequences in the same way.

    Options that an earlier version did not have are not compared.
    """
    first, second = ({**m.get("options", {}), "reader": m.get("reader")} for m in manifests)
    ignored = ("recording", "faults", "agents", "path", "name", *NOT_PREPARATION)
    return all(first[key] == second[key] for key in first.keys() & second.keys() - {*ignored})


def evaluate_checkpoint(config: DictConfig, folder: Path) -> None:
    """Write ``metrics.json`` and ``replay.html``, and print errors of the model and baselines.

    For lanes, the errors of every follower are printed and written as well.

    Raises:
        NNodeError: the checkpoint or the data do not exist, or the data have another domain.
    """
    checkpoint = load_checkpoint(config.checkpoint)
    config = with_prepared(merge_saved(config, checkpoint.config, ("data", "solver")))
    data: DataOptions = options_of(config.data)
    solver_options: SolverOptions = options_of(config.solver)
    set_threads(checkpoint.config["trainer"]["threads"], data.domain)
    store = open_data(data, folder / "data")
    part, indices, trained = choose(store, checkpoint, config.part)
    if trained is None:
        print("these files were cut into sequences in another way than in training: some of what")
        print("is evaluated may have been trained on")
    elif trained and part != "train":
        print(f"{trained} of the {len(indices)} sequences were trained on")
    device = World().use(Device(config.device), "device")
    source = started(checkpoint, store)
    model, solver = checkpoint.build().to(device), build_solver(solver_options, device)
    dtype = getattr(torch, checkpoint.config["trainer"]["dtype"])
    convention = Convention(checkpoint.config["trainer"]["cost"])

    def measure(simulate: Simulate) -> Metrics:
        size = data.loader.batch_size
        batches = stream(straight_loader(source, indices, size), dtype, device)
        return evaluate(simulate, batches, convention)

    name = checkpoint.config["model"]["name"]
    baselines_of = baselines(model, solver, checkpoint.free_speed)
    shares = {name: 1.0, **{f"baseline {key}": 0.5 for key in baselines_of}}
    with Stages("evaluating", shares) as stages:
        stages.begin(name)
        metrics = measure(lambda batch: solver(model, batch))
        baseline_metrics = {}
        for key, simulate in baselines_of.items():
            stages.begin(f"baseline {key}")
            baseline_metrics[key] = measure(simulate)
    write_json(
        folder / "metrics.json",
        {
            **metrics.plain(),
            "model": name,
            "data": data.name,
            "part": part,
            "trained_on": trained,
            "unit": convention.unit,
            # the usual name in car following
            **({"spacing_rmse": metrics.objectives["spacing"]} if metrics.objectives else {}),
            "parameters": {k: float(v) for k, (v, _) in model.physical().items()},
            "free_speed": checkpoint.free_speed,
            "baselines": {key: metrics.plain() for key, metrics in baseline_metrics.items()},
        },
    )
    _print(
        {name: metrics, **baseline_metrics},
        f"{data.name}, {part}: {metrics.sequences} sequences",
        convention,
    )
    if data.domain == "traffic":
        from nnode.app.followers import follower_errors, write_followers  # loads Matplotlib

        batches = stream(straight_loader(source, indices, data.loader.batch_size), dtype, device)
        rows = follower_errors(lambda batch: solver(model, batch), batches, store.index)
        if len(rows):
            write_followers(rows, folder)
    print(f"metrics: {folder / 'metrics.json'}")
    if config.replay:
        from nnode.app.replay import write_replay  # loads Matplotlib, which takes a second

        with Stages("drawing", {"drawing": 1.0}) as stages:
            stages.begin("drawing")
            path = write_replay(
                folder / "replay.html",
                store,
                indices,
                lambda batch: solver(model, batch),
                model,
                name,
                dtype=dtype,
                device=device,
            )
        print(f"replay: {path}")


def _print(rows: dict[str, Metrics], title: str, convention: Convention) -> None:
    table = Table(title=title)
    unit = convention.unit
    heads = ("", f"J ({unit})", "RMSE (m)", "final displacement (m)", "collisions (%)")
    last = next(iter(rows.values())).horizons
    chosen = sorted({len(last) // 4, len(last) // 2, len(last) - 1} & set(range(len(last))))
    for head in (*heads, *(f"RMSE at {last[i]['t']:g} s" for i in chosen)):
        table.add_column(head, justify="right")
    for name, m in rows.items():
        values = (m.J, m.rmse, m.final_displacement, 100 * m.collisions)
        at = (m.horizons[i]["rmse"] for i in chosen)
        table.add_row(name, *(f"{value:.4g}" for value in (*values, *at)))
    Console(width=140).print(table)
