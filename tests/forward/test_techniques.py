"""Techniques: each is one file, and whatever is one runs through all that there is."""

from __future__ import annotations

import ast
import itertools
import math
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from nerif.analysis.evaluation import evaluate_views
from nerif.analysis.gains import fit_gains, with_gains
from nerif.analysis.prediction import predict, reproject
from nerif.data.measurement import Measurement, measurement_of
from nerif.fields.base import Field
from nerif.fields.grid import Boundary
from nerif.fields.network import Network, NetworkShape, NeuralField
from nerif.fields.phantoms import GaussianBalls, Scaled
from nerif.forward import registry
from nerif.forward.absorption import Absorption, absorbance
from nerif.forward.base import ForwardModel, Light, Weights, midpoints
from nerif.forward.deflection import Deflection
from nerif.forward.emission import Emission
from nerif.forward.interferometry import Interferometry
from nerif.forward.path_integral import PathIntegral
from nerif.forward.registry import TECHNIQUES, forward_model, forward_models
from nerif.geometry import Box, Grid, Lens, Rays, Ring
from nerif.reconstruction.base import Reconstructor, State
from nerif.reconstruction.files import read_state, write_state
from nerif.reconstruction.neural.losses import LossWeights, loss_terms
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.trainer import Trainer
from nerif.reconstruction.neural.training_data import TrainingData
from nerif.reconstruction.target import Target
from nerif.reconstruction.voxels.multiplicative import MART, MLEM
from nerif.reconstruction.voxels.operator import VoxelOperator
from nerif.reconstruction.voxels.problem import Problem
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.simulation.simulate import Simulation, simulate
from refusals import refused

PACKAGE = Path(registry.__file__).parents[1]
BOX = Box((-10.0, -8.0, -6.0), (9.0, 11.0, 7.0))
RING = Ring(views=5, image_size=(18, 23), pixel_pitch=0.13, distance=400.0, background_distance=300.0)
SIMULATED = {name: kind for name, kind in TECHNIQUES.items() if not kind.derived}
OTHERS = [Absorption, Emission, Interferometry]
NETWORK = NeRIF(network=NetworkShape(width=48, depth=3), points_per_batch=2048, max_steps=120, device="cpu")


@pytest.fixture(scope="module")
def balls() -> Field:
    """A few balls of extinction or emission, about 0.1 1/mm."""
    centres = torch.tensor([[-3.0, 0.0, 1.0], [3.0, 4.0, -1.0], [1.0, -1.5, 1.5]])
    return GaussianBalls(centres, torch.tensor([2.2, 2.0, 1.8]), torch.tensor([0.1, 0.08, 0.12]))


@pytest.fixture(scope="module")
def measured(balls) -> dict[str, Measurement]:
    def of(kind: type[ForwardModel]) -> Measurement:
        field = Scaled(balls, 1e-3) if kind.quantity == "index_excess" else balls
        return simulate(field, RING.cameras(), BOX, 1.00027, 0.02, 1, 60, 532.0, techniques=[kind])

    return {kind.name: of(kind) for kind in SIMULATED.values()}


# -- one file each ---------------------------------------------------------------------------------------------------


def test_a_technique_is_one_file():
    homes = [kind.__module__ for kind in TECHNIQUES.values()]
    assert len(set(homes)) == len(homes)
    assert {home.rpartition(".")[0] for home in homes} == {"nerif.forward"}
    others = {kind.__module__ for kind in TECHNIQUES.values() if kind is not Deflection}
    importing = [
        (path.relative_to(PACKAGE), node.module)
        for path in PACKAGE.rglob("*.py")
        if path.relative_to(PACKAGE).parts[0] not in ("forward", "imaging")  # images become a measurement of one
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom) and node.module in others
    ]
    assert importing == []  # nothing else knows which techniques there are


