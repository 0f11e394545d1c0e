"""The order of rays: each once an epoch, another in every epoch, and the same again wherever one begins."""

from __future__ import annotations

import pytest
import torch

from nerif.reconstruction.neural.training_data import shuffled


@pytest.mark.parametrize("count", [1, 2, 3, 17, 1024, 40_000])
def test_each_once_an_epoch(count):
    for epoch in range(3):
        assert torch.equal(shuffled(epoch * count, count, count, 3).sort()[0], torch.arange(count))


def test_it_goes_on_from_any_place_and_over_the_end_of_an_epoch():
    whole = shuffled(0, 3000, 1000, 7)
    parts = [shuffled(first, 60, 1000, 7) for first in range(0, 3000, 60)]
    assert torch.equal(torch.cat(parts), whole)


def test_epochs_and_seeds_differ_and_neighbours_are_scattered():
    count = 100_000
    a, b, c = shuffled(0, count, count, 0), shuffled(count, count, count, 0), shuffled(0, count, count, 1)
    assert float((a == b).float().mean()) < 1e-3
    assert float((a == c).float().mean()) < 1e-3
    places = a.double()
    correlation = torch.corrcoef(torch.stack([places[:-1], places[1:]]))[0, 1]
    assert abs(float(correlation)) < 0.02
    # every tenth of the order has as many of each tenth of the numbers
    table = torch.histogramdd(torch.stack([torch.arange(count) / count, places / count], -1), [10, 10]).hist
    assert float((table / (count / 100) - 1).abs().max()) < 0.12
