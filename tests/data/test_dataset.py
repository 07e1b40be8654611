"""Streaming of sequences and the order of mini-batches."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from nnode.data.dataset import EpochSampler, SequenceDataset, make_loader
from nnode.data.options import LoaderOptions
from nnode.data.sequence import collate
from nnode.data.store import Store, write_store
from nnode.errors import ConfigError, DataError
from tests.builders import lane


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    rng = np.random.default_rng(0)
    items = [
        lane(
            np.cumsum(rng.uniform(5, 9, (3 + i % 3, 2 + i % 2)), axis=1),
            start=10.0 * i,
            name=f"r/{i}",
        )
        for i in range(11)
    ]
    return write_store(tmp_path_factory.mktemp("store"), items, {})


def epoch(sampler: EpochSampler, number: int, start: int = 0) -> list[list[int]]:
    sampler.set_epoch(number)
    sampler.set_start(start)
    return list(sampler)


def test_each_epoch_has_all_sequences_in_its_order() -> None:
    sampler = EpochSampler(11, 4, seed=3)
    first, second = epoch(sampler, 0), epoch(sampler, 1)
    assert [len(batch) for batch in first] == [4, 4, 3]
    assert len(sampler) == 3
    for batches in (first, second):
        assert sorted(i for batch in batches for i in batch) == list(range(11))
    assert first != second
    assert epoch(EpochSampler(11, 4, seed=4), 0) != first


def test_epoch_depends_only_on_seed_and_number() -> None:
    sampler = EpochSampler(11, 4, seed=3)
    for number in range(5):
        expected = epoch(sampler, number)
    torch.manual_seed(99)
    np.random.seed(99)
    assert epoch(EpochSampler(11, 4, seed=3), 4) == expected


@pytest.mark.parametrize("start", [0, 1, 2, 3])
def test_epoch_resumes_at_any_mini_batch(start: int) -> None:
    complete = epoch(EpochSampler(11, 4, seed=3), 7)
    sampler = EpochSampler(11, 4, seed=3)
    assert epoch(sampler, 7, start) == complete[start:]
    assert len(sampler) == 3 - start
    sampler.set_epoch(8)
    assert len(sampler) == 3


def test_batch_size_zero_and_no_shuffling() -> None:
    assert epoch(EpochSampler(5, 0, seed=0, shuffle=False), 3) == [[0, 1, 2, 3, 4]]
    assert epoch(EpochSampler(5, 2, seed=0, shuffle=False), 3) == [[0, 1], [2, 3], [4]]
    assert sorted(epoch(EpochSampler(5, 0, seed=0), 3)[0]) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(
    ("batch_size", "seed", "message"), [(-1, 0, "batch_size=-1"), (1, -2, "seed=-2")]
)
def test_invalid_sampler_options(batch_size: int, seed: int, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        EpochSampler(5, batch_size, seed=seed)


def test_invalid_epochs_and_starts() -> None:
    sampler = EpochSampler(5, 2, seed=0)
    with pytest.raises(ValueError, match="counted from 0"):
        sampler.set_epoch(-1)
    with pytest.raises(ValueError, match="mini-batches 0 to 3"):
        sampler.set_start(4)


@pytest.mark.parametrize("workers", [0, 2])
def test_loader_streams_the_sequences_of_the_sampler(store: Store, workers: int) -> None:
    chosen = [0, 2, 3, 5, 7, 8, 10]
    options = LoaderOptions(batch_size=3, workers=workers)
    loader = make_loader(SequenceDataset(store, chosen), options, seed=1)
    sampler = loader.batch_sampler
    assert isinstance(sampler, EpochSampler)
    for number in (0, 1):
        expected = epoch(sampler, number, start=1)
        loaded = list(loader)
        assert [batch.names for batch in loaded] == [
            tuple(f"r/{chosen[i]}" for i in batch) for batch in expected
        ]
        expected_batch = collate(store[chosen[i]] for i in expected[0])
        assert torch.equal(loaded[0].x, expected_batch.x)
        assert torch.equal(loaded[0].valid, expected_batch.valid)


def test_loader_does_not_change_the_global_generator(store: Store) -> None:
    loader = make_loader(SequenceDataset(store), LoaderOptions(batch_size=4), seed=1)
    torch.manual_seed(5)
    before = torch.get_rng_state()
    assert len(list(loader)) == 3
    assert torch.equal(torch.get_rng_state(), before)


def test_sequences_are_read_on_demand(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[int] = []
    original = Store.__getitem__
    monkeypatch.setattr(
        Store, "__getitem__", lambda self, i: (read.append(i), original(self, i))[1]
    )
    dataset = SequenceDataset(store)
    loader = make_loader(dataset, LoaderOptions(batch_size=2, shuffle=False), seed=0)
    assert len(dataset) == 11
    assert read == []
    next(iter(loader))
    assert read == [0, 1]


def test_invalid_positions_and_workers(store: Store) -> None:
    for positions in ([11], [-1]):
        with pytest.raises(DataError, match="sequences 0 to 10, asked for number"):
            SequenceDataset(store, positions)
    with pytest.raises(DataError, match="no sequence to load"):
        make_loader(SequenceDataset(store, []), LoaderOptions(), seed=0)
    with pytest.raises(ConfigError, match="workers=-1"):
        make_loader(SequenceDataset(store), LoaderOptions(workers=-1), seed=0)
