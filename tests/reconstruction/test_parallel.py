"""Two processes under torchrun do what one does with the same batch."""

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
from nerif.fields.network import NetworkShape
from nerif.reconstruction.files import read_field
from nerif.reconstruction.neural.losses import LossWeights, MixedPrecision
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.objective import Draw, Objective
from nerif.reconstruction.neural.parallel import Ranks
from nerif.reconstruction.neural.training_data import TrainingData

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
    done = torchrun("reconstruct", measured, "-o", two, *words)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("all 30 steps done") == 1  # the first process alone tells
    points = 40 * torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) - 20
    a, b = read_field(one)[0](points), read_field(two)[0](points)
    assert float(a.abs().max()) > 0
    torch.testing.assert_close(a, b, rtol=0, atol=tolerance * float(a.abs().max()))


def test_what_does_not_split_is_refused(measured, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert main(["reconstruct", str(measured), "-o", str(tmp_path / "r"), "--method", "tv"]) == 2
    assert "under torchrun" in capsys.readouterr().err
    assert main(["reconstruct", str(measured), "-o", str(tmp_path / "r"), "--uncertainty", "fast"]) == 2
    assert "under torchrun" in capsys.readouterr().err


def test_every_ray_is_in_one_share():
    rays = torch.arange(11)
    shares = [rays[Ranks(rank, 3).share] for rank in range(3)]
    assert sorted(torch.cat(shares).tolist()) == rays.tolist()


def test_a_process_without_a_ray_of_a_technique_has_the_same_terms_and_counts_for_nothing(measured):
    """One ray of a technique that measures the gradient and one of a technique that does not, for three processes."""
    m = Measurement.read(measured)
    fringes = torch.zeros(m.shape)
    both = replace(m, maps={"fringes": fringes, "fringes_sigma": torch.ones(m.shape)}, wavelength_nm=532.0)
    weights, heads = LossWeights(1.0, 1.0, 1.0, 1.0), NetworkShape(width=24, depth=2, gradient_head=True)
    settings = NeRIF(device="cpu", precision="float32", weights=weights, network=heads)
    data = TrainingData(settings, both, coarsest=1)
    torch.manual_seed(0)
    field = data.initial_field()
    network = MixedPrecision(field.network, data.device, settings.precision, settings.compile)
    index = torch.tensor([0, len(data) - 1])

    def of(ranks: Ranks) -> tuple[dict[str, float], set[str], float]:
        drawn = torch.Generator().manual_seed(1)
        objective = Objective(settings, data, field, network, drawn, ranks)
        pieces, whole = objective.batch(index, Draw(1, 8))
        terms = objective.terms(pieces)
        field.network.zero_grad()
        sum(terms.values()).backward()
        weighed = {name for name, p in field.network.named_parameters() if p.grad is not None}
        share = sum(piece.numbers for piece in pieces) / whole
        assert share or float(objective.ambient_term([p.part for p in pieces], [p.numbers for p in pieces])) == 0
        return {name: share * float(term.detach()) for name, term in terms.items()}, weighed, share

    alone, weighed, _ = of(Ranks())
    shared = [of(Ranks(rank, 3)) for rank in range(3)]
    assert [share for _, _, share in shared] == [1.0, 0.0, 0.0]
    for terms, others, _ in shared:
        assert list(terms) == list(alone)
        assert others == weighed
    assert {name: sum(terms[name] for terms, _, _ in shared) for name in alone} == pytest.approx(alone)
