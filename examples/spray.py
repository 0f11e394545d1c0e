"""X-ray absorption of a liquid spray, one slice: from a scan by parallel rays to the extinction coefficient.

    python examples/spray.py spray_Re6700.hdf5 --slice impingement --out spray

Data: N. Rahman et al., doi 10.4231/G20X-4Z27 (CC0). Offset, axis of rotation and saturation are estimated from the scan
(line_scans.py). Every fifth angle is withheld and predicted; the figure shows slice, sinogram, residuals and the
withheld angles.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import xarray as xr
from line_scans import LineScan, ScanEstimate

from nerif import Measurement, NeRIF, TotalVariation, reproject
from nerif.reconstruction.reconstructor import Reconstruction, Reconstructor

WITHHELD = (2, 7, 12, 17)
WEIGHTS = (5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3)  # of total variation, to choose from
FOLDS = 5  # of the cross-validation
ANGLE_DIGITS = 4  # of an angle in degrees; the file has single precision
WATER = 1006.0  # mm2/g at 8 keV: extinction over density


def read(path: Path, name: str) -> LineScan:
    """Return the scan of one of the slices jets, impingement and near."""
    with xr.open_dataset(path, group=name, engine="h5netcdf", phony_dims="sort") as data:
        arrays = (data[key].values.astype(np.float64) for key in ("theta", "x", "ext_length"))
        theta, x, readings = arrays
        return LineScan(np.radians(np.degrees(theta).round(ANGLE_DIGITS)), x, readings)


def without_sigma(measurement: Measurement) -> Measurement:
    """Return the measurement with readings of equal weight: sigma is that outside the medium, where it is smallest."""
    return replace(measurement, maps={"absorbance": measurement.maps["absorbance"]})


def reconstruct(
    scan: LineScan, withheld: tuple[int, ...], method: Reconstructor
) -> tuple[LineScan, np.ndarray, Reconstruction, ScanEstimate]:
    """Return the scan without offset, the prediction of all its angles, the field, and the estimates of the scan.

    The withheld angles are not used.
    """
    training = [i for i in range(len(scan.angles)) if i not in withheld]
    estimate = scan.select(training).estimate()
    scan = scan.without_offset(estimate.offset)
    whole = scan.corrected(estimate.saturation).measurement(estimate.axis)
    measurement = whole.select([whole.names[i] for i in training])
    result = method(without_sigma(measurement))
    predicted = LineScan.saturate(reproject(result.field, whole).predicted[:, 0, :, 0].numpy(), estimate.saturation)
    return scan, predicted, result, estimate


def total_variation(scan: LineScan, withheld: tuple[int, ...], weights: tuple[float, ...] = WEIGHTS) -> TotalVariation:
    """Return total variation with the weight that best predicts each fifth of the other angles from the rest."""
    method = TotalVariation(voxels=75, basis="linear", iterations=200)
    training = scan.select([i for i in range(len(scan.angles)) if i not in withheld])

    def error(weight: float) -> float:
        total = 0.0
        for first in range(FOLDS):
            fold = tuple(range(first, len(training.angles), FOLDS))
            corrected, predicted, _, _ = reconstruct(training, fold, replace(method, regularisation=weight))
            total += float(np.square((predicted - corrected.readings)[list(fold)]).sum())
        return total

    return replace(method, regularisation=min(weights, key=error))


def refined_axis(scan: LineScan, estimate: ScanEstimate, method: TotalVariation) -> float:
    """Return the position of the axis of rotation, mm, by refinement of the rig together with the field.

    The rig assumes the axis at 0; the lateral shifts of the angles are s = c + a cos(theta) + b sin(theta), of which a
    and b move rig and field together, and -c is the position of the axis.
    """
    rig = replace(method, refine=("cameras",), pose_sigma_mm=0.3, pose_sigma_deg=1e-4)
    result = rig(scan.without_offset(estimate.offset).corrected(estimate.saturation).measurement(0.0))
    shifts = np.array([view["values"]["shift_x"] for view in result.rig])
    waves = np.stack([np.ones_like(scan.angles), np.cos(scan.angles), np.sin(scan.angles)], axis=1)
    return -float(np.linalg.lstsq(waves, shifts, rcond=None)[0][0])


def relative_error(predicted: np.ndarray, measured: np.ndarray) -> float:
    """Return |predicted - measured| / |measured|."""
    return float(np.linalg.norm(predicted - measured) / np.linalg.norm(measured))


def draw(path: Path, scan: LineScan, predicted: np.ndarray, result: Reconstruction, withheld: tuple[int, ...]) -> None:
    """Write the figure."""
    from matplotlib.figure import Figure

    from nerif.geometry import Grid

    (x0, y0, _), (x1, y1, _) = result.box.lower, result.box.upper
    middle = result.volume(Grid.of_resolution(result.box, 160)).values
    middle = middle[len(middle) // 2].numpy() / WATER * 1e3
    figure = Figure(figsize=(11, 6.2), layout="constrained")
    axes = figure.subplots(2, 2)
    image = axes[0, 0].imshow(middle, origin="lower", extent=(x0, x1, y0, y1), cmap="magma", vmin=0)
    axes[0, 0].set(xlabel="x [mm]", ylabel="y [mm]", title="Density of water in the slice")
    figure.colorbar(image, ax=axes[0, 0], label="mg mm⁻³")
    x, degrees = scan.positions, np.degrees(scan.angles)
    extent = (x[0] - scan.spacing / 2, x[-1] + scan.spacing / 2, degrees[-1] + 5, degrees[0] - 5)
    residual = predicted - scan.readings
    largest = float(np.percentile(np.abs(residual), 99.5))
    diverging = {"cmap": "RdBu_r", "vmin": -largest, "vmax": largest}
    for ax, values, title, style in (
        (axes[0, 1], scan.readings, "Absorbance measured", {"cmap": "magma", "vmin": 0}),
        (axes[1, 0], residual, "Predicted minus measured", diverging),
    ):
        image = ax.imshow(values, aspect="auto", extent=extent, **style)
        ax.set(xlabel="position [mm]", ylabel="angle [°]", title=title)
        figure.colorbar(image, ax=ax)
    for i in withheld:
        axes[1, 0].axhline(degrees[i], color="0.4", linewidth=0.6, linestyle=":")
    for k, i in enumerate(withheld):
        (line,) = axes[1, 1].plot(x, predicted[i] + k, linewidth=1)
        axes[1, 1].plot(x, scan.readings[i] + k, ".", markersize=4, color=line.get_color())
        axes[1, 1].text(x[-1], k + 0.08, f"{degrees[i]:.0f}°", ha="right", color=line.get_color())
    axes[1, 1].set(xlabel="position [mm]", ylabel="absorbance, each 1 higher", title="Withheld angles; dots: measured")
    figure.savefig(path, dpi=150)


def main() -> None:
    """Reconstruct a slice, print the errors, and draw it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path, help="spray_Re6700.hdf5")
    parser.add_argument("--slice", default="impingement", choices=["jets", "impingement", "near"])
    parser.add_argument("--method", default="nerif", choices=["nerif", "tv"])
    parser.add_argument("--withhold", type=int, nargs="*", default=list(WITHHELD), help="numbers of angles")
    parser.add_argument("--steps", type=int, default=300, help="of training")
    parser.add_argument("--find-axis", action="store_true", help="also by refinement of the rig")
    parser.add_argument("--out", type=Path, default=Path("spray"))
    parser.add_argument(
        "--measurement", type=Path, help="NAME.nc: write the corrected scan for nerif reconstruct, and end"
    )
    options = parser.parse_args()
    methods: dict[str, Reconstructor] = {
        "nerif": NeRIF(max_steps=options.steps, samples=(24, 40)),
    }
    scan, withheld = read(options.data, options.slice), tuple(options.withhold)
    if options.measurement is not None:
        estimate = scan.estimate()
        corrected = scan.without_offset(estimate.offset).corrected(estimate.saturation).measurement(estimate.axis)
        without_sigma(corrected).write(options.measurement)
        print(f"{options.measurement}: {estimate}")
        return
    if options.find_axis:
        at = refined_axis(scan, scan.estimate(), TotalVariation(voxels=40, basis="linear"))
        print(f"axis by refinement of the rig: {at:.3f} mm")
    if options.method == "tv":
        methods["tv"] = total_variation(scan, withheld)
    scan, predicted, result, estimate = reconstruct(scan, withheld, methods[options.method])
    print(estimate)
    training = [i for i in range(len(scan.angles)) if i not in withheld]
    for name, angles in (("training", training), ("withheld", list(withheld))):
        if angles:
            error = relative_error(predicted[angles], scan.readings[angles])
            print(f"{name} angles: relative rms error {error:.4f}")
    options.out.mkdir(parents=True, exist_ok=True)
    draw(options.out / f"{options.slice}-{options.method}.png", scan, predicted, result, withheld)
    print(f"{options.out / f'{options.slice}-{options.method}.png'}: slice, sinogram and residuals")


if __name__ == "__main__":
    main()
