"""The modulation transfer function of edges of which it is known, and its figure."""

from __future__ import annotations

import math

import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.study.mtf import COARSEST, MTF, draw_mtf

STEP, HALF = 0.01, 1.2


def edge(sigma: float, strength: float = 1.0) -> torch.Tensor:
    """A step from -strength to 0, blurred by a Gaussian."""
    t = (torch.arange(-round(HALF / STEP), round(HALF / STEP), dtype=torch.float64) + 0.5) * STEP
    return -0.5 * strength * torch.erfc(t / (math.sqrt(2) * sigma))


@pytest.mark.parametrize(
    ("of_length", "error"), [(0.03, 1e-3), (1 / 5, 1e-3), (1 / 3, 8e-3), (1 / 2, 0.14)], ids=lambda v: f"{v:.3g}"
)
def test_gaussian_edges_within_the_errors_that_the_module_states(of_length, error):
    sigma = of_length * HALF
    mtf = MTF.of(edge(sigma), STEP)
    assert float(mtf.resolution) == pytest.approx(math.sqrt(2 * math.log(10)) / (2 * math.pi * sigma), rel=error)
    assert float(mtf.transfer[0]) == pytest.approx(1)
    assert float(mtf.frequency[-1]) == pytest.approx(0.5 / STEP)


def test_many_edges_at_once_faint_ones_and_a_sharp_one():
    edges = torch.stack([edge(0.1), edge(0.2), edge(0.1, 0.5), edge(0.1, 0.05), torch.zeros(240).double(), edge(1e-6)])
    found = MTF.of(edges, STEP).resolution
    assert found[0].item() == pytest.approx(2 * found[1].item(), rel=1e-3)
    assert found[2].item() == pytest.approx(found[0].item())  # a weak edge is as sharp as a strong one
    assert found[3:5].tolist() == [0, 0]  # no edge
    assert math.isnan(found[5])  # finer than the samples


def test_nothing_is_coarser_than_the_window_alone():
    ramp = torch.linspace(-1, 0, 240, dtype=torch.float64)
    assert float(MTF.of(ramp, STEP).resolution) == pytest.approx(COARSEST / HALF, rel=0.02)


def test_figure():
    figure = Figure()
    axes = figure.subplots()
    for label, spread in (("NeRIF", edge(0.1)), ("sharp", edge(1e-6)), ("nothing", torch.zeros(240).double())):
        assert draw_mtf(axes, MTF.of(spread, STEP), label) is axes
    FigureCanvasAgg(figure).draw()
    said = [text.get_text() for text in axes.get_legend().get_texts()]
    resolution = float(MTF.of(edge(0.1), STEP).resolution)
    assert said == [f"NeRIF: {resolution:.2f} lp/mm", "10%", "sharp: > 50 lp/mm", "nothing: no edge"]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("spatial frequency [lp/mm]", "MTF [1]")