@dataclass(frozen=True)
class Knife(ForwardModel):
    """A toy of two edges and none: deflections, less and less the deeper, and a little of the field itself."""

    name, measured, sigma = "knife", "grey", "grey_sigma"
    channels = ("across", "along", "open")
    unit = "1"
    limits = (1e-9, 1e9)
    quantity = "index_excess"

    @classmethod
    def of(cls, light: Light, model: str) -> ForwardModel:
        return cls()

    def weights(self, rays: Rays, s: Float[Tensor, "n m"], step: Float[Tensor, "n m"]) -> Weights:
        up = rays.direction.new_tensor([[0.0, 0.0, 1.0]]).expand_as(rays.direction)
        side = torch.linalg.cross(rays.direction, up)
        depth = (s - rays.near[:, None]) / 40
        value = rays.near.new_tensor([300.0, 100.0, 200.0]).expand(len(rays), 3)
        slope = 3e3 * torch.stack([side, torch.linalg.cross(side, rays.direction), 0 * side], dim=1)
        return Weights(torch.exp(-depth) * step, value=value, slope=slope)


@pytest.mark.slow
def test_a_technique_of_ones_own_runs_through_everything(balls, monkeypatch, tmp_path):
    monkeypatch.setitem(registry.TECHNIQUES, "knife", Knife)
    field = Scaled(balls, 1e-3)
    cameras = RING.cameras()
    seen = simulate(field, cameras, BOX, 1.00027, 0.02, 1, 60, techniques=[Knife])
    seen.write(tmp_path / "knife.nc")
    back = Measurement.read(tmp_path / "knife.nc")
    assert back.techniques == (Knife,)
    assert torch.equal(back.maps["grey"].nan_to_num(), seen.maps["grey"].nan_to_num())
    assert seen.maps["grey"].shape == (5, 18, 23, 3)
    clean = predict(field, cameras, BOX, 1.00027, technique=Knife)
    noise = (clean.maps["grey"] - seen.maps["grey"])[seen.sees_box] / seen.maps["grey_sigma"][seen.sees_box]
    assert 0.9 < float(noise.std()) < 1.1
    for method in (NETWORK, Tikhonov(voxels=16, device="cpu")):
        result = method(back)
        assert not result.outcome.failed
        assert result.quantity == "index_excess"
        assert all(v["cc"] > 0.98 for v in evaluate_views(reproject(result.field, back)))
    simulation = Simulation(technique=("knife",), truth_voxels=8, steps=20, noise=0.1)
    assert simulation(RING.cameras())[0].techniques == (Knife,)


# -- what the pixels see ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Cubic(Knife):
    """A toy whose profile is odd about the middle of the ray, but no line."""

    name, channels = "cubic", ("",)

    def weights(self, rays: Rays, s: Float[Tensor, "n m"], step: Float[Tensor, "n m"]) -> Weights:
        middle = 0.5 * (rays.near + rays.far)[:, None]
        return Weights(((s - middle) / 10) ** 3 * step, value=step.new_ones(len(rays), 1))


def rays_of(m: Measurement) -> Rays:
    return m.rays()[0].to(dtype=torch.float64)


@pytest.mark.parametrize(
    ("kind", "basis"),
    [*itertools.product(SIMULATED.values(), ["linear", "cubic"]), (Knife, "cubic"), (Cubic, "cubic")],
    ids=lambda x: x if isinstance(x, str) else x.name,
)
def test_the_voxel_operator_and_its_adjoint(kind, basis, measured, balls):
    m = measured["deflection"]
    model, rays, grid = forward_model(kind, m), rays_of(m)[::3], Grid(BOX, (11, 9, 13))
    a = VoxelOperator(rays, grid, model, basis, Boundary(("x-", "z+")), dtype=torch.float64)
    g = torch.Generator().manual_seed(0)
    c, y = (torch.randn(shape, generator=g, dtype=torch.float64) for shape in (a.domain_shape, a.range_shape))
    there, back = float((a(c) * y).sum()), float((c * a.T(y)).sum())
    assert abs(there - back) <= 1e-12 * float(a(c).norm() * y.norm())
    # whichever kernels sum
    compiled, adjoint, a.compiled = a(c), a.T(y), False
    assert torch.allclose(a(c), compiled, rtol=1e-12, atol=1e-12 * float(compiled.abs().max()))
    assert torch.allclose(a.T(y), adjoint, rtol=1e-12, atol=1e-12 * float(adjoint.abs().max()))
    # and it is the path integral through the spline
    fine = VoxelOperator(rays, grid, model, basis, Boundary(), step=0.05, dtype=torch.float64)
    exact = PathIntegral(model, 600)(fine.field(c), rays)
    assert float((fine(c) - exact).norm() / exact.norm()) < 2e-2


