"""Displacement by every method.

Rendered pairs of images, displacements up to 3 px, 12-bit noise. The truth is the displacement of the pinhole camera
by curved rays; errors are taken 8 px inside the edge of the image. e / sigma is the rms error over the stated sigma
(five reference images). OpenPIV: window deformation in five passes, windows of 32 to 8 px, validated and filled by
its own defaults, cubic splines between the windows.
"""

from __future__ import annotations

import contextlib
import io
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.runner import N_AMBIENT, Settings, peer, ratios
from nerif.fields.phantoms import Scaled, make_phantom
from nerif.geometry import paper_rig
from nerif.imaging.displacement.displacement import measure as measure_displacement
from nerif.imaging.displacement.optical_flow import FLOWS
from nerif.imaging.imaging_settings import DisplacementSettings
from nerif.imaging.patterns import KINDS, Background
from nerif.simulation.experiment_settings import Sensor
from nerif.simulation.rendering import background_texture, pattern_size, render
from nerif.simulation.simulate import view_displacement

COLUMNS = {
    "pixels": "{pixels}²", "phantom": "{phantom}", "background": "{background}", "method": "{method}",
    "median error [px]": "{median:.4f}", "rms error [px]": "{rms:.4f}", "rms / correlation": "{rms_ratio:.2f}",
    "e / sigma": "{over_sigma:.1f}", "valid": "{valid:.1%}", "seconds a pair": "{seconds:.2f}",
    "seconds / correlation": "{seconds_ratio:.1f}",
}  # fmt: skip
LARGEST = 3.0  # px
REFERENCES = 5
EDGE = 8  # px
WINDOWS, OVERLAPS = (32, 16, 12, 8, 8), (16, 12, 9, 6, 6)  # of OpenPIV, px: the most accurate of ten choices


def cases(quick: bool) -> Iterator[Settings]:
    for pixels in (96,) if quick else (200, 1024):
        for phantom in ("gaussians",) if quick else ("gaussians", "flame"):
            for kind in ("dots",) if quick else KINDS:
                for method in ("correlation", "dis", "OpenPIV") if quick else (*FLOWS, "OpenPIV"):
                    yield {"pixels": pixels, "phantom": phantom, "background": kind, "method": method, "dot": 3.0}


def pair(folder: Path, phantom: str, kind: str, pixels: int, dot: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return reference images, flow image and true displacement, rendered once for all methods."""
    path = folder / f"pair-{phantom}-{kind}-{pixels}-{dot:g}.npz"
    if not path.is_file():
        cameras, box = paper_rig(pixels)
        camera = cameras[0]
        field = make_phantom(phantom, box, 0)
        largest = float(view_displacement(field, camera, box, N_AMBIENT, steps=60).norm(dim=-1).max())
        field = Scaled(field, LARGEST / largest)
        truth = view_displacement(field, camera, box, N_AMBIENT, steps=60)
        width, height = pattern_size(camera)
        pixel = width / 1.1 / pixels
        raster = Background(kind, width, height, dot=dot * pixel).raster(pixel / 4)
        texture = background_texture(camera, torch.from_numpy(raster), pixel / 4)
        sensor, reference = Sensor(bits=12), render(camera, texture)
        flow = sensor.expose(render(camera, texture, field, box, N_AMBIENT, steps=60), 99)
        references = np.stack([sensor.expose(reference, i) for i in range(REFERENCES)])
        np.savez(path, references=references, flow=flow, truth=truth.numpy())
    with np.load(path) as arrays:
        return arrays["references"], arrays["flow"], arrays["truth"]


def openpiv(reference: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """Return the displacement (row, column, 2) in px by OpenPIV."""
    from scipy.interpolate import RectBivariateSpline

    windef = peer("openpiv.windef", "OpenPIV")
    settings = windef.PIVSettings()
    settings.windowsizes, settings.overlap, settings.num_iterations = WINDOWS, OVERLAPS, len(WINDOWS)
    settings.show_plot = settings.show_all_plots = settings.save_plot = False
    with contextlib.redirect_stdout(io.StringIO()):
        x, y, u, v, _ = windef.simple_multipass(reference, flow, settings)  # y and v upwards
    rows, columns = (np.arange(n) for n in reference.shape)
    splines = (RectBivariateSpline(y[::-1, 0], x[0], c) for c in (u, -v))
    return np.stack([spline(rows, columns) for spline in splines], axis=-1)


def measure(folder: Path, pixels: int, phantom: str, background: str, method: str, dot: float) -> dict[str, Any]:
    references, flow, truth = pair(folder, phantom, background, pixels, dot)
    inner = slice(EDGE, -EDGE)
    start = time.perf_counter()
    if method == "OpenPIV":
        displacement = openpiv(references[0].astype(np.float64), flow.astype(np.float64))
        metrics = {"seconds": time.perf_counter() - start}
        displacement = openpiv(references.mean(axis=0), flow.astype(np.float64))  # of five, as the other methods have
        error = (displacement - truth)[inner, inner]
    else:
        settings = DisplacementSettings(method)
        measure_displacement(list(references[:1]), [flow], settings)
        metrics = {"seconds": time.perf_counter() - start}
        result = measure_displacement(list(references), [flow], settings)
        error = (result.displacement - truth)[inner, inner]
        metrics["over_sigma"] = float(np.sqrt(np.mean((error / result.sigma[inner, inner]) ** 2)))
        metrics["valid"] = float(result.valid[inner, inner].mean())
    length = np.hypot(error[..., 0], error[..., 1])
    return {"median": float(np.median(length)), "rms": float(np.sqrt(np.mean(length**2))), **metrics}


def derive(rows: list[dict[str, Any]]) -> None:
    for metric in ("rms", "seconds"):
        ratios(rows, metric, ("pixels", "phantom", "background"), method="correlation")
