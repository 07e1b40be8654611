"""Errors of a checkpoint beside its baselines: ``scripts/evaluate.py``."""

from __future__ import annotations

from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.table import Table

from nnode.app.saved import merge_saved
from nnode.app.sweep import write_json
from nnode.app.train import build_solver, set_threads, source_hashes, straight_loader, stream
from nnode.calibrate.checkpoint import Checkpoint, load_checkpoint
from nnode.calibrate.cost import Convention
from nnode.calibrate.distributed import World
from nnode.calibrate.evaluate import Metrics, Simulate, baselines, evaluate
from nnode.calibrate.options import Device, SolverOptions
from nnode.data.options import DataOptions
from nnode.data.prepare import open_data
from nnode.data.store import Store
from nnode.errors import ConfigError

PARTS = ("auto", "heldout", "train", "all")


def choose(store: Store, checkpoint: Checkpoint, part: str) -> tuple[str, list[int]]:
    """Which sequences of a store are evaluated.

    ``heldout`` and ``train`` are the checkpoint's own parts, recognised by name and source
    hashes. ``auto``: held-out sequences where the data are the checkpoint's and it held some
    out, else all.

    Raises:
        ConfigError: an unknown part, or one that these data do not have.
    """
    if part not in PARTS:
        raise ConfigError(f"part={part} is unknown, expected one of {', '.join(PARTS)}")
    same = source_hashes(store.manifest) == source_hashes(checkpoint.manifest)
    own = {name: set(checkpoint.split.get(name, [])) for name in ("heldout", "train")}
    if part == "auto":
        part = "heldout" if same and own["heldout"] else "all"
    if part == "all":
        return part, list(range(len(store)))
    indices = [i for i, entry in enumerate(store.index) if entry["name"] in own[part]]
    if not same or not indices:
        raise ConfigError(
            f"part={part} needs data with sequences of the checkpoint's {part} part; these have "
            "none, use part=all"
        )
    return part, indices


def evaluate_checkpoint(config: DictConfig, folder: Path) -> None:
    """Write ``metrics.json`` and print the model beside its baselines.

    Raises:
        NNodeError: no such checkpoint, no such data, or data of another domain.
    """
    checkpoint = load_checkpoint(config.checkpoint)
    config = merge_saved(config, checkpoint.config, ("data", "solver"))
    data: DataOptions = OmegaConf.to_object(config.data)  # type: ignore[assignment]
    solver_options: SolverOptions = OmegaConf.to_object(config.solver)  # type: ignore[assignment]
    set_threads(checkpoint.config["trainer"]["threads"], data.domain)
    store = open_data(data, folder / "data")
    part, indices = choose(store, checkpoint, config.part)
    device = World().use(Device(config.device), "device")
    model, solver = checkpoint.build().to(device), build_solver(solver_options)
    dtype = getattr(torch, checkpoint.config["trainer"]["dtype"])
    convention = Convention(checkpoint.config["trainer"]["cost"])

    def measure(simulate: Simulate) -> Metrics:
        size = data.loader.batch_size
        batches = stream(straight_loader(store, indices, size), dtype, device)
        return evaluate(simulate, batches, convention)

    name = checkpoint.config["model"]["name"]
    found = measure(lambda batch: solver(model, batch))
    others = {
        key: measure(simulate)
        for key, simulate in baselines(model, solver, checkpoint.free_speed).items()
    }
    write_json(
        folder / "metrics.json",
        {
            **found.plain(),
            "model": name,
            "data": data.name,
            "part": part,
            "unit": "m² s" if convention is Convention.integral else "m²",
            "parameters": {k: float(v) for k, (v, _) in model.physical().items()},
            "free_speed": checkpoint.free_speed,
            "baselines": {key: metrics.plain() for key, metrics in others.items()},
        },
    )
    _print({name: found, **others}, f"{data.name}, {part}: {found.sequences} sequences", convention)
    print(f"metrics: {folder / 'metrics.json'}")


def _print(rows: dict[str, Metrics], title: str, convention: Convention) -> None:
    table = Table(title=title)
    unit = "m² s" if convention is Convention.integral else "m²"
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
