"""From images to the field.

Rendered images of a flame with 12-bit noise, reconstructed from displacements and from the images themselves. They
are rendered by curved rays, averaged over pixels and lens, with shot noise of 10,000 electrons at full well. All
routes have the same images and cameras. Last columns: rms error of the displacements, and that over their sigma.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.runner import N_AMBIENT, Settings
from nerif.analysis.evaluation import evaluate_volume
from nerif.analysis.prediction import predict
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume, write_netcdf
from nerif.data.volume_file import read_volume
from nerif.fields.field import Field
from nerif.fields.phantoms import Scaled, make_phantom
from nerif.geometry import Grid, Lens, paper_rig
from nerif.imaging.displacement.displacement import measure as measure_displacement
from nerif.imaging.imaging_settings import DisplacementSettings, Surroundings
from nerif.imaging.patterns import Background
from nerif.imaging.recording import Scene, ViewMeasurement, join_views
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.shared_settings import Source
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.simulation.experiment_settings import Sensor
from nerif.simulation.rendering import background_texture, pattern_size, render

REFERENCES = 5
CHECKER = "checker"
ROUTES = (
    ("nerif", "correlation", "displacements"),
    ("nerif", "dis", "displacements"),
    ("nerif", "correlation", "images"),
    ("nerif", "none", "images"),
    ("tv", "correlation", "displacements"),
    ("tv", "correlation", "images"),
)
"""Method, optical flow (none: images alone), data that are fitted."""
DEFAULTS: Settings = {
    "pixels": 128, "seconds": 30.0, "f_number": 0.0, "background": "dots", "dot": 3.0, "shift": 0.0, "drift": 0.0,
    "truth_voxels": 100,
}  # fmt: skip
"""Edge (px), time of NeRIF (s), f-number of 50 mm lenses (0: pinholes), pattern and its size (px), largest displacement
(px; 0: that of the flame), drift of the illumination from one side of the image to the other, and as much overall."""
CASES: tuple[tuple[Settings, tuple[int, ...]], ...] = (
    ({}, (0, 1, 2, 3, 4, 5)),
    ({"pixels": 200, "seconds": 60.0, "f_number": 8.0}, (0, 1, 2, 3, 4, 5)),
    ({"background": "wavelet"}, (0, 2)),
    ({"background": CHECKER}, (0, 2)),
    ({"shift": 0.3}, (0, 2)),
    ({"shift": 1.0}, (0, 2)),
    ({"shift": 4.0}, (0, 2, 3)),
    ({"drift": 0.05}, (0, 2)),
)
COLUMNS = {
    "pixels": "{pixels}²", "f-number": "{f_number:g}", "background": "{background}", "shift [px]": "{shift:g}",
    "drift": "{drift:.0%}", "method": "{method}", "optical flow": "{flow}", "from": "{source}", "L2": "{l2:.2%}",
    "of variation": "{l2_variation:.2%}", "seconds": "{time:.0f}", "error [px]": "{error:.4f}",
    "error / sigma": "{over_sigma:.1f}",
}  # fmt: skip


def cases(quick: bool) -> Iterator[Settings]:
    small = {"pixels": 32, "seconds": 3.0, "truth_voxels": 30}
    for changes, routes in [(small, (0, 3))] if quick else CASES:
        for method, flow, source in (ROUTES[i] for i in routes):
            yield {**DEFAULTS, **changes, "method": method, "flow": flow, "source": source, "seed": 0}


def pattern(background: str, dot: float, seed: int, width: float, height: float, pixel: float) -> np.ndarray:
    """Return the background of a view, four texels per pixel."""
    texel = pixel / 4
    if background != CHECKER:
        return Background(background, width, height, dot=dot * pixel, seed=seed).raster(texel)
    row, column = np.mgrid[: round(height / texel), : round(width / texel)] // round(4 * dot)
    return ((row + column) % 2).astype(float)


def photographed(
    folder: Path,
    pixels: int,
    f_number: float,
    background: str,
    dot: float,
    shift: float,
    drift: float,
    truth_voxels: int,
) -> Path:
    """Render images and measure displacements once for all routes; return the folder of measurements and truth."""
    folder = folder / f"images-{pixels}-{f_number:g}-{background}-{dot:g}-{shift:g}-{drift:g}-{truth_voxels}"
    if (folder / "none.nc").is_file():
        return folder
    folder.mkdir(parents=True, exist_ok=True)
    cameras, box = paper_rig(pixels)
    pinholes = cameras
    if f_number:
        cameras = tuple(replace(camera, lens=Lens(50.0 / f_number)) for camera in cameras)
    field: Field = make_phantom("flame", box, 0)
    exact = predict(field, pinholes, box, N_AMBIENT).displacements
    if shift:
        factor = shift / float(exact.norm(dim=-1).max())
        field, exact = Scaled(field, factor), exact * factor
    torch.save(exact, folder / "exact.pt")
    grid = Grid.of_resolution(box, truth_voxels)
    write_netcdf(folder / "truth.nc", [Volume.of(field.sample(grid), grid, "index_excess", N_AMBIENT)])
    sensor, images = Sensor(bits=12), []
    for i, camera in enumerate(cameras):
        width, height = pattern_size(camera)
        pixel = width / 1.1 / pixels
        texture = background_texture(
            camera, torch.from_numpy(pattern(background, dot, i, width, height, pixel)), pixel / 4
        )
        reference = render(camera, texture)
        flow = render(camera, texture, field, box, N_AMBIENT, steps=60)
        light = 1 + drift * (1 + torch.linspace(-0.5, 0.5, pixels, dtype=torch.float64))
        references = [sensor.expose(reference, REFERENCES * i + k) for k in range(REFERENCES)]
        images.append((references, sensor.expose(flow * light, 1000 + i)))
    scene = Scene(box, Surroundings(n_ambient=N_AMBIENT))
    for method in ("correlation", "dis"):
        settings = DisplacementSettings(method)
        results = [measure_displacement(references, [image], settings) for references, image in images]
        views = (ViewMeasurement(camera, one, None) for camera, one in zip(cameras, results, strict=True))
        join_views(views, scene, images=True).write(folder / f"{method}.nc")
    replace(Measurement.read(folder / "correlation.nc"), displacement=None, sigma=None).write(folder / "none.nc")
    return folder


def measure(
    folder: Path, pixels: int, seconds: float, f_number: float, background: str, dot: float, shift: float, drift: float,
    truth_voxels: int, method: str, flow: str, source: Source, seed: int,
) -> dict[str, Any]:  # fmt: skip
    folder = photographed(folder, pixels, f_number, background, dot, shift, drift, truth_voxels)
    measurement = Measurement.read(folder / f"{flow}.nc")
    if method == "nerif":
        result = NeRIF(time_limit=seconds, epochs=1e9, seed=seed, source=source, device="cpu")(measurement)
    else:
        result = TotalVariation(source=source, device="cpu")(measurement)
    scores = evaluate_volume(result.field, read_volume(folder / "truth.nc"), N_AMBIENT)
    metrics = {"l2": scores["l2"], "l2_variation": scores["l2_variation"], "time": result.seconds}
    if source == "displacements":
        assert measurement.displacement is not None
        assert measurement.sigma is not None
        error = (measurement.displacement - torch.load(folder / "exact.pt")).numpy()
        metrics["error"] = float(np.sqrt(np.nanmean(error**2)))
        metrics["over_sigma"] = float(np.sqrt(np.nanmean((error / measurement.sigma.numpy()) ** 2)))
    return metrics
