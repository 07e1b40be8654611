"""Streaming prepared sequences as mini-batches, in an order that can be resumed anywhere."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from collections.abc import Sequence as ListLike

import numpy as np
import torch
import torch.utils.data
from torch.utils.data import DataLoader

from nnode.data.options import LoaderOptions
from nnode.data.sequence import Batch, Sequence, collate
from nnode.data.sequences import Sequences
from nnode.data.smooth import Noise, measured_noise, smooth_speeds, suggested_window
from nnode.data.store import Store
from nnode.errors import ConfigError, DataError

#: Sequences by which noise is estimated where no manifest has it.
_ESTIMATED = 400


class SmoothSpeeds:
    """A source of sequences with the speeds of smoothed paths, positions as they are.

    Args:
        source: the sequences as they were measured.
        window: s, see :func:`nnode.data.smooth.smooth_speeds`.
    """

    def __init__(self, source: Store | Sequences, window: float) -> None:
        self.source, self.index, self.manifest = source, source.index, source.manifest
        self.window = window

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, i: int) -> Sequence:
        return smooth_speeds(self.source[i], self.window)

    def __iter__(self) -> Iterator[Sequence]:
        return (self[i] for i in range(len(self)))


#: What sequences are taken from.
Source = Store | Sequences | SmoothSpeeds


def noise_of(source: Source) -> Noise:
    """The noise of measurement of a source, from its manifest or else estimated."""
    stored = source.manifest.get("noise")
    if stored is not None:
        values = {key: float("nan") if value is None else value for key, value in stored.items()}
        return Noise(**values)
    every = max(1, -(-len(source) // _ESTIMATED))
    return measured_noise(source[i] for i in range(0, len(source), every))


def sound_speeds(source: Source, domain: str, order: int) -> Source:
    """Sequences whose speeds a simulation can start with.

    Args:
        source: the sequences as they were measured.
        domain, order: of the model.

    Returns:
        The same; of vehicles, for laws of second order, with the speeds of smoothed paths where the
        noise of the measurement is :attr:`~nnode.data.smooth.Noise.beyond` what these laws bear,
        and where ``data.start_speeds`` does not ask for others.
    """
    options = source.manifest.get("options", {})
    asked = options.get("start_speeds", "measured") != "measured"
    if domain != "traffic" or order < 2 or asked or isinstance(source, SmoothSpeeds):
        return source
    noise = noise_of(source)
    return SmoothSpeeds(source, suggested_window(noise, source[0].dt)) if noise.beyond else source


class SequenceDataset(torch.utils.data.Dataset[Sequence]):
    """Some sequences of a store, each read from the disk when it is asked for.

    Nothing is kept in memory, so that a data set may be larger than it.

    Args:
        store: the prepared data, or sequences in memory.
        indices: positions in the store, such as ``Split.train``; None takes all.

    Raises:
        DataError: a position that the store does not have.
    """

    def __init__(self, store: Source, indices: Iterable[int] | None = None) -> None:
        self.store = store
        self.indices = _positions(store, indices)

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, i: int) -> Sequence:
        return self.store[self.indices[i]]


class EpochSampler(torch.utils.data.Sampler[list[int]]):
    """Mini-batches of positions, the order of epoch e being a pure function of (seed, e).

    No generator is advanced from epoch to epoch: a run that is resumed at any mini-batch of any
    epoch sees exactly what the uninterrupted run would have seen.

    Args:
        n: number of sequences.
        batch_size: most sequences per mini-batch, shared out evenly; 0 takes all at once.
        seed: of the shuffling, >= 0.
        shuffle: False keeps the order of the data set.
        rank, size: this process's number and the number of processes that share out every
            mini-batch; a process gets an empty list of one that is smaller than their number.

    Raises:
        ConfigError: a negative batch size or seed.
    """

    def __init__(
        self,
        n: int,
        batch_size: int,
        seed: int,
        shuffle: bool = True,
        rank: int = 0,
        size: int = 1,
    ) -> None:
        if batch_size < 0:
            raise ConfigError(
                f"data.loader.batch_size={batch_size}: expected at least 1, or 0 for all at once"
            )
        if seed < 0:
            raise ConfigError(f"seed={seed}: expected an integer of at least 0")
        self.n = n
        self.batch_size = batch_size or max(n, 1)
        self.seed = seed
        self.shuffle = shuffle
        self.rank, self.size = rank, size
        self.epoch = 0
        self.start = 0

    @property
    def n_batches(self) -> int:
        """Mini-batches of a whole epoch."""
        return -(-self.n // self.batch_size)

    def sequences(self, batch: int) -> int:
        """Sequences of mini-batch number ``batch``, those of all processes."""
        smallest, larger_ones = divmod(self.n, self.n_batches)
        return smallest + (batch < larger_ones)

    def set_epoch(self, epoch: int) -> None:
        """Choose the epoch, counted from 0; it starts at its first mini-batch."""
        if epoch < 0:
            raise ValueError(f"epoch {epoch}: epochs are counted from 0")
        self.epoch = epoch
        self.start = 0

    def set_start(self, batch: int) -> None:
        """Skip the mini-batches before number ``batch`` of the present epoch, unread."""
        if not 0 <= batch <= self.n_batches:
            raise ValueError(f"mini-batch {batch}: an epoch has mini-batches 0 to {self.n_batches}")
        self.start = batch

    def order(self) -> np.ndarray:
        """``(n,)`` positions in the order of the present epoch."""
        if not self.shuffle:
            return np.arange(self.n)
        return np.random.default_rng((self.seed, self.epoch)).permutation(self.n)

    def __len__(self) -> int:
        """Mini-batches that are left in the present epoch."""
        return self.n_batches - self.start

    def __iter__(self) -> Iterator[list[int]]:
        # shared out evenly: a last mini-batch of one or two sequences would give a wild gradient
        batches = np.array_split(self.order(), self.n_batches)
        for batch in batches[self.start :]:
            yield batch[self.rank :: self.size].tolist()


def make_loader(
    dataset: SequenceDataset, options: LoaderOptions, *, seed: int, rank: int = 0, size: int = 1
) -> DataLoader[Sequence]:
    """A loader of :class:`~nnode.data.sequence.Batch` mini-batches.

    With several processes (``size``) it gives this one's share of every mini-batch, None where
    that is empty.

    ``loader.batch_sampler`` is an :class:`EpochSampler`: call its ``set_epoch`` before each
    epoch, and ``set_start`` to resume within one. The order is the same for every number of
    workers.

    Raises:
        ConfigError: a negative batch size, number of workers or seed.
        DataError: an empty data set.
    """
    if not len(dataset):
        raise DataError(f"{_called(dataset.store)}: there is no sequence to load")
    if options.workers < 0:
        raise ConfigError(f"data.loader.workers={options.workers}: expected at least 0")
    return DataLoader(
        dataset,
        batch_sampler=EpochSampler(
            len(dataset), options.batch_size, seed, options.shuffle, rank, size
        ),
        num_workers=options.workers,
        collate_fn=_collate_share,
        # Its own generator: a loader would otherwise advance the global one at every epoch.
        generator=torch.Generator().manual_seed(seed),
    )


def _called(store: Source) -> str:
    return str(store.folder) if isinstance(store, Store) else "the data set"


def _collate_share(sequences: list[Sequence]) -> Batch | None:
    return collate(sequences) if sequences else None


def _positions(store: Source, indices: Iterable[int] | None) -> ListLike[int]:
    if indices is None:
        return range(len(store))
    positions = list(indices)
    for i in positions:
        if not 0 <= i < len(store):
            raise DataError(
                f"{_called(store)} has sequences 0 to {len(store) - 1}, asked for number {i}; the "
                "split belongs to other data"
            )
    return positions
