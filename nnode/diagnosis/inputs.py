"""The sequences of a diagnosis, and the faulty ones that are left out and reported."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

from nnode.data.dataset import Source, noise_of
from nnode.data.options import DataOptions, Faults
from nnode.data.prepare import open_data
from nnode.data.quality import Fault, interpolated_text, kinds_text, recorded
from nnode.data.readers.recordings import natural
from nnode.data.sequence import Domain, Sequence
from nnode.diagnosis.result import DataFault
from nnode.errors import DataError

#: Smallest number of sequences that can be resampled and divided.
LEAST = 3


@dataclass(frozen=True)
class Inputs:
    """The input data of a diagnosis.

    Attributes:
        domain: of the data.
        sequences: without a fault.
        faulty: those with faults that can be drawn.
        faults: all faults by the sequence's name.
        data_faults: the same for the report, agents by identifier or, where there are none, by
            their number in the sequence.
        manifest: where the data come from.
        measured: sentences about the measurement noise and about filled samples.
    """

    domain: Domain
    sequences: list[Sequence]
    faulty: list[Sequence]
    faults: dict[str, list[Fault]]
    data_faults: list[DataFault]
    manifest: dict[str, Any]
    measured: list[str] = field(default_factory=list)


def read_inputs(options: DataOptions, folder: Path) -> Inputs:
    """Read data and separate faulty sequences.

    Args:
        options: with ``faults=error`` faults are refused; otherwise faulty sequences are left
            out of the diagnosis, independently of their treatment in training.
        folder: where data are prepared.

    Raises:
        DataError: fewer than three sequences are left, or no vehicle follows another.
        NNodeError: see :func:`nnode.data.prepare.open_data`.
    """
    return inputs_of(open_data(with_faulty(options), folder), options)


def with_faulty(options: DataOptions) -> DataOptions:
    """Options that also read faulty sequences, which the report lists."""
    if options.prepared is None and options.faults is Faults.drop:
        return replace(options, faults=Faults.keep)
    return options


def inputs_of(store: Source, options: DataOptions) -> Inputs:
    """Separate faulty sequences.

    Args:
        store: what was read, on the disk or in memory.
        options: of these data.

    Raises:
        DataError: fewer than three sequences are left, or no vehicle follows another.
    """
    faults = recorded(store.manifest)
    reported = [
        DataFault(
            entry["kind"],
            entry["sequence"],
            entry.get("names") or [str(i) for i in entry["agents"]],
            entry["time"],
            entry["detail"],
        )
        for entry in store.manifest.get("faults", [])
    ]
    # a fixed order, because divisions into folds depend on it
    everything = sorted(store, key=lambda s: natural(s.name))
    sound = [s for s in everything if s.name not in faults]
    read = store.manifest.get("counts", {}).get("read", len(everything))
    _check_enough(sound, faults, read, options)
    return Inputs(
        domain=cast(Domain, options.domain),
        sequences=sound,
        faulty=[s for s in everything if s.name in faults],
        faults=faults,
        data_faults=reported,
        manifest=store.manifest,
        measured=_measured(store),
    )


def _measured(store: Source) -> list[str]:
    """Notes on the measurement for the report."""
    noise, filled = noise_of(store), store.manifest.get("filled", [])
    text = f"N{str(noise)[1:]}."
    if noise.beyond:
        text += " Initial states and measured leaders are taken from smoothed paths."
    return [text] + ([f"{interpolated_text(filled)}."] if filled else [])


def _check_enough(
    sound: list[Sequence], faults: dict[str, list[Fault]], read: int, options: DataOptions
) -> None:
    if options.domain == "traffic" and all(s.n_agents < 2 for s in sound) and read:
        too_short = [f for faults_of in faults.values() for f in faults_of if f.kind == "too_short"]
        if sound or len(too_short) == sum(map(len, faults.values())):
            raise DataError(
                f"data={options.name}: no vehicle follows another in any of the {read} sequences; "
                "a diagnosis of traffic needs sequences of two or more vehicles of one lane"
            )
    if len(sound) >= LEAST:
        return
    why = kinds_text(faults.values())
    raise DataError(
        f"data={options.name}: {len(sound)} of {read} sequences are without a fault"
        f"{f' ({why})' if why else ''}; a diagnosis needs at least {LEAST}, some to calibrate on "
        "and some kept for the end: take more data, or cut a long recording into several sequences"
    )
