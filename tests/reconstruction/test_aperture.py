"""Lenses and correlation windows: projections are means over them, which improves the reconstruction."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
import xarray as xr

from nerif.analysis.consistency import check_consistency
from nerif.analysis.evaluation import evaluate_views
from nerif.analysis.prediction import predict_view, reproject
from nerif.cli.cli import main
from nerif.data.measurement import Measurement
from nerif.fields.network_shape import NetworkShape
from nerif.fields.phantoms import make_phantom
from nerif.forward.images import Images
from nerif.forward.path_integral import PathIntegral
from nerif.forward.registry import forward_model
from nerif.geometry import Box, Grid, Lens, Ring
from nerif.reconstruction.aperture import apply_aperture, lens_rays
from nerif.reconstruction.neural.losses import MixedPrecision
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.objective import Objective
from nerif.reconstruction.neural.parallel import Ranks
from nerif.reconstruction.neural.sampling import PixelSampling, Sampler
from nerif.reconstruction.neural.training_data import TrainingData
from nerif.reconstruction.neural.training_settings import LossWeights
from nerif.reconstruction.voxels.operator import VoxelOperator, rays_through
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.results.directory import ResultDirectory
from nerif.simulation.simulate import simulate, view_displacement
from refusals import refused

BOX = Box.cube(50.0)
RING = Ring(views=4, arc=(0.0, 135.0), image_size=(14, 16), pixel_pitch=0.25)


def flame():
    return make_phantom("flame", BOX, seed=3)


@pytest.fixture(scope="module")
def wide() -> Measurement:
    """Through lenses of 12.5 mm, whose cones are about 5 mm wide in the flow."""
    cameras = tuple(replace(c, lens=Lens(12.5, points=12)) for c in RING.cameras())
    return simulate(flame(), cameras, BOX, 1.00027, 0.02, 1, 40)


def predicted(wide: Measurement, camera) -> torch.Tensor:
    model = forward_model(wide.techniques[0], wide)
    return predict_view(make_phantom("gaussians", BOX, seed=1), camera, PathIntegral(model, 80), BOX)


def simulated(camera, steps: int = 40) -> torch.Tensor:
    return view_displacement(make_phantom("gaussians", BOX, seed=1), camera, BOX, 1.00027, steps)


@pytest.mark.slow
def test_the_path_integral_through_a_lens_agrees_with_curved_rays(wide):
    camera = replace(wide.cameras[1], lens=Lens(12.5, points=100))
    exact, thin = simulated(camera), simulated(replace(camera, lens=None))
    assert float((exact - thin).std()) > 0.03 * float(exact.std())
    assert float((exact - predicted(wide, camera)).std()) < 0.005 * float(exact.std())


@pytest.mark.slow
def test_a_displacement_over_a_window_is_the_mean_over_its_pixels(wide):
    edge = 3
    camera = replace(wide.cameras[1], lens=Lens(window=float(edge)))
    fine = replace(camera, lens=None, intrinsics=camera.intrinsics * torch.tensor([[5.0, 1, 5], [1, 5, 5], [1, 1, 1]]))
    fine = replace(fine, intrinsics=fine.intrinsics + torch.tensor([[0, 0, 2.0], [0, 0, 2], [0, 0, 0]]))
    height, width = camera.image_size
    thin = simulated(replace(fine, image_size=(5 * height, 5 * width))) / 5
    exact = torch.nn.functional.avg_pool2d(thin.permute(2, 0, 1), 5 * edge, stride=5).permute(1, 2, 0)
    inner = slice(edge // 2, height - edge // 2), slice(edge // 2, width - edge // 2)
    many = replace(camera, lens=replace(camera.lens, points=100))
    errors = [
        float((d[inner] - exact).std())
        for d in (predicted(wide, camera), simulated(many), simulated(replace(camera, lens=None)))
    ]
    assert max(errors[:2]) < 0.03 * float(exact.std())
    assert errors[2] > 3 * errors[0]


def test_windows_are_in_files_and_apply_to_displacements_alone(wide, tmp_path):
    cameras = tuple(replace(c, lens=Lens(window=float(i))) for i, c in enumerate(RING.cameras()))
    windowed = replace(wide, cameras=cameras)
    windowed.write(tmp_path / "m.nc")
    back = Measurement.read(tmp_path / "m.nc")
    assert [camera.lens.window for camera in back.cameras] == [0.0, 1.0, 2.0, 3.0]
    dataset = xr.load_dataset(tmp_path / "m.nc")
    assert dataset["window"].attrs["units"] == "px"
    assert "aperture_diameter" not in dataset
    assert lens_rays(apply_aperture(back, "auto")) > 1
    assert lens_rays(apply_aperture(back, "off")) == 1
    with refused("aperture"):
        apply_aperture(back, "on")
    assert Images.seen_by(cameras[3]).lens.window == 0
    assert wide.techniques[0].seen_by(cameras[3]).lens.window == 3
    dataset["window"][1] = -1.0
    with refused("window"):
        Measurement.from_dataset(dataset)


def test_a_lens_focused_on_the_flow_is_like_a_pinhole_there(wide):
    """The cone is narrow in the flow, and the background is blurred instead."""
    thin = replace(wide.cameras[0], lens=None)
    lenses = (None, Lens(12.5), Lens(12.5, RING.distance))
    pinhole, background, flow = (simulated(replace(thin, lens=lens), 20) for lens in lenses)
    assert float((flow - pinhole).std()) < 0.5 * float((background - pinhole).std())


def test_a_wider_cone_and_smaller_voxels_have_more_rays_in_an_operator(wide):
    rays, _, _ = wide.rays()
    assert rays_through(rays, 1.0) > rays_through(rays, 10.0) >= 2
    assert rays_through(rays, 1e-3) == 16
    assert rays_through(replace(rays, lens=None), 1.0) == 1
    operator = VoxelOperator(rays, Grid.of_resolution(BOX, 8), forward_model(wide.techniques[0], wide), "cubic")
    assert operator.for_rays(rays[:10], forward_model(wide.techniques[0], wide)).range_shape == (10, 2)


def test_the_aperture_can_be_off_or_required(wide):
    thin = apply_aperture(wide, "off")
    assert all(camera.lens is None for camera in thin.cameras)
    assert apply_aperture(wide, "auto") is apply_aperture(wide, "on") is wide
    assert apply_aperture(thin, "off") is thin
    none = replace(wide, cameras=tuple(replace(camera, lens=Lens(0.0)) for camera in wide.cameras))
    assert all(camera.lens is None for camera in apply_aperture(none, "auto").cameras)
    with refused("aperture"):
        apply_aperture(thin, "on")
    for kind in (NeRIF, Tikhonov):
        with refused("aperture"):
            kind(aperture="f/8")
        with refused("aperture"):
            kind(aperture="on")(thin)
    with refused("lens_rays"):
        NeRIF(lens_rays=3)


def test_a_wider_cone_has_more_rays(wide):
    def of(diameter: float, count: int = 0) -> int:
        return lens_rays(replace(wide, cameras=tuple(replace(c, lens=Lens(diameter)) for c in wide.cameras)), count)

    assert lens_rays(apply_aperture(wide, "off")) == 1
    assert [of(0.0), of(1.0), of(100.0), of(4.0, 8)] == [1, 2, 12, 8]
    assert 2 <= of(4.0) <= of(8.0) <= of(16.0) <= 12


def test_a_file_keeps_the_lenses_of_all_views(wide, tmp_path):
    with refused("aperture_diameter"):
        replace(wide, cameras=(replace(wide.cameras[0], lens=None), *wide.cameras[1:]))
    cameras = tuple(replace(c, lens=Lens(float(i), 600.0 if i == 2 else None)) for i, c in enumerate(wide.cameras))
    replace(wide, cameras=cameras).write(tmp_path / "m.nc")
    back = Measurement.read(tmp_path / "m.nc")
    assert [c.lens for c in back.cameras] == [c.lens for c in cameras]
    dataset = replace(wide, cameras=cameras).to_dataset()
    assert dataset.attrs["Conventions"] == "BOST-1.1"
    dataset["aperture_diameter"][1] = -1.0
    with refused("aperture_diameter"):
        Measurement.from_dataset(dataset)
    dataset["aperture_diameter"][:] = 0.0
    assert all(c.lens is None for c in Measurement.from_dataset(dataset).cameras)


@pytest.mark.parametrize("model", ["lever_arm", "paraxial", "curved"])
@pytest.mark.parametrize("lens", [Lens(12.5), Lens(window=4.0)], ids=["lens", "window"])
def test_loss_terms_and_gradients_are_finite_if_rays_of_a_pixel_miss_the_box(wide, lens, model):
    cameras = tuple(replace(c, lens=lens) for c in wide.cameras)
    measurement = replace(wide, cameras=cameras, box=Box.cube(20.0))
    shape = NetworkShape(depth=2, width=8, octaves=1, gradient_head=True)
    weights = LossWeights(consistency=1, numerical=1, head=1, automatic=1)
    settings = NeRIF(network=shape, weights=weights, model=model, device="cpu", lens_rays=4, norm="l2")
    data = TrainingData(settings, measurement, coarsest=1)
    torch.manual_seed(0)
    field, generator = data.initial_field(), torch.Generator().manual_seed(0)
    network = MixedPrecision(field.network, data.device, "float32", "off")
    batch = Sampler(settings, data, field, network, generator, Ranks()).of(torch.arange(len(data)), PixelSampling(4, 4))
    assert not bool(batch.pieces[0].rays.crosses.all())
    for name, term in Objective(settings, data, field, network, generator).terms(batch).items():
        slopes = torch.autograd.grad(term, list(field.network.parameters()), retain_graph=True, allow_unused=True)
        assert bool(term.isfinite()), name
        assert all(bool(g.isfinite().all()) for g in slopes if g is not None), name


@pytest.mark.slow
def test_lenses_on_the_command_line(wide, tmp_path, capsys):
    path, out = tmp_path / "m.nc", tmp_path / "r"
    wide.write(path)
    quick = ["--max-steps", "20", "--network.width", "16", "--voxels", "8", "--no-report"]
    assert main(["info", str(path)]) == 0
    assert "aperture       12.5 mm, focused on the backgrounds" in capsys.readouterr().out
    assert main(["reconstruct", str(path), "-o", str(out), "--aperture", "off", *quick]) == 0
    assert main(["evaluate", str(out), "--measurement", str(path)]) == 0
    field, _, _ = ResultDirectory(out).field()
    predictions = {name: reproject(field, apply_aperture(wide, name)) for name in ("auto", "off")}
    scores = {name: evaluate_views(reprojection)[0]["rms"] for name, reprojection in predictions.items()}
    assert ResultDirectory(out).metrics().views[0]["rms"] == pytest.approx(scores["off"], rel=1e-4)
    assert scores["auto"] != pytest.approx(scores["off"], rel=1e-3)
    assert main(["project", str(out), "-o", str(tmp_path / "p.nc"), "--cameras", str(path), "--f-number", "8"]) == 2
    assert main(["project", str(out), "-o", str(tmp_path / "p.nc"), "--aperture", "off"]) == 2
    ring = ["--views", "2", "--image-size", "5", "6", "--pixel-pitch", "0.6", "--f-number", "4"]
    assert main(["project", str(out), "-o", str(tmp_path / "p.nc"), *ring, "--samples", "20"]) == 0
    assert [c.lens.diameter for c in Measurement.read(tmp_path / "p.nc").cameras] == pytest.approx([12.5, 12.5])
    assert main(["simulate", "-o", str(tmp_path / "s.nc"), *ring, "--steps", "5", "--truth-voxels", "4"]) == 0
    assert [c.lens.diameter for c in Measurement.read(tmp_path / "s.nc").cameras] == pytest.approx([12.5, 12.5])
    apply_aperture(wide, "off").write(tmp_path / "thin.nc")
    capsys.readouterr()
    assert main(["reconstruct", str(tmp_path / "thin.nc"), "-o", str(tmp_path / "t"), "--aperture", "on", *quick]) == 2
    message = capsys.readouterr().err
    assert "expected a measurement with aperture_diameter" in message
    assert len(message.splitlines()) == 1
    assert not (tmp_path / "t").exists()


@pytest.mark.slow
def test_a_check_uses_the_lenses_by_default(wide, tmp_path, capsys):
    through = [view.agreement for view in check_consistency(wide, 12).views]
    thin = [view.agreement for view in check_consistency(wide, 12, aperture="off").views]
    assert len(through) == len(thin) == len(wide.names)
    assert through != thin
    apply_aperture(wide, "off").write(tmp_path / "thin.nc")
    for more in ([], ["--refine", "cameras", "--time-limit", "1"]):
        assert main(["check", str(tmp_path / "thin.nc"), "--aperture", "on", *more]) == 2
        assert "aperture: expected a measurement with aperture_diameter" in capsys.readouterr().err
