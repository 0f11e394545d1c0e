"""Why the `fast` preset is what it is: speed of a training step by its parts, and error at equal time.

    python benchmarks/choices.py --write benchmarks/results/choices-cpu.md

Ratios within one run are what counts: the machine may be shared.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch

from bench import N_AMBIENT, Table, add_write
from nerif.analysis.evaluation import evaluate_volume
from nerif.data.volume import Volume
from nerif.fields.network import Network, NetworkShape, NeuralField
from nerif.fields.phantoms import Flame
from nerif.geometry import Box, Grid, paper_rig
from nerif.reconstruction.device import keep_freed_memory
from nerif.reconstruction.neural.fused import value_and_gradient
from nerif.reconstruction.neural.losses import LossWeights
from nerif.reconstruction.neural.neural import NeRIF
from nerif.simulation.simulate import add_noise, simulate


def rate(work: Callable[[], object], points: int) -> float:
    """Median of seven timings of `work`, in thousand points a second."""
    work()
    seconds = []
    for _ in range(7):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return points / statistics.median(seconds) / 1e3


def steps(network: Network, count: int) -> dict[str, Callable[[], None]]:
    """A training step's arithmetic: gradient at so many points, and its derivative in the weights."""
    p = torch.rand(count, 3) * 2 - 1

    def exact(bf16: bool) -> None:
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=bf16):
            gradient = network.value_and_gradient(p)[1]
        gradient.float().square().mean().backward()

    def differences(bf16: bool) -> None:
        shift = 0.02 * torch.eye(3)[:2]
        points = torch.stack([p + s for s in (shift[0], -shift[0], shift[1], -shift[1])]).reshape(-1, 3)
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=bf16):
            n = network(points).float().reshape(4, -1)
        ((n[0] - n[1]).square() + (n[2] - n[3]).square()).mean().backward()

    def by_layers() -> None:
        value_and_gradient(network, p)[1].square().mean().backward()

    return {
        "exact gradient, float32": lambda: exact(False),
        "exact gradient, float32, layers in one function": by_layers,
        "exact gradient, bf16": lambda: exact(True),
        "four displaced evaluations, float32": lambda: differences(False),
        "four displaced evaluations, bf16": lambda: differences(True),
    }


def limit(network: Network, count: int) -> list[str]:
    """What a matrix product of the shape of a hidden layer reaches, and how many points a second that would allow."""
    layers = [weight for weight in network.layers.parameters() if weight.ndim == 2]
    # a product for the value and one for the slope, and two for the derivative of each; none for that in the points
    flops = 2 * (6 * sum(w.numel() for w in layers) - layers[0].numel())
    width, found = layers[-1].shape[0], []
    for dtype in (torch.float32, torch.bfloat16):
        x, w = torch.rand(count, width).to(dtype), torch.rand(width, width).to(dtype)
        speed = rate(partial(torch.mm, x, w), count) * 1e3 * 2 * width**2
        name = str(dtype).removeprefix("torch.")
        found.append(
            f"A product of {count} x {width} by {width} x {width} in {name}: {speed / 1e9:.0f} GFLOP/s; at that, the "
            f"exact gradient would have {speed / flops / 1e3:.0f} thousand points a second of {flops / 1e3:.0f} kFLOP."
        )
    return found


def sampling_rates(network: Network, count: int) -> dict[str, float]:
    """Evaluation in chunks of so many points, and of eight times as many."""
    field = NeuralField(network, Box.cube(50.0), 1e-4)
    points = torch.rand(16 * count, 3) * 50 - 25

    def run(chunk: int) -> None:
        with torch.no_grad():
            for part in points.split(chunk):
                field(part)

    return {f"values, chunks of {c}": rate(lambda c=c: run(c), len(points)) for c in (count, 8 * count)}  # type: ignore[misc]


def speeds(network: Network, count: int) -> dict[str, float]:
    """Thousand points a second of all that is timed, by name."""
    return {name: rate(work, count) for name, work in steps(network, count).items()} | sampling_rates(network, count)


def main() -> None:
    """Run and print both tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--points", type=int, default=8192, help="of a step, for its speed")
    parser.add_argument("--pixels", type=int, default=64, help="of an edge of each view")
    parser.add_argument("--time-limit", type=float, default=45.0, help="seconds of training of each variant")
    add_write(parser)
    arguments = parser.parse_args()
    table = Table(
        "Choices behind the fast preset",
        ("", "malloc as it is", "freed memory kept", "ratio"),
        arguments.write,
        f"\n\nNetwork of 4 layers of 128, {arguments.points} points a step, median of 7; thousand points a second.",
    )
    network = Network(NetworkShape())
    before = speeds(network, arguments.points)
    keep_freed_memory()
    after = speeds(network, arguments.points)
    for k in before:
        table.row([k, f"{before[k]:.0f}", f"{after[k]:.0f}", f"{after[k] / before[k]:.2f}"])

    table.text("", "  \n".join(limit(network, arguments.points)), "")
    cameras, box = paper_rig(arguments.pixels)
    flame = Flame(box)
    grid = Grid.of_resolution(box, 64)
    truth = Volume(flame.sample(grid), grid)
    measurement = add_noise(simulate(flame, cameras, box, N_AMBIENT), 0.05, seed=1)
    base = NeRIF(time_limit=arguments.time_limit, device="cpu")
    variants = {
        "fast preset": base,
        "Adam for all weights": replace(base, optimiser="adam"),
        "equal intervals, one draw a ray": replace(base, sampling="shifted"),
        "equal intervals, one draw each (the paper's sampling)": replace(base, sampling="random"),
        "equal intervals, twice the samples a ray": replace(base, sampling="shifted", samples=(24, 48)),
        "Adam and equal intervals": replace(base, optimiser="adam", sampling="shifted", samples=(24, 48)),
        "octaves along the axes alone": replace(base, network=replace(base.network, directions=3)),
        "octaves along nine directions": replace(base, network=replace(base.network, directions=9)),
        "96 neurons a layer": replace(base, network=replace(base.network, width=96)),
        "plain network": replace(base, compile="off"),
        "float32 throughout": replace(base, precision="float32"),
        "bf16 throughout": replace(base, full_precision_from=2.0),
        "central differences alone": replace(base, weights=LossWeights(numerical=1, automatic=0)),
        "mean length of residuals (the paper's norm)": replace(base, norm="l2"),
    }
    table.text(
        "",
        f"Flame, 9 views of {arguments.pixels} x {arguments.pixels}, noise 0.05, "
        f"{arguments.time_limit:g} s of training each:",
        "",
    )
    table.begin(("", "steps", "L2", "L2 of variation", "CC"))
    for name, settings in variants.items():
        result = settings(measurement)
        m = evaluate_volume(result.field, truth, N_AMBIENT)
        steps_done = result.history[-1]["step"]
        table.row([name, f"{steps_done:.0f}", f"{m['l2']:.3%}", f"{m['l2_variation']:.2%}", f"{m['cc']:.5f}"])


if __name__ == "__main__":
    main()
