"""A real supersonic jet from one camera: two images, no calibration, a field of (r, h), and its shock cells.

    python examples/jet.py jet_reference.tif jet_flow.tif --out jet

The images are of github.com/alexlib/OpticFlow-BOS (MIT). The positions of camera and background are unknown: distances
and scale below are plausible values, so the index is determined up to one factor and lengths up to another. The right
half is withheld and predicted from the left; then the whole image is reconstructed, from displacements and from grey
values. The spacing of the shock cells is compared with that of the displacement.
"""

from __future__ import annotations

import argparse
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import least_squares

from nerif.data.measurement import Measurement
from nerif.imaging.calibration.calibration_settings import ImportSettings, SimpleRig
from nerif.imaging.calibration.simple_rig import box_about_axis, find_image, simple_camera
from nerif.imaging.imaging_settings import Surroundings
from nerif.imaging.readers.views import find_views
from nerif.imaging.recording import Recording, Scene, measure_instant
from nerif.plotting.drawing import style
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.progress import Monitor
from nerif.report.meridian_figure import draw_centre_line, draw_section
from nerif.results.directory import ResultDirectory
from nerif.workflow.pipeline import reconstruct_into
from nerif.workflow.run_settings import RunSettings

HARMONICS = 3  # of a cell
DRAWS = 200  # of the bootstrap
BLOCK = 0.25  # of a cell, in which residuals stay together
ON_AXIS = 0.04  # of the width of the image, within which the displacement is taken as that on the axis


@dataclass(frozen=True)
class Spacing:
    """Length of a cell and its standard deviation, mm, and the share of the signal that cells explain."""

    length: float
    sigma: float
    explained: float


