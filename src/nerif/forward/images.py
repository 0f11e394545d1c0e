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
from nerif.common.transfer import in_double
from nerif.fields.voxel_field import spline_weights
from nerif.forward.deflection import LeverArm
from nerif.forward.forward_model import ForwardModel, Light, Map, Mask, PerRay, Samples, Weights, masked_blur
from nerif.geometry import Rays

__all__ = [
    "GUESS", "ROUNDING_VARIANCE", "Images", "LinearImages", "References", "difference_variance", "grey_variance",
    "local_mean",
]  # fmt: skip

DEGREE = 4  # total, of the polynomials of gain and offset
RIDGE = 1e-4  # of the weight of a pixel, for every term beyond the constants
ROUNDS, OUTLIER = 3, 3.0  # of the fit; residual in standard deviations, beyond which a pixel counts less
MAX_PIXELS = 1 << 16  # of a view, for the fit of gain and offset
PAD = 2  # rows and columns of the spline beyond the edges, mirrored
GUESS = "displacement_guess"  # map of an approximate displacement, px: the start, and the point of linearisation
ROUNDING_VARIANCE = 1 / 12  # grey values squared
DOTS_PX = 4.0  # standard deviation of the window of local means
MIN_PIXELS = 256  # to decide whether there is a pattern
MIN_PATCHES, MAX_PATCH = 64, 4  # with a common displacement: along the shorter side of an image; their edge, px

PerPixel = Float[Tensor, " n"]
Positions = Float[Tensor, "n 2"]  # (column, row), px
Views = Int[Tensor, " n"]
Grey = Float[np.ndarray, "row column"]


