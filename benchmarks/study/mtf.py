"""Modulation transfer function of an edge, and the spatial resolution (paper, App. D).

    LSF = d ESF / dt,     MTF(f) = |DFT(w LSF)|(f) / |DFT(w LSF)|(0)

The resolution is the frequency at which the MTF first falls below 10 %; for a Gaussian blur sigma,
sqrt(2 ln 10) / (2 pi sigma).

Computation and its error, for an edge spread over -L <= t <= L:

- The Tukey window w, 1 over |t| <= L / 2 with a cosine taper to 0 at L, removes noise and slow slopes at the ends. It
  changes the resolution of a Gaussian edge by less than 0.1 % up to sigma = L / 5 and 0.8 % up to L / 3, and
  overestimates it by 13 % at L / 2. The window alone has 0.6 / L (`COARSEST`), the lower limit of any result.
- Zero-padding interpolates the transform.
- A difference over one sample h multiplies the MTF by sinc(f h), which is divided out.
- Average profiles first: the derivative of a single one is mostly noise. Variation of the edge position within an
  average counts as blur. Remaining noise raises the MTF and, as a rule, the resolution.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from nerif.plotting.drawing import COLOURS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["COARSEST", "MTF", "THRESHOLD", "draw_mtf"]

THRESHOLD = 0.1  # of the MTF
MIN_STEP = 0.1  # of the true step: less is no edge
PADDING = 20  # times as many zeros as samples
COARSEST = 0.60  # of the window alone, line pairs in the half length L


@dataclass(frozen=True)
class MTF:
    """Modulation transfer function of one edge or of many.

    Parameters
    ----------
    frequency : (f,) up to the Nyquist frequency of the samples, line pairs (lp) per unit of length
    transfer : (*batch, f) 1; NaN where there is no edge
    """

    frequency: Float[Tensor, " f"]
    transfer: Float[Tensor, "*batch f"]

    @classmethod
    def of(cls, edge_spread: Float[Tensor, "*batch t"], step: float) -> MTF:
        """Transform edge spread functions, sampled every `step`; the true edge is a step from -1 to 0."""
        line = edge_spread.diff(dim=-1)
        line = line * _window(line.shape[-1])
        padded = PADDING * edge_spread.shape[-1]
        frequency = torch.arange(padded // 2 + 1, dtype=torch.float64) / (padded * step)
        height = line.sum(-1, keepdim=True)
        height = torch.where(height >= MIN_STEP, height, math.nan)
        return cls(frequency, torch.fft.rfft(line, padded).abs() / height / torch.sinc(frequency * step))

    @property
    def resolution(self) -> Float[Tensor, "*batch"]:
        """The frequency at which the MTF first falls below 10 %, lp per unit of length.

        NaN if the MTF stays above 10 % up to the Nyquist frequency; 0 if there is no edge.
        """
        frequency, transfer = self.frequency, self.transfer
        first = ((transfer < THRESHOLD).cumsum(-1) == 0).sum(-1, keepdim=True)
        i = first.clamp(1, len(frequency) - 1)
        before, after = transfer.gather(-1, i - 1), transfer.gather(-1, i)
        crossing = frequency[i - 1] + (before - THRESHOLD) / (before - after) * (frequency[1] - frequency[0])
        crossing = torch.where(first < len(frequency), crossing, math.nan)
        return torch.where(transfer[..., :1].isnan(), 0.0, crossing).squeeze(-1)


def _window(n: int) -> Float[Tensor, " n"]:
    """Tukey window at n points in (-L, L), with a taper over the outer half."""
    place = (torch.arange(n, dtype=torch.float64) - (n - 1) / 2).abs() / ((n + 1) / 2)
    return 0.5 * (1 + torch.cos(math.pi * (2 * place - 1).clamp(min=0)))


def draw_mtf(axes: Axes, mtf: MTF, label: str = "", colour: str = COLOURS["blue"], unit: str = "mm") -> Axes:
    """Draw an MTF and its resolution; further ones into the same axes."""
    first = not axes.has_data()
    frequency, resolution = mtf.frequency.numpy(), float(mtf.resolution)
    right = 2 * resolution if resolution > 0 else frequency[-1]  # NaN and 0 are not on the axis
    if not first:
        right = max(right, axes.get_xlim()[1])
    text = "no edge" if resolution == 0 else f"> {frequency[-1]:.4g} lp/{unit}"
    text = f"{resolution:.2f} lp/{unit}" if resolution > 0 else text
    axes.plot(frequency, mtf.transfer.numpy(), color=colour, label=f"{label}: {text}" if label else text)
    if first:
        axes.axhline(THRESHOLD, color=COLOURS["grey"], linewidth=0.8, linestyle="--", label=f"{THRESHOLD:.0%}")
    if resolution > 0:
        axes.plot(resolution, THRESHOLD, marker="o", markersize=4, color=colour)
    axes.set(xlim=(0, right), ylim=(0, 1.1), xlabel=f"spatial frequency [lp/{unit}]", ylabel="MTF [1]")
    axes.legend(frameon=False)
    return axes
