"""Prepared data of the studies."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from nnode.data.sequence import Sequence
from nnode.data.store import Store


@lru_cache(maxsize=8)
def sequences(folder: str) -> tuple[Sequence, ...]:
    """All sequences of a prepared folder."""
    return tuple(Store(folder))


def hash_of(stores: Mapping[Any, Store]) -> str:
    """Of the content of all files of prepared data: a fingerprint of tasks that read them."""
    content = {str(name): store.manifest["files"] for name, store in stores.items()}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
