"""Techniques: each is one file, and every one runs through the whole program."""

from __future__ import annotations

import math
import re
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
from nerif.fields.field import Field
from nerif.fields.network import Network, NeuralField
from nerif.fields.network_shape import NetworkShape
from nerif.fields.phantoms import GaussianBalls, Scaled
from nerif.forward import registry
from nerif.forward.absorption import Absorption, absorbance
from nerif.forward.deflection import Deflection
from nerif.forward.emission import Emission
from nerif.forward.forward_model import ForwardModel, Weights, midpoints
from nerif.forward.images import Images
from nerif.forward.interferometry import Interferometry
from nerif.forward.path_integral import PathIntegral
from nerif.forward.registry import TECHNIQUES, forward_model, forward_models
from nerif.geometry import Grid, Lens, Rays
from nerif.reconstruction.field_files import read_state, write_state
from nerif.reconstruction.neural.losses import loss_terms
from nerif.reconstruction.neural.neural import NeRIF
from nerif.reconstruction.neural.trainer import Trainer
from nerif.reconstruction.neural.training_data import TrainingData
from nerif.reconstruction.neural.training_settings import LossWeights
from nerif.reconstruction.reconstructor import Reconstructor, State
from nerif.reconstruction.target import Target
from nerif.reconstruction.voxels.multiplicative import MART, MLEM
from nerif.reconstruction.voxels.operator import VoxelOperator
from nerif.reconstruction.voxels.tikhonov import Tikhonov
from nerif.reconstruction.voxels.total_variation import TotalVariation
from nerif.reconstruction.voxels.voxel_problem import Problem
from nerif.simulation.simulate import simulate
from nerif.simulation.simulation import Simulation
from refusals import refused
from techniques import BOX, RING, Cubic, Knife

PACKAGE = Path(registry.__file__).parents[1]
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
        return simulate(field, RING.cameras(), BOX, 1.00027, 0.02, 1, 30, 532.0, techniques=[kind])

    return {kind.name: of(kind) for kind in SIMULATED.values()}


# -- one file each ---------------------------------------------------------------------------------------------------


def test_a_technique_is_one_file_and_nothing_else_depends_on_it():
    homes = [kind.__module__ for kind in TECHNIQUES.values()]
    assert len(set(homes)) == len(homes)
    assert {home.rpartition(".")[0] for home in homes} == {"nerif.forward"}
    others = set(homes) - {Deflection.__module__, Images.__module__}  # the data own images, see TechniqueData
    for path in PACKAGE.rglob("*.py"):
        if path.relative_to(PACKAGE).parts[0] != "forward":
            assert not others & {*re.findall(r"^ *from (\S+) import", path.read_text(), re.MULTILINE)}, path


@pytest.mark.slow
def test_a_technique_of_your_own_runs_through_everything(balls, monkeypatch, tmp_path):
    monkeypatch.setitem(registry.TECHNIQUES, "knife", Knife)
    field, cameras = Scaled(balls, 1e-3), RING.cameras()
    noisy = simulate(field, cameras, BOX, 1.00027, 0.02, 1, 60, techniques=[Knife])
    noisy.write(tmp_path / "knife.nc")
    back = Measurement.read(tmp_path / "knife.nc")
    assert back.techniques == (Knife,)
    assert torch.equal(back.maps["grey"].nan_to_num(), noisy.maps["grey"].nan_to_num())
    assert noisy.maps["grey"].shape == (5, 18, 23, 3)
    clean, inside = predict(field, cameras, BOX, 1.00027, technique=Knife), noisy.sees_box
    noise = (clean.maps["grey"] - noisy.maps["grey"])[inside] / noisy.maps["grey_sigma"][inside]
    assert 0.9 < float(noise.std()) < 1.1
    for method in (NETWORK, Tikhonov(voxels=16, device="cpu")):
        result = method(back)
        assert not result.outcome.failed
        assert result.quantity == "index_excess"
        assert all(v["cc"] > 0.98 for v in evaluate_views(reproject(result.field, back)))
    simulation = Simulation(technique=("knife",), truth_voxels=8, steps=20, noise=0.1)
    assert simulation(RING.cameras())[0].techniques == (Knife,)


# -- projections -----------------------------------------------------------------------------------------------------


def rays_of(m: Measurement) -> Rays:
    return m.rays()[0].to(dtype=torch.float64)


def test_weights_of_a_wrong_number_of_channels_are_refused(measured, monkeypatch):
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
def test_a_ray_that_grazes_the_box_does_not_affect_the_scale(measured, name):
    model = forward_model(TECHNIQUES[name], measured[name])
    rays, values, _ = measured[name].rays()
    grazing = Rays.collect([rays, replace(rays[:1], far=rays.near[:1])], len(rays) + 1)  # of length 0
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