def test_weights_of_other_channels_than_named_never_reach_the_kernels(measured, monkeypatch):
    monkeypatch.setattr(Cubic, "channels", ("one", "two"))
    with refused("Cubic"):
        VoxelOperator(rays_of(measured["deflection"])[::50], Grid(BOX, (5, 5, 5)), Cubic())


@pytest.mark.parametrize("kind", OTHERS, ids=lambda k: k.name)
def test_line_integrals_of_a_ball_are_exact(kind, measured):
    width, peak, centre = 2.0, 0.3, torch.tensor([1.0, 2.0, 0.5], dtype=torch.float64)
    ball = GaussianBalls(centre[None], torch.tensor([width]).double(), torch.tensor([peak]).double())
    m = measured["deflection"]
    rays = rays_of(m)
    away = centre - rays.origin
    along = (away * rays.direction).sum(-1)
    distance = (away.square().sum(-1) - along.square()).clamp_min(0)
    exact = peak * width * (2 * torch.pi) ** 0.5 * torch.exp(-distance / (2 * width**2))
    weight = 1 / 532e-6 if kind is Interferometry else 1.0
    inside = distance < 4.0
    got = PathIntegral(forward_model(kind, m), 300)(ball, rays)[:, 0]
    assert torch.allclose(got[inside], weight * exact[inside], rtol=2e-3)


@pytest.mark.parametrize("kind", OTHERS, ids=lambda k: k.name)
def test_a_file_keeps_every_technique(kind, measured, tmp_path):
    m = measured[kind.name]
    cameras = tuple(
        replace(c, lens=Lens(3.0, 700.0 + i), pose_sigma=torch.full((6,), 3.0).double() if i else None)
        for i, c in enumerate(m.cameras)
    )
    m = replace(m, cameras=cameras)
    m.write(tmp_path / "m.nc")
    back = Measurement.read(tmp_path / "m.nc")
    assert back.techniques == (kind,)
    assert back.displacement is None
    assert all(camera.background is None for camera in back.cameras)
    for name, value in m.maps.items():
        assert torch.equal(back.maps[name].nan_to_num(), value.nan_to_num())
    assert [camera.lens for camera in back.cameras] == [camera.lens for camera in cameras]
    assert back.cameras[0].pose_sigma is None
    assert [camera.pose_sigma.tolist() for camera in back.cameras[1:]] == [[3.0] * 6] * 4


@pytest.mark.parametrize("name", list(SIMULATED))
def test_a_ray_that_grazes_the_box_says_nothing_of_the_scale(measured, name):
    measurement = measured[name]
    model = forward_model(TECHNIQUES[name], measurement)
    rays, values, _ = measurement.rays()
    first = replace(rays[:1], far=rays.near[:1])  # of no length in single precision
    grazing = Rays.collect([rays, first], len(rays) + 1)
    scale = model.field_scale(grazing, torch.cat([values, values[:1]]))
    assert scale == pytest.approx(model.field_scale(rays, values), rel=1e-6)


# -- reconstruction --------------------------------------------------------------------------------------------------


