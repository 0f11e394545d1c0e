"""The resolution of blurred octahedra, of which it is known, and its figures."""

from __future__ import annotations

import json
import math
from collections.abc import Callable

import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

from benchmarks.study.mtf import draw_mtf
from benchmarks.study.octahedron_figures import draw_distribution, draw_edge_spread
from benchmarks.study.resolution import Resolution, from_plain, measure_resolution, pixels_per_unit, to_plain
from nerif.common.files import write_json
from nerif.fields.field import Field
from nerif.fields.phantoms import Octahedron
from nerif.fields.voxel_field import VoxelField
from nerif.geometry import Box, Grid, Ring
from refusals import refused

PHANTOM = Octahedron(Box((-9.0, -12.0, -14.0), (11.0, 13.0, 16.0)))  # off the origin; one unit is 5 mm


def expected(sigma: float) -> float:
    """exp(-2 (pi f sigma)^2) = 0.1."""
    return math.sqrt(2 * math.log(10)) / (2 * math.pi * sigma)


class Blurred(Field):
    """The octahedron, of which the steps at the faces are error functions of the distance to them.

    `sigma` gives the blur (mm) at points from the centre (mm).
    """

    def __init__(self, sigma: Callable[[torch.Tensor], torch.Tensor], strength: float = 1.0) -> None:
        self.sigma, self.strength = sigma, strength

    def value_and_gradient(self, points):
        p = points - points.new_tensor(PHANTOM.box.centre)
        sigma = self.sigma(p)
        distance = (p.abs().sum(-1) - 1.5 * PHANTOM.unit) / math.sqrt(3)
        tail = 0.5 * torch.erfc(distance / (math.sqrt(2) * sigma))
        bell = sigma / math.sqrt(2 * math.pi) * torch.exp(-0.5 * (distance / sigma) ** 2)
        slope = self.strength * PHANTOM.amplitude / PHANTOM.unit
        return slope * math.sqrt(3) * (bell - distance * tail), -slope * p.sign() * tail[..., None]


def even(sigma: float) -> Blurred:
    return Blurred(lambda p: torch.full_like(p[..., 0], sigma * PHANTOM.unit))


class Nothing(Field):
    def value_and_gradient(self, points):
        return torch.zeros_like(points[..., 0]), torch.zeros_like(points)


def measure(field: Field, **settings) -> Resolution:
    return measure_resolution(field, PHANTOM, **({"patches": 3, "points": 2} | settings))


@pytest.fixture(scope="module")
def uneven() -> Resolution:
    """Twice as sharp above the centre as below, where it grows with x."""
    return measure(Blurred(lambda p: 0.2 * torch.where(p[..., 2] > 0, 1.0, 2.0 + p[..., 0] / 10)))


@pytest.mark.parametrize(("sigma", "error"), [(0.005, 1e-3), (0.02, 1e-3), (0.06, 1e-3), (0.08, 2e-3), (0.13, 0.01)])
def test_a_gaussian_edge(sigma, error):
    """The errors that the module states."""
    resolution = measure(even(sigma))
    assert resolution.lp_per_unit == pytest.approx(expected(sigma), rel=error)
    assert resolution.lp_per_mm == pytest.approx(resolution.lp_per_unit / 5)
    torch.testing.assert_close(
        resolution.local_lp_per_unit, torch.full((72,), resolution.lp_per_unit).double(), rtol=1e-3, atol=0
    )
    low = resolution.mtf.frequency < 2 * resolution.lp_per_mm
    gauss = torch.exp(-2 * (math.pi * resolution.mtf.frequency * sigma * PHANTOM.unit) ** 2)
    torch.testing.assert_close(resolution.mtf.transfer[low], gauss[low], rtol=0, atol=2e-3 if sigma < 0.1 else 0.05)