@pytest.fixture(scope="module")
def both(balls) -> Measurement:
    """Displacements and fringes of one index."""
    kinds = [Deflection, Interferometry]
    return simulate(Scaled(balls, 1e-3), RING.cameras(), BOX, 1.00027, 0.3, 1, 30, 532.0, techniques=kinds)


@pytest.mark.slow
def test_two_techniques_of_one_index_are_weighted_by_their_noise(both, balls):
    assert both.techniques == (Deflection, Interferometry)
    result, alone = (Tikhonov(voxels=16, device="cpu")(m) for m in (both, replace(both, maps={})))
    assert error(result, balls, Interferometry) < error(alone, balls, Interferometry)
    views = evaluate_views(reproject(result.field, both))
    assert [v["measured"] for v in views] == ["displacement"] * 5 + ["fringes"] * 5
    assert error(NETWORK(both), balls, Interferometry) < 0.3


THREE = LossWeights(consistency=1, numerical=1, head=1, automatic=0)
HEADS = NetworkShape(width=32, depth=2, gradient_head=True)


def test_loss_terms_of_a_technique_without_gradient(measured, both):
    """Of the terms of the paper only those of the value are left."""
    history = replace(NETWORK, network=HEADS, weights=THREE, max_steps=30)(measured["emission"]).history
    assert history[-1]["loss"] < 0.5 * history[0]["loss"]
    assert history[0]["loss"] == pytest.approx(history[0]["head"] + history[0]["numerical"])
    network, names = Network(HEADS), []
    for part in Target.of(both).parts:
        part, (s, step) = part[:30], midpoints(part.rays[:30], 20)
        field = NeuralField(network, BOX, 1e-3)
        names.append(set(loss_terms(field, Plain(network), part, part.rays, s, step, THREE, "squared")))
    assert names == [{"head", "consistency", "numerical"}, {"head", "numerical"}]
    assert "automatic" not in replace(NETWORK, network=HEADS, weights=THREE, max_steps=1)(both).history[0]


def test_rays_bend_equally_in_all_terms_and_in_the_path_integral(measured, balls):
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
    rays = rays_of(m)[::9]
    s, step = midpoints(rays, 40)
    shifted = (step * balls(rays.at(s) + 1)).sum(dim=1, keepdim=True)
    assert torch.allclose(PathIntegral(Mirage(), 40)(balls, rays), shifted)


class Plain:
    """A network with the interface of MixedPrecision."""

    def __init__(self, network: Network) -> None:
        self.value, self.network = network, network

    def value_and_gradient(self, p, heads):
        return self.network.value_and_gradient(p, heads)


@dataclass(frozen=True)
class Mirage(Knife):
    """A toy: the field alone, beside the straight ray."""

    straight, linear, channels = False, False, ("",)

    def weights(self, rays: Rays, s: Float[Tensor, "n m"], step: Float[Tensor, "n m"]) -> Weights:
        return Weights(step, value=step.new_ones(len(rays), 1))

    def bend(self, value, gradient, rays, s, step):
        return torch.ones_like(gradient), torch.zeros_like(gradient)


def test_a_run_that_began_from_a_field_of_another_scale_resumes_exactly(measured, tmp_path):
    m = measured["emission"]
    (observation,) = m.observations
    bright = m.observed({"emission": 3 * observation.values}, {"emission": observation.sigma})
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
    training.run(lambda step: True)
    training.load_state_dict(training.watch.first)
    assert training.field.bounds == bounds


@pytest.mark.parametrize("method", [MLEM, MART])
def test_multiplicative_iterations_resume_exactly_and_preserve_zeros(method, measured):
    m = replace(measured["emission"], maps={"radiance": measured["emission"].maps["radiance"]})  # stops not by sigma
    quick = method(voxels=12, device="cpu", iterations=6, tolerance=0.0, basis="linear")
    one = replace(quick, iterations=1)(m)
    assert float(one.field.coefficients.std()) > 0.1 * float(one.field.coefficients.mean())
    whole, half = quick(m), replace(quick, iterations=3)(m)
    assert torch.equal(quick(m, resume=half.state).field.coefficients, whole.field.coefficients)
    x = half.state.tensors["x"]
    empty = x < x.mean()
    after = quick(m, resume=State({"x": torch.where(empty, 0, x)}, half.state.scalars))
    assert float(after.state.tensors["x"][empty].abs().max()) == 0


