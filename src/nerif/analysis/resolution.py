"""Modulation transfer function of an edge, and the resolution that follows from it (paper, App. D).

    LSF = d ESF / dt,     MTF(f) = |DFT(w LSF)|(f) / |DFT(w LSF)|(0)

The resolution is the frequency at which the MTF first falls below 10 %. Of a Gaussian blur sigma, that is
sqrt(2 ln 10) / (2 pi sigma).

How it is computed, and what error that makes, for an edge spread over -L <= t <= L:

- The Tukey window w is 1 over |t| <= L / 2 and falls as a cosine to 0 at L: it leaves a narrow line spread as it is,
  and takes out what noise and slow slopes there are at the ends. Of an edge blurred by sigma, it changes the resolution
  by less than 0.1 % up to sigma = L / 5 and 0.8 % up to L / 3; it makes it 13 % too fine at L / 2. The window alone has
  0.6 / L (`COARSEST`): a field found near that is worse than that.
- Zero-padding only draws the same transform more finely, and is interpolated linearly.
- A difference over one sample h multiplies the MTF by sinc(f h), which is divided out.
- Profiles are to be averaged before: the derivative of a single one shows mostly noise. Where the edge lies at
  different depths within an average, that counts as blur. Noise that is left lifts the MTF, and makes the resolution
  seem finer as a rule.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["COARSEST", "MTF", "THRESHOLD"]

THRESHOLD = 0.1  # of the MTF
FAINTEST = 0.1  # of the true step: less is no edge
PADDING = 20  # times as many zeros as samples
COARSEST = 0.60  # of the window alone, line pairs in the half length L


@dataclass(frozen=True)
class MTF:
    """Modulation transfer function of an edge, or of many.

    Parameters
    ----------
    frequency : (f,) up to the Nyquist frequency of the samples, line pairs (lp) per unit of length
    transfer : (*batch, f) 1; NaN where there is no edge
    """

    frequency: Float[Tensor, " f"]
    transfer: Float[Tensor, "*batch f"]

    @classmethod
    def of(cls, edge_spread: Float[Tensor, "*batch t"], step: float) -> MTF:
        """Transform edge spread functions, sampled every `step` around the edge: the truth is a step from -1 to 0."""
        line = edge_spread.diff(dim=-1)
        line = line * _window(line.shape[-1])
        padded = PADDING * edge_spread.shape[-1]
        frequency = torch.arange(padded // 2 + 1, dtype=torch.float64) / (padded * step)
        found = line.sum(-1, keepdim=True)
        found = torch.where(found >= FAINTEST, found, math.nan)
        return cls(frequency, torch.fft.rfft(line, padded).abs() / found / torch.sinc(frequency * step))

    @property
    def resolution(self) -> Float[Tensor, "*batch"]:
        """Where the MTF first falls below 10 %, lp per unit of length.

        NaN is finer than the samples can tell: the MTF stays above 10 % up to their Nyquist frequency. 0 is no edge,
        less than a tenth of the true step.
        """
        frequency, transfer = self.frequency, self.transfer
        first = ((transfer < THRESHOLD).cumsum(-1) == 0).sum(-1, keepdim=True)
        i = first.clamp(1, len(frequency) - 1)
        before, after = transfer.gather(-1, i - 1), transfer.gather(-1, i)
        found = frequency[i - 1] + (before - THRESHOLD) / (before - after) * (frequency[1] - frequency[0])
        found = torch.where(first < len(frequency), found, math.nan)
        return torch.where(transfer[..., :1].isnan(), 0.0, found).squeeze(-1)


def _window(n: int) -> Float[Tensor, " n"]:
    """Tukey's window at n places over (-L, L): 1 in the inner half, a cosine to 0 in the outer."""
    place = (torch.arange(n, dtype=torch.float64) - (n - 1) / 2).abs() / ((n + 1) / 2)
    return 0.5 * (1 + torch.cos(math.pi * (2 * place - 1).clamp(min=0)))
