"""Threads of torch and of NumPy's linear algebra."""

from __future__ import annotations

import torch
from threadpoolctl import threadpool_info

from nnode.app.training import set_threads, threads_given_back


def thread_counts() -> tuple[int, set[int]]:
    """Numbers of threads of torch and of BLAS."""
    pools = threadpool_info()
    blas = {pool["num_threads"] for pool in pools if pool["user_api"] == "blas"}
    return torch.get_num_threads(), blas


def test_traffic_uses_one_thread_temporarily() -> None:
    with threads_given_back():
        set_threads(2, "crowd")
        assert thread_counts() == (2, {2})
        with threads_given_back():
            set_threads(None, "crowd")
            assert thread_counts() == (2, {2})
            set_threads(None, "traffic")
            assert thread_counts() == (1, {1})
        assert thread_counts() == (2, {2})