@pytest.mark.parametrize(("sigma", "error"), [(0.05, 0.01), (0.1, 0.025)])
def test_the_whole_phantom_blurred_in_three_dimensions(sigma, error):
    """The other steps of the gradient, at the planes of the edges, hardly count."""
    box = Box.cube(20.0)
    grid = Grid(box, (110, 110, 110))
    phantom = Octahedron(box)
    sharp = phantom(grid.points(torch.float64).reshape(-1, 3)).reshape(grid.shape)
    field = VoxelField.through(torch.from_numpy(gaussian_filter(sharp.numpy(), sigma * 27.5)), grid)
    resolution = measure_resolution(field, phantom, patches=2, points=2, samples=128)
    assert resolution.lp_per_unit == pytest.approx(expected(sigma), rel=error)
    assert float((resolution.local_lp_per_unit / expected(sigma) - 1).abs().max()) < error


def test_the_phantom_itself_is_finer_than_the_samples():
    resolution = measure(PHANTOM)
    assert math.isnan(resolution.lp_per_mm)
    assert resolution.local_lp_per_mm.isnan().all()
    assert float(resolution.mtf_per_unit.frequency[-1]) == pytest.approx(128)  # half of 256 samples a unit
    assert float(resolution.mtf.transfer.min()) > 0.99
    inside = resolution.distance < 0
    expected_spread = torch.where(inside, -1.0, 0.0).double()
    torch.testing.assert_close(resolution.edge_spread, expected_spread, atol=1e-6, rtol=0)


def test_no_edge_is_no_resolution():
    for field in (Nothing(), Blurred(lambda p: torch.full_like(p[..., 0], 0.3), strength=0.05)):
        resolution = measure(field)
        assert resolution.lp_per_mm == 0
        assert (resolution.local_lp_per_mm == 0).all()
        assert resolution.mtf.transfer.isnan().all()


def test_a_weak_edge_is_as_sharp_as_a_strong_one():
    weak = measure(Blurred(lambda p: torch.full_like(p[..., 0], 0.3), strength=0.5))
    assert weak.lp_per_mm == pytest.approx(expected(0.3), rel=1e-3)
    assert float(weak.mtf.transfer[0]) == pytest.approx(1)


def test_wide_blur_comes_near_what_the_window_alone_has():
    assert measure(even(2.0)).lp_per_unit == pytest.approx(1.5, rel=0.05)
    assert measure(even(2.0)).coarsest == pytest.approx(1.5)


def test_blur_that_depends_on_the_place(uneven):
    p = uneven.positions - torch.tensor(PHANTOM.box.centre)
    above = p[:, 2] > 0
    assert int(above.sum()) == 36
    torch.testing.assert_close(
        uneven.local_lp_per_mm[above], torch.full((36,), expected(0.2)).double(), rtol=1e-3, atol=0
    )
    blur = 0.2 * (2 + p[~above, 0] / 10)
    assert float(blur.max() / blur.min()) > 1.45
    there = torch.sqrt(torch.tensor(2 * math.log(10))) / (2 * math.pi * blur)
    torch.testing.assert_close(uneven.local_lp_per_mm[~above], there, rtol=0.02, atol=0)
    assert expected(0.4 * 1.6) < uneven.lp_per_mm < expected(0.2)


def test_noise_is_averaged_out():
    """White noise of 20 % of the step on every sample."""

    class Noisy(Field):
        def __init__(self) -> None:
            self.field, self.generator = even(0.06), torch.Generator().manual_seed(2)

        def value_and_gradient(self, points):
            value, gradient = self.field.value_and_gradient(points)
            noise = torch.randn(points.shape, generator=self.generator, dtype=points.dtype)
            return value, gradient + 0.2 * math.sqrt(3) * PHANTOM.amplitude / PHANTOM.unit * noise

    resolution = measure(Noisy(), patches=4, points=4)
    assert resolution.lp_per_unit == pytest.approx(expected(0.06), rel=0.05)
    assert float(resolution.local_lp_per_unit.nanmedian()) == pytest.approx(expected(0.06), rel=0.15)


