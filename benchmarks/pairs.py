"""Real pairs of images: what optical flow leaves of the flow image, and what a smooth displacement does.

    python benchmarks/pairs.py ../shared/data/bos_pairs --write benchmarks/results/pairs-cpu.md

The folder holds NAME_reference.tif and NAME_flow.tif. A displacement that is a function of the pixel alone, cubic
B-splines of some spacing, is fitted to the grey values by the model of the reconstruction (gain and offset that vary
slowly, images first blurred, then less). The residual is that of the unblurred images, in grey values, a margin
of 20 px left out, each displacement with the gain and offset that suit it best.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bench import Table, add_write
from nerif.forward.images import Images, References
from nerif.imaging.displacement.displacement import DisplacementSettings, displacement
from nerif.imaging.displacement.optical_flow import FLOWS
from nerif.imaging.readers.open import open_frames

MARGIN = 20
BLURS = (3.0, 1.0, 0.0)
ROUNDS = 15  # of L-BFGS at each blur


class Pair:
    """A pair of images, as the reconstruction sees one."""

    def __init__(self, reference: np.ndarray, flow: np.ndarray, blur: float) -> None:
        size = [(flow.shape[0], flow.shape[1])]
        maps = {"reference": torch.tensor(reference)[None].float(), "flow": torch.tensor(flow)[None].float()}
        maps = Images.blur(maps, size, blur) if blur else maps
        self.references = References(maps["reference"], size)
        self.references.match(maps["flow"])
        row, column = torch.meshgrid(*(torch.arange(n) for n in flow.shape), indexing="ij")
        self.pixel = torch.stack([column, row], dim=-1).reshape(-1, 2).float()
        self.view, self.flow = torch.zeros(len(self.pixel), dtype=torch.int16), maps["flow"].flatten()
        last = torch.tensor(flow.shape[::-1]) - 1 - MARGIN
        self.inner = ((self.pixel >= MARGIN) & (self.pixel <= last)).all(dim=-1)

    def settle(self, d: Float[Tensor, "n 2"]) -> None:
        """Fit gain and offset to a displacement."""
        inner = self.inner
        one = torch.ones(int(inner.sum()))
        self.references.fit(self.view[inner], self.pixel[inner], d[inner], self.flow[inner], one)

    def left(self, d: Float[Tensor, "n 2"]) -> Float[Tensor, " n"]:
        """Return the difference to the flow image, grey values."""
        return self.references.flow_at(self.view, self.pixel, d) - self.flow

    def rms(self, d: Float[Tensor, "n 2"]) -> float:
        """Return the rms difference inside the margin, gain and offset fitted."""
        self.settle(d)
        return float(self.left(d)[self.inner].square().mean().sqrt())


class Smooth:
    """Displacements by cubic B-splines, which are the shape of an image's own spline."""

    def __init__(self, shape: tuple[int, ...], spacing: float) -> None:
        self.knots = [int(np.ceil((n - 1) / spacing)) + 4 for n in shape]
        bases = []
        for n, knots in zip(shape, self.knots, strict=True):
            t = torch.arange(n) / spacing
            first, u = t.floor().long(), t - t.floor()
            v = 1 - u
            taps = torch.stack([v**3, 4 - 6 * u**2 + 3 * u**3, 4 - 6 * v**2 + 3 * v**3, u**3], dim=-1) / 6
            basis = torch.zeros(n, knots)
            for k in range(4):
                basis[torch.arange(n), first + k] = taps[:, k]
            bases.append(basis)
        self.down, self.across = bases

    def __call__(self, c: Float[Tensor, "2 r c"]) -> Float[Tensor, "n 2"]:
        """Return the displacement at every pixel."""
        return (self.down @ c @ self.across.T).flatten(1).T


def fitted(reference: np.ndarray, flow: np.ndarray, spacing: float) -> Float[Tensor, "n 2"]:
    """Fit a smooth displacement to grey values, from nothing."""
    smooth = Smooth(flow.shape, spacing)
    c = torch.zeros(2, *smooth.knots, requires_grad=True)
    for blur in BLURS:
        pair = Pair(reference, flow, blur)
        pair.settle(smooth(c.detach()))
        optimiser = torch.optim.LBFGS([c], max_iter=ROUNDS, history_size=8, line_search_fn="strong_wolfe")
        spread = float(pair.left(smooth(c.detach())).square().mean())

        def loss(pair: Pair = pair, optimiser: torch.optim.LBFGS = optimiser, spread: float = spread) -> Tensor:
            optimiser.zero_grad()
            total = pair.left(smooth(c)).square().mean() / spread
            total.backward()
            return total

        optimiser.step(loss)
    return smooth(c.detach())


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("pairs", type=Path, help="folder with NAME_reference.tif and NAME_flow.tif")
    parser.add_argument("--spacing", type=float, nargs="+", default=[5.0], help="of the splines, px")
    add_write(parser)
    asked = parser.parse_args()
    columns = ["pair", "displacement", "rms [px]", "residual [grey values]", "without any", "s"]
    table = Table("Real pairs of images", columns, asked.write)
    for path in sorted(asked.pairs.glob("*_reference.tif")):
        name = path.name.removesuffix("_reference.tif")
        reference, flow = (open_frames(asked.pairs / f"{name}_{what}.tif")[0] for what in ("reference", "flow"))
        reference, flow = (np.asarray(x, dtype=np.float32) for x in (reference, flow))
        sharp = Pair(reference, flow, 0.0)
        without = sharp.rms(torch.zeros_like(sharp.pixel))
        routes = [(f"optical flow, {method}", method) for method in FLOWS]
        routes += [(f"grey values, splines of {spacing:g} px", spacing) for spacing in asked.spacing]
        for words, how in routes:
            start = time.perf_counter()
            if isinstance(how, str):
                d = torch.tensor(displacement(reference, flow, DisplacementSettings(how))).reshape(-1, 2).float()
            else:
                d = fitted(reference, flow, how)
            seconds = time.perf_counter() - start
            rms = float(d[sharp.inner].square().mean().sqrt())
            table.row([name, words, f"{rms:.3f}", f"{sharp.rms(d):.3f}", f"{without:.3f}", f"{seconds:.0f}"])


if __name__ == "__main__":
    main()
