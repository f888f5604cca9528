"""Streams of random numbers: equal names give equal numbers, others do not."""

from __future__ import annotations

import torch

from tpcd.random import stream


def first(*names: int) -> float:
    return float(torch.rand((), generator=stream(*names), dtype=torch.float64))


def test_equal_names_give_equal_numbers_and_all_others_different_ones() -> None:
    names = [(5,), (5, 0), (5, 0, 0), (0, 5), (2**32,), (0, 1), (1,), (1, 0), (0, 0, 1), (5, 4, 3)]
    numbers = [first(*name) for name in names]
    assert numbers == [first(*name) for name in names]
    assert len(set(numbers)) == len(names)