def test_patches_lie_on_the_faces(uneven):
    p = uneven.positions - torch.tensor(PHANTOM.box.centre)
    torch.testing.assert_close(p.abs().sum(-1), torch.full((72,), 1.5 * PHANTOM.unit).double())
    torch.testing.assert_close(uneven.normals, p.sign() / math.sqrt(3))
    assert len(torch.unique(p, dim=0)) == 72
    area = torch.linalg.cross(
        uneven.patches[:, 1] - uneven.patches[:, 0], uneven.patches[:, 2] - uneven.patches[:, 0]
    ).norm(dim=-1)
    torch.testing.assert_close(area, area[:1].expand(72))
    # along the whole profile, all signs stay and the box is not left
    for side in (-1, 1):
        ends = uneven.patches + side * uneven.half_length * uneven.normals[:, None]
        local = ends - torch.tensor(PHANTOM.box.centre)
        assert float((local * uneven.normals.sign()[:, None]).min()) > 0.049 * PHANTOM.unit
        assert float(local.abs().max()) < 2 * PHANTOM.unit


@pytest.mark.parametrize(
    ("settings", "field"),
    [({"half_length": 0.8}, "half_length"), ({"samples": 2}, "samples"), ({"patches": 0}, "samples")],
)
def test_wrong_settings(settings, field):
    with refused(field):
        measure(PHANTOM, **settings)


@pytest.mark.parametrize("field", [even(0.1), PHANTOM, Nothing()], ids=["blurred", "sharp", "nothing"])
def test_a_resolution_is_restored_from_a_json_file(field, tmp_path):
    resolution = measure(field, patches=2, points=1)
    write_json(tmp_path / "resolution.json", to_plain(resolution))
    plain = json.loads((tmp_path / "resolution.json").read_text())
    restored = from_plain(plain)
    for before, after in ((vars(resolution), vars(restored)), (vars(resolution.mtf), vars(restored.mtf))):
        for name, value in before.items():
            if name != "mtf":
                torch.testing.assert_close(after[name], value, rtol=0, atol=0, equal_nan=True)
    assert plain["lp_per_unit"] == pytest.approx(resolution.lp_per_unit) or plain["lp_per_unit"] is None
    assert plain["finest_lp_per_unit"] == pytest.approx(128)


def test_pixels_of_a_unit():
    ring = Ring(views=2, focal_length=50, pixel_pitch=0.02, image_size=(30, 40), distance=700, elevation=10)
    centred = Octahedron(Box((-25.0, -30.0, -35.0), (25.0, 30.0, 35.0)))
    for camera in ring.cameras():  # 50 / 700 of 12.5 mm, in pixels of 0.02 mm
        assert pixels_per_unit(camera, centred) == pytest.approx(50 / 700 * 12.5 / 0.02)


@pytest.mark.parametrize("field", [None, PHANTOM, Nothing()], ids=["uneven", "sharp", "nothing"])
def test_figures(field, uneven):
    resolution = measure(field) if field else uneven
    figure = Figure(figsize=(9, 3), layout="constrained")
    edge, mtf, distribution = figure.subplots(1, 3)
    assert draw_edge_spread(edge, resolution, "NeRIF") is edge
    assert draw_mtf(mtf, resolution.mtf_per_unit, "NeRIF", unit="unit") is mtf
    assert draw_mtf(mtf, uneven.mtf_per_unit, "other", "black", "unit") is mtf
    assert draw_distribution(distribution, resolution) is distribution
    FigureCanvasAgg(figure).draw()
    units = ["[mm]", "[1]", "[lp/unit]", "[1]", "[mm]", "[mm]"]
    labels = [label for axes in (edge, mtf, distribution) for label in (axes.get_xlabel(), axes.get_ylabel())]
    assert [label[label.index("[") :] for label in labels] == units
    assert "lp/unit" in figure.axes[3].get_ylabel()
    labels = [text.get_text() for text in mtf.get_legend().get_texts()]
    assert len(labels) == 3
    if field is None:
        assert f"NeRIF: {uneven.lp_per_unit:.2f} lp/unit" in labels


def test_unfolded_patches_lie_within_their_faces(uneven):
    axes = Figure().subplots()
    draw_distribution(axes, uneven, limits=(2.0, 9.0))
    outlines, patches = axes.collections
    assert len(outlines.get_paths()) == 8
    assert len(patches.get_paths()) == 72
    assert patches.get_clim() == (2.0, 9.0)
    for i, path in enumerate(patches.get_paths()):
        inside = [outline.contains_points(path.vertices[:3]).all() for outline in outlines.get_paths()]
        assert sum(inside) == 1
        assert inside[i // 9]  # in the order of the faces
