"""A Measurement: cameras and the displacement each of them saw, and its file (NetCDF-4, Conventions BOST-1.0)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerif.atomic import atomic
from nerif.conventions import COMPONENTS, DEFAULT_AMBIENT_FACES, InputError, parse_faces
from nerif.geometry import Box, Camera, Plane, Rays

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["CONVENTIONS", "MAPS", "Measurement"]

CONVENTIONS = "BOST-1.0"

VARIABLES = {
    "displacement": (("view", "row", "column", "component"), "px"),
    "sigma": (("view", "row", "column", "component"), "px"),
    "valid": (("view", "row", "column"), "1"),
    "flow_mask": (("view", "row", "column"), "1"),
    "intrinsics": (("view", "i", "j"), "px"),
    "distortion": (("view", "coefficient"), "1"),
    "rotation": (("view", "i", "j"), "1"),
    "translation": (("view", "i"), "mm"),
    "background_normal": (("view", "i"), "1"),
    "background_offset": (("view",), "mm"),
    "box": (("corner", "i"), "mm"),
    "image_size": (("view", "side"), "px"),
}
"""Dimensions and unit of every variable of the file."""

MAPS = ("displacement", "sigma", "valid", "flow_mask")
"""What is measured; the rest is known of the rig."""

OPTIONAL = ("sigma", "valid", "flow_mask", "distortion", "image_size")
SIZES = {"component": 2, "i": 3, "j": 3, "coefficient": 5, "corner": 2, "side": 2}


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
        if not 0.9 < self.n_ambient < 4:
            raise InputError(f"n_ambient: expected a refractive index such as 1.00027, got {self.n_ambient}")
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
            rays = camera.rays(torch.cartesian_prod(u, v).reshape(-1, 2)).clip(self.box)
            crossing |= bool(rays.crosses.any())
            normal = camera.background.normal.to(torch.float64)
            plane = corners @ normal - camera.background.offset
            behind = plane * float(camera.centre.to(torch.float64) @ normal - camera.background.offset)
            seen = rays[rays.crosses]
            if len(seen) and (float(behind.min()) <= 0 or not bool((seen.background > seen.far).all())):
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
        """Pixels that are inside their image, valid, finite, and of positive finite sigma."""
        mask = torch.isfinite(self.displacement).all(dim=-1)
        if self.valid is not None:
            mask = mask & self.valid
        if self.sigma is not None:
            mask = mask & (torch.isfinite(self.sigma) & (self.sigma > 0)).all(dim=-1)
        return mask & self._inside

    @property
    def _inside(self) -> Bool[Tensor, "view row column"]:
        mask = torch.zeros(self.displacement.shape[:3], dtype=torch.bool)
        for i, camera in enumerate(self.cameras):
            mask[i, : camera.image_size[0], : camera.image_size[1]] = True
        return mask

    @property
    def sees_box(self) -> Bool[Tensor, "view row column"]:
        """Pixels whose rays cross the box."""
        mask = torch.zeros(self.displacement.shape[:3], dtype=torch.bool)
        for i, camera in enumerate(self.cameras):
            height, width = camera.image_size
            crosses = camera.rays(camera.pixel_grid().reshape(-1, 2)).clip(self.box).crosses
            mask[i, :height, :width] = crosses.reshape(height, width)
        return mask

    @property
    def bad_pixels(self) -> int:
        """Pixels called valid whose displacement is NaN or infinite: masked, but worth a line."""
        called = self._inside if self.valid is None else self._inside & self.valid
        return int((called & ~torch.isfinite(self.displacement).all(dim=-1)).sum())

    def rays(self) -> tuple[Rays, Float[Tensor, "n 2"], Float[Tensor, "n 2"] | None]:
        """Return the usable rays that cross the box, their displacement and sigma (None if unknown), px."""
        parts, displacement, sigma = [], [], []
        usable = self.usable
        for i, camera in enumerate(self.cameras):
            mask = usable[i, : camera.image_size[0], : camera.image_size[1]]
            rays = camera.rays(camera.pixel_grid()[mask]).clip(self.box)
            keep = rays.crosses
            parts.append(rays[keep].to(dtype=torch.float32))
            displacement.append(self.displacement[i][usable[i]][keep])
            if self.sigma is not None:
                sigma.append(self.sigma[i][usable[i]][keep])
        return (
            Rays.concatenate(parts),
            torch.cat(displacement).float(),
            torch.cat(sigma).float() if self.sigma is not None else None,
        )

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

    def summary(self, held_out: int = 0) -> list[tuple[str, str]]:
        """Return what was measured as names and values with units; `held_out` of the views were not used."""
        from nerif.notebook import number

        def rms(values: Tensor) -> str:
            return number(float(values.square().mean().sqrt()), 3)

        sizes = sorted({c.image_size for c in self.cameras})
        held = f", of which {held_out} held out" if held_out else ""
        usable = self.usable
        d = self.displacement[usable]
        inside = sum(height * width for height, width in (c.image_size for c in self.cameras))
        light = f" at {self.wavelength_nm:g} nm" if self.wavelength_nm else ""
        return [
            ("Views", f"{len(self.cameras)}{held}, of {' and '.join(f'{w} × {h}' for h, w in sizes[:3])} px"),
            ("Displacement", f"rms {rms(d)} px, up to {number(float(d.abs().max()), 3)} px"),
            ("Noise σ", "not known" if self.sigma is None else f"rms {rms(self.sigma[usable])} px"),
            ("Usable pixels", f"{float(usable.sum()) / inside:.1%}"),
            ("Volume", " × ".join(f"{e:g}" for e in self.box.edges) + " mm (x, y, z)"),
            ("Ambient index", f"{self.n_ambient:.7g}{light}"),
        ]

    def _repr_html_(self) -> str:
        """Return what a notebook shows: u and v of the views, and the summary."""
        from nerif.notebook import panel, show_views

        shown = torch.where(self.usable[..., None], self.displacement, torch.nan).numpy()
        maps = [d[: c.image_size[0], : c.image_size[1]] for d, c in zip(shown, self.cameras, strict=True)]
        picture = show_views(self.names, maps)
        return panel("Measurement", self.summary(), picture, "Displacement u and v of each view, in px")

    # -- files ---------------------------------------------------------------------------------------------------

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the file of docs/formats.md, atomically."""
        dataset = self.to_dataset()
        packed = {k: {"zlib": True, "complevel": 3} for k in MAPS if k in dataset}
        with atomic(path) as part:
            dataset.to_netcdf(part, engine="h5netcdf", encoding=packed)

    def to_dataset(self) -> xr.Dataset:
        """Return the variables and attributes of the file."""
        import numpy as np
        import xarray as xr

        def stack(values: list[Tensor]) -> np.ndarray:
            return torch.stack(values).numpy()

        cameras = self.cameras
        data: dict[str, np.ndarray] = {
            "displacement": self.displacement.float().numpy(),
            "intrinsics": stack([c.intrinsics for c in cameras]),
            "distortion": stack([c.distortion for c in cameras]),
            "rotation": stack([c.rotation for c in cameras]),
            "translation": stack([c.translation for c in cameras]),
            "background_normal": stack([c.background.normal for c in cameras]),
            "background_offset": np.array([c.background.offset for c in cameras]),
            "box": np.array([self.box.lower, self.box.upper]),
            "image_size": np.array([c.image_size for c in cameras], dtype=np.int32),
        }
        for name in MAPS[1:]:
            value = getattr(self, name)
            if value is not None:
                data[name] = value.to(torch.int8 if value.dtype == torch.bool else torch.float32).numpy()
        dataset = xr.Dataset({k: (VARIABLES[k][0], v, {"units": VARIABLES[k][1]}) for k, v in data.items()})
        dataset = dataset.assign_coords(view=list(self.names), component=list(COMPONENTS))
        dataset.attrs = {
            "Conventions": CONVENTIONS,
            "n_ambient": self.n_ambient,
            "ambient_faces": " ".join(self.ambient_faces),
        }
        if self.wavelength_nm is not None:
            dataset.attrs["wavelength_nm"] = self.wavelength_nm
        return dataset

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Measurement:
        """Read a measurement file.

        Raises
        ------
        InputError
            If the file is missing, foreign, truncated, or breaks the contract; the message names the variable.
        """
        import xarray as xr

        path = Path(path)
        if not path.is_file():
            raise InputError(f"{path}: no such file; expected a measurement (NetCDF-4, {CONVENTIONS})")
        try:
            dataset = xr.load_dataset(path, engine="h5netcdf")
        except (OSError, ValueError, KeyError, RuntimeError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise InputError(f"{path}: not a readable NetCDF-4 file, or truncated ({reason})") from None
        try:
            return cls.from_dataset(dataset)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None

    @classmethod
    def from_dataset(cls, dataset: xr.Dataset) -> Measurement:
        """Return the measurement that such variables and attributes describe.

        Raises
        ------
        InputError
            If they break the contract; the message names the variable.
        """
        import numpy as np

        found = dataset.attrs.get("Conventions")
        if found != CONVENTIONS:
            raise InputError(f"attribute Conventions: expected '{CONVENTIONS}', got '{found}'; is it a measurement?")
        _check_variables(dataset)

        def array(name: str) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(dataset[name].values.astype(np.float64)))

        def mask(name: str) -> Tensor | None:
            return array(name) != 0 if name in dataset else None

        displacement = array("displacement").float()
        views = displacement.shape[0]
        names = [str(n) for n in dataset["view"].values] if "view" in dataset.coords else [str(i) for i in range(views)]
        sizes = dataset["image_size"].values if "image_size" in dataset else [displacement.shape[1:3]] * views
        distortion = array("distortion") if "distortion" in dataset else torch.zeros(views, 5, dtype=torch.float64)
        corners = array("box").tolist()
        box = Box(tuple(corners[0]), tuple(corners[1]))
        intrinsics, rotation, translation = array("intrinsics"), array("rotation"), array("translation")
        normals, offsets = array("background_normal"), array("background_offset")
        cameras = []
        for i in range(views):
            length = float(normals[i].norm())
            if not 0.99 < length < 1.01:
                raise InputError(
                    f"background_normal of view '{names[i]}': expected a unit vector, got length {length:g}"
                )
            cameras.append(
                Camera(
                    intrinsics=intrinsics[i],
                    rotation=rotation[i],
                    translation=translation[i],
                    image_size=(int(sizes[i][0]), int(sizes[i][1])),
                    background=Plane(normals[i] / length, float(offsets[i]) / length),
                    distortion=distortion[i],
                    name=names[i],
                )
            )
        if "n_ambient" not in dataset.attrs:
            raise InputError("attribute n_ambient: expected the index around the flow, e.g. 1.00027, got none")
        wavelength = dataset.attrs.get("wavelength_nm")
        return cls(
            cameras=tuple(cameras),
            displacement=displacement,
            box=box,
            n_ambient=float(dataset.attrs["n_ambient"]),
            sigma=array("sigma").float() if "sigma" in dataset else None,
            valid=mask("valid"),
            flow_mask=mask("flow_mask"),
            wavelength_nm=None if wavelength is None else float(wavelength),
            ambient_faces=parse_faces(str(dataset.attrs.get("ambient_faces", " ".join(DEFAULT_AMBIENT_FACES)))),
        )


def _check_variables(dataset: xr.Dataset) -> None:
    """Refuse missing variables and wrong dimensions, sizes and units, by name."""
    for name, (dimensions, unit) in VARIABLES.items():
        if name not in dataset:
            if name in OPTIONAL:
                continue
            raise InputError(f"variable '{name}': expected on ({', '.join(dimensions)}) in {unit}, got none")
        variable = dataset[name]
        if tuple(variable.dims) != dimensions:
            got = tuple(map(str, variable.dims))
            raise InputError(f"variable '{name}': expected dimensions {dimensions}, got {got}")
        for dimension in dimensions:
            size = SIZES.get(dimension)
            if size is not None and variable.sizes[dimension] != size:
                got_size = variable.sizes[dimension]
                raise InputError(f"variable '{name}': expected {size} along {dimension}, got {got_size}")
        given = variable.attrs.get("units")
        if given is not None and given != unit:
            raise InputError(f"variable '{name}': expected units '{unit}', got '{given}'")
        if variable.dtype.kind not in "fiub":
            raise InputError(f"variable '{name}': expected numbers, got {variable.dtype}")
