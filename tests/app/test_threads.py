"""Threads of torch and of NumPy's linear algebra."""

from __future__ import annotations

import torch
from threadpoolctl import threadpool_info

from nnode.app.training import set_threads, threads_given_back


def of_linear_algebra() -> set[int]:
    return {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"}


def test_traffic_takes_one_thread_and_gives_the_others_back() -> None:
    with threads_given_back():
        set_threads(2, "crowd")
        before = torch.get_num_threads(), of_linear_algebra()
        assert before == (2, {2})
        with threads_given_back():
            set_threads(None, "crowd")
            assert (torch.get_num_threads(), of_linear_algebra()) == before
            set_threads(None, "traffic")
            assert (torch.get_num_threads(), of_linear_algebra()) == (1, {1})
        assert (torch.get_num_threads(), of_linear_algebra()) == before
