"""Draw the figure of the paper: a flame, its reconstructions from noisy displacements, and their errors.

    python paper/figure.py [OUT.png [PIXELS STEPS VOXELS]]

Nine views over 170 degrees, 96 x 96 px, noise of 10 %; errors and seconds are printed.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import nerif

SENSOR, N_AMBIENT, NOISE = 4.0, 1.00027, 0.1  # SENSOR: edge in mm
SCALE = 1e4  # of the index in the figure


Fits = dict[str, tuple[np.ndarray, dict[str, Any]]]


def reconstruct(pixels: int, steps: int, voxels: int) -> tuple[np.ndarray, Fits]:
    """Return the truth n - n_ambient [z, y, x] and, of each method, the same and its scores."""
    box = nerif.Box((-25, -25, -25), (25, 25, 25))
    rig = nerif.Ring(
        views=9, arc=(0, 170), image_size=(pixels, pixels), pixel_pitch=SENSOR / pixels, distance=700,
        background_distance=500,
    )  # fmt: skip
    flame = nerif.make_phantom("flame", box)
    measurement = nerif.simulate(flame, rig.cameras(), box, n_ambient=N_AMBIENT, noise=NOISE)
    grid = nerif.Grid.of_resolution(box, voxels)
    truth = nerif.Volume(flame.sample(grid), grid, attributes={"n_ambient": N_AMBIENT})
    methods = {
        "NeRIF": nerif.preset("fast", max_steps=steps, precision="float32", device="cpu"),
        "total variation": nerif.TotalVariation(voxels=min(64, voxels), basis="cubic", device="cpu"),
    }
    fits = {}
    for name, method in methods.items():
        result = method(measurement)
        scores = nerif.evaluate_volume(result.field, truth, N_AMBIENT)
        print(f"{name}: L2 {scores['l2']:.2%}, of the variation {scores['l2_variation']:.2%}, {result.seconds:.0f} s")
        fits[name] = (np.asarray(result.volume(grid)), scores)
    return np.asarray(truth), fits


def draw(truth: np.ndarray, fits: Fits, out: Path) -> None:
    """Draw the vertical middle slice of truth and reconstructions, and of the errors below them."""
    middle = truth.shape[1] // 2
    slices = {"truth": truth[:, middle] * SCALE} | {
        name: values[:, middle] * SCALE for name, (values, _) in fits.items()
    }
    errors = {name: slices[name] - slices["truth"] for name in fits}
    largest = max(float(np.quantile(np.abs(error), 0.999)) for error in errors.values())
    figure = Figure(figsize=(7.0, 4.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 3, subplot_kw={"xticks": [], "yticks": []})
    limits = float(slices["truth"].min()), float(slices["truth"].max())
    for column, (name, values) in zip(axes.T, slices.items(), strict=True):
        image = column[0].imshow(values, origin="lower", vmin=limits[0], vmax=limits[1], cmap="inferno")
        column[0].set_title(name, fontsize=9)
        if name in errors:
            error = column[1].imshow(errors[name], origin="lower", vmin=-largest, vmax=largest, cmap="RdBu_r")
            share = fits[name][1]["l2_variation"]
            column[1].set_xlabel(f"error: {share:.1%} of the variation", fontsize=8)
    axes[1, 0].axis("off")
    for panel, row, label in ((image, axes[0], "10⁴ (n − n_ambient)"), (error, axes[1], "10⁴ error of n")):
        bar = figure.colorbar(panel, ax=list(row), shrink=0.85)
        bar.ax.tick_params(labelsize=7)
        bar.set_label(label, fontsize=8)
    figure.savefig(out, dpi=200)


def main(words: list[str]) -> None:
    """Reconstruct and draw."""
    out = Path(words[0]) if words else Path(__file__).with_name("figure.png")
    pixels, steps, voxels = map(int, words[1:4]) if len(words) > 1 else (96, 500, 80)
    draw(*reconstruct(pixels, steps, voxels), out)
    print(f"{out}: {out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