def error(result, balls, kind) -> float:
    field = Scaled(balls, 1e-3) if kind.quantity == "index_excess" else balls
    grid = Grid.of_resolution(BOX, 24)
    truth = field.sample(grid)
    return float((result.field.sample(grid) - truth).norm() / truth.norm())


@pytest.mark.parametrize("kind", [pytest.param(Emission, marks=pytest.mark.slow), Interferometry])
def test_every_method_finds_the_field(kind, measured, balls):
    methods: dict[str, Reconstructor] = {"tv": TotalVariation(voxels=16, device="cpu")}
    if kind.additive:  # a network for the others: two techniques of one index, below
        multiplicative = {"mlem": MLEM(voxels=16, device="cpu"), "mart": MART(voxels=16, device="cpu")}
        methods |= {"nerif": replace(NETWORK, max_steps=200), **multiplicative}
    for name, method in methods.items():
        result = method(measured[kind.name])
        assert result.quantity == kind.quantity
        assert error(result, balls, kind) < 0.3, name
        if kind.additive:
            assert float(result.field.sample(Grid.of_resolution(BOX, 16)).min()) >= 0, name


@pytest.mark.slow
def test_two_techniques_of_one_index_are_weighed_by_their_noise(balls):
    field = Scaled(balls, 1e-3)
    kinds = [Deflection, Interferometry]
    both = simulate(field, RING.cameras(), BOX, 1.00027, 0.3, 1, 60, 532.0, techniques=kinds)
    assert both.techniques == (Deflection, Interferometry)
    result = Tikhonov(voxels=16, device="cpu")(both)
    alone = Tikhonov(voxels=16, device="cpu")(replace(both, maps={}))
    assert error(result, balls, Interferometry) < error(alone, balls, Interferometry)
    views = evaluate_views(reproject(result.field, both))
    assert [v["measured"] for v in views] == ["displacement"] * 5 + ["fringes"] * 5
    assert error(NETWORK(both), balls, Interferometry) < 0.3


THREE = LossWeights(consistency=1, numerical=1, head=1, automatic=0)
HEADS = NetworkShape(width=32, depth=2, gradient_head=True)


def test_the_three_terms_of_the_paper_are_one_for_what_sees_no_gradient(measured, balls):
    result = replace(NETWORK, network=HEADS, weights=THREE, max_steps=60)(measured["emission"])
    assert result.history[-1]["loss"] < 0.5 * result.history[0]["loss"]
    first = result.history[0]
    assert first["loss"] == pytest.approx(first["head"] + first["numerical"])


def test_fringes_count_beside_displacements_whatever_the_terms(balls):
    kinds = [Deflection, Interferometry]
    both = simulate(Scaled(balls, 1e-3), RING.cameras(), BOX, 1.00027, 0.3, 1, 60, 532.0, techniques=kinds)
    network = Network(HEADS)
    field, found = NeuralField(network, BOX, 1e-3), []
    for part in Target.of(both).parts:
        part, (s, step) = part[:30], midpoints(part.rays[:30], 20)
        found.append(loss_terms(field, Plain(network), part, part.rays, s, step, THREE, "squared"))
    assert [set(terms) for terms in found] == [{"head", "consistency", "numerical"}, {"head", "numerical"}]
    assert "automatic" not in replace(NETWORK, network=HEADS, weights=THREE, max_steps=1)(both).history[0]


def test_rays_bend_alike_in_all_terms_and_in_the_path_integral(measured):
    m = measured["deflection"]
    model = forward_models(m.techniques, m, "curved")[0]
    (part,) = Target.of(m, model="curved").parts
    torch.manual_seed(0)
    network = Network(NetworkShape(width=16, depth=2, octaves=1)).requires_grad_(False)
    field = NeuralField(network, BOX, 2.0)
    part, (s, step) = part[:40], midpoints(part.rays[:40], 50)
    integral = PathIntegral(model, 50)(field, part.rays)
    terms = loss_terms(field, Plain(network), part, part.rays, s, step, LossWeights(numerical=1), "squared")
    exact = float(part.residual(integral).square().mean())
    straight = float(part.residual(PathIntegral(model.linear_twin, 50)(field, part.rays)).square().mean())
    assert float(terms["automatic"]) == pytest.approx(exact, rel=1e-4)
    assert abs(straight - exact) > 0.02 * exact
    assert float(terms["numerical"]) == pytest.approx(exact, rel=0.005)


