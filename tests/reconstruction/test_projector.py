"""The public projector: an exact adjoint, the predictions of the program, derivatives, and solvers built on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import nerif
from nerif.common.conventions import FACES
from nerif.data.measurement import Measurement
from nerif.fields.voxel_field import DEGREES
from nerif.forward.forward_model import ForwardModel
from nerif.forward.registry import TECHNIQUES
from nerif.geometry import Box, Grid, Ring
from nerif.reconstruction.projector import Projector
from refusals import refused

BOX = Box((-10.0, -8.0, -6.0), (9.0, 11.0, 7.0))
SHAPE = (8, 11, 13)
RING = Ring(views=4, image_size=(18, 23), pixel_pitch=0.13, distance=400.0, background_distance=300.0)
LINEAR = [kind for kind in TECHNIQUES.values() if not kind.derived]
TECHNIQUE = pytest.mark.parametrize("kind", LINEAR, ids=lambda kind: kind.name)


def observed(*kinds: type[ForwardModel]) -> Measurement:
    """Random values of techniques with sigma, in which no pixel is missing."""
    cameras = RING.cameras()
    if not any(kind.background for kind in kinds):
        cameras = tuple(camera.without_background for camera in cameras)
    maps = {}
    for i, kind in enumerate(kinds):
        shape = (4, 18, 23, len(kind.channels))[: None if len(kind.channels) > 1 else 3]
        maps[kind.measured] = 1 + random(*shape, seed=i).float().abs()
        maps[kind.sigma] = 0.1 + random(*shape, seed=9 + i).float().abs()
    d, sigma = maps.pop("displacement", None), maps.pop("sigma", None)
    return Measurement(cameras, d, BOX, 1.00027, sigma=sigma, wavelength_nm=532.0, maps=maps)


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def projector(m: Measurement, basis: str = "cubic", box: Box = BOX, **settings) -> Projector:
    return Projector(m, Grid(box, SHAPE), basis, **{"dtype": torch.float64, **settings})


def mismatch(a: Projector) -> float:
    """|<A x, y> - <x, A^T y>| over |A x| |y|."""
    x, y = random(*a.domain_shape).to(a.dtype), random(*a.range_shape, seed=1).to(a.dtype)
    forward, adjoint = a(x).double(), a.T(y).double()
    assert float(forward.norm()) > 0
    return abs(float((forward * y).sum() - (x * adjoint).sum())) / float(forward.norm() * y.double().norm())


@TECHNIQUE
def test_the_adjoint_is_exact_and_views_data_and_noise_are_those_of_the_measurement(kind):
    m = observed(kind)
    assert mismatch(projector(m)) < 1e-12
    single = projector(m, dtype=torch.float32)
    assert mismatch(single) < 1e-6
    x, y, z = (torch.sin(torch.pi * (torch.arange(n) + 0.5) / n) for n in SHAPE[::-1])  # 0 on the faces
    c = 1e-4 * z[:, None, None] * y[:, None] * x
    predicted = nerif.reproject(single.field(c), m).predicted.reshape(single.range_shape)[single.mask]
    projected = single(c)[single.mask]
    assert float((projected - predicted).norm() / projected.norm()) < 3e-3
    a, (o,) = projector(m), m.observations
    assert a.channels == o.components
    assert a.domain_shape == SHAPE
    assert a.range_shape == tuple(o.values.shape)
    assert a.mask[..., 0].equal(m.sees_box)
    assert torch.equal(a.data[a.mask], o.values.double()[a.mask])
    assert torch.allclose(a.sigma[a.mask], o.sigma.double()[a.mask], rtol=1e-6)
    assert not bool(a.data[~a.mask].any())
    assert bool(a.sigma[~a.mask].isinf().all())
    unknown = replace(m, sigma=None, maps={name: v for name, v in m.maps.items() if name != kind.sigma})
    assert projector(unknown).sigma is None


def test_several_techniques_are_channels_of_one_image():
    kinds = [kind for kind in LINEAR if kind.quantity == "index_excess"]
    m = observed(*kinds)
    m = replace(m, maps={name: value.index_fill(0, torch.tensor([1]), np.nan) for name, value in m.maps.items()})
    a = projector(m)
    assert a.channels == ("u", "v", "fringes")
    assert mismatch(a) < 1e-12
    assert a.mask[1, ..., :2].any()
    assert not a.mask[1, ..., 2].any()
    x = random(*SHAPE)
    for o, channels in zip(m.observations, (slice(0, 2), slice(2, 3)), strict=True):
        alone = projector(o.alone(m), ambient_faces=m.ambient_faces)
        views = [m.names.index(name) for name in alone.measurement.names]
        assert torch.allclose(a(x)[views][..., channels], alone(x))
        assert torch.equal(a.data[views][..., channels], alone.data)


def test_pixels_without_data_are_0_and_ignored():
    m = observed(TECHNIQUES["deflection"])
    d, valid = m.displacement.clone(), torch.ones(m.shape, dtype=torch.bool)
    d[0, 4, 5, 1], valid[1, 6, 7] = np.nan, False
    whole, a = projector(m), projector(replace(m, displacement=d, valid=valid))
    absent = whole.mask & ~a.mask
    assert absent.nonzero().tolist() == [[0, 4, 5, 0], [0, 4, 5, 1], [1, 6, 7, 0], [1, 6, 7, 1]]
    x, y = random(*SHAPE), random(*a.range_shape, seed=1)
    assert torch.equal(a(x), whole(x) * a.mask)
    expected = whole.T(y * a.mask)
    assert torch.allclose(a.T(torch.where(a.mask, y, torch.nan)), expected, atol=1e-12 * float(expected.abs().max()))
    assert float((a.data - a(x))[~a.mask].abs().sum()) == 0
    assert bool(((a.data - a(x)) / a.sigma).isfinite().all())


def test_views_of_two_sizes_and_faces_through_which_flow_leaves():
    m = observed(TECHNIQUES["deflection"])
    cameras = (replace(m.cameras[0], image_size=(15, 20)), *m.cameras[1:])
    a = projector(replace(m, cameras=cameras))
    assert a.range_shape == (4, 18, 23, 2)
    assert not a.mask[0, 15:].any()
    assert not a.mask[0, :, 20:].any()
    assert mismatch(a) < 1e-12
    fewer = projector(m, open_faces=("x+",))
    assert 0 < int(fewer.mask.sum()) < int(projector(m).mask.sum())


def test_values_and_coefficients_are_inverse():
    m, values = observed(TECHNIQUES["deflection"]), random(*SHAPE)
    for basis in DEGREES:
        a = projector(m, basis, ambient_faces=("x-", "y+"))
        x = a.coefficients(values)
        assert torch.allclose(a.volume(x).values.double(), values, atol=1e-5)
        assert torch.equal(x, values) == (basis == "linear")


def test_the_box_of_the_grid_counts():
    """Rays are integrated through the box of the grid, smaller or larger than that of the measurement."""
    m, smaller = observed(TECHNIQUES["absorption"]), Box((-7.0, -5.0, -4.0), (5.0, 8.0, 6.0))
    x = torch.ones(SHAPE, dtype=torch.float64)
    a, b = projector(m, "linear"), projector(m, "linear", smaller)
    lengths = {box: replace(m, box=box).rays()[0] for box in (BOX, smaller)}
    for op, rays in zip((a, b), lengths.values(), strict=True):
        assert torch.allclose(op(x)[op.mask], (rays.far - rays.near).double(), rtol=1e-4)
    assert projector(m, "linear", smaller).mask.sum() < a.mask.sum()


def test_derivatives_of_every_order_are_exact():
    m = observed(TECHNIQUES["deflection"]).select(["0deg", "170deg"])
    a = Projector(m, Grid(BOX, (2, 3, 4)), dtype=torch.float64)
    x = random(*a.domain_shape).requires_grad_(True)
    y = (random(*a.range_shape, seed=1) * a.mask).requires_grad_(True)
    scale = float(a(x.detach()).abs().max())
    assert torch.autograd.gradcheck(lambda x: a(x) / scale, x, fast_mode=True)
    assert torch.autograd.gradcheck(lambda y: a.T(y) / scale, y, fast_mode=True)
    assert torch.autograd.gradgradcheck(lambda x: (a(x) / scale).square(), x, fast_mode=True)
    (slope,) = torch.autograd.grad(0.5 * (a(x) - a.data).square().sum(), x)
    assert torch.allclose(slope, a.T(a(x) - a.data))


def test_lsmr_of_scipy_finds_the_least_squares_solution():
    from scipy.sparse.linalg import lsmr

    a = Projector(observed(TECHNIQUES["interferometry"]), Grid(BOX, (3, 4, 5)), dtype=torch.float64)
    units = torch.eye(60, dtype=torch.float64).reshape(60, 3, 4, 5)
    matrix = torch.stack([a(unit).flatten() for unit in units], dim=1).numpy()
    operator, b = a.as_linear_operator(), a.data.flatten().numpy()
    assert operator.shape == matrix.shape
    exact = np.linalg.lstsq(matrix, b, rcond=None)[0]
    solution = lsmr(operator, b, atol=1e-14, btol=1e-14, conlim=0, maxiter=2000)[0]
    np.testing.assert_allclose(solution, exact, rtol=1e-6, atol=1e-8 * np.abs(exact).max())
    assert 0.9 * np.linalg.norm(matrix, 2) < a.norm < np.linalg.norm(matrix, 2) * (1 + 1e-9)


@pytest.mark.usefixtures("unchecked")
def test_invalid_input():
    m = observed(TECHNIQUES["deflection"])
    for field, settings in {
        "model": {"model": "curved"}, "basis": {"basis": "quintic"}, "device": {"device": "abacus"},
        "from": {"source": "images"}, "aperture": {"aperture": "on"}, "open_faces": {"open_faces": FACES},
        "box": {"box": Box((900.0, 900.0, 900.0), (901.0, 901.0, 901.0))},
    }.items():  # fmt: skip
        with refused(field):
            projector(m, **settings)
    a = projector(m)
    with refused("x") as error:
        a(torch.zeros(13, 11, 8))
    assert "z and x swapped? Transpose the array: np.swapaxes(x, 0, 2)" in str(error.value)
    with refused("y") as error:
        a.T(torch.zeros(2, 4, 18, 23))
    assert "np.transpose(y, (1, 2, 3, 0))" in str(error.value)


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no NVIDIA GPU here")
def test_cuda_equals_the_cpu():
    m = observed(TECHNIQUES["deflection"])
    cpu, cuda = projector(m), projector(m, device="cuda")
    x, y = random(*SHAPE), random(*cpu.range_shape, seed=1)
    assert torch.equal(cuda.data.cpu(), cpu.data)
    assert torch.allclose(cuda(x).cpu(), cpu(x), rtol=1e-10, atol=1e-10 * float(cpu(x).abs().max()))
    assert torch.allclose(cuda.T(y).cpu(), cpu.T(y), rtol=1e-10, atol=1e-10 * float(cpu.T(y).abs().max()))
