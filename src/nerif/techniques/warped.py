"""Reference pictures moved by a displacement, and made as bright as the flow pictures.

    flow(p) = g(p) reference(p - d(p)) + o(p)

The reference between pixels is the cubic B-spline through them. Gain g and offset o vary slowly over a picture, as
light flickers and a flame shines of its own: polynomials of DEGREE, fitted view by view.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

__all__ = ["References"]

DEGREE = 4
"""Of the polynomials of gain and offset, in total."""
RIDGE = 1e-4  # of what a pixel weighs, for every term beyond the constants
ROUNDS, OUTLIER = 3, 3.0  # of the fit; residuals, in standard deviations, beyond which a pixel counts less
MOST = 1 << 16  # pixels of a view that tell its gain and offset
PAD = 2  # rows and columns that the spline takes beyond the edges, mirrored


class References:
    """The pictures without flow of all views.

    Parameters
    ----------
    pictures : (view, row, column) grey values; NaN where not seen
    sizes : (height, width) of each view's picture, px; what is beyond is padding
    """

    def __init__(self, pictures: Float[Tensor, "view row column"], sizes: Sequence[tuple[int, int]]) -> None:
        from scipy.ndimage import spline_filter

        views, height, width = pictures.shape
        self.width = width + 2 * PAD
        self.area = (height + 2 * PAD) * self.width
        coefficients = torch.zeros(views, height + 2 * PAD, self.width)
        self.good = torch.zeros(views, height, width, dtype=torch.bool)
        for i, (h, w) in enumerate(sizes):
            picture = pictures[i, :h, :w].double()
            self.good[i, :h, :w] = good = picture.isfinite()
            filled = torch.where(good, picture, picture[good].mean() if bool(good.any()) else 0.0)
            own = spline_filter(filled.numpy(), order=3, mode="mirror")
            padded = np.pad(own, PAD, mode="reflect")  # PyTorch's takes no more rows than there are
            coefficients[i, : h + 2 * PAD, : w + 2 * PAD] = torch.from_numpy(padded).float()
        self.coefficients = coefficients.flatten()
        self.sizes = torch.tensor(sizes)
        terms = (DEGREE + 1) * (DEGREE + 2) // 2
        self.brightness = torch.zeros(views, 2, terms)
        """(view, 2, k) coefficients of gain and offset."""
        self.brightness[:, 0, 0] = 1

    def to(self, device: torch.device) -> None:
        """Move the pictures to a device."""
        for name in ("coefficients", "good", "sizes", "brightness"):
            setattr(self, name, getattr(self, name).to(device))

    def seen(
        self, view: Int[Tensor, " n"], pixel: Float[Tensor, "n 2"], d: Float[Tensor, "n 2"]
    ) -> Float[Tensor, " n"]:
        """Return g reference(p - d) + o.

        Parameters
        ----------
        view : numbers of the views
        pixel : p, (column, row)
        d : displacement, px
        """
        gain, offset = self.gain_and_offset(view, pixel)
        return gain * self.at(view, pixel - d) + offset

    def at(self, view: Int[Tensor, " n"], place: Float[Tensor, "n 2"]) -> Float[Tensor, " n"]:
        """Return the reference at places (column, row); beyond its edges the value there."""
        return self._sum(view, place, False)[0]

    def slope(self, view: Int[Tensor, " n"], place: Float[Tensor, "n 2"]) -> Float[Tensor, "n 2"]:
        """Return the gradient of the reference along columns and rows, grey values a px."""
        return torch.stack(self._sum(view, place, True), dim=-1)

    def known(self, view: Int[Tensor, " n"], place: Float[Tensor, "n 2"]) -> Bool[Tensor, " n"]:
        """Return where places are within a picture that was seen there."""
        self._follow(place)
        last = self.sizes[view.long()].flip(-1) - 1
        inside = ((place >= 0) & (place <= last)).all(dim=-1)
        column, row = place.nan_to_num(0.0).round().long().clamp(min=0).minimum(last).unbind(-1)
        return inside & self.good[view.long(), row, column]

    def gain_and_offset(
        self, view: Int[Tensor, " n"], pixel: Float[Tensor, "n 2"]
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Return g and o at pixels."""
        self._follow(pixel)
        both = torch.einsum("nk,nck->nc", self._terms(view, pixel), self.brightness[view.long()])
        return both[:, 0], both[:, 1]

    def fit(
        self,
        view: Int[Tensor, " n"],
        pixel: Float[Tensor, "n 2"],
        d: Float[Tensor, "n 2"],
        flow: Float[Tensor, " n"],
        inverse_sigma: Float[Tensor, " n"],
    ) -> None:
        """Fit gain and offset of every view that has pixels to the flow picture, given the displacement there.

            min over a, b of sum w^2 (flow - sum_k (a_k P_k reference(p - d) + b_k P_k))^2,     P_k Legendre's

        Pixels far off count less (Huber); the terms beyond the constants are kept small where little is known.
        """
        self._follow(pixel)
        moved, known, terms = self.at(view, pixel - d), self.known(view, pixel - d), self._terms(view, pixel)
        for i in view.unique().tolist():
            own = (view == i) & known & flow.isfinite() & inverse_sigma.isfinite() & (inverse_sigma > 0)
            if int(own.sum()) < 4 * terms.shape[1]:
                continue
            if int(own.sum()) > MOST:
                drawn = torch.rand(len(own), generator=torch.Generator().manual_seed(i))
                own &= (drawn < MOST / int(own.sum())).to(own.device)
            p, w, y = terms[own].double(), inverse_sigma[own].double(), flow[own].double()
            scale = moved[own].double().std().clamp(min=1e-9)
            matrix = torch.cat([p * (moved[own].double() / scale)[:, None], p], dim=1)
            small = torch.full((matrix.shape[1],), RIDGE, dtype=torch.float64, device=p.device)
            small[0] = small[p.shape[1]] = 0
            less = torch.ones_like(w)
            for _ in range(ROUNDS):
                weighted = matrix * (w * less)[:, None]
                normal = weighted.T @ weighted + torch.diag(small * (w.square().sum()))
                found = torch.linalg.solve(normal, weighted.T @ (y * w * less))
                left = ((y - matrix @ found) * w).abs()
                spread = 1.4826 * left.median().clamp(min=1e-12)
                less = (OUTLIER * spread / left.clamp(min=1e-12)).clamp(max=1).sqrt()
            gain, offset = found.float().split(p.shape[1])
            self.brightness[i] = torch.stack([gain / scale.float(), offset])

    def match(self, flow: Float[Tensor, "view row column"]) -> None:
        """Set gain and offset of every view so that mean and spread of the reference are those of the flow picture."""
        for i, (h, w) in enumerate(self.sizes.tolist()):
            column, row = torch.meshgrid(torch.arange(w), torch.arange(h), indexing="xy")
            place = torch.stack([column, row], dim=-1).reshape(-1, 2).float()
            one = self.at(torch.full((len(place),), i), place)
            other = flow[i, :h, :w].flatten()
            both = other.isfinite() & self.good[i, :h, :w].flatten()
            if int(both.sum()) > 1:
                gain = float(other[both].std() / one[both].std().clamp(min=1e-9))
                self.brightness[i] = 0
                self.brightness[i, 0, 0] = gain
                self.brightness[i, 1, 0] = float(other[both].mean()) - gain * float(one[both].mean())

    def _follow(self, tensor: Tensor) -> None:
        if self.coefficients.device != tensor.device:
            self.to(tensor.device)

    def _sum(self, view: Int[Tensor, " n"], place: Float[Tensor, "n 2"], slope: bool) -> list[Float[Tensor, " n"]]:
        """The spline, or its two slopes."""
        self._follow(place)
        place = place.clamp(min=0).minimum(self.sizes[view.long()].flip(-1).to(place) - 1)
        first = place.detach().nan_to_num(0.0).floor()
        within = place - first
        column, row = first.long().unbind(-1)
        start = view.long() * self.area + (row + PAD - 1) * self.width + column + PAD - 1
        tap = torch.arange(4, device=place.device)
        taken = self.coefficients[start[:, None, None] + tap[:, None] * self.width + tap]  # n row column
        across, down = _weights(within[:, 0]), _weights(within[:, 1])
        if not slope:
            return [torch.einsum("nij,ni,nj->n", taken, down, across)]
        steep = _slopes(within[:, 0]), _slopes(within[:, 1])
        pairs = ((down, steep[0]), (steep[1], across))
        return [torch.einsum("nij,ni,nj->n", taken, rows, columns) for rows, columns in pairs]

    def _terms(self, view: Int[Tensor, " n"], pixel: Float[Tensor, "n 2"]) -> Float[Tensor, "n k"]:
        """Products of Legendre polynomials, the picture mapped to [-1, 1]."""
        half = (self.sizes[view.long()].flip(-1).to(pixel) - 1).clamp(min=1) / 2
        x, y = (_legendre(column) for column in (pixel / half - 1).unbind(-1))
        return torch.stack([x[i] * y[j] for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)], dim=-1)


def _weights(t: Float[Tensor, " n"]) -> Float[Tensor, "n 4"]:
    """Cubic B-splines of the four coefficients around a place, t beyond the second."""
    u = 1 - t
    inner = [4 - 6 * x**2 + 3 * x**3 for x in (t, u)]
    return torch.stack([u**3, inner[0], inner[1], t**3], dim=-1) / 6


def _slopes(t: Float[Tensor, " n"]) -> Float[Tensor, "n 4"]:
    """Their derivatives."""
    u = 1 - t
    return torch.stack([-(u**2), 3 * t**2 - 4 * t, 4 * u - 3 * u**2, t**2], dim=-1) / 2


def _legendre(x: Float[Tensor, " n"]) -> list[Float[Tensor, " n"]]:
    """Legendre polynomials of degree 0 to DEGREE."""
    found = [torch.ones_like(x), x]
    for n in range(1, DEGREE):
        found.append(((2 * n + 1) * x * found[n] - n * found[n - 1]) / (n + 1))
    return found