class Plain:
    """A network as the loss asks it."""

    def __init__(self, network: Network) -> None:
        self.value, self.network = network, network

    def value_and_gradient(self, p, heads):
        return self.network.value_and_gradient(p, heads)


@dataclass(frozen=True)
class Mirage(Knife):
    """A toy that sees the field alone, somewhat beside the straight ray."""

    straight, linear, channels = False, False, ("",)

    def weights(self, rays: Rays, s: Float[Tensor, "n m"], step: Float[Tensor, "n m"]) -> Weights:
        return Weights(step, value=step.new_ones(len(rays), 1))

    def bend(self, value, gradient, rays, s, step):
        return torch.ones_like(gradient), torch.zeros_like(gradient)


def test_rays_that_bend_do_so_too_where_the_field_alone_is_seen(measured, balls):
    rays = rays_of(measured["deflection"])[::9]
    s, step = midpoints(rays, 40)
    there = (step * balls(rays.at(s) + 1)).sum(dim=1, keepdim=True)
    assert torch.allclose(PathIntegral(Mirage(), 40)(balls, rays), there)


def test_a_run_that_began_from_another_scale_goes_on_as_if_it_had_not_stopped(measured, tmp_path):
    m = measured["emission"]
    (seen,) = m.observations
    bright = m.observed({"emission": 3 * seen.values}, {"emission": seen.sigma})
    settings = replace(NETWORK, max_steps=12, upper=0.5, precision="float32")
    start = replace(settings, max_steps=3)(bright).field
    whole = settings(m, start=start)
    half = settings(m, lambda step: step.step == 5, start=start)
    write_state(tmp_path, half.state)
    again = settings(m, resume=read_state(tmp_path))
    points = torch.rand(50, 3) * 6
    assert torch.equal(again.field(points), whole.field(points))
    with refused("resume"):
        replace(settings, upper=0.4)(m, resume=half.state)
    training = Trainer(settings, TrainingData(settings, m), None, start)
    bounds = training.field.bounds
    for callback in training.callbacks:  # the fit to the start among them
        callback.on_start(training)
    training.load_state_dict(training.states.first)
    assert training.field.bounds == bounds


@pytest.mark.parametrize("method", [MLEM, MART])
def test_multiplicative_iterations_are_all_taken_and_none_is_lost_by_resuming(method, measured):
    m = measured["emission"]
    quick = method(voxels=12, device="cpu", iterations=6, tolerance=0.0, basis="linear")
    m = replace(m, maps={"radiance": m.maps["radiance"]})  # without sigma nothing stops it before
    one = replace(quick, iterations=1)(m)
    assert float(one.field.coefficients.std()) > 0.1 * float(one.field.coefficients.mean())
    whole, half = quick(m), replace(quick, iterations=3)(m)
    rest = quick(m, resume=half.state)
    assert torch.equal(rest.field.coefficients, whole.field.coefficients)
    x = half.state.tensors["x"]
    empty = x < x.mean()
    on = quick(m, resume=State({"x": torch.where(empty, 0, x)}, half.state.scalars))
    assert float(on.state.tensors["x"][empty].abs().max()) == 0