class References:
    """The images without flow of all views.

    Parameters
    ----------
    images : (view, row, column) grey values; NaN where not valid
    sizes : (height, width) of each view's image, px; the rest is padding
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
            spline = spline_filter(filled.numpy(), order=3, mode="mirror")
            padded = np.pad(spline, PAD, mode="reflect")  # PyTorch's is limited to the number of rows
            coefficients[i, : h + 2 * PAD, : w + 2 * PAD] = torch.from_numpy(padded).float()
        self.coefficients = coefficients.flatten()
        self.sizes = torch.tensor(sizes)
        terms = (DEGREE + 1) * (DEGREE + 2) // 2
        self.brightness = torch.zeros(views, 2, terms)  # coefficients of gain and offset
        self.brightness[:, 0, 0] = 1

    def flow_at(self, view: Views, pixel: Positions, d: Positions) -> PerPixel:
        """Return g reference(p - d) + o at pixels p with displacements d, px."""
        gain, offset = self.gain_and_offset(view, pixel)
        return gain * self.at(view, pixel - d) + offset

    def at(self, view: Views, place: Positions) -> PerPixel:
        """Return the reference at positions; beyond its edges the value at the edge."""
        taps, (across, _), (down, _) = self._taps(view, place)
        return torch.einsum("nij,ni,nj->n", taps, down, across)

    def slope(self, view: Views, place: Positions) -> Float[Tensor, "n 2"]:
        """Return the gradient of the reference along columns and rows, grey values per px."""
        taps, (across, steep_across), (down, steep_down) = self._taps(view, place)
        pairs = ((down, steep_across), (steep_down, across))
        return torch.stack([torch.einsum("nij,ni,nj->n", taps, rows, columns) for rows, columns in pairs], dim=-1)

    def covers(self, view: Views, place: Positions) -> Bool[Tensor, " n"]:
        """Return whether positions are within the image, and valid there."""
        self._follow(place)
        last = self.sizes[view.long()].flip(-1) - 1
        inside = ((place >= 0) & (place <= last)).all(dim=-1)
        column, row = place.nan_to_num(0.0).round().long().clamp(min=0).minimum(last).unbind(-1)
        return inside & self.good[view.long(), row, column]

    def gain_and_offset(self, view: Views, pixel: Positions) -> tuple[PerPixel, PerPixel]:
        """Return g and o at pixels."""
        self._follow(pixel)
        both = torch.einsum("nk,nck->nc", self._terms(view, pixel), self.brightness[view.long()])
        return both[:, 0], both[:, 1]

    def fit(self, view: Views, pixel: Positions, d: Positions, flow: PerPixel, inverse_sigma: PerPixel) -> None:
        """Fit gain and offset of every view with enough pixels to its flow image, for given displacements.

            min over a, b of sum w^2 (flow - sum_k (a_k P_k reference(p - d) + b_k P_k))^2,     P_k Legendre polynomials

        Outliers count less (Huber); terms beyond the constants are regularised.
        """
        self._follow(pixel)
        reference, valid, terms = self.at(view, pixel - d), self.covers(view, pixel - d), self._terms(view, pixel)
        for i in view.unique().tolist():
            used = (view == i) & valid & flow.isfinite() & inverse_sigma.isfinite() & (inverse_sigma > 0)
            if int(used.sum()) < 4 * terms.shape[1]:
                continue
            if int(used.sum()) > MAX_PIXELS:
                random = torch.rand(len(used), generator=torch.Generator().manual_seed(i))
                used &= (random < MAX_PIXELS / int(used.sum())).to(used.device)
            p, w, y, image = (in_double(x[used]) for x in (terms, inverse_sigma, flow, reference))
            scale = image.std().clamp(min=1e-9)
            matrix = torch.cat([p * (image / scale)[:, None], p], dim=1)
            ridge = torch.full((matrix.shape[1],), RIDGE, dtype=torch.float64, device=p.device)
            ridge[0] = ridge[p.shape[1]] = 0
            less = torch.ones_like(w)
            for _ in range(ROUNDS):
                weighted = matrix * (w * less)[:, None]
                normal = weighted.T @ weighted + torch.diag(ridge * (w.square().sum()))
                solution = torch.linalg.solve(normal, weighted.T @ (y * w * less))
                residual = ((y - matrix @ solution) * w).abs()
                spread = 1.4826 * residual.median().clamp(min=1e-12)
                less = (OUTLIER * spread / residual.clamp(min=1e-12)).clamp(max=1).sqrt()
            gain, offset = solution.float().split(p.shape[1])
            self.brightness[i] = torch.stack([gain / scale.float(), offset]).to(self.brightness)

    def match(self, flow: Float[Tensor, "view row column"]) -> None:
        """Set constant gain and offset such that mean and standard deviation are those of the flow image."""
        for i, (h, w) in enumerate(self.sizes.tolist()):
            _, _, place = _pixels(h, w)
            one = self.at(torch.full((len(place),), i), place)
            other = flow[i, :h, :w].flatten()
            both = other.isfinite() & self.good[i, :h, :w].flatten()
            if int(both.sum()) > 1:
                gain = float(other[both].std() / one[both].std().clamp(min=1e-9))
                self.brightness[i] = 0
                self.brightness[i, 0, 0] = gain
                self.brightness[i, 1, 0] = float(other[both].mean()) - gain * float(one[both].mean())

    def _follow(self, tensor: Tensor) -> None:
        """Move the images to the device of a tensor."""
        if self.coefficients.device != tensor.device:
            for name in ("coefficients", "good", "sizes", "brightness"):
                setattr(self, name, getattr(self, name).to(tensor.device))

    def _taps(self, view: Views, place: Positions) -> tuple[Tensor, tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
        """The 4 x 4 coefficients around positions (n, row, column), and weights and slopes across and down (n, 4)."""
        self._follow(place)
        place = place.clamp(min=0).minimum(self.sizes[view.long()].flip(-1).to(place) - 1)
        first = place.detach().nan_to_num(0.0).floor()
        within = place - first
        column, row = first.long().unbind(-1)
        start = view.long() * self.area + (row + PAD - 1) * self.width + column + PAD - 1
        tap = torch.arange(4, device=place.device)
        taps = self.coefficients[start[:, None, None] + tap[:, None] * self.width + tap]
        return taps, spline_weights(within[:, 0], 3), spline_weights(within[:, 1], 3)

    def _terms(self, view: Views, pixel: Positions) -> Float[Tensor, "n k"]:
        """Products of Legendre polynomials, the image mapped to [-1, 1]."""
        half = (self.sizes[view.long()].flip(-1).to(pixel) - 1).clamp(min=1) / 2
        x, y = (_legendre(column) for column in (pixel / half - 1).unbind(-1))
        return torch.stack([x[i] * y[j] for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)], dim=-1)


def _legendre(x: PerPixel) -> list[PerPixel]:
    """Legendre polynomials of degree 0 to DEGREE."""
    polynomials = [torch.ones_like(x), x]
    for n in range(1, DEGREE):
        polynomials.append(((2 * n + 1) * x * polynomials[n] - n * polynomials[n - 1]) / (n + 1))
    return polynomials


def _pixels(height: int, width: int, mask: Tensor | None = None) -> tuple[Tensor, Tensor, Positions]:
    """Rows, columns and positions of all pixels, or of those of a mask, row by row."""
    mask = torch.ones(height, width, dtype=torch.bool) if mask is None else mask
    row, column = mask.nonzero().unbind(-1)
    return row, column, torch.stack([column, row], dim=-1).float()


@dataclass(frozen=True, eq=False)
class Images(LeverArm):
    """Grey values of the flow image, as those of the displaced reference image.

    The path integral is that of `integral`; the data of a reconstruction own the images, which compare it with the
    grey values of every pixel of a patch (`residual`). Nuisance parameters are gain and offset of every view.
    """

    name = "images"
    measured, sigma = "flow", "image_sigma"
    beside = MappingProxyType({"reference": (1, "grey value"), GUESS: (2, "px")})
    channels = ("",)
    unit = "grey value"
    misscaled = "another exposure"
    limits = (1e-9, 1e9)
    traced = windowed = linear = False
    derived = "deflection"
    outlier = 0.75  # sigma, beyond which the loss is linear (Huber): splines at a sharp pattern err with long tails

    maps: Mapping[str, Tensor] = field(default_factory=dict)
    sizes: Sequence[tuple[int, int]] = ()  # (height, width) of each view, px

    @classmethod
    def of(cls, light: Light, model: str) -> Images:
        reference, flow = light.maps.get("reference"), light.maps.get(cls.measured)
        if reference is None or flow is None:
            raise InputError(
                "expected images without flow (variable reference) beside those with it (flow), got none; "
                "nerif displacement writes both",
                field="reference",
            )
        return cls(light.n_ambient, light.maps, tuple(camera.image_size for camera in light.cameras))

    @classmethod
    def check(cls, values: Map, sigma: Map | None, usable: Mask) -> None:
        if int(usable.sum()) >= MIN_PIXELS and not float(values[usable].std(correction=0)) > 0:
            raise InputError("expected an image of a pattern, got one of a single grey", field="flow")

    @cached_property
    def references(self) -> References:
        """The reference images, with gain and offset of the flow images."""
        references = References(self.maps["reference"], self.sizes)
        references.match(self.maps["flow"])
        if GUESS in self.maps:
            for i in range(len(self.sizes)):
                view, row, column, pixel, flow = self._flow_pixels(i)
                guess = self.maps[GUESS][i, row, column].nan_to_num(0.0)
                references.fit(view, pixel, guess, flow, self._inverse_sigma(i, row, column))
        return references

    def _flow_pixels(self, i: int) -> tuple[Tensor, Tensor, Tensor, Positions, PerPixel]:
        """View, row, column, position and value of the valid pixels of a flow image."""
        height, width = self.sizes[i]
        row, column, pixel = _pixels(height, width, self.maps["flow"][i, :height, :width].isfinite())
        return torch.full_like(row, i), row, column, pixel, self.maps["flow"][i, row, column]

    @property
    def constants(self) -> dict[str, Any]:
        return {"n_ambient": self.n_ambient, **{name: self.maps.get(name) for name in self.beside}}

    @property
    def integral(self) -> LeverArm:
        """The model of the displacement."""
        return LeverArm(self.n_ambient)

    @property
    def patch(self) -> int:
        """Edge (px) of the squares of pixels that share one ray, each with its own value."""
        shortest = min(min(size) for size in self.sizes)
        return min(max(1, shortest // MIN_PATCHES), MAX_PATCH)

    @property
    def linear_twin(self) -> ForwardModel:
        return LinearImages(self.n_ambient, self.maps, self.sizes)

    def residual(self, prediction: PerRay, measured: PerRay, rays: Rays) -> PerRay:
        """Return the residual of every pixel of a ray's patch; 0 where the reference is not valid."""
        view, pixel = _of_patches(rays, measured.shape[1])
        d = prediction.repeat_interleave(measured.shape[1], dim=0)
        valid = self.references.covers(view, pixel - d.detach())
        residual = self.references.flow_at(view, pixel, d) - measured.flatten()
        return torch.where(valid | d.isnan().any(dim=-1), residual, 0.0).reshape(measured.shape)

    def fit_nuisance(self, prediction: PerRay, measured: PerRay, inverse_sigma: PerRay, rays: Rays) -> None:
        """Fit gain and offset to predicted displacements."""
        view, pixel = _of_patches(rays, measured.shape[1])
        d = prediction.repeat_interleave(measured.shape[1], dim=0)
        self.references.fit(view, pixel, d, measured.flatten(), inverse_sigma.flatten())

    @property
    def nuisance(self) -> Tensor:
        """The coefficients of gain and offset, view by view."""
        return self.references.brightness

    def set_nuisance(self, nuisance: Tensor) -> None:
        """Set them to those of another fit."""
        self.references.brightness = nuisance.to(self.references.brightness)

    @classmethod
    def complete(cls, maps: Mapping[str, Tensor], attributes: Mapping[str, Any]) -> dict[str, Tensor]:
        """Return the maps, with image_sigma from the camera noise in the attributes, if the file has that instead.

        By `difference_variance`, read = read_noise^2 and shot = 1 / electrons_per_grey_value, with one reference.
        """
        names, defaults = ("read_noise", "electrons_per_grey_value"), (0.0, math.inf)
        if cls.sigma in maps or "reference" not in maps or not any(name in attributes for name in names):
            return dict(maps)
        views, of_view = len(maps[cls.measured]), []
        for name, default in zip(names, defaults, strict=True):
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
            variance = difference_variance(one, other, read**2, 1 / electrons, _contrast_ratio(one, other))
            sigma[i] = torch.where(flow.isfinite(), torch.from_numpy(variance).sqrt().to(flow), math.nan)
        return {**maps, cls.sigma: sigma}

    @classmethod
    def blur(cls, maps: Mapping[str, Tensor], sizes: Sequence[tuple[int, int]], px: float) -> dict[str, Tensor]:
        """Return maps of views of (height, width) px, of which the images are blurred by a Gaussian."""

        def blurred(image: Float[Tensor, "row column"], squares: bool) -> Tensor:
            good = image.isfinite()
            mean = masked_blur((image.double().square() if squares else image)[..., None], good, px)[..., 0]
            # the mean over 4 pi px^2 pixels reduces the variance
            mean = (mean / max(4 * math.pi * px**2, 1.0)).sqrt() if squares else mean
            return torch.where(good, mean, math.nan).float()

        result = dict(maps)
        for name in ("reference", cls.measured, cls.sigma):
            if name in maps:
                result[name] = torch.full_like(maps[name], math.nan)
                for i, (height, width) in enumerate(sizes):
                    result[name][i, :height, :width] = blurred(maps[name][i, :height, :width], name == cls.sigma)
        return result

    def to_map(self, integral: Map, view: int) -> Map:
        """Return the flow image of displacements, with gain and offset fitted to the measured one."""
        height, width, _ = integral.shape
        row, column, pixel = _pixels(height, width)
        number, d = torch.full((len(pixel),), view), integral.reshape(-1, 2).float()
        flow = self.maps["flow"][view, :height, :width].reshape(-1)
        self.references.fit(number, pixel, d, flow, self._inverse_sigma(view, row, column))
        return self.references.flow_at(number, pixel, d).reshape(height, width, 1)

    def _inverse_sigma(self, view: int, row: Tensor, column: Tensor) -> PerPixel:
        """One over sigma at pixels of a view; 1 without sigma."""
        if self.sigma not in self.maps:
            return torch.ones(len(row))
        return 1 / self.maps[self.sigma][view, row, column]

    def field_scale(self, rays: Rays, measured: PerRay) -> float:
        return self.integral.field_scale(rays, torch.full((len(rays), 2), self._rms_displacement()))

    def _rms_displacement(self) -> float:
        """The rms displacement, px: the approximate one, else the difference of the images over their gradient."""
        if GUESS in self.maps:
            d = self.maps[GUESS]
            return float(d[d.isfinite().all(dim=-1)].square().mean().sqrt())
        change, steep = [], []
        for i in range(len(self.sizes)):
            view, _, _, pixel, flow = self._flow_pixels(i)
            change.append((self.references.flow_at(view, pixel, torch.zeros_like(pixel)) - flow).square())
            gain, _ = self.references.gain_and_offset(view, pixel)
            steep.append((gain[:, None] * self.references.slope(view, pixel)).square().mean(dim=-1))
        return float((torch.cat(change).mean() / torch.cat(steep).mean().clamp(min=1e-30) / 2).sqrt())


