"""Images: the flow image is the reference displaced by the field."""

from __future__ import annotations

import math
import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import xarray as xr
from scipy.ndimage import map_coordinates

from nerif.analysis.evaluation import evaluate_views, evaluate_volume
from nerif.analysis.prediction import predict, reproject
from nerif.cli.cli import main
from nerif.data.measurement import Measurement
from nerif.data.volume import Volume
from nerif.fields.network_shape import NetworkShape
from nerif.fields.phantoms import GaussianBalls
from nerif.fields.voxel_field import VoxelField
from nerif.forward.deflection import LeverArm
from nerif.forward.images import GUESS, Images, References
from nerif.forward.interferometry import Interferometry
from nerif.forward.registry import forward_model
from nerif.geometry import Box, Grid, Ring
from nerif.reconstruction.detail.detail import Detail
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.trainer import Trainer
from nerif.reconstruction.neural.training_data import TrainingData
from nerif.reconstruction.projector import Projector
from nerif.reconstruction.sources import of_source, stages
from nerif.reconstruction.target import Target
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from refusals import refused

BOX = Box((-10.0, -8.0, -6.0), (9.0, 11.0, 7.0))
RING = Ring(views=4, image_size=(38, 43), pixel_pitch=0.06, distance=400.0, background_distance=300.0)
NETWORK = NeRIF(points_per_batch=2048, max_steps=160, device="cpu", samples=(6, 10), sample_jitter=2)
WAVES = 60
GREYS = 20.0  # sigma


