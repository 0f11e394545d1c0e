"""Rendered images obey the conventions: what appears at p with flow appears at p - d(p) without."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter, map_coordinates

from nerif.fields.phantoms import Scaled
from nerif.geometry import PROJECTIONS, Box, Camera, Lens, Ring
from nerif.simulation.experiment_settings import Sensor
from nerif.simulation.rendering import Texture, background_texture, pattern_size, render
from nerif.simulation.simulate import view_displacement
from refusals import refused

BOX = Box((-12.0, -10.0, -8.0), (12.0, 10.0, 8.0))


@pytest.fixture(scope="module")
def camera() -> Camera:
    """A camera with distortion that looks down at an oblique background."""
    ring = Ring(views=1, arc=(30.0, 30.0), elevation=10.0, image_size=(48, 60), pixel_pitch=0.04)
    plain = ring.cameras()[0]
    turn = torch.tensor([0.05, -0.08, 0.02], dtype=torch.float64)
    normal = plain.background.normal + turn
    distortion = torch.tensor([-0.3, 0.0, 0.001, -0.001, 0.0], dtype=torch.float64)
    plane = dataclasses.replace(plain.background, normal=normal / normal.norm())
    return dataclasses.replace(plain, background=plane, distortion=distortion)


@pytest.fixture(scope="module")
def texture(camera) -> Texture:
    """Smooth noise, fine enough to see a tenth of a pixel."""
    width, height = pattern_size(camera)
    rng = np.random.default_rng(0)
    values = gaussian_filter(rng.standard_normal((round(height / 0.3), round(width / 0.3))), 8.0)
    return background_texture(camera, torch.from_numpy(0.5 + 0.15 * values / values.std()), 0.3)


def test_a_ramp_is_seen_as_a_ramp(camera):
    ramp = torch.linspace(0, 1, 400, dtype=torch.float64).expand(300, 400)
    width, height = pattern_size(camera)
    texture = background_texture(camera, ramp, max(width / 400, height / 300))
    rays = camera.rays(camera.pixel_grid().reshape(-1, 2))
    hit = rays.end_points
    expected = ((hit - texture.corner) @ texture.right / texture.texel - 0.5) / 399
    image = render(camera, texture)
    assert float((image.flatten() - expected).abs().max()) < 1e-5


def test_background_stands_upright_in_the_middle_and_fills_the_image(camera):
    texture = background_texture(camera, torch.zeros(200, 240, dtype=torch.float64), 1.0)
    centre = texture.corner + 120 * texture.right + 100 * texture.down
    middle = camera.project(centre)
    assert torch.allclose(middle, torch.tensor([29.5, 23.5], dtype=torch.float64), atol=1e-6)
    assert float(camera.project(centre + texture.right)[0]) > 29.5
    assert float(camera.project(centre + texture.down)[1]) > 23.5
    assert abs(abs(float(texture.plane.normal @ camera.background.normal)) - 1) < 1e-12
    width, height = pattern_size(camera)
    whole = background_texture(camera, torch.ones(round(height), round(width), dtype=torch.float64), 1.0)
    whole = dataclasses.replace(whole, surround=0.0)
    assert float(render(camera, whole).min()) == pytest.approx(1.0)


def test_a_pixel_averages_over_its_area(camera):
    fine = torch.from_numpy(np.indices((900, 1100)).sum(axis=0) % 2).double()
    texture = background_texture(camera, fine, 0.15)
    assert float(render(camera, texture, samples=1).std()) > 0.1
    assert float(render(camera, texture, samples=8).std()) < 0.03


def test_flow_shows_at_p_what_the_reference_shows_at_p_minus_d(camera, texture, ball):
    strong = Scaled(ball, 20.0)
    reference = render(camera, texture).numpy()
    flow = render(camera, texture, strong, BOX, 1.00027).numpy()
    d = view_displacement(strong, camera, BOX, 1.00027).numpy()
    assert np.linalg.norm(d, axis=-1).max() > 0.5
    rows, columns = np.mgrid[:48, :60].astype(float)
    moved = map_coordinates(reference, [rows - d[..., 1], columns - d[..., 0]], order=3, mode="nearest")
    inner = (slice(3, -3), slice(3, -3))
    assert (flow - moved)[inner].std() < 0.06 * (flow - reference)[inner].std()


def test_movement_between_pixel_centres_is_that_of_rays_bent_one_by_one(camera, texture, ball):
    strong = Scaled(ball, 20.0)
    k = camera.intrinsics * 2
    k[:2, 2] = 2 * camera.intrinsics[:2, 2] + 0.5
    k[2, 2] = 1
    fine = dataclasses.replace(camera, intrinsics=k, image_size=(96, 120))
    each = render(fine, texture, strong, BOX, 1.00027, samples=1).reshape(48, 2, 60, 2).mean(dim=(1, 3))
    between = render(camera, texture, strong, BOX, 1.00027, samples=2)
    reference = render(camera, texture, samples=2)
    assert float((each - between).std()) < 0.02 * float((between - reference).std())


@pytest.mark.slow
@pytest.mark.parametrize("projection", sorted(PROJECTIONS))
def test_a_lens_is_sharp_in_focus_and_blurs_by_its_circle_of_confusion(projection):
    flat = Ring(views=1, arc=(0.0, 0.0), image_size=(3, 60), pixel_pitch=0.04, projection=projection).cameras()[0]
    edge = torch.zeros(100, 600, dtype=torch.float64)
    edge[:, 300:] = 1.0
    texture = background_texture(flat, edge, 0.5)
    pinhole = render(flat, texture)
    sharp = render(dataclasses.replace(flat, lens=Lens(10.0, points=9)), texture)
    assert float((pinhole - sharp).abs().max()) < 0.02
    blurred = render(dataclasses.replace(flat, lens=Lens(10.0, 700.0, points=40)), texture)
    spread = np.diff(blurred.numpy()[1])
    columns = np.arange(len(spread))
    variance = np.average((columns - np.average(columns, weights=spread)) ** 2, weights=spread)
    behind = flat.centre + 1200 * flat.rotation[2]
    circle = 10.0 * abs(1200 / 700 - 1) / float(flat.pixel_size(behind))  # px
    assert variance == pytest.approx((circle / 4) ** 2 + 1 / 12, rel=0.1)  # of a disc, along one axis, and a pixel


def test_where_a_telecentric_lens_is_along_its_axis_changes_no_image(ball):
    """Calibration lays z_cam = 0 through the flow: the rays of its aperture begin before it all the same."""
    ring = Ring(views=1, arc=(20.0, 20.0), image_size=(12, 16), pixel_pitch=0.12, projection="telecentric")
    far = ring.cameras()[0]
    near = dataclasses.replace(far, translation=far.translation * torch.tensor([1.0, 1.0, 0.0]).double())
    width, height = pattern_size(far)
    noise = gaussian_filter(np.random.default_rng(0).standard_normal((round(height), round(width))), 1.5)
    texture = background_texture(far, torch.from_numpy(0.5 + 0.15 * noise / noise.std()), 1.0)
    strong, images, diameters = Scaled(ball, 30.0), [], []
    for camera in (far, near):
        camera = camera.with_f_number(0.12, 4.0)
        camera = dataclasses.replace(camera, lens=dataclasses.replace(camera.lens, points=5))
        diameters.append(camera.lens.diameter)
        still = render(camera, texture, samples=1)
        images.append((still, render(camera, texture, strong, BOX, 1.00027, 1, 60) - still))
    assert diameters[0] / diameters[1] == pytest.approx(1200 / 500)  # one cone, cut elsewhere
    for a, b in zip(*images, strict=True):
        assert float(a.std()) > 1e-3
        assert float((a - b).abs().max()) < 1e-4


@pytest.mark.slow
def test_an_aperture_smooths_the_flow(camera, texture, ball):
    strong = Scaled(ball, 20.0)
    wide = dataclasses.replace(camera, lens=Lens(60.0, points=30))
    open_ = render(wide, texture, strong, BOX, 1.00027) - render(wide, texture)
    pinhole = render(camera, texture, strong, BOX, 1.00027) - render(camera, texture)
    assert float(open_.abs().max()) < 0.95 * float(pinhole.abs().max())


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_counts_have_the_noise_of_a_sensor(bits):
    sensor = Sensor(bits=bits, exposure=0.6, full_well=8000, read_noise=12)
    counts = sensor.expose(torch.full((200, 300), 0.5, dtype=torch.float64), seed=1).astype(float)
    full = 2**bits - 1
    assert counts.mean() / full == pytest.approx(0.3, rel=0.01)
    expected = math.sqrt(0.3 * 8000 + 12**2) / 8000 * full
    assert counts.std() == pytest.approx(math.sqrt(expected**2 + 1 / 12), rel=0.03)
    dark = sensor.expose(torch.full((4, 4), 9.0, dtype=torch.float64), seed=1)
    assert (dark == full).all()
    assert dark.dtype == (np.uint8 if bits == 8 else np.uint16)
    quiet = Sensor(bits=bits, full_well=0)
    assert np.ptp(quiet.expose(torch.full((9, 9), 0.5, dtype=torch.float64), seed=1)) == 0
    light = torch.rand(9, 9, dtype=torch.float64)
    assert np.array_equal(sensor.expose(light, 3), sensor.expose(light, 3))
    assert not np.array_equal(sensor.expose(light, 3), sensor.expose(light, 4))


@pytest.mark.parametrize(
    ("field", "call"),
    [
        ("bits", lambda camera, texture: Sensor(bits=20)),
        ("read_noise", lambda camera, texture: Sensor(read_noise=-1.0)),
        ("aperture_diameter", lambda camera, texture: Lens(diameter=-1.0)),
        ("samples", lambda camera, texture: render(camera, texture, samples=0)),
    ],
)
def test_invalid_input(camera, texture, field, call):
    with refused(field):
        call(camera, texture)
