"""Background-oriented schlieren from images, without optical flow: the flow image against the displaced reference.

    flow(p) = g(p) reference(p - d(p)) + o(p),     d the path integral of deflection (deflection.py)

Every pixel has its measured value and the camera noise. The reference between pixels is its cubic B-spline. Gain g and
offset o vary slowly over an image, because of flickering light and flame emission: polynomials of DEGREE, fitted for
each view. About a known displacement d_0 (from correlation windows, or 0) the difference is linear in the field:

    g reference(p - d) = g reference(p - d_0) - g grad(reference)(p - d_0) . (d - d_0)

Source: Grauer and Steinberg, Exp. Fluids 61 (2020) 80 (unified BOS, linear); the displaced form is nonlinear.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerif.common.conventions import InputError
from nerif.forward.base import ForwardModel, Light, Weights
from nerif.forward.deflection import LeverArm
from nerif.geometry import Rays

__all__ = ["LEAST", "Images", "LinearImages", "References", "around", "difference_variance", "grey_variance"]

DEGREE = 4
"""Of the polynomials of gain and offset, in total."""
RIDGE = 1e-4  # of what a pixel weighs, for every term beyond the constants
ROUNDS, OUTLIER = 3, 3.0  # of the fit; residuals, in standard deviations, beyond which a pixel counts less
MOST = 1 << 16  # pixels of a view that tell its gain and offset
PAD = 2  # rows and columns that the spline takes beyond the edges, mirrored


class References:
    """The images without flow of all views.

    Parameters
    ----------
    images : (view, row, column) grey values; NaN where not seen
    sizes : (height, width) of each view's image, px; what is beyond is padding
    """

    def __init__(self, images: Float[Tensor, "view row column"], sizes: Sequence[tuple[int, int]]) -> None:
        from scipy.ndimage import spline_filter

        views, height, width = images.shape
        self.width = width + 2 * PAD
        self.area = (height + 2 * PAD) * self.width
        coefficients = torch.zeros(views, height + 2 * PAD, self.width)
        self.good = torch.zeros(views, height, width, dtype=torch.bool)
        for i, (h, w) in enumerate(sizes):
            image = images[i, :h, :w].double()
            self.good[i, :h, :w] = good = image.isfinite()
            filled = torch.where(good, image, image[good].mean() if bool(good.any()) else 0.0)
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
        """Move the images to a device."""
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
        """Return where places are within an image that was seen there."""
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
        """Fit gain and offset of every view that has pixels to the flow image, given the displacement there.

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
        """Set gain and offset of every view so that mean and spread of the reference are those of the flow image."""
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
        """Products of Legendre polynomials, the image mapped to [-1, 1]."""
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


GUESS = "displacement_guess"
"""Map of what the displacement is about, px: where to begin, and where to be linear."""
LEAST = 1 / 12
"""Variance of rounding, grey values squared."""
AROUND = 4.0  # px, standard deviation of the window of means

FEWEST = 256  # pixels that show whether there is a pattern
PATCHES, LARGEST_PATCH = 64, 4
"""Patches that an image keeps along its shorter side, and their largest edge, px: a displacement for each."""