@pytest.mark.parametrize("name", ["emission", "both"])
def test_memory_includes_the_operators_of_all_techniques_and_of_every_view(name, measured, both):
    m = both if name == "both" else measured[name]
    target, grid = Target.of(m), Grid.of_resolution(BOX, 12)
    problem = Problem([VoxelOperator(p.rays, grid, p.model, "linear") for p in target.parts], target)
    assert Tikhonov(voxels=12, basis="linear").operator_bytes(m, grid) > sum(map(bytes_of, problem.operators))
    if name == "emission":
        blocks = MART(voxels=12, basis="linear").blocks(problem)
        more = sum(b.reach.nbytes + sum(map(bytes_of, b.operators)) for b in blocks)
        few, many = (kind(voxels=12, basis="linear").memory_bytes(m, grid) for kind in (MLEM, MART))
        assert many - few > more


def bytes_of(operator: VoxelOperator) -> int:
    return sum(t.nbytes for b in operator.bundles for t in vars(b).values() if isinstance(t, torch.Tensor))


def test_bounds_hold_within_those_of_the_technique(measured):
    bounded = replace(NETWORK, max_steps=30, lower=-1e-5, upper=0.0)(measured["deflection"])
    values = bounded.field.sample(Grid.of_resolution(BOX, 30))
    assert float(values.min()) >= -1e-5 * (1 + 1e-6)  # as float32 rounds
    assert float(values.max()) <= 0
    for method in (NETWORK, Tikhonov(voxels=8, device="cpu")):
        with refused("upper"):
            replace(method, upper=0.0)(measured["emission"])
    assert not replace(NETWORK, max_steps=1, upper=0.0)(measured["interferometry"]).outcome.failed


def test_intensities_are_fitted_at_large_absorbance(balls):
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


def test_bins_of_intensities_are_weighted_by_their_pixels_without_sigma(measured):
    m = measured["absorption"]
    target = Target.of(replace(m, maps={"absorbance": 20 * m.maps["absorbance"]}), edge=2, model="intensity")
    (part,) = target.parts
    weights = part.inverse_scale / part.inverse_scale.max()
    whole = (weights - 1).abs() < 1e-6
    assert float(whole.float().mean()) > 0.5  # most bins have all their pixels, whatever they saw
    assert float(part.measured[whole].min()) < 0.2 < 0.9 < float(part.measured[whole].max())


def test_gains_of_cameras_are_fitted(measured):
    even, gains = measured["emission"], torch.tensor([1.0, 1.3, 0.8, 1.1, 0.9])
    estimate = fit_gains(with_gains(even, dict(zip(even.names, (1 / gains).tolist(), strict=True))))
    assert [*estimate] == [*even.names]
    assert torch.allclose(torch.tensor([*estimate.values()]), gains / gains.log().mean().exp(), rtol=0.03)
    with refused("fit_gains"):
        fit_gains(measured["absorption"])
    with refused("fit_gains"):
        fit_gains(even.select(even.names[:1]))


# -- noise and invalid input -----------------------------------------------------------------------------------------


def test_absorbance_of_counts_and_its_sigma():
    truth = torch.full((60_000,), 1.5, dtype=torch.float64)
    passed = 20 + torch.poisson(400 * torch.exp(-truth), torch.Generator().manual_seed(0)) / 2
    values, sigma = absorbance(passed.numpy(), (20 + 200 * torch.ones(60_000)).numpy(), 20.0, 2.0, 0.0, math.inf)
    assert float(values.mean()) == pytest.approx(1.5, abs=0.01)
    assert float(values.std()) == pytest.approx(float(sigma.mean()), rel=0.05)


def test_absorbance_is_large_without_light_and_nan_without_a_reference():
    passed = torch.tensor([0.0, -0.3, 1.0, 50.0]).double().numpy()
    values, sigma = absorbance(passed, 0 * passed + 100, reference_images=math.inf)
    assert values.tolist() == pytest.approx([math.log(200), math.log(200), math.log(100), math.log(2)])
    assert sigma.tolist() == pytest.approx([2, 2, 1, 50**-0.5])
    assert math.isnan(absorbance(passed, torch.tensor([0.0, 100, 100, 100]).numpy())[0][0])
    for kind in (Absorption, Emission):
        values, _ = kind.detect(torch.tensor([[math.nan], [2.0]]), 1e4, torch.Generator().manual_seed(0))
        assert values.isnan().flatten().tolist() == [True, False]


