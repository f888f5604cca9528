"""Rows in threads: every row once and in order, however they are split."""

from __future__ import annotations

import pytest
import torch

from tpcd.threads import over_threads


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("most", [None, 1, 100, 10_000])
@pytest.mark.parametrize("count", [0, 1, 512, 513, 2000])
def test_every_row_is_worked_on_once_and_in_order(
    threads: int, most: int | None, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", str(threads))
    rows = torch.arange(count, dtype=torch.float64)[:, None].requires_grad_()
    parts = over_threads(lambda own: 2 * own, rows, most)
    found = torch.cat(parts)
    assert torch.equal(found, 2 * rows.detach()) and not found.requires_grad
    assert most is None or max(len(part) for part in parts) <= most
    if count <= 512 and (most is None or most >= count):
        assert len(parts) == 1
