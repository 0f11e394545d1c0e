"""Several processes under torchrun find the field of one."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from nerif.cli.cli import main
from nerif.data.measurement import Measurement
from nerif.fields.network_shape import NetworkShape
from nerif.reconstruction.field_files import read_field
from nerif.reconstruction.neural.losses import MixedPrecision
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.objective import Objective
from nerif.reconstruction.neural.parallel import Ranks
from nerif.reconstruction.neural.sampling import PixelSampling, Sampler
from nerif.reconstruction.neural.training_data import TrainingData
from nerif.reconstruction.neural.training_settings import LossWeights

SMALL = [
    "--network.depth", "2", "--network.width", "24", "--network.octaves", "2", "--max-steps", "30",
    "--samples", "12", "16", "--sample-jitter", "2", "--points-per-batch", "600", "--voxels", "12", "--device", "cpu",
    "--precision", "float32", "--no-report",
]  # fmt: skip


def torchrun(*words: object) -> subprocess.CompletedProcess[str]:
    """Run nerif in two processes on this machine."""
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "nerif"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.run([*launch, *map(str, words)], capture_output=True, text=True, env=environment, timeout=120)


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("parallel") / "m.nc"
    tiny = ["--image-size", "18", "22", "--pixel-pitch", "0.2", "--views", "4", "--steps", "40", "--truth-voxels", "16"]
    assert main(["simulate", "--phantom", "gaussians", "--noise", "0.05", "-o", str(path), *tiny]) == 0
    return path


# Muon gives the smallest directions of a step the weight of the largest, and with them the last bit of a sum
@pytest.mark.slow
@pytest.mark.parametrize(("norm", "optimiser", "tolerance"), [("squared", "muon", 2e-3), ("l2", "adam", 2e-5)])
def test_two_processes_find_the_field_of_one(measured, tmp_path, norm, optimiser, tolerance):
    one, two = tmp_path / "one", tmp_path / "two"
    words = ["--norm", norm, "--optimiser", optimiser, "--withhold", "none", *SMALL]
    assert main(["reconstruct", str(measured), "-o", str(one), *words]) == 0
    run = torchrun("reconstruct", measured, "-o", two, *words)
    assert run.returncode == 0, run.stderr
    assert run.stdout.count("all 30 steps done") == 1  # only the first process reports
    points = 40 * torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) - 20
    a, b = read_field(one)[0](points), read_field(two)[0](points)
    assert float(a.abs().max()) > 0
    torch.testing.assert_close(a, b, rtol=0, atol=tolerance * float(a.abs().max()))


@pytest.mark.parametrize("options", [["--method", "tv"], ["--uncertainty", "fast"]])
def test_voxels_and_bootstrap_are_refused(measured, tmp_path, monkeypatch, capsys, options):
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert main(["reconstruct", str(measured), "-o", str(tmp_path / "r"), *options]) == 2
    assert "under torchrun" in capsys.readouterr().err


def test_a_process_without_a_ray_of_a_technique_has_the_same_terms_with_weight_0(measured):
    """One ray of a technique with a gradient and one of a technique without, for three processes."""
    m = Measurement.read(measured)
    maps = {"fringes": torch.zeros(m.shape), "fringes_sigma": torch.ones(m.shape)}
    settings = NeRIF(
        device="cpu", precision="float32", weights=LossWeights(1.0, 1.0, 1.0, 1.0),
        network=NetworkShape(width=24, depth=2, gradient_head=True),
    )  # fmt: skip
    data = TrainingData(settings, replace(m, maps=maps, wavelength_nm=532.0), coarsest=1)
    torch.manual_seed(0)
    field = data.initial_field()
    network = MixedPrecision(field.network, data.device, settings.precision, settings.compile)

    def of(ranks: Ranks) -> tuple[dict[str, float], set[str], float]:
        generator = torch.Generator().manual_seed(1)
        batch = Sampler(settings, data, field, network, generator, ranks).of(
            torch.tensor([0, len(data) - 1]), PixelSampling(1, 8)
        )
        objective = Objective(settings, data, field, network, generator)
        terms = objective.terms(batch)
        field.network.zero_grad()
        sum(terms.values()).backward()
        names = {name for name, p in field.network.named_parameters() if p.grad is not None}
        share = batch.own_numbers / batch.numbers
        parts, numbers = [p.part for p in batch.pieces], [p.numbers for p in batch.pieces]
        assert share or float(objective.ambient_term(parts, numbers)) == 0
        return {name: share * float(term.detach()) for name, term in terms.items()}, names, share

    alone, names, _ = of(Ranks())
    ranks = [of(Ranks(rank, 3)) for rank in range(3)]
    assert [share for _, _, share in ranks] == [1.0, 0.0, 0.0]
    assert all(list(terms) == list(alone) and others == names for terms, others, _ in ranks)
    assert {name: sum(terms[name] for terms, _, _ in ranks) for name in alone} == pytest.approx(alone)