@pytest.mark.parametrize("name", ["emission", "both"])
def test_memory_counts_the_operators_of_all_techniques_and_of_every_view(name, measured, balls):
    m, kinds = measured["emission"], [Deflection, Interferometry]
    if name == "both":
        m = simulate(Scaled(balls, 1e-3), RING.cameras(), BOX, 1.00027, 0.3, 1, 60, 532.0, techniques=kinds)
    target, grid = Target.of(m), Grid.of_resolution(BOX, 12)
    problem = Problem([VoxelOperator(p.rays, grid, p.model, "linear") for p in target.parts], target)
    one, held = Tikhonov(voxels=12, basis="linear"), sum(map(held_by, problem.operators))
    assert one.operator_bytes(m, grid) > held
    if name == "emission":
        blocks = MART(voxels=12, basis="linear").blocks(problem)
        more = sum(b.reach.nbytes + sum(map(held_by, b.operators)) for b in blocks)
        few, many = (kind(voxels=12, basis="linear").memory_bytes(m, grid) for kind in (MLEM, MART))
        assert many - few > more


def held_by(operator: VoxelOperator) -> int:
    return sum(t.nbytes for b in operator.bundles for t in vars(b).values() if isinstance(t, torch.Tensor))


@pytest.mark.parametrize("method", [NETWORK, Tikhonov(voxels=8, device="cpu")], ids=["network", "voxels"])
def test_bounds_that_leave_nothing_with_those_of_the_technique_are_refused(method, measured):
    with refused("upper"):
        replace(method, upper=0.0)(measured["emission"])
    assert not replace(NETWORK, max_steps=1, upper=0.0)(measured["interferometry"]).outcome.failed


def test_bounds_cannot_be_left(measured):
    m = measured["deflection"]
    bounded = replace(NETWORK, max_steps=30, lower=-1e-5, upper=0.0)(m)
    values = bounded.field.sample(Grid.of_resolution(BOX, 30))
    assert float(values.min()) >= -1e-5 * (1 + 1e-6)  # as float32 rounds
    assert float(values.max()) <= 0
    with refused("lower, upper"):
        NeRIF(lower=1e-5)


def test_intensities_are_fitted_where_little_light_is_left(balls):
    dense = Scaled(balls, 12.0)  # absorbance up to some 6
    m = simulate(dense, RING.cameras(), BOX, 1.00027, 0.02, 1, 60, techniques=[Absorption])
    integral, noise = torch.tensor([[0.0], [3.0]]).double(), torch.full((2, 1), 0.1).double()
    rays = m.rays()[0][:2]
    for name, power in (("intensity", 1.0), ("poisson", 0.5)):
        (model,) = forward_models(m.techniques, m, name)
        values, sigma = model.reading(integral, noise, rays)
        assert sigma is not None
        assert values.flatten().tolist() == pytest.approx([1, 0.0497871**power], rel=1e-5)
        nearby = model.read(integral + 1e-3 * noise, rays)
        assert torch.allclose((values - nearby) / 1e-3, sigma, rtol=1e-3)
        assert torch.equal(model.read(integral, rays), values)
        result = replace(NETWORK, max_steps=20, model=name)(m)
        assert not result.outcome.failed
    with refused("model"):
        Tikhonov(model="intensity")(m)


def test_bins_of_intensities_weigh_by_their_pixels_where_sigma_is_not_known(measured):
    m = measured["absorption"]
    target = Target.of(replace(m, maps={"absorbance": 20 * m.maps["absorbance"]}), edge=2, model="intensity")
    (part,) = target.parts
    weights = part.inverse_scale / part.inverse_scale.max()
    whole = (weights - 1).abs() < 1e-6
    assert float(whole.float().mean()) > 0.5  # most bins have all their pixels, whatever they saw
    assert float(part.measured[whole].min()) < 0.2 < 0.9 < float(part.measured[whole].max())


def test_gains_of_cameras_are_found(measured):
    even, gains = measured["emission"], torch.tensor([1.0, 1.3, 0.8, 1.1, 0.9])
    found = fit_gains(with_gains(even, dict(zip(even.names, (1 / gains).tolist(), strict=True))))
    assert [*found] == [*even.names]
    assert torch.allclose(torch.tensor([*found.values()]), gains / gains.log().mean().exp(), rtol=0.03)
    with refused("fit_gains"):
        fit_gains(measured["absorption"])
    with refused("fit_gains"):
        fit_gains(even.select(even.names[:1]))