@dataclass(frozen=True, eq=False)
class LinearImages(Images):
    """Images linearised about the approximate displacement, or about 0."""

    linear = True

    @property
    def linear_twin(self) -> ForwardModel:
        return self

    def weights(self, rays: Rays, s: Samples, step: Samples) -> Weights:
        plain = super().weights(rays, s, step)
        assert plain.slope is not None
        steep = -self._slope(rays).to(plain.slope)
        return Weights(plain.profile, slope=torch.einsum("ni,nij->nj", steep, plain.slope)[:, None])

    def reading(self, values: PerRay, sigma: PerRay | None, rays: Rays) -> tuple[PerRay, PerRay | None]:
        """Return flow - g reference(p - d_0) - o - g grad(reference) . d_0; 0 where the reference is not valid."""
        guess = self._guess(rays)
        flow = self.references.flow_at(rays.view, rays.pixel.float(), guess)
        difference = values[:, 0] - flow - (self._slope(rays) * guess).sum(dim=-1)
        valid = self.references.covers(rays.view, rays.pixel.float() - guess)
        return torch.where(valid, difference, 0.0)[:, None], sigma

    def _guess(self, rays: Rays) -> Positions:
        if GUESS not in self.maps:
            return torch.zeros(len(rays), 2, device=rays.pixel.device)
        column, row = rays.pixel.round().long().cpu().unbind(-1)
        return self.maps[GUESS][rays.view.long().cpu(), row, column].nan_to_num(0.0).to(rays.pixel.device)

    def _slope(self, rays: Rays) -> Float[Tensor, "n 2"]:
        """g grad(reference) at p - d_0; 0 where the reference is not valid."""
        pixel = rays.pixel.float()
        place = pixel - self._guess(rays).to(pixel)
        gain, _ = self.references.gain_and_offset(rays.view, pixel)
        valid = self.references.covers(rays.view, place)
        return torch.where(valid[:, None], gain[:, None] * self.references.slope(rays.view, place), 0.0)


