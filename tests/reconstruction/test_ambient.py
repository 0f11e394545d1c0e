"""Truths and phantoms with another ambient index are converted, or refused without one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from nerif.analysis.evaluation import evaluate
from nerif.cli.cli import main
from nerif.common.conventions import InputError
from nerif.data.volume import Volume, write_netcdf
from nerif.fields.voxel_field import VoxelField
from nerif.geometry import Grid
from nerif.reconstruction.reconstructor import Outcome, Reconstruction
from nerif.results.directory import ResultDirectory
from nerif.simulation.simulate import simulate
from nerif.simulation.simulation import Simulation

N_AMBIENT = 1.00027


@pytest.fixture(scope="module")
def truth(ball, box) -> Volume:
    """The balls over air."""
    grid = Grid(box, (12, 14, 16))
    return Volume(ball.sample(grid), grid, attributes={"n_ambient": N_AMBIENT})


@pytest.fixture
def perfect(truth, tmp_path) -> ResultDirectory:
    """A result whose field is the truth."""
    field = VoxelField.through(truth.values, truth.grid)
    out = ResultDirectory(tmp_path / "r")
    out.begin({"method": "tikhonov"})
    out.write_field(Reconstruction(field, truth.grid.box, N_AMBIENT, [], Outcome("converged", ""), {}))
    return out


def over_vacuum(truth: Volume) -> Volume:
    """The same n, counted from 1."""
    return replace(truth, values=truth.values + (N_AMBIENT - 1), attributes={"n_ambient": 1.0})


def test_an_excess_is_converted_to_another_ambient(truth):
    other = over_vacuum(truth)
    assert other.relative_to(N_AMBIENT).n_ambient == N_AMBIENT
    torch.testing.assert_close(other.relative_to(N_AMBIENT).values, truth.values, atol=1e-9, rtol=0)
    n = Volume(truth.values.double() + N_AMBIENT, truth.grid, "n")
    torch.testing.assert_close(n.relative_to(N_AMBIENT).values, truth.values, atol=1e-9, rtol=0)
    assert truth.relative_to(N_AMBIENT) is truth
    for changes, message in (({"attributes": {}}, "n_ambient"), ({"quantity": "density"}, "index_excess or n")):
        with pytest.raises(InputError, match=message):
            replace(truth, **changes).relative_to(N_AMBIENT)


def test_a_perfect_field_has_no_error_against_a_truth_over_another_ambient(truth, perfect, tmp_path):
    path = tmp_path / "t.nc"
    write_netcdf(path, [over_vacuum(truth)])
    metrics = evaluate(perfect.path, truth=path)
    assert metrics["l2_variation"] < 1e-3
    assert perfect.metrics().l2 == metrics["l2"]
    perfect.write_volumes([truth])
    torch.testing.assert_close(perfect.read().truth.values, truth.values, atol=1e-9, rtol=0)


def test_a_truth_over_an_unknown_ambient_is_refused(truth, perfect, tmp_path, capsys):
    write_netcdf(tmp_path / "t.nc", [replace(truth, attributes={})])
    assert main(["evaluate", str(perfect.path), "--truth", str(tmp_path / "t.nc")]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert "t.nc" in line
    assert "n_ambient" in line


def test_frames_are_compared_with_truths_over_another_ambient(measurement, tmp_path):
    pytest.importorskip("zarr", reason="pip install '.[sequence]'")
    from nerif.data.measurement_sequence import MeasurementSequence
    from nerif.data.volume_sequence import VolumeSequence
    from nerif.fields.network import Network, NeuralField
    from nerif.fields.network_shape import NetworkShape
    from nerif.workflow.sequence.sequence_evaluation import evaluate_sequence
    from nerif.workflow.sequence.store import Frame, SequenceStore

    shape, grid = NetworkShape(2, 8, 1), Grid(measurement.box, (6, 7, 8))
    sequence = MeasurementSequence.create(tmp_path / "m.zarr", [0.0], measurement)
    sequence.write_frame(0, measurement)
    store = SequenceStore.begin(tmp_path / "r.zarr", sequence, grid, ("index_excess",), shape, {})
    field = NeuralField(Network(shape), measurement.box, 1e-4)
    excess = Volume(field.sample(grid), grid)
    store.write_frame(0, Frame(field, [excess], [], 0.0, 0))
    truth = VolumeSequence.create(tmp_path / "t.zarr", [0.0], grid, ("index_excess",), 1.0)
    truth.write(0, [replace(excess, values=excess.values + (N_AMBIENT - 1))])
    assert evaluate_sequence(store.path, truth.path)["mean"]["l2_variation"] < 1e-3


@pytest.mark.parametrize("n_ambient", [N_AMBIENT, None])
def test_a_phantom_from_a_file_has_its_ambient(truth, cameras, tmp_path, n_ambient):
    """Over the ambient of the settings, or else that of the file."""
    path: Path = tmp_path / "own.nc"
    reference = over_vacuum(truth) if n_ambient else truth
    write_netcdf(path, [reference])
    quick = Simulation(phantom=str(path), n_ambient=n_ambient, steps=12, truth_voxels=16)
    measurement, made = quick(cameras[:2])
    field = VoxelField.through(truth.values, truth.grid)
    expected = simulate(field, cameras[:2], truth.grid.box, N_AMBIENT, steps=12)
    assert measurement.n_ambient == N_AMBIENT
    error = (measurement.displacement - expected.displacement).norm() / expected.displacement.norm()
    assert float(error) < 1e-3
    assert float((made.values - field.sample(made.grid)).abs().max()) < 1e-3 * float(truth.values.abs().max())
    write_netcdf(path, [replace(reference, attributes={})])
    with pytest.raises(InputError, match=r"own\.nc: expected the attribute n_ambient"):
        quick(cameras[:2])
