"""A Measurement: cameras and the displacement each of them saw."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif import measurement_file
from nerif.atomic import atomic
from nerif.conventions import DEFAULT_AMBIENT_FACES, InputError, ambient_index, parse_faces
from nerif.geometry import Box, Camera, Rays
from nerif.netcdf import opened

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["LIMITS_PX", "Measurement"]

LIMITS_PX = (1e-6, 1e5)
"""Least sigma, and largest displacement and sigma, that a camera can have measured, px."""

LIMITS_NM = (100.0, 30000.0)
"""Wavelengths from ultraviolet to thermal infrared, nm."""

CHUNK = 1 << 17
"""Pixels that are traced at a time."""


@dataclass(frozen=True)
class Measurement:
    """What was measured: cameras, displacements and the volume of interest.

    Parameters
    ----------
    cameras : one a view; their names are the names of the views
    displacement : (view, row, column, 2) d = p - p0 on the grid of the flow image, px; NaN where not measured
    box : Box, mm
    n_ambient : refractive index around the flow
    sigma : (view, row, column, 2) standard deviation of the noise, px, or None
    valid : (view, row, column) False where a pixel is not to be used, or None
    flow_mask : (view, row, column) True where there is flow, or None
    wavelength_nm : of the light, or None
    ambient_faces : faces of the box on which the index is ambient (the gauge)

    Raises
    ------
    InputError
        If shapes disagree, a view has no valid pixel, a background is not behind the box, or no ray crosses the box.
    """

    cameras: tuple[Camera, ...]
    displacement: Float[Tensor, "view row column 2"]
    box: Box
    n_ambient: float
    sigma: Float[Tensor, "view row column 2"] | None = None
    valid: Bool[Tensor, "view row column"] | None = None
    flow_mask: Bool[Tensor, "view row column"] | None = None
    wavelength_nm: float | None = None
    ambient_faces: tuple[str, ...] = DEFAULT_AMBIENT_FACES

    def __post_init__(self) -> None:
        shape = tuple(self.displacement.shape)
        if len(self.cameras) != shape[0] or not self.cameras:
            raise InputError(f"displacement: expected one map a camera ({len(self.cameras)}), got {shape[0]}")
        if len(set(self.names)) < len(self.names):
            raise InputError(f"view: expected different names, got {', '.join(self.names)}")
        for name in ("sigma", "valid", "flow_mask"):
            value = getattr(self, name)
            if value is not None and tuple(value.shape)[:3] != shape[:3]:
                raise InputError(f"{name}: expected (view, row, column) = {shape[:3]}, got {tuple(value.shape)[:3]}")
        for camera in self.cameras:
            if camera.image_size[0] > shape[1] or camera.image_size[1] > shape[2]:
                raise InputError(
                    f"image_size of view '{camera.name}': expected at most {shape[1:3]} (height, width) px, "
                    f"got {camera.image_size}"
                )
        ambient_index(self.n_ambient)
        if self.wavelength_nm is not None and not LIMITS_NM[0] <= self.wavelength_nm <= LIMITS_NM[1]:
            raise InputError(f"wavelength_nm: expected nanometres such as 532, got {self.wavelength_nm}")
        parse_faces(self.ambient_faces)
        good = self.usable.flatten(1).sum(dim=1)
        for name, count in zip(self.names, good.tolist(), strict=True):
            if count == 0:
                raise InputError(f"displacement of view '{name}': no valid pixel; leave the view out or mend its mask")
        self._check_geometry()

    def _check_geometry(self) -> None:
        """Refuse a background in front of or inside the box, and a box that no ray crosses."""
        corners = torch.tensor(
            [[c[i >> a & 1][a] for a in range(3)] for i in range(8) for c in [(self.box.lower, self.box.upper)]],
            dtype=torch.float64,
        )
        crossing = False
        for camera in self.cameras:
            height, width = camera.image_size
            u = torch.linspace(0, width - 1, min(width, 33), dtype=torch.float64)
            v = torch.linspace(0, height - 1, min(height, 33), dtype=torch.float64)
            rays = camera.rays(torch.cartesian_prod(u, v).reshape(-1, 2), sensitivity=False).clip(self.box)
            crossing |= bool(rays.crosses.any())
            if camera.background is None:
                continue
            normal = camera.background.normal.to(torch.float64)
            plane = corners @ normal - camera.background.offset
            sight = camera.sight((camera.background.offset * normal).to(camera.rotation))
            behind = -plane * float(sight.to(normal) @ normal)
            seen = rays[rays.crosses]
            if len(seen) and (float(behind.min()) <= 0 or not bool(seen.unobstructed.all())):
                raise InputError(
                    f"background of view '{camera.name}': expected a plane behind the box as the camera sees it, got "
                    "one that cuts or stands before the box; check background_normal, background_offset (mm) and box"
                )
        if not crossing:
            raise InputError(
                f"box: no ray of any view crosses it ({self.box.lower} to {self.box.upper} mm); "
                "check the box, and that rotation and translation map world to camera"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the views."""
        return tuple(c.name for c in self.cameras)

    @property
    def usable(self) -> Bool[Tensor, "view row column"]:
        """Pixels inside their image, valid, of a displacement and, where it is known, a sigma within LIMITS_PX."""
        mask = self._called_valid
        for i in range(len(mask)):
            mask[i] &= self._measured(i)
        return mask

    @property
    def bad_pixels(self) -> int:
        """Pixels called valid that measured nothing (NaN, infinite or impossible numbers): masked, but worth a line."""
        mask = self._called_valid
        return sum(int((mask[i] & ~self._measured(i)).sum()) for i in range(len(mask)))

    @property
    def _called_valid(self) -> Bool[Tensor, "view row column"]:
        mask = self._inside
        return mask if self.valid is None else mask.logical_and_(self.valid)

    def _measured(self, view: int) -> Bool[Tensor, "row column"]:
        least, most = LIMITS_PX
        mask = (self.displacement[view].abs() <= most).all(dim=-1)  # NaN compares false
        if self.sigma is not None:
            mask &= ((self.sigma[view] >= least) & (self.sigma[view] <= most)).all(dim=-1)
        return mask

    @property
    def _inside(self) -> Bool[Tensor, "view row column"]:
        mask = torch.zeros(self.displacement.shape[:3], dtype=torch.bool)
        for i, camera in enumerate(self.cameras):
            mask[i, : camera.image_size[0], : camera.image_size[1]] = True
        return mask

    @cached_property
    def sees_box(self) -> Bool[Tensor, "view row column"]:
        """Pixels whose rays cross the box on the way to the background."""
        mask = self._inside
        for _ in self._traced(mask, sensitivity=False):
            pass
        return mask

    def rays(self) -> tuple[Rays, Float[Tensor, "n 2"], Float[Tensor, "n 2"] | None]:
        """Return the usable rays that cross the box, their displacement and sigma (None if unknown), px."""
        mask = self.usable
        rays = Rays.collect((traced[keep] for traced, keep in self._traced(mask)), int(mask.sum()))
        return rays, self.displacement[mask].float(), None if self.sigma is None else self.sigma[mask].float()

    def _traced(
        self, mask: Bool[Tensor, "view row column"], sensitivity: bool = True
    ) -> Iterator[tuple[Rays, Bool[Tensor, " n"]]]:
        """Trace the pixels of a mask, some at a time, tell whose ray crosses the box, and clear the others in the mask.

        Rays are made in double precision: cameras stand far off, and positions lose digits in single precision.
        """
        for view, (camera, wanted) in enumerate(zip(self.cameras, mask, strict=True)):
            rows = max(1, CHUNK // wanted.shape[1])
            for first in range(0, wanted.shape[0], rows):
                block = wanted[first : first + rows]  # a view, through which the mask is changed
                row, column = block.nonzero().unbind(-1)
                pixels = torch.stack([column, row + first], dim=-1).to(camera.intrinsics.dtype)
                rays = camera.rays(pixels, sensitivity, view).clip(self.box)
                keep = rays.unobstructed
                block[row, column] = keep
                yield rays, keep

    def select(self, names: Sequence[str]) -> Measurement:
        """Return the measurement of the named views only.

        Raises
        ------
        InputError
            If there is no view of that name, or none is left.
        """
        for name in names:
            if name not in self.names:
                raise InputError(f"view: expected one of {', '.join(self.names)}, got '{name}'")
        index = [i for i, name in enumerate(self.names) if name in names]
        if not index:
            raise InputError(f"view: expected at least one of {', '.join(self.names)}, got none")
        if len(index) == len(self.cameras):
            return self

        def pick(x: Tensor | None) -> Tensor | None:
            return None if x is None else x[index]

        return replace(
            self,
            cameras=tuple(self.cameras[i] for i in index),
            displacement=self.displacement[index],
            sigma=pick(self.sigma),
            valid=pick(self.valid),
            flow_mask=pick(self.flow_mask),
        )

    def without(self, held_out: Sequence[str]) -> Measurement:
        """Return the measurement that is left to reconstruct from when some views are held out.

        Raises
        ------
        InputError
            If there is no view of that name, or none is left.
        """
        for name in held_out:
            if name not in self.names:
                raise InputError(f"hold_out: expected views out of {', '.join(self.names)}, got '{name}'")
        kept = [name for name in self.names if name not in held_out]
        if not kept:
            raise InputError("hold_out: every view is held out, so none is left to reconstruct from")
        return self.select(kept)

    def summary(self, held_out: int = 0) -> list[tuple[str, str]]:
        """Return what was measured as names and values with units; `held_out` of the views were not used."""
        from nerif.notebook import number

        usable = self.usable
        count = max(int(usable.sum()), 1)
        squares, noise, largest = 0.0, 0.0, 0.0
        for i, mask in enumerate(usable):  # view by view: pictures may be large
            d = self.displacement[i][mask].double()
            squares, largest = squares + float(d.square().sum()), max(largest, float(d.abs().max()))
            if self.sigma is not None:
                noise += float(self.sigma[i][mask].double().square().sum())
        rms, sigma = (number((total / (2 * count)) ** 0.5, 3) for total in (squares, noise))
        sizes = sorted({c.image_size for c in self.cameras})
        inside = sum(height * width for height, width in (c.image_size for c in self.cameras))
        held = f", of which {held_out} held out" if held_out else ""
        light = f" at {self.wavelength_nm:g} nm" if self.wavelength_nm else ""
        return [
            ("Views", f"{len(self.cameras)}{held}, of {' and '.join(f'{w} × {h}' for h, w in sizes[:3])} px"),
            ("Displacement", f"rms {rms} px, up to {number(largest, 3)} px"),
            ("Noise σ", "not known" if self.sigma is None else f"rms {sigma} px"),
            ("Usable pixels", f"{count / inside:.1%}"),
            ("Volume", " × ".join(f"{e:g}" for e in self.box.edges) + " mm (x, y, z)"),
            ("Ambient index", f"{self.n_ambient:.7g}{light}"),
        ]

    def _repr_html_(self) -> str:
        """Return what a notebook shows: u and v of the views, and the summary."""
        from nerif.notebook import PIXELS, panel, show_views

        maps, usable = [], self.usable
        for i, (height, width) in enumerate(c.image_size for c in self.cameras):
            step = -(-max(height, width) // PIXELS)
            part = i, slice(0, height, step), slice(0, width, step)
            maps.append(torch.where(usable[part][..., None], self.displacement[part], torch.nan).numpy())
        picture = show_views(self.names, maps)
        return panel("Measurement", self.summary(), picture, "Displacement u and v of each view, in px")

    # -- files ---------------------------------------------------------------------------------------------------

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the file of docs/formats.md, atomically."""
        dataset = self.to_dataset()
        with atomic(path) as part:
            dataset.to_netcdf(part, engine="h5netcdf", encoding=measurement_file.encoding(dataset))

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Measurement:
        """Read a measurement file.

        Raises
        ------
        InputError
            If the file is missing, foreign, truncated, or breaks the contract; the message names the variable.
        """
        with opened(path, f"a measurement (NetCDF-4, {measurement_file.CONVENTIONS})") as dataset:
            return cls.from_dataset(dataset)

    def to_dataset(self) -> xr.Dataset:
        """Return the variables and attributes of the file."""
        return measurement_file.to_dataset(self)

    @classmethod
    def from_dataset(cls, dataset: xr.Dataset) -> Measurement:
        """Return the measurement that such variables and attributes describe.

        Raises
        ------
        InputError
            If they break the contract; the message names the variable.
        """
        return cls(**measurement_file.from_dataset(dataset))