def pattern(view: int, column: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Grey values of a background of WAVES waves, none shorter than 4 px, at any position."""
    draw = np.random.default_rng(view)
    angle, length = draw.uniform(0, math.pi, WAVES), draw.uniform(4, 12, WAVES)
    phase = draw.uniform(0, 2 * math.pi, WAVES)
    along = column[..., None] * np.cos(angle) + row[..., None] * np.sin(angle)
    return 2000 + 3000 / math.sqrt(WAVES) * np.cos(2 * math.pi * along / length + phase).sum(axis=-1)


def photographed(balls: GaussianBalls, gain: float = 0.0) -> Measurement:
    """Flow images of a field and their references, with noise; the gain drifts over a view."""
    measurement = predict(balls, RING.cameras(), BOX, 1.00027)
    row, column = (x.astype(float) for x in np.mgrid[: measurement.shape[1], : measurement.shape[2]])
    draw, maps = np.random.default_rng(5), {"reference": [], "flow": []}
    for i, d in enumerate(measurement.displacements.double().numpy()):
        maps["reference"].append(pattern(i, column, row) + GREYS / 3 * draw.standard_normal(row.shape))
        displaced = pattern(i, column - d[..., 0], row - d[..., 1])
        bright = (1 + gain * column / row.shape[1]) * displaced + 300 * gain
        maps["flow"].append(bright + GREYS * draw.standard_normal(row.shape))
    maps = {name: torch.tensor(np.stack(images)).float() for name, images in maps.items()}
    maps["image_sigma"] = torch.full_like(maps["flow"], 1.05 * GREYS)
    return replace(measurement, maps=maps, displacement=None)


@pytest.fixture(scope="module")
def balls() -> GaussianBalls:
    """A few balls of index, displacements up to half a pixel."""
    centres = torch.tensor([[-3.0, 0.0, 1.0], [3.0, 4.0, -1.0], [1.0, -1.5, 1.5]])
    return GaussianBalls(centres, torch.tensor([2.6, 2.4, 2.2]), torch.tensor([4e-4, 3.2e-4, 4.8e-4]))


@pytest.fixture(scope="module")
def shots(balls) -> Measurement:
    """Images of the balls."""
    return photographed(balls)


@pytest.fixture(scope="module")
def d(balls, shots) -> torch.Tensor:
    """Displacements of the balls."""
    return predict(balls, shots.cameras, BOX, 1.00027).displacements


@pytest.fixture(scope="module")
def both(shots, d) -> Measurement:
    """Images and displacements."""
    return replace(shots, displacement=d, sigma=torch.full_like(d, 0.05))


def error(balls: GaussianBalls, result) -> float:
    grid = Grid.of_resolution(BOX, 30)
    truth = Volume.of(balls.sample(grid), grid, "index_excess", 1.00027)
    return float(evaluate_volume(result.field, truth, 1.00027)["l2_variation"])


# -- the reference between pixels ------------------------------------------------------------------------------------


def test_the_reference_between_pixels_is_the_cubic_spline():
    draw = np.random.default_rng(0)
    images = torch.tensor(draw.normal(100, 30, (2, 21, 26))).float()
    references = References(images, [(21, 26), (17, 26)])
    place = torch.tensor(draw.uniform(0, 1, (300, 2))).float() * torch.tensor([25.0, 16.0])
    for view, rows in ((0, 21), (1, 17)):
        number = torch.full((300,), view, dtype=torch.int16)
        image = images[view, :rows].double().numpy()
        right = map_coordinates(image, [place[:, 1], place[:, 0]], order=3, mode="mirror")
        assert np.abs(references.at(number, place).numpy() - right).max() < 1e-3
        at = place.clone().requires_grad_(True)
        (slope,) = torch.autograd.grad(references.at(number, at).sum(), at)
        assert torch.allclose(slope, references.slope(number, place), atol=1e-3)
    beyond = torch.tensor([[-3.0, 5.0], [25.5, 5.0], [5.0, 17.0]])
    assert references.covers(torch.ones(3, dtype=torch.int16), beyond).tolist() == [False, False, False]


@pytest.mark.parametrize(("height", "width"), [(1, 9), (2, 7), (6, 2), (1, 1)])
def test_an_image_of_few_rows_has_a_reference_too(height, width):
    image = torch.rand(1, height, width, generator=torch.Generator().manual_seed(0)) * 100
    row, column = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    place = torch.stack([column, row], dim=-1).reshape(-1, 2).float()
    place = torch.cat([place, torch.tensor([[(width - 1) / 2, (height - 1) / 2]])])
    values = References(image, [(height, width)]).at(torch.zeros(len(place), dtype=torch.int16), place)
    exact = map_coordinates(image[0].double().numpy(), place.flip(-1).T.numpy(), order=3, mode="mirror")
    torch.testing.assert_close(values.double(), torch.tensor(exact).double(), rtol=1e-4, atol=1e-3)


def test_pixels_without_a_reference_are_not_covered():
    images = torch.rand(1, 20, 20) * 100
    images[0, 4:7, 4:7] = torch.nan
    references = References(images, [(20, 20)])
    place = torch.tensor([[5.2, 4.9], [12.0, 12.0]])
    assert references.covers(torch.zeros(2, dtype=torch.int16), place).tolist() == [False, True]
    assert bool(references.at(torch.zeros(2, dtype=torch.int16), place).isfinite().all())


def test_gain_and_offset_are_fitted_despite_outliers():
    draw = torch.Generator().manual_seed(0)
    references = References(torch.rand(1, 60, 60, generator=draw) * 1000, [(60, 60)])
    pixel = torch.rand(3000, 2, generator=draw) * 57 + 1
    view, still = torch.zeros(3000, dtype=torch.int16), torch.zeros(3000, 2)
    right = (1.2 + 0.002 * pixel[:, 0]) * references.at(view, pixel) + 40 - 0.5 * pixel[:, 1]
    spoiled = right.clone()
    spoiled[::20] += 800
    references.fit(view, pixel, still, spoiled, torch.ones(3000))
    assert float((references.flow_at(view, pixel, still) - right).square().mean().sqrt()) < 3


# -- the model -------------------------------------------------------------------------------------------------------


def test_the_residual_of_the_truth_is_noise(shots, d):
    rays, values, sigma = shots.rays(shots.observations[0])
    model, d = forward_model(Images, shots), d[rays.view.long(), *rays.pixel.long().flip(-1).T]
    residual, empty = (model.residual(x, values, rays) / sigma for x in (d, 0 * d))
    assert float(residual.square().mean().sqrt()) == pytest.approx(1, abs=0.12)  # noise, and the error of splines
    assert float(empty.square().mean().sqrt()) > 3


def test_the_linear_model_is_the_slope_of_the_displaced_one(shots):
    guessed = of_source(shots, "images", 0.0)
    guessed = replace(guessed, maps={**guessed.maps, GUESS: torch.full((*guessed.shape, 2), 0.3)})
    rays, values, _ = guessed.rays()
    inner = ((rays.pixel - 20).abs() < 14).all(dim=-1)
    rays, values = rays[inner], values[inner]
    model = forward_model(Images, guessed)
    twin = model.linear_twin
    s, step = (rays.near + rays.far)[:, None] / 2, (rays.far - rays.near)[:, None]
    gradient = 1e-6 * torch.randn(len(rays), 1, 3, generator=torch.Generator().manual_seed(0))
    guess = torch.full((len(rays), 2), 0.3)
    d = guess + LeverArm(shots.n_ambient).weights(rays, s, step)(None, gradient)
    change = model.residual(d, values, rays) - model.residual(guess, values, rays)
    assert torch.allclose(twin.weights(rays, s, step)(None, gradient), change, rtol=0.05, atol=1.0)
    # at the guess itself the residuals are equal
    measured, _ = twin.reading(values, None, rays)
    at_guess = -(twin._slope(rays) * 0.3).sum(dim=-1, keepdim=True) - measured  # type: ignore[attr-defined]
    assert torch.allclose(at_guess, model.residual(guess, values, rays), atol=0.5)


def test_outliers_have_the_slope_of_the_huber_loss(shots):
    (part,) = Target.of(of_source(shots, "images")).parts
    part = part[:50]
    d = torch.zeros(50, 2, requires_grad=True)
    plain = replace(part, outlier=math.inf).residual(d)
    (square,) = torch.autograd.grad(0.5 * plain.square().sum(), d)
    (robust,) = torch.autograd.grad(0.5 * part.residual(d).square().sum(), d)
    size = plain.detach().abs()
    share = (part.outlier / size).clamp(max=1)
    assert bool((share < 1).any())
    assert torch.allclose(robust, square * share, rtol=1e-4, atol=1e-6)


# -- reconstructions -------------------------------------------------------------------------------------------------


def test_missing_images_are_reported_in_one_line(balls, tmp_path, capsys):
    predict(balls, RING.cameras(), BOX, 1.00027).write(tmp_path / "m.nc")
    assert main(["reconstruct", str(tmp_path / "m.nc"), "-o", str(tmp_path / "r"), "--from", "images"]) == 2
    (line,) = "".join(capsys.readouterr()).splitlines()
    assert "from: expected a measurement with images" in line


@pytest.mark.slow
def test_networks_and_voxels_find_the_field_in_images(balls, shots):
    assert error(balls, NETWORK(shots)) < 0.15
    assert error(balls, Tikhonov(voxels=24)(shots)) < 0.25


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["shots", "both"])
def test_detail_is_added_from_images_and_from_their_displacements(balls, kind, request):
    measurement, grid = request.getfixturevalue(kind), Grid.of_resolution(BOX, 30)
    weak = VoxelField.through(0.7 * balls.sample(grid), grid)
    detail = Detail(weak, measurement, NeRIF(device="cpu"))
    posterior = detail.solve(detail.first(blurred=False))
    assert posterior.residual < 0.5 * detail.residual
    assert error(balls, SimpleNamespace(field=posterior.field)) < 0.5 * error(balls, SimpleNamespace(field=weak))


@pytest.mark.slow
def test_a_drift_of_the_light_is_fitted(balls):
    assert error(balls, NETWORK(photographed(balls, gain=0.05))) < 0.16


@pytest.mark.slow
def test_shifts_of_several_pixels_are_found_without_displacements(balls):
    far = GaussianBalls(balls.centres, balls.widths, 8 * balls.amplitudes)
    m = photographed(far)
    largest = float(predict(far, m.cameras, BOX, 1.00027).displacements.norm(dim=-1).max())
    assert largest > 3
    assert error(far, replace(NETWORK, max_steps=400)(m)) < 0.15


def names_of(measurement: Measurement) -> list[str]:
    return sorted(o.technique.name for o in measurement.observations)


@pytest.mark.slow
def test_images_follow_displacements(balls, shots, both, d):
    biased = replace(both, displacement=d + 0.05)
    parts = stages(biased, "auto")
    assert [names_of(part.measurement()) for part in parts[:2]] == [["deflection"], ["images"]]
    assert torch.equal(parts[1].measurement().maps[GUESS], (d + 0.05).float())
    assert error(balls, NETWORK(biased)) < 0.15
    assert names_of(of_source(biased, "auto", preferred="displacements")) == ["deflection"]
    assert not replace(NETWORK, source="both", max_steps=60)(biased).outcome.failed


def test_a_run_notes_where_images_follow_and_its_pace_continues(shots, both):
    """There are fewer pixels of images than displacements, so fewer rays are counted from then on."""
    flow = shots.maps["flow"].clone()
    flow[:, ::2] = torch.nan
    fewer = replace(both, maps={**shots.maps, "flow": flow})
    settings, steps = replace(NETWORK, max_steps=12, network=NetworkShape(depth=1, width=8)), []
    Trainer(settings, TrainingData(settings, fewer)).run(steps.append)
    assert [s.step for s in steps if s.note] == [5]
    assert steps[4].note == "now fitting images; loss values before and after cannot be compared"
    assert all(s.rays_per_second > 0 for s in steps)


def test_shifts_of_images_are_refined_from_displacements(both):
    shifted = replace(NETWORK, refine=("cameras,shift",))
    data = TrainingData(shifted, both)
    assert [names_of(stage.measurement()) for stage in data.stages] == [["deflection"]]
    assert data.refinement is not None
    with refused("refine"):
        TrainingData(replace(shifted, source="images"), both)


def test_data_of_other_techniques_are_unchanged(balls, shots, d):
    """Fringes beside images and displacements, also in a view that has nothing else."""
    fringes = predict(balls, shots.cameras, BOX, 1.00027, technique=Interferometry, wavelength_nm=532.0).maps["fringes"]
    d, flow = d.clone(), shots.maps["flow"].clone()
    d[3] = flow[3] = math.nan
    maps = {**shots.maps, "flow": flow, "fringes": fringes}
    whole = replace(shots, displacement=d, sigma=torch.full_like(d, 0.05), wavelength_nm=532.0, maps=maps)
    image, deflection = ["images", "interferometry"], ["deflection", "interferometry"]
    sources = {"auto": image, "images": image, "displacements": deflection, "both": ["deflection", *image]}
    for source, names in sources.items():
        data = of_source(whole, source)
        assert names_of(data) == names
        assert data.names == whole.names
    assert of_source(replace(shots, displacement=d), "displacements").names == whole.names[:3]


@pytest.mark.slow
def test_a_run_from_images_resumes_bit_for_bit(shots):
    settings, states = replace(NETWORK, max_steps=40, network=NetworkShape(depth=2, width=16)), {}

    def keep(step) -> None:
        if step.step == 25:
            states[25] = step.capture()

    once = Trainer(settings, TrainingData(settings, shots)).run(keep)
    again = Trainer(settings, TrainingData(settings, shots), states[25]).run()
    a, b = (dict(r.field.network.state_dict()) for r in (once, again))
    assert all(torch.equal(a[name], b[name]) for name in a)


@pytest.mark.slow
def test_without_a_limit_a_run_is_judged_by_pixels_withheld(shots):
    settings = replace(NETWORK, max_steps=0, first_cycle=120)
    result = settings(shots, lambda step: step.step > 121)
    residuals = [row["withheld_residual"] for row in result.history if "withheld_residual" in row]
    judges = TrainingData(settings, shots, withhold=True).withheld
    assert judges is not None
    assert len(judges) > 200
    assert residuals[-1] < 0.5 * math.sqrt(judges.chi_square)  # the residual without a field


def test_views_are_compared_as_images(balls, shots):
    views = reproject(balls, shots, withheld=["cam1"])
    scores = evaluate_views(views)
    assert {v["measured"] for v in scores} == {"flow"}
    assert [v["withheld"] for v in scores] == [v["name"] == "cam1" for v in scores]
    assert min(v["cc"] for v in scores) > 0.99
    assert max(v["rms_over_sigma"] for v in scores) < 1.1


def test_threads_that_score_views_share_the_references(balls, shots, monkeypatch):
    built, init = [], References.__init__

    def recorded(self, *arguments):
        built.append(threading.current_thread())
        init(self, *arguments)

    views = reproject(balls, shots)
    monkeypatch.setattr(References, "__init__", recorded)
    evaluate_views(views)
    assert built == [threading.main_thread()]


# -- files and invalid input -----------------------------------------------------------------------------------------


def test_files_hold_images_beside_displacements(tmp_path, shots, both):
    for measurement in (shots, both):
        measurement.write(tmp_path / "m.nc")
        read = Measurement.read(tmp_path / "m.nc")
        assert names_of(read) == names_of(measurement)
        assert all(torch.equal(read.maps[name], value) for name, value in measurement.maps.items())
    with xr.open_dataset(tmp_path / "m.nc", engine="h5netcdf") as data:
        assert data.attrs["technique"] == "deflection images"
        assert data["reference"].attrs["units"] == "grey value"


def test_the_noise_of_images_may_be_given_by_attributes(shots):
    plain = {name: value for name, value in shots.maps.items() if name != "image_sigma"}
    dataset = replace(shots, maps=plain).to_dataset()
    dataset.attrs |= {"read_noise": 10.0, "electrons_per_grey_value": [2.0, 4.0, 4.0, 4.0]}
    sigma = Measurement.from_dataset(dataset).maps["image_sigma"]
    grey = (shots.maps["flow"] + shots.maps["reference"]).clamp(min=0).mean(dim=(1, 2))  # as bright as each other
    assert torch.allclose(sigma.square().mean(dim=(1, 2)), 200 + grey / torch.tensor([2.0, 4, 4, 4]), rtol=0.02)
    assert float(sigma.std() / sigma.mean()) < 0.3  # a local mean, which does not select pixels
    dataset.attrs["read_noise"] = [1.0, 2.0]
    with refused("attribute read_noise"):
        Measurement.from_dataset(dataset)
    flow, reference = (shots.maps[name].clone() for name in ("flow", "reference"))
    flow[0, :3], reference[1, 5:9, 5:9] = math.nan, math.nan
    sigma = Images.complete({"flow": flow, "reference": 2 * reference}, {"read_noise": 0})["image_sigma"]
    assert torch.equal(sigma.isfinite(), flow.isfinite())
    assert torch.allclose(sigma[2:], torch.tensor(math.sqrt(1.25 / 12)), rtol=0.01)  # rounding; half the gain


def test_missing_and_impossible_images_are_refused(shots, balls):
    maps, displaced = shots.maps, predict(balls, shots.cameras, BOX, 1.00027)
    cases = [
        ("reference", lambda: replace(shots, maps={"flow": maps["flow"]})),
        ("reference", lambda: replace(shots, maps={**maps, "reference": maps["reference"][:, :-1]})),
        ("flow", lambda: replace(shots, maps={**maps, "flow": torch.ones_like(maps["flow"])})),
        ("from", lambda: of_source(shots, "displacements")),
        ("from", lambda: NeRIF(source="images")(displaced)),
        ("source", lambda: NeRIF(source="image")),
        ("technique", lambda: predict(balls, shots.cameras, BOX, 1.00027, technique=Images)),
    ]
    for field, make in cases:
        with refused(field):
            make()


def test_the_projector_of_images_is_linear_about_the_displacements(balls, both):
    """The field explains the difference of the images; by default displacements are the data."""
    grid = Grid.of_resolution(BOX, 30)
    assert Projector(both, grid).channels == ("u", "v")
    a = Projector(both, grid, source="images")
    assert a.channels == ("flow",)
    residual = a.data - a(a.coefficients(balls.sample(grid)))
    assert float(residual.norm() / a.data.norm()) < 0.1
    assert float((residual / a.sigma)[a.mask].abs().median()) < 1.2
