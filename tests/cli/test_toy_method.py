"""A new method is a class and a line in METHODS: command line, settings file, report, app and docs know it by that."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import pytest
import torch
from torch import Tensor

from commands import metrics_of, run
from nerif.app.pages.reconstruct import form_of, titles
from nerif.data.measurement import Measurement
from nerif.fields.field import Field
from nerif.reconstruction.field_files import read_field
from nerif.reconstruction.methods import METHODS
from nerif.reconstruction.reconstructor import OnStep, Reconstruction, State
from nerif.reconstruction.shared_settings import SharedSettings, Source
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.reconstruction.voxels.voxel_problem import Iterate, Problem
from nerif.reconstruction.voxels.voxel_reconstructor import VoxelReconstructor
from nerif.results.directory import ResultDirectory

DOCS = Path(__file__).parents[2] / "docs"


@dataclass(frozen=True)
class Toy(VoxelReconstructor):
    """Voxels by steepest descent."""

    title: ClassVar[str] = "toy descent"
    gait: Literal["slow", "brisk"] = "slow"
    """Length of a step."""

    def iterate(self, problem: Problem, x: Tensor, weight: float) -> Iterator[Iterate]:
        while True:
            slope = problem.adjoint(problem.data - problem.forward(x))
            length = slope.square().sum() / problem.forward(slope).square().sum()
            x = problem.clip(x + (0.5 if self.gait == "slow" else 1.0) * length * slope)
            yield Iterate(x, problem.residual(x), 0.0)


@dataclass(frozen=True)
class Other(SharedSettings):
    """A method without voxels of its own."""

    title: ClassVar[str] = "toy without voxels"
    source: Source = "auto"
    """Data to fit."""
    gait: Literal["slow", "brisk"] = "slow"
    """Number of iterations."""

    def __call__(
        self, measurement: Measurement, on_step: OnStep | None = None, resume: State | None = None,
        start: Field | None = None,
    ) -> Reconstruction:  # fmt: skip
        method = Tikhonov(voxels=8, iterations=3 if self.gait == "slow" else 6, regularisation=1e-3)
        return method(measurement, on_step, resume, start)

    def split_for_cross_validation(self) -> tuple[Other, Other]:
        return self, self


@pytest.fixture(params=[Toy, Other])
def toy(request, monkeypatch) -> type[Toy | Other]:
    monkeypatch.setitem(METHODS, "toy", request.param)
    return request.param


def test_help_lists_it_and_its_settings(toy, capsys):
    assert run("reconstruct", "--help") == 0
    assert ",toy}" in capsys.readouterr().out
    assert run("reconstruct", "--method", "toy", "--help") == 0
    assert toy.about() in capsys.readouterr().out
    assert run("reconstruct", "--method", "toy", "--help", "all") == 0
    assert "--gait {slow,brisk}" in capsys.readouterr().out
    assert run("reconstruct", ".", "-o", "r", "--method", "toys") == 2
    assert "mart, toy, got 'toys'" in capsys.readouterr().err


def test_a_run_its_report_and_its_repetition(toy, measurement, tmp_path):
    measurement.write(tmp_path / "m.nc")
    first, again = tmp_path / "first", tmp_path / "again"
    voxels = ["--voxels", "8", *(["--iterations", "6"] if toy is Toy else [])]
    words = ["--method", "toy", "--gait", "brisk", *voxels]
    assert run("reconstruct", tmp_path / "m.nc", "-o", first, *words) == 0
    assert (ResultDirectory(first).settings()["method"], ResultDirectory(first).settings()["gait"]) == ("toy", "brisk")
    assert toy.title in (first / "report.html").read_text()
    assert run("reconstruct", "--config", first / "run.toml", "-o", again, "--no-report") == 0
    fields = [read_field(result)[0] for result in (first, again)]
    assert torch.equal(fields[0].coefficients, fields[1].coefficients)
    assert run("evaluate", again, "--measurement", tmp_path / "m.nc") == 0
    assert metrics_of(again)["views"]


def test_the_app_offers_it(toy):
    assert titles()["toy"].lower() == toy.title
    form = form_of("toy", "auto")
    assert form.field("gait").choices == ("slow", "brisk")
    assert form.arguments({"gait": "brisk"}) == ["--gait", "brisk"]
    assert {"time_limit", "voxels"} <= {f.name for f in form.fields}


def test_the_docs_list_it(toy, monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS / "_extensions"))
    from repository import api_pages

    monkeypatch.delitem(sys.modules, "repository")
    row = f"| `toy` | {toy.title} | {toy.about()} |"
    assert row in api_pages(DOCS)["reconstruction"]
