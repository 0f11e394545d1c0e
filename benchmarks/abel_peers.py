"""Inverse Abel transforms of a displacement map, by PyAbel and by a quadrature; peers of one_camera.py.

Rays are assumed parallel, as in these methods: row by row, with F the index excess integrated along a ray at the
distance y from the axis and L the distance of the background from it,

    u = -(L m / n_ambient) dF/dy,      n(r) - n_ambient = -(1 / pi) integral_r^inf dF/dy / sqrt(y^2 - r^2) dy

with m px per mm on the background (not the inverse of the mm per px on the axis, in perspective). In the form
"projection" u is integrated to F, which is transformed; in the form "derivative" dF/dy is used directly.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.interpolate import CubicSpline, make_interp_spline
from scipy.ndimage import gaussian_filter

from benchmarks.runner import peer
from nerif.geometry import Camera, Grid

Array = np.ndarray
Inversion = Callable[["HalfView", float], Float[Array, "row n"]]

SMOOTHING = (0.0, 0.5, 1.0, 2.0, 4.0)
"""Standard deviations of the Gaussian that a displacement map is smoothed by along rows and columns, px."""

ORDERS = {1: "linear", 3: "cubic"}
"""Interpolation of a map between pixels."""


def pyabel() -> Any:
    """Return the package PyAbel."""
    return peer("abel", "PyAbel")


@dataclass(frozen=True)
class ParallelView:
    """View of a flow around a vertical axis, its rays assumed parallel.

    Parameters
    ----------
    axis : column of the axis, px
    horizon : row of the height 0 (of the centre), px
    pixel : mm per px on the axis
    lever : L, axis to background, mm
    scale : m, px per mm on the background
    centre : a point of the axis (x, y, z), mm
    """

    axis: float
    horizon: float
    pixel: float
    lever: float
    scale: float
    centre: tuple[float, float, float]

    @classmethod
    def of(cls, camera: Camera, centre: tuple[float, float, float]) -> ParallelView:
        """Return the view of an upright camera that looks at the centre."""
        point = torch.tensor(centre, dtype=torch.float64)
        column, row = camera.project(point).tolist()
        depth, behind = float(camera.local(point)[2]), camera.depth(camera.plane)
        scale = 1 / float(camera.pixel_size(camera.centre + behind * camera.rotation[2]))
        return cls(column, row, float(camera.pixel_size(point)), behind - depth, scale, centre)

    def heights(self, rows: int) -> Float[Array, " row"]:
        """Return z of every row, mm."""
        return self.centre[2] + (self.horizon - np.arange(rows)) * self.pixel


class HalfView:
    """F and dF/dy of every row, averaged over both halves, by cubic splines between pixels.

    Parameters
    ----------
    displacement : (row, column, 2), px
    view : ParallelView
    n_ambient : 1
    smoothing : standard deviation of a Gaussian along rows and columns, px
    """

    def __init__(
        self, displacement: Float[Array, "row column 2"], view: ParallelView, n_ambient: float, smoothing: float = 0.0
    ) -> None:
        u = np.nan_to_num(displacement[..., 0].astype(np.float64))
        if smoothing:
            u = gaussian_filter(u, smoothing, mode="nearest")
        columns = u.shape[1]
        self.view, self.count = view, math.floor(min(view.axis, columns - 1 - view.axis)) + 1
        slope = -n_ambient / (view.lever * view.scale) * u
        self.spline = CubicSpline(np.arange(columns), slope, axis=1)
        self.integral = self.spline.antiderivative()

    def slope(self, offset: float = 0.0) -> Float[Array, "row n"]:
        """Return dF/dy (1) at y = offset, offset + 1, ... px."""
        y = np.arange(self.count - math.ceil(offset)) + offset
        return 0.5 * (self.spline(self.view.axis + y) - self.spline(self.view.axis - y))

    def projection(self) -> Float[Array, "row n"]:
        """Return F (mm) at y = 0, 1, ... px; 0 at the last."""
        y, axis = np.arange(self.count), self.view.axis
        both = self.integral(axis + y) + self.integral(axis - y)
        return 0.5 * self.view.pixel * (both - both[:, -1:])


def by_pyabel(transform: str, parameter: str = "", **settings: Any) -> Inversion:
    """Return a transform of F by PyAbel, such as "dasch.three_point_transform", and the name of its parameter there."""

    def invert(half: HalfView, value: float) -> Float[Array, "row n"]:
        module, name = transform.split(".")
        parameters = {parameter: int(value) if parameter == "hold_order" else value} if parameter else {}
        function = getattr(getattr(pyabel(), module), name)
        return function(half.projection(), dr=half.view.pixel, **settings, **parameters)

    return invert


def quadrature(half: HalfView, _: float) -> Float[Array, "row n"]:
    """The integral of dF/dy, linear between pixels; Kolhe & Agrawal, Appl. Opt. 48 (2009) 3894."""
    slope = half.slope()
    n = np.zeros_like(slope)
    for i in range(slope.shape[1] - 1):
        y = np.arange(i, slope.shape[1], dtype=np.float64)
        root = np.sqrt(y**2 - i**2)
        logarithm = np.log(np.maximum(y + root, 1))  # on the axis, where its factor dF/dy is 0
        rise = np.diff(slope[:, i:])
        n[:, i] = rise @ np.diff(root) + (slope[:, i:-1] - rise * y[:-1]) @ np.diff(logarithm)
    return -n / math.pi


def daun_of_slope(half: HalfView, strength: float) -> Float[Array, "row n"]:
    """Least squares of Daun et al. with dF/dy between the nodes as data."""
    slope = half.slope(0.5)
    nodes = slope.shape[1] + 1
    forward = pyabel().daun.daun_transform(np.eye(nodes), degree=1, direction="forward", verbose=False)
    matrix = np.diff(forward, axis=1)  # pixels cancel: F has one of y, dF/dy divides by one
    roughness = np.diff(np.eye(nodes), axis=0)
    ends = np.zeros((1, nodes))
    ends[0, -1] = 1.0  # ambient at the last
    system = np.concatenate([matrix.T, math.sqrt(strength) * roughness, ends])
    data = np.concatenate([slope.T, np.zeros((nodes, len(slope)))])
    return np.linalg.lstsq(system, data, rcond=None)[0].T


@dataclass(frozen=True)
class Peer:
    """A method in one of the two forms, projection or derivative.

    Parameters
    ----------
    invert : from a half view and a parameter to the index excess at r = 0, 1, ... px
    parameter : its name; empty for none
    values : of the parameter
    """

    name: str
    form: str
    invert: Inversion
    parameter: str = ""
    values: tuple[float, ...] = (0.0,)

    @property
    def title(self) -> str:
        """Name and form."""
        return f"{self.name}, {self.form}"


STRENGTHS = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)

PEERS = (
    Peer("three-point", "projection", by_pyabel("dasch.three_point_transform", basis_dir=None)),
    Peer("onion peeling", "projection", by_pyabel("dasch.onion_peeling_transform", basis_dir=None)),
    Peer(
        "Hansen-Law", "projection", by_pyabel("hansenlaw.hansenlaw_transform", "hold_order"), "hold order", (0.0, 1.0)
    ),
    Peer(
        "BASEX",
        "projection",
        by_pyabel("basex.basex_transform", "reg", basis_dir=None, verbose=False),
        "reg",
        STRENGTHS,
    ),
    Peer("Daun", "projection", by_pyabel("daun.daun_transform", "reg", degree=1, verbose=False), "reg", STRENGTHS),
    Peer("quadrature", "derivative", quadrature),
    Peer("Daun", "derivative", daun_of_slope, "reg", STRENGTHS),
)
"""Dasch, Appl. Opt. 31 (1992) 1146 (three-point, onion peeling); Hansen & Law, J. Opt. Soc. Am. A 2 (1985) 510;
Dribinski et al., Rev. Sci. Instrum. 73 (2002) 2634 (BASEX); Daun et al., Appl. Opt. 45 (2006) 4638."""


def attempts(
    peer: Peer, displacement: Float[Array, "row column 2"], view: ParallelView, n_ambient: float
) -> Iterator[tuple[str, Float[Array, "row n"]]]:
    """Yield each set of options of a method, in words, and the index excess."""
    for smoothing in SMOOTHING:
        half = HalfView(displacement, view, n_ambient, smoothing)
        for value in peer.values:
            words = f"smoothed by {smoothing:g} px" + (f", {peer.parameter} {value:g}" if peer.parameter else "")
            yield words, peer.invert(half, value)


class Revolution:
    """Revolution of a map over rows and radii around the axis onto a grid; ambient beyond the last pixel.

    Parameters
    ----------
    view : ParallelView
    shape : rows and radii of the map, px
    grid : Grid
    order : 1 for linear interpolation between pixels, 3 for cubic splines
    """

    def __init__(self, view: ParallelView, shape: tuple[int, ...], grid: Grid, order: int = 1) -> None:
        rows, radii = shape
        x, y, z = (grid.axis(name).numpy().astype(np.float64) for name in "xyz")
        squares = (y[:, None] - view.centre[1]) ** 2 + (x - view.centre[0]) ** 2
        unique, self.places = np.unique(squares.round(9), return_inverse=True)
        self.shape = (len(z), len(y), len(x))
        self.outward = _interpolation(radii, np.sqrt(unique) / view.pixel, order)
        self.upward = _interpolation(rows, view.horizon - (z - view.centre[2]) / view.pixel, order)

    def __call__(self, index_map: Float[Array, "row n"]) -> Float[Array, "z y x"]:
        """Return the volume of a map."""
        values = self.upward @ index_map @ self.outward.T
        return values[:, self.places.ravel()].reshape(self.shape)


def _interpolation(nodes: int, at: Float[Array, " m"], order: int) -> Float[Array, "m n"]:
    """Matrix of interpolation between the nodes 0, 1, 2, ...; rows of 0 beyond them."""
    matrix = make_interp_spline(np.arange(nodes), np.eye(nodes), k=order)(at)
    matrix[(at < 0) | (at > nodes - 1)] = 0.0
    return matrix