# -- what cannot be right --------------------------------------------------------------------------------------------


def test_absorbance_of_counts_and_its_sigma():
    rng = torch.Generator().manual_seed(0)
    truth = torch.full((60_000,), 1.5, dtype=torch.float64)
    passed = 20 + torch.poisson(400 * torch.exp(-truth), rng) / 2
    found, sigma = absorbance(passed.numpy(), (20 + 200 * torch.ones(60_000)).numpy(), 20.0, 2.0, 0.0, float("inf"))
    assert float(found.mean()) == pytest.approx(1.5, abs=0.01)
    assert float(found.std()) == pytest.approx(float(sigma.mean()), rel=0.05)


def test_where_no_quantum_is_left_the_absorbance_is_large():
    passed = torch.tensor([0.0, -0.3, 1.0, 50.0]).double().numpy()
    found, sigma = absorbance(passed, 0 * passed + 100, reference_images=float("inf"))
    assert found.tolist() == pytest.approx([math.log(200), math.log(200), math.log(100), math.log(2)])
    assert sigma.tolist() == pytest.approx([2, 2, 1, 50**-0.5])
    found, _ = absorbance(passed, torch.tensor([0.0, 100, 100, 100]).numpy())
    assert math.isnan(found[0])
    unseen = torch.tensor([[math.nan], [2.0]])
    for kind in (Absorption, Emission):
        values, _ = kind.detect(unseen, 1e4, torch.Generator().manual_seed(0))
        assert values.isnan().flatten().tolist() == [True, False]


def test_noise_alone_is_not_an_offset(measured):
    """Noise added to that of the measurement is no offset."""
    noisy = measured["emission"].maps["radiance"]
    noise = torch.randn(noisy.shape, generator=torch.Generator().manual_seed(2))
    noisy = noisy + 0.06 * noisy.nan_to_num().max() * noise
    replace(measured["emission"], maps={"radiance": noisy})
    with refused("radiance"):
        replace(measured["emission"], maps={"radiance": noisy - 0.5 * noisy.nan_to_num().max()})


def test_counts_that_cannot_be():
    bright, dim = torch.full((50,), 100.0).numpy(), torch.full((50,), 30.0).numpy()
    with refused("intensity"):
        absorbance(bright, dim)
    with refused("intensity"):
        absorbance(dim - 90, bright)
    with refused("reference"):
        absorbance(dim[:3], bright)
    with refused("dark"):
        absorbance(dim, bright, dim[:3])


@pytest.mark.usefixtures("unchecked")
def test_measurements_that_cannot_be(measured):
    m = measured["absorption"]
    with refused("absorbance"):
        replace(m, maps={"absorbance": m.maps["absorbance"] - 0.6})
    with refused("radiance"):
        replace(measured["emission"], maps={"radiance": -measured["emission"].maps["radiance"]})
    with refused("maps"):
        replace(m, maps={**m.maps, "phase": m.maps["absorbance"]})
    with refused("technique"):
        replace(measured["deflection"], maps=m.maps)
    fringes = measured["interferometry"]
    with refused("technique"):
        NETWORK(replace(measured["deflection"], sigma=None, wavelength_nm=532.0, maps=fringes.maps))
    with refused("wavelength_nm"):
        replace(fringes, wavelength_nm=None)
    with refused("background of view '0deg'"):
        replace(m, cameras=RING.cameras())
    with refused("background of view '0deg'"):
        replace(measured["deflection"], cameras=m.cameras)
    whole = fringes.maps["fringes"] / fringes.maps["fringes"].nan_to_num().abs().max() * 4
    with refused("fringes"):
        replace(fringes, maps={"fringes": torch.remainder(whole, 1)})
    with refused("method"):
        MLEM(voxels=8, device="cpu")(measured["deflection"])
    with refused("model"):
        NeRIF(model="curved")(m)
    with refused("technique"):
        Simulation(technique=("schlieren",))
    with refused("counts"):
        Simulation(technique=("interferometry",), counts=100.0, truth_voxels=4)(RING.cameras())