def spacing(h: np.ndarray, signal: np.ndarray, shortest: float, longest: float) -> Spacing:
    """Fit a periodic signal and a slow trend, from the period whose spectral power is highest; block bootstrap.

    signal = a + b h + c h^2 + sum_k [p_k cos(2 pi k h / L) + q_k sin(2 pi k h / L)]
    """
    h, signal = h[np.isfinite(signal)], signal[np.isfinite(signal)]
    h = h - h.mean()

    def columns(length: float) -> np.ndarray:
        phase = 2 * np.pi * np.arange(1, HARMONICS + 1)[:, None] * h / length
        return np.concatenate([[np.ones_like(h), h, h**2], np.cos(phase), np.sin(phase)]).T

    def left(length: float, values: np.ndarray) -> np.ndarray:
        a = columns(length)
        return values - a @ np.linalg.lstsq(a, values, rcond=None)[0]

    def best(values: np.ndarray, start: float) -> float:
        fit = least_squares(lambda x: left(x[0], values), [start], bounds=([shortest], [longest]), x_scale=start)
        return float(fit.x[0])

    tried = np.linspace(shortest, longest, 400)
    length = best(signal, min(tried, key=lambda t: np.square(left(t, signal)).sum()))
    rest = left(length, signal)
    slow = signal - np.polyval(np.polyfit(h, signal, 2), h)
    block = max(1, round(BLOCK * length / (h[1] - h[0])))
    random, lengths = np.random.default_rng(0), []
    for _ in range(DRAWS):
        first = random.integers(0, len(h) - block, -(-len(h) // block))
        noise = np.concatenate([rest[i : i + block] for i in first])[: len(h)]
        lengths.append(best(signal - rest + noise, length))
    return Spacing(length, float(np.std(lengths)), 1 - float(np.var(rest) / np.var(slow)))


def measure(folder: Path, rig: SimpleRig, background_distance: float) -> Measurement:
    """Return what the one view in a folder measured: displacements, and the images themselves."""
    name, size = find_image(folder)
    camera = simple_camera(rig, size, ImportSettings(background_distance=background_distance), name)
    scene = Scene(box_about_axis(camera), Surroundings())
    measured, _ = measure_instant(Recording(find_views(folder), {name: camera}, scene))
    return measured


def correlations(directory: Path) -> dict[str, tuple[float, float]]:
    """Return how predicted and measured displacements correlate over each half that a result shows, u and v."""
    reprojection = ResultDirectory(directory).reprojection()
    measurement, scores = reprojection.measurement, {}
    usable = measurement.usable_for(measurement.observations[0]) & measurement.sees_box
    for view, name in enumerate(measurement.names):
        pairs = torch.stack([measurement.displacements, reprojection.maps["deflection"]])[:, view, usable[view]]
        u, v = (float(torch.corrcoef(pairs[..., c])[0, 1]) for c in range(2))
        scores[name] = (u, v)
    return scores


def cells(out: Path, measurement: Measurement, shortest: float, longest: float) -> None:
    """Print how far apart shock cells are, by the fields on the axis and by the displacement along it."""
    for name in ("displacements", "images"):
        meridian = ResultDirectory(out / name).read().meridian
        assert meridian is not None
        estimate = spacing(meridian.h, meridian.quantities["index_excess"][:, 0], shortest, longest)
        print(f"shock cells by the field from {name}: {estimate.length:.2f} +- {estimate.sigma:.2f} mm "
              f"({estimate.explained:.0%} of what varies on the axis)")  # fmt: skip
    axis, camera = ResultDirectory(out / "displacements").metrics().axis["symmetry"], measurement.cameras[0]
    h = np.linspace(measurement.box.lower[2], measurement.box.upper[2], camera.image_size[0])
    points = torch.tensor(axis["point"]) + torch.from_numpy(h)[:, None] * torch.tensor(axis["frame"][2])
    column, row = camera.project(points.to(camera.intrinsics)).round().long().unbind(-1)
    beside = round(ON_AXIS * camera.image_size[1] / 2)
    displacement = measurement.displacements[0].nan_to_num()
    rows = [float(displacement[r, c - beside : c + beside + 1, 1].mean()) for r, c in zip(row, column, strict=True)]
    estimate = spacing(h, np.array(rows), shortest, longest)
    print(f"shock cells by the displacement along the axis: {estimate.length:.2f} +- {estimate.sigma:.2f} mm")


def draw(out: Path) -> Path:
    """Draw measured and predicted halves, the section, and the index on the axis."""
    from matplotlib.figure import Figure

    half, whole = ResultDirectory(out / "half").reprojection(), ResultDirectory(out / "displacements").read()
    measured = half.measurement.displacements
    usable = half.measurement.usable_for(half.measurement.observations[0])
    limit = float(np.quantile(measured[usable].abs().numpy(), 0.995))
    with style(8):
        figure = Figure(figsize=(8.0, 5.6), layout="constrained")
        left, right = figure.subfigures(1, 2, width_ratios=(1.15, 1.0))
        grid = left.subplots(2, 2, sharex=True, sharey=True)
        for c, line in enumerate(grid):
            predicted = half.maps["deflection"][0, ..., c]
            images = (measured[0, ..., c], predicted)
            for axes, image, title in zip(line, images, ("measured", "predicted"), strict=True):
                axes.imshow(image, vmin=-limit, vmax=limit, cmap="RdBu_r")
                axes.set_title(f"{'uv'[c]} {title}")
                axes.label_outer()
        grid[1, 1].set_xlabel("right half withheld")
        section, line = right.subplots(2, 1, height_ratios=(1.9, 1.0))
        meridian = whole.meridian
        assert meridian is not None
        draw_section(section, meridian, "n")
        draw_centre_line(line, meridian, "n")
        path = out / "jet.png"
        figure.savefig(path, dpi=160)
    return path


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("reference", type=Path)
    parser.add_argument("flow", type=Path)
    parser.add_argument("--out", type=Path, default=Path("jet"))
    parser.add_argument("--distance", type=float, default=1000.0, help="camera to axis, mm; a guess")
    parser.add_argument("--background-distance", type=float, default=300.0, help="axis to background, mm; a guess")
    parser.add_argument("--mm-per-px", type=float, default=0.1, help="in the plane of the axis; a guess")
    parser.add_argument("--seconds", type=float, default=90.0, help="of each reconstruction")
    parser.add_argument("--cells", type=float, nargs=2, default=(10.0, 40.0), help="mm between which a cell is sought")
    arguments = parser.parse_args()
    folder = arguments.out / "images_taken"
    for kind, path in (("reference", arguments.reference), ("flow", arguments.flow)):
        (folder / "camera" / kind).mkdir(parents=True, exist_ok=True)
        shutil.copy(path, folder / "camera" / kind / path.name)
    rig = SimpleRig(distance=arguments.distance, mm_per_px=arguments.mm_per_px)
    measurement = measure(folder, rig, arguments.background_distance)
    measurement.write(arguments.out / "jet.nc")
    method = NeRIF(symmetry="axis", open_faces=("z-", "z+"), time_limit=arguments.seconds, source="displacements")
    for name, settings, run in (
        ("half", method, RunSettings(withhold=("right",))),
        ("displacements", method, RunSettings()),
        ("images", replace(method, source="images"), RunSettings(withhold=("none",))),
    ):
        print(f"-- {name}")
        reconstruct_into(
            arguments.out / name, arguments.out / "jet.nc", settings, run, force=True, monitor=Monitor(print)
        )
    for name, (u, v) in correlations(arguments.out / "half").items():
        print(f"{name}: predicted against measured displacement, correlation u {u:.3f}, v {v:.3f}")
    cells(arguments.out, measurement, *arguments.cells)
    print(f"{draw(arguments.out)}: measured, predicted, section, axis")


if __name__ == "__main__":
    main()