def _of_patches(rays: Rays, pixels: int) -> tuple[Tensor, Float[Tensor, "m 2"]]:
    """The views and pixels of the patches of rays, row by row."""
    edge = math.isqrt(pixels)
    corner = ((rays.pixel + 0.5) / edge).floor() * edge if edge > 1 else rays.pixel
    within = torch.arange(edge, device=corner.device).to(corner)
    row, column = torch.meshgrid(within, within, indexing="ij")
    pixel = corner[:, None] + torch.stack([column, row], dim=-1).reshape(-1, 2)
    return rays.view.repeat_interleave(pixels), pixel.reshape(-1, 2)


def grey_variance(grey: Grey, read: float, shot: float) -> Grey:
    """Return the variance of grey values: read + shot max(grey, 0), read at least that of rounding."""
    return max(read, ROUNDING_VARIANCE) + shot * np.maximum(grey, 0)


def difference_variance(flow: Grey, reference: Grey, read: float, shot: float, gain: float, repeats: int = 1) -> Grey:
    """Return <var(flow) + gain^2 var(reference) / repeats>, averaged over the dots around each pixel.

    Parameters
    ----------
    flow, reference : grey values; NaN where not valid
    read, shot : variance without light, grey values squared, and its increase per grey value
    gain : factor from the brightness of the reference to that of the flow image
    repeats : images averaged in the reference
    """
    return local_mean(grey_variance(flow, read, shot) + gain**2 * grey_variance(reference, read, shot) / repeats)


def local_mean(squares: Grey) -> Grey:
    """Return the mean of finite values over the dots around each pixel; NaN where there are none."""
    from scipy.ndimage import gaussian_filter

    squares, finite = squares.astype(np.float64), np.isfinite(squares)
    if bool(finite.all()):
        return np.asarray(gaussian_filter(squares, DOTS_PX))
    total, share = (gaussian_filter(x, DOTS_PX) for x in (np.where(finite, squares, 0.0), finite.astype(np.float64)))
    return np.where(share > 1e-6, total / np.maximum(share, 1e-6), np.nan)


def _contrast_ratio(flow: Grey, reference: Grey) -> float:
    """Contrast of the flow image over that of the reference; 1 if the latter is 0."""
    both = np.isfinite(flow) & np.isfinite(reference)
    spread = float(reference[both].std()) if bool(both.any()) else 0.0
    return float(flow[both].std()) / spread if spread > 0 else 1.0