@pytest.mark.usefixtures("unchecked")
def test_maps_of_other_shapes_are_refused(measured):
    m = measured["absorption"]
    with refused("absorbance"):
        replace(m, maps={"absorbance": m.maps["absorbance"][..., None]})


def test_a_technique_by_which_nothing_was_measured_is_none(balls):
    """As when the only interferometer's view is held out, or a film's instant has no fringes."""
    kinds = [Deflection, Interferometry]
    both = simulate(Scaled(balls, 1e-3), RING.cameras(), BOX, 1.00027, 0.1, 1, 30, 532.0, techniques=kinds)
    fringes = both.maps["fringes"].clone()
    fringes[1:] = torch.nan
    one = replace(both, maps={**both.maps, "fringes": fringes})
    assert one.techniques == (Deflection, Interferometry)
    rest = one.without([one.names[0]])
    assert rest.techniques == (Deflection,)
    assert len(Target.of(rest).parts) == len(Target.of(rest, edge=2).parts) == 1
    assert rest.observed({"deflection": rest.displacements}).techniques == (Deflection,)


def hill(shape: tuple[int, int], fringes: float, width: float, steepness: float = 1.0) -> Tensor:
    """A phase of so many fringes, as wide as a share of the image's shorter side."""
    y, x = (torch.arange(n) - (n - 1) / 2 for n in shape)
    radius = torch.sqrt(y[:, None] ** 2 + x**2) / (width * max(min(shape), 40))
    return fringes * torch.exp(-(radius ** (2 * steepness)) / 2)


def check_phase(values: Tensor) -> None:
    Interferometry.check(values[..., None], None, torch.ones(values.shape, dtype=torch.bool))


@pytest.mark.parametrize("size", [(1024, 1024), (200, 200), (60, 75), (1, 200)])
@pytest.mark.parametrize(("fringes", "noise"), [(0.6, 0.0), (0.8, 0.02), (2.4, 0.15)])
def test_wrapped_phases_are_refused_whatever_the_size(size, fringes, noise):
    phase = hill(size, fringes, 0.2)
    phase = phase + noise * torch.randn(size, generator=torch.Generator().manual_seed(0))
    wrapped = torch.remainder(phase + 0.5, 1) - 0.5
    with refused("fringes"):
        check_phase(wrapped)
    with refused("fringes"):
        check_phase(2 * torch.pi * wrapped)


@pytest.mark.parametrize("size", [(500, 500), (60, 75), (1, 200)])
@pytest.mark.parametrize("steepness", [1.0, 4.0])
def test_small_phases_with_noise_and_steep_flanks_are_measured(size, steepness):
    generator = torch.Generator().manual_seed(0)
    for noise in (0.0, 0.05, 0.15):
        phase = hill(size, 1.0, 0.2, steepness) + noise * torch.randn(size, generator=generator)
        for spans in (0.85, 1.0, 0.95 * 2 * torch.pi):  # all that is there lies within about a fringe, or 2 pi
            check_phase(phase / float(phase.max() - phase.min()) * spans)
    pure = torch.randn(size, generator=generator)
    check_phase(pure / float(pure.max() - pure.min()))


def test_nothing_measured_is_refused():
    with refused("measurement"):
        Measurement(RING.cameras(), None, BOX, 1.0)
    cameras = [Absorption.seen_by(c) for c in RING.cameras()]
    empty = measurement_of({Absorption: torch.zeros(5, 18, 23, 1)}, cameras, BOX, 1.0)
    assert empty.techniques == (Absorption,)