@dataclass(frozen=True, eq=False)
class Images(LeverArm):
    """Grey values of the flow image, by the reference image moved.

    Parameters
    ----------
    n_ambient : refractive index the excess is counted from
    maps : reference, flow and, if something is known of it, the displacement, by their names
    sizes : (height, width) of each view, px
    """

    name = "images"
    measured, sigma = "flow", "image_sigma"
    beside = MappingProxyType({"reference": (1, "grey value"), GUESS: (2, "px")})
    channels = ("",)
    integrals = 2
    unit = "grey value"
    misscaled = "another exposure"
    limits = (1e-9, 1e9)
    traced = False
    windowed = False
    linear = False
    averaged = False
    derived, guess = "deflection", GUESS
    outlier = 0.75  # what splines miss of a sharp pattern has long tails
    settles = True

    maps: Mapping[str, Tensor] = field(default_factory=dict)
    sizes: Sequence[tuple[int, int]] = ()

    @classmethod
    def of(cls, light: Light, model: str) -> ForwardModel:
        reference, flow = light.maps.get("reference"), light.maps.get(cls.measured)
        if reference is None or flow is None:
            raise InputError(
                "expected images without flow (variable reference) beside those with it (flow), got none; "
                "nerif displacement writes both",
                field="reference",
            )
        return cls(light.n_ambient, light.maps, tuple(camera.image_size for camera in light.cameras))

    @classmethod
    def check(
        cls,
        values: Float[Tensor, "row column c"],
        sigma: Float[Tensor, "row column c"] | None,
        usable: Bool[Tensor, "row column"],
    ) -> None:
        if int(usable.sum()) >= FEWEST and not float(values[usable].std(correction=0)) > 0:
            raise InputError("expected an image of a pattern, got one of a single grey", field="flow")

    @cached_property
    def references(self) -> References:
        """The reference images, as bright as the flow images."""
        found = References(self.maps["reference"], self.sizes)
        found.match(self.maps["flow"])
        if GUESS in self.maps:
            for i, (height, width) in enumerate(self.sizes):
                row, column = self.maps["flow"][i, :height, :width].isfinite().nonzero().unbind(-1)
                view, flow = torch.full_like(row, i), self.maps["flow"][i, row, column]
                pixel = torch.stack([column, row], dim=-1).float()
                guess = self.maps[GUESS][i, row, column].nan_to_num(0.0)
                found.fit(view, pixel, guess, flow, self._inverse_sigma(i, row, column))
        return found

    @property
    def constants(self) -> dict[str, Any]:
        return {"n_ambient": self.n_ambient, **{name: self.maps.get(name) for name in self.beside}}

    @property
    def integral(self) -> ForwardModel:
        return LeverArm(self.n_ambient)

    @property
    def patch(self) -> int:
        shortest = min(min(size) for size in self.sizes)
        return min(max(1, shortest // PATCHES), LARGEST_PATCH)

    @property
    def linear_twin(self) -> ForwardModel:
        return LinearImages(self.n_ambient, self.maps, self.sizes)

    def read(self, prediction: Float[Tensor, "n k"], rays: Rays) -> Float[Tensor, "n c"]:
        return self.references.seen(rays.view, rays.pixel, prediction)[:, None]

    def residual(
        self, prediction: Float[Tensor, "n k"], measured: Float[Tensor, "n c"], rays: Rays
    ) -> Float[Tensor, "n c"]:
        """Return the difference at every pixel of a ray's patch; 0 where what is seen lies beyond the reference."""
        view, pixel = _of_patches(rays, measured.shape[1])
        d = prediction.repeat_interleave(measured.shape[1], dim=0)
        known = self.references.known(view, pixel - d.detach())
        left = self.references.seen(view, pixel, d) - measured.flatten()
        return torch.where(known | d.isnan().any(dim=-1), left, 0.0).reshape(measured.shape)

    def settle(
        self,
        prediction: Float[Tensor, "n k"],
        measured: Float[Tensor, "n c"],
        inverse_sigma: Float[Tensor, "n c"],
        rays: Rays,
    ) -> None:
        """Fit gain and offset of every view to what is predicted."""
        view, pixel = _of_patches(rays, measured.shape[1])
        d = prediction.repeat_interleave(measured.shape[1], dim=0)
        self.references.fit(view, pixel, d, measured.flatten(), inverse_sigma.flatten())

    @property
    def settled(self) -> Tensor:
        return self.references.brightness

    def adopt(self, settled: Tensor) -> None:
        self.references.brightness = settled.to(self.references.brightness)

    @classmethod
    def completed(cls, maps: Mapping[str, Tensor], attributes: Mapping[str, Any]) -> dict[str, Tensor]:
        """Return the maps, with image_sigma by the noise of the cameras where a file tells that instead.

        That of `difference_variance`, read = read_noise^2 and shot = 1 / electrons_per_grey_value, by one reference.
        """
        names, otherwise = ("read_noise", "electrons_per_grey_value"), (0.0, math.inf)
        if cls.sigma in maps or "reference" not in maps or not any(name in attributes for name in names):
            return dict(maps)
        views, of_view = len(maps[cls.measured]), []
        for name, default in zip(names, otherwise, strict=True):
            value = np.asarray(attributes.get(name, default))
            good = value.dtype.kind in "fiu" and value.shape in ((), (1,), (views,))
            if not good or not bool(np.all(value > 0 if name == names[1] else value >= 0)):
                raise InputError(
                    f"expected a number, or one for each of {views} views, got {value}", field=f"attribute {name}"
                )
            of_view.append(np.broadcast_to(value.astype(np.float64), (views,)))
        sigma = torch.full_like(maps[cls.measured], math.nan)
        for i, (flow, reference) in enumerate(zip(maps[cls.measured], maps["reference"], strict=True)):
            one, other, read, electrons = flow.numpy(), reference.numpy(), of_view[0][i], of_view[1][i]
            variance = difference_variance(one, other, read**2, 1 / electrons, _gain(one, other))
            sigma[i] = torch.where(flow.isfinite(), torch.from_numpy(variance).sqrt().to(flow), math.nan)
        return {**maps, cls.sigma: sigma}

    @classmethod
    def softened(cls, maps: Mapping[str, Tensor], sizes: Sequence[tuple[int, int]], px: float) -> dict[str, Tensor]:
        from scipy.ndimage import gaussian_filter

        def blurred(image: Float[Tensor, "row column"], squares: bool) -> Tensor:
            good = image.isfinite()
            weight = torch.from_numpy(gaussian_filter(good.double().numpy(), px)).clamp(min=1e-6)
            filled = torch.where(good, image, 0.0).double()
            filled = filled.square() if squares else filled
            mean = torch.from_numpy(gaussian_filter(filled.numpy(), px)) / weight
            # so many pixels have that much less of the noise
            mean = (mean / max(4 * math.pi * px**2, 1.0)).sqrt() if squares else mean
            return torch.where(good, mean, math.nan).float()

        found = dict(maps)
        for name in ("reference", cls.measured, cls.sigma):
            if name in maps:
                found[name] = torch.full_like(maps[name], math.nan)
                for i, (height, width) in enumerate(sizes):
                    found[name][i, :height, :width] = blurred(maps[name][i, :height, :width], name == cls.sigma)
        return found

    def prepare(self) -> None:
        """Build the references: `mapped` fits the brightness of its own view in them, and they have no lock."""
        _ = self.references

    def mapped(self, integral: Float[Tensor, "row column k"], view: int) -> Float[Tensor, "row column c"]:
        """Return the flow image that displacements make, gain and offset fitted to the one that was taken."""
        height, width, _ = integral.shape
        row, column = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        pixel = torch.stack([column, row], dim=-1).reshape(-1, 2).float()
        number, d = torch.full((len(pixel),), view), integral.reshape(-1, 2).float()
        flow = self.maps["flow"][view, :height, :width].reshape(-1)
        weight = self._inverse_sigma(view, row.flatten(), column.flatten())
        self.references.fit(number, pixel, d, flow, weight)
        return self.references.seen(number, pixel, d).reshape(height, width, 1)

    def _inverse_sigma(self, view: int, row: Tensor, column: Tensor) -> Float[Tensor, " n"]:
        """One over sigma at pixels of a view; 1 where it is not known of the measurement."""
        if self.sigma not in self.maps:
            return torch.ones(len(row))
        return 1 / self.maps[self.sigma][view, row, column]

    def field_scale(self, rays: Rays, measured: Float[Tensor, "n c"]) -> float:
        return self.integral.field_scale(rays, torch.full((len(rays), 2), self._displaced()))

    def _displaced(self) -> float:
        """The rms displacement, px: as guessed, else by the difference of the images over their gradient."""
        if GUESS in self.maps:
            d = self.maps[GUESS]
            return float(d[d.isfinite().all(dim=-1)].square().mean().sqrt())
        change, steep = [], []
        for i, (height, width) in enumerate(self.sizes):
            row, column = self.maps["flow"][i, :height, :width].isfinite().nonzero().unbind(-1)
            view, pixel = torch.full_like(row, i), torch.stack([column, row], dim=-1).float()
            seen = self.references.seen(view, pixel, torch.zeros_like(pixel))
            change.append((seen - self.maps["flow"][i, row, column]).square())
            gain, _ = self.references.gain_and_offset(view, pixel)
            steep.append((gain[:, None] * self.references.slope(view, pixel)).square().mean(dim=-1))
        return float((torch.cat(change).mean() / torch.cat(steep).mean().clamp(min=1e-30) / 2).sqrt())


@dataclass(frozen=True, eq=False)
class LinearImages(Images):
    """The same, linear around the displacement that is guessed, or around none."""

    linear = True
    integrals = 1
    settles = False
    outlier = math.inf
    patch = 1

    @property
    def linear_twin(self) -> ForwardModel:
        return self

    def weights(self, rays: Rays, s: Float[Tensor, "n m"], step: Float[Tensor, "n m"]) -> Weights:
        plain = super().weights(rays, s, step)
        assert plain.slope is not None
        steep = -self._slope(rays).to(plain.slope)
        return Weights(plain.profile, slope=torch.einsum("ni,nij->nj", steep, plain.slope)[:, None])

    def read(self, prediction: Float[Tensor, "n k"], rays: Rays) -> Float[Tensor, "n c"]:
        return prediction

    def residual(
        self, prediction: Float[Tensor, "n k"], measured: Float[Tensor, "n c"], rays: Rays
    ) -> Float[Tensor, "n c"]:
        return prediction - measured

    def reading(
        self, values: Float[Tensor, "n c"], sigma: Float[Tensor, "n c"] | None, rays: Rays
    ) -> tuple[Float[Tensor, "n c"], Float[Tensor, "n c"] | None]:
        """Return flow - g reference(p - d_0) - o - g grad(reference) . d_0; 0 where that is not known."""
        guess = self._guess(rays)
        seen = self.references.seen(rays.view, rays.pixel.float(), guess)
        left = values[:, 0] - seen - (self._slope(rays) * guess).sum(dim=-1)
        known = self.references.known(rays.view, rays.pixel.float() - guess)
        return torch.where(known, left, 0.0)[:, None], sigma

    def _guess(self, rays: Rays) -> Float[Tensor, "n 2"]:
        if GUESS not in self.maps:
            return torch.zeros(len(rays), 2, device=rays.pixel.device)
        column, row = rays.pixel.round().long().cpu().unbind(-1)
        return self.maps[GUESS][rays.view.long().cpu(), row, column].nan_to_num(0.0).to(rays.pixel.device)

    def _slope(self, rays: Rays) -> Float[Tensor, "n 2"]:
        """g grad(reference) at p - d_0; 0 where that is not known."""
        pixel = rays.pixel.float()
        place = pixel - self._guess(rays).to(pixel)
        gain, _ = self.references.gain_and_offset(rays.view, pixel)
        known = self.references.known(rays.view, place)
        return torch.where(known[:, None], gain[:, None] * self.references.slope(rays.view, place), 0.0)


def _of_patches(rays: Rays, pixels: int) -> tuple[Tensor, Float[Tensor, "m 2"]]:
    """The views and pixels of the patches that rays stand for, of so many pixels each, row by row."""
    edge = math.isqrt(pixels)
    corner = ((rays.pixel + 0.5) / edge).floor() * edge if edge > 1 else rays.pixel
    within = torch.arange(edge, device=corner.device).to(corner)
    row, column = torch.meshgrid(within, within, indexing="ij")
    pixel = corner[:, None] + torch.stack([column, row], dim=-1).reshape(-1, 2)
    return rays.view.repeat_interleave(pixels), pixel.reshape(-1, 2)


def grey_variance(grey: Float[np.ndarray, "row column"], read: float, shot: float) -> Float[np.ndarray, "row column"]:
    """Return the variance of grey values: read + shot max(grey, 0), and read no less than that of rounding."""
    return max(read, LEAST) + shot * np.maximum(grey, 0)


def difference_variance(
    flow: Float[np.ndarray, "row column"],
    reference: Float[np.ndarray, "row column"],
    read: float,
    shot: float,
    gain: float,
    repeats: int = 1,
) -> Float[np.ndarray, "row column"]:
    """Return <var(flow) + gain^2 var(reference) / repeats>, the mean over the dots around each pixel.

    Parameters
    ----------
    flow, reference : grey values; NaN where not known
    read, shot : variance without light, grey values squared, and what a grey value adds, grey values
    gain : factor that makes the reference as bright as the flow image
    repeats : images that the reference is the mean of
    """
    return around(grey_variance(flow, read, shot) + gain**2 * grey_variance(reference, read, shot) / repeats)


def around(squares: Float[np.ndarray, "row column"]) -> Float[np.ndarray, "row column"]:
    """Return the mean over the dots around each pixel, of what is known; NaN where nothing is."""
    from scipy.ndimage import gaussian_filter

    squares, known = squares.astype(np.float64), np.isfinite(squares)
    if bool(known.all()):
        return np.asarray(gaussian_filter(squares, AROUND))
    total, share = (gaussian_filter(x, AROUND) for x in (np.where(known, squares, 0.0), known.astype(np.float64)))
    return np.where(share > 1e-6, total / np.maximum(share, 1e-6), np.nan)


def _gain(flow: Float[np.ndarray, "row column"], reference: Float[np.ndarray, "row column"]) -> float:
    """How much more contrast the flow image has than the reference; 1 where that cannot be told."""
    both = np.isfinite(flow) & np.isfinite(reference)
    spread = float(reference[both].std()) if bool(both.any()) else 0.0
    return float(flow[both].std()) / spread if spread > 0 else 1.0
