"""X-ray absorption of a liquid spray, one slice: from a scan by parallel rays to the extinction coefficient.

    python examples/spray.py spray_Re6700.hdf5 --slice impingement --out spray

The data are of N. Rahman et al., doi 10.4231/G20X-4Z27 (CC0). The scan itself tells its offset, its axis of rotation
and by how much it falls short where little is left of the beam (nerif/imaging/line_scans.py). Every fifth angle is held
out and predicted; the figure shows slice, sinogram, residuals and the angles that were predicted.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import xarray as xr

from nerif import NeRIF, TotalVariation, reproject
from nerif.imaging.line_scans import LineScan, Told
from nerif.reconstruction.base import Reconstruction, Reconstructor

WITHHELD = (2, 7, 12, 17)
WEIGHTS = (5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3)  # of total variation, tried
FOLDS = 5  # shares of the angles, each of which is predicted from the others
WATER = 1006.0  # mm2/g at 8 keV: extinction over density


def read(path: Path, name: str) -> LineScan:
    """Return the scan of one of the slices jets, impingement and near."""
    with xr.open_dataset(path, group=name, engine="h5netcdf", phony_dims="sort") as data:
        arrays = (data[key].values.astype(np.float64) for key in ("theta", "x", "ext_length"))
        return LineScan(*arrays)


def reconstruct(
    scan: LineScan, withheld: tuple[int, ...], method: Reconstructor
) -> tuple[LineScan, np.ndarray, Reconstruction, Told]:
    """Return the scan without offset, what is predicted of all its angles, the field, and what the scan told.

    Nothing of the angles held out is used.
    """
    kept = [i for i in range(len(scan.angles)) if i not in withheld]
    told = scan.select(kept).tell()
    scan = scan.without_offset(told.offset)
    whole = scan.unbent(told.bend).measurement(told.axis)
    training = whole.select([whole.names[i] for i in kept])
    found = method(replace(training, maps={"absorbance": training.maps["absorbance"]}))  # all readings count alike
    predicted = LineScan.bent(reproject(found.field, whole).predicted[:, 0, :, 0].numpy(), told.bend)
    return scan, predicted, found, told


def total_variation(scan: LineScan, withheld: tuple[int, ...], weights: tuple[float, ...] = WEIGHTS) -> TotalVariation:
    """Return total variation with the weight that best predicts each fifth of the other angles from the rest."""
    method = TotalVariation(voxels=75, basis="linear", iterations=200)
    kept = scan.select([i for i in range(len(scan.angles)) if i not in withheld])

    def error(weight: float) -> float:
        total = 0.0
        for first in range(FOLDS):
            out = tuple(range(first, len(kept.angles), FOLDS))
            tried, predicted, _, _ = reconstruct(kept, out, replace(method, regularisation=weight))
            total += float(np.square((predicted - tried.readings)[list(out)]).sum())
        return total

    return replace(method, regularisation=min(weights, key=error))


def refined_axis(scan: LineScan, told: Told, method: TotalVariation) -> float:
    """Return the position of the axis of rotation, mm, that a rig refined together with the field shows.

    The rig is set up as if the axis were at 0; the angles' shifts sideways are s = c + a cos(theta) + b sin(theta), of
    which a and b move rig and field alike, and c is what the axis is off by.
    """
    rig = replace(method, refine=("cameras",), pose_sigma_mm=0.3, pose_sigma_deg=1e-4)
    found = rig(scan.without_offset(told.offset).unbent(told.bend).measurement(0.0))
    shifts = np.array([view["values"]["shift_x"] for view in found.rig])
    waves = np.stack([np.ones_like(scan.angles), np.cos(scan.angles), np.sin(scan.angles)], axis=1)
    return -float(np.linalg.lstsq(waves, shifts, rcond=None)[0][0])


def relative_error(predicted: np.ndarray, measured: np.ndarray) -> float:
    """Return |predicted - measured| / |measured|."""
    return float(np.linalg.norm(predicted - measured) / np.linalg.norm(measured))


def draw(path: Path, scan: LineScan, predicted: np.ndarray, found: Reconstruction, withheld: tuple[int, ...]) -> None:
    """Write the figure."""
    from matplotlib.figure import Figure

    from nerif.geometry import Grid

    (x0, y0, _), (x1, y1, _) = found.box.lower, found.box.upper
    middle = found.volume(Grid.of_resolution(found.box, 160)).values
    middle = middle[len(middle) // 2].numpy() / WATER * 1e3
    figure = Figure(figsize=(11, 6.2), layout="constrained")
    axes = figure.subplots(2, 2)
    shown = axes[0, 0].imshow(middle, origin="lower", extent=(x0, x1, y0, y1), cmap="magma", vmin=0)
    axes[0, 0].set(xlabel="x [mm]", ylabel="y [mm]", title="Density of water in the slice")
    figure.colorbar(shown, ax=axes[0, 0], label="mg mm⁻³")
    x, degrees = scan.positions, np.degrees(scan.angles)
    extent = (x[0] - scan.spacing / 2, x[-1] + scan.spacing / 2, degrees[-1] + 5, degrees[0] - 5)
    residual = predicted - scan.readings
    largest = float(np.percentile(np.abs(residual), 99.5))
    diverging = {"cmap": "RdBu_r", "vmin": -largest, "vmax": largest}
    for ax, values, title, style in (
        (axes[0, 1], scan.readings, "Absorbance measured", {"cmap": "magma", "vmin": 0}),
        (axes[1, 0], residual, "Predicted minus measured", diverging),
    ):
        shown = ax.imshow(values, aspect="auto", extent=extent, **style)
        ax.set(xlabel="position [mm]", ylabel="angle [°]", title=title)
        figure.colorbar(shown, ax=ax)
    for i in withheld:
        axes[1, 0].axhline(degrees[i], color="0.4", linewidth=0.6, linestyle=":")
    for k, i in enumerate(withheld):
        (line,) = axes[1, 1].plot(x, predicted[i] + k, linewidth=1)
        axes[1, 1].plot(x, scan.readings[i] + k, ".", markersize=4, color=line.get_color())
        axes[1, 1].text(x[-1], k + 0.08, f"{degrees[i]:.0f}°", ha="right", color=line.get_color())
    axes[1, 1].set(xlabel="position [mm]", ylabel="absorbance, each 1 higher", title="Angles held out; dots: measured")
    figure.savefig(path, dpi=150)


def main() -> None:
    """Reconstruct a slice, print what was found, and draw it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path, help="spray_Re6700.hdf5")
    parser.add_argument("--slice", default="impingement", choices=["jets", "impingement", "near"])
    parser.add_argument("--method", default="nerif", choices=["nerif", "tv"])
    parser.add_argument("--withhold", type=int, nargs="*", default=list(WITHHELD), help="numbers of angles")
    parser.add_argument("--steps", type=int, default=300, help="of training")
    parser.add_argument("--find-axis", action="store_true", help="find the axis of rotation by a refined rig as well")
    parser.add_argument("--out", type=Path, default=Path("spray"))
    asked = parser.parse_args()
    methods: dict[str, Reconstructor] = {
        "nerif": NeRIF(max_steps=asked.steps, samples=(24, 40)),
    }
    scan, withheld = read(asked.data, asked.slice), tuple(asked.withhold)
    if asked.find_axis:
        at = refined_axis(scan, scan.tell(), TotalVariation(voxels=40, basis="linear"))
        print(f"axis by a rig that is refined with the field: {at:.3f} mm")
    if asked.method == "tv":
        methods["tv"] = total_variation(scan, withheld)
    scan, predicted, found, told = reconstruct(scan, withheld, methods[asked.method])
    print(told)
    kept = [i for i in range(len(scan.angles)) if i not in withheld]
    print(f"angles reconstructed from: relative rms error {relative_error(predicted[kept], scan.readings[kept]):.4f}")
    if withheld:
        chosen = list(withheld)
        print(f"angles held out: relative rms error {relative_error(predicted[chosen], scan.readings[chosen]):.4f}")
    asked.out.mkdir(parents=True, exist_ok=True)
    draw(asked.out / f"{asked.slice}-{asked.method}.png", scan, predicted, found, withheld)
    print(f"{asked.out / f'{asked.slice}-{asked.method}.png'}: slice, sinogram and residuals")


if __name__ == "__main__":
    main()