def test_noise_alone_is_not_an_offset(measured):
    m = measured["emission"]
    radiance = m.maps["radiance"]
    largest, noise = (
        radiance.nan_to_num().max(),
        torch.randn(radiance.shape, generator=torch.Generator().manual_seed(2)),
    )
    replace(m, maps={"radiance": radiance + 0.06 * largest * noise})
    with refused("radiance"):
        replace(m, maps={"radiance": radiance + 0.06 * largest * noise - 0.5 * largest})


def test_impossible_counts():
    bright, dim = torch.full((50,), 100.0).numpy(), torch.full((50,), 30.0).numpy()
    images = {"intensity": (bright, dim), "reference": (dim[:3], bright), "dark": (dim, bright, dim[:3])}
    for field, arguments in (*images.items(), ("intensity", (dim - 90, bright))):
        with refused(field):
            absorbance(*arguments)


@pytest.mark.usefixtures("unchecked")
def test_impossible_measurements_and_settings(measured):
    m, fringes, displacements = measured["absorption"], measured["interferometry"], measured["deflection"]
    values, phase = m.maps["absorbance"], fringes.maps["fringes"]
    wrapped = torch.remainder(phase / phase.nan_to_num().abs().max() * 4, 1)
    cases = [
        ("absorbance", lambda: replace(m, maps={"absorbance": values - 0.6})),
        ("absorbance", lambda: replace(m, maps={"absorbance": values[..., None]})),
        ("radiance", lambda: replace(measured["emission"], maps={"radiance": -measured["emission"].maps["radiance"]})),
        ("maps", lambda: replace(m, maps={**m.maps, "phase": values})),
        ("technique", lambda: replace(displacements, maps=m.maps)),
        ("technique", lambda: NETWORK(replace(displacements, sigma=None, wavelength_nm=532.0, maps=fringes.maps))),
        ("wavelength_nm", lambda: replace(fringes, wavelength_nm=None)),
        ("background of view '0deg'", lambda: replace(m, cameras=RING.cameras())),
        ("background of view '0deg'", lambda: replace(displacements, cameras=m.cameras)),
        ("fringes", lambda: replace(fringes, maps={"fringes": wrapped})),
        ("method", lambda: MLEM(voxels=8, device="cpu")(displacements)),
        ("model", lambda: NeRIF(model="curved")(m)),
        ("technique", lambda: Simulation(technique=("schlieren",))),
        ("counts", lambda: Simulation(technique=("interferometry",), counts=100.0, truth_voxels=4)(RING.cameras())),
        ("measurement", lambda: Measurement(RING.cameras(), None, BOX, 1.0)),
        ("lower, upper", lambda: NeRIF(lower=1e-5)),
    ]
    for field, make in cases:
        with refused(field):
            make()


def test_a_technique_without_data_is_none(both):
    """As when the only interferometer's view is withheld, or a frame has no fringes."""
    fringes = both.maps["fringes"].clone()
    fringes[1:] = torch.nan
    one = replace(both, maps={**both.maps, "fringes": fringes})
    assert one.techniques == (Deflection, Interferometry)
    rest = one.without([one.names[0]])
    assert rest.techniques == (Deflection,)
    assert len(Target.of(rest).parts) == len(Target.of(rest, edge=2).parts) == 1
    assert rest.observed({"deflection": rest.displacements}).techniques == (Deflection,)
    cameras = [Absorption.seen_by(c) for c in RING.cameras()]
    zero = measurement_of({Absorption: torch.zeros(5, 18, 23, 1)}, cameras, BOX, 1.0)
    assert zero.techniques == (Absorption,)


def hill(shape: tuple[int, int], fringes: float, width: float, steepness: float = 1.0) -> Tensor:
    """A phase of some fringes, whose width is a share of the image's shorter side."""
    y, x = (torch.arange(n) - (n - 1) / 2 for n in shape)
    radius = torch.sqrt(y[:, None] ** 2 + x**2) / (width * max(min(shape), 40))
    return fringes * torch.exp(-(radius ** (2 * steepness)) / 2)


def check_phase(values: Tensor) -> None:
    Interferometry.check(values[..., None], None, torch.ones(values.shape, dtype=torch.bool))


@pytest.mark.parametrize("size", [(1024, 1024), (200, 200), (60, 75), (1, 200)])
@pytest.mark.parametrize(("fringes", "noise"), [(0.6, 0.0), (0.8, 0.02), (2.4, 0.15)])
def test_wrapped_phases_of_any_size_are_refused(size, fringes, noise):
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
        for spans in (0.85, 1.0, 0.95 * 2 * torch.pi):  # the range is about a fringe, or 2 pi
            check_phase(phase / float(phase.max() - phase.min()) * spans)
    pure = torch.randn(size, generator=generator)
    check_phase(pure / float(pure.max() - pure.min()))
