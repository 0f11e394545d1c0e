"""The measurement: its file, what of it is used, and what is refused (more of that in test_cli.py)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.data.measurement_file import variables
from nerif.forward.deflection import Deflection
from nerif.forward.registry import TECHNIQUES
from nerif.geometry import Lens, Ring
from nerif.simulation.simulate import simulate
from refusals import refused


@pytest.fixture(scope="module")
def full(ball, box) -> Measurement:
    """Views of different size, with everything that is optional."""
    cameras = Ring(views=2, arc=(0, 60), image_size=(10, 14), pixel_pitch=0.2).cameras()
    cameras += Ring(views=1, arc=(110, 110), image_size=(13, 9), pixel_pitch=0.2).cameras()
    cameras = (
        replace(cameras[0], distortion=torch.tensor([0.01, 0.02, 1e-3, 2e-3, 0.5], dtype=torch.float64)),
        *cameras[1:],
    )
    m = simulate(ball, cameras, box, 1.00027, noise=0.1, steps=15, wavelength_nm=532.0, ambient_faces=("x-", "z+"))
    valid = torch.rand(m.displacement.shape[:3], generator=torch.Generator().manual_seed(0)) > 0.2
    return replace(m, valid=valid, flow_mask=~valid)


def test_round_trip(full, tmp_path):
    full.write(tmp_path / "m.nc")
    back = Measurement.read(tmp_path / "m.nc")
    for name in ("displacement", "sigma", "valid", "flow_mask"):
        a, b = getattr(full, name), getattr(back, name)
        assert a.dtype == b.dtype
        assert torch.equal(a.nan_to_num(-9.0), b.nan_to_num(-9.0))
    for name in ("box", "n_ambient", "wavelength_nm", "ambient_faces", "names"):
        assert getattr(full, name) == getattr(back, name)
    for a, b in zip(full.cameras, back.cameras, strict=True):
        assert a.image_size == b.image_size
        for name in ("intrinsics", "rotation", "translation", "distortion"):
            assert torch.equal(getattr(a, name), getattr(b, name))
        assert torch.allclose(a.background.normal, b.background.normal, atol=1e-15)
        assert a.background.offset == pytest.approx(b.background.offset)
    assert not list(tmp_path.glob("*.part"))


def test_file_opens_with_plain_xarray_and_states_its_units(full, tmp_path):
    full.write(tmp_path / "m.nc")
    with xr.open_dataset(tmp_path / "m.nc") as dataset:
        assert dataset.attrs["Conventions"] == "BOST-1.0"
        assert dataset.attrs["ambient_faces"] == "x- z+"
        known = variables()
        others = {name for k in TECHNIQUES.values() if k is not Deflection for name in (k.measured, k.sigma, *k.beside)}
        later = {"aperture_diameter", "focus_distance", "window", "pose_sigma"}
        assert set(dataset.data_vars) == set(known) - later - others
        for name in dataset.data_vars:
            dimensions, unit = known[name]
            assert dataset[name].dims == dimensions
            assert dataset[name].attrs["units"] == unit
        assert list(dataset["component"].values) == ["u", "v"]


def test_what_is_optional_may_be_missing(full, tmp_path):
    m = replace(full.select(full.names[1:2]), sigma=None, valid=None, flow_mask=None, wavelength_nm=None)
    m = replace(m, displacement=m.displacement[:, :10, :14])
    m.write(tmp_path / "m.nc")
    dataset = xr.load_dataset(tmp_path / "m.nc").drop_vars(["distortion", "image_size", "view", "component"])
    del dataset.attrs["ambient_faces"]
    dataset.to_netcdf(tmp_path / "bare.nc", engine="h5netcdf")
    back = Measurement.read(tmp_path / "bare.nc")
    assert back.sigma is back.valid is back.flow_mask is back.wavelength_nm is None
    assert back.cameras[0].image_size == (10, 14)
    assert back.ambient_faces == ("x-", "x+", "y-", "y+")


def test_usable_pixels_and_rays(full):
    spoilt = full.displacement.clone()
    spoilt[0, 2, 3, 1] = float("nan")
    sigma = full.sigma.clone()
    sigma[1, 4, 5] = 0.0
    m = replace(full, displacement=spoilt, sigma=sigma, valid=torch.ones_like(full.valid))
    assert m.bad_pixels == 2
    usable = m.usable
    assert not bool(usable[0, 2, 3])
    assert not bool(usable[1, 4, 5])
    assert not bool(usable[0, 10:].any() | usable[2, :, 9:].any())
    assert int(usable.sum()) == 2 * 140 + 117 - 2
    rays, d, s = m.rays()
    assert len(rays) == len(d) == len(s)
    assert bool(rays.crosses.all())
    assert rays.origin.dtype == torch.float32
    # the k-th ray and the k-th displacement belong together
    index = usable.nonzero()
    camera = m.cameras[2]
    mine = index[index[:, 0] == 2]
    own = camera.rays(mine[:, [2, 1]].double()).clip(m.box)
    count = int(own.crosses.sum())
    assert torch.allclose(rays.direction[-count:], own.direction[own.crosses].float())
    assert torch.equal(d[-count:], m.displacement[2][usable[2]][own.crosses])


def test_select(full):
    part = full.select([full.names[2], full.names[0]])
    assert part.names == (full.names[0], full.names[2])
    assert torch.equal(part.displacement.nan_to_num(), full.displacement[[0, 2]].nan_to_num())
    assert torch.equal(part.valid, full.valid[[0, 2]])
    with refused("view"):
        full.select(["nobody"])
    with refused("view"):
        full.select([])


@pytest.fixture(scope="module")
def two(full) -> Measurement:
    """Displacements of two views and fringes of the third, all with a background."""
    d, valid = full.displacement.clone(), torch.ones_like(full.valid)
    fringes = d[..., 0].clone()
    d[2], fringes[:2] = torch.nan, torch.nan
    maps = {"fringes": fringes, "fringes_sigma": torch.full_like(fringes, 0.1)}
    return replace(full, displacement=d, maps=maps, valid=valid, flow_mask=None)


def test_techniques_are_taken_apart(two):
    deflection, interferometry = two.observations
    for alone in (interferometry.alone(two), deflection.without(two), two.without(two.names[:2])):
        assert alone.names == two.names[2:]
        assert alone.cameras[0].background is None
        assert [o.technique.name for o in alone.observations] == ["interferometry"]
    for alone in (deflection.alone(two), interferometry.without(two)):
        assert alone.names == two.names[:2]
        assert all(camera.background is not None for camera in alone.cameras)
    mixed = two.select(two.names[1:])
    assert all(camera.background is not None for camera in mixed.cameras)


def test_sizes_and_numbers_that_cannot_be_right(full, unchecked):
    for change, word in (
        ({"displacement": full.displacement[:2]}, "displacement"),
        ({"sigma": full.sigma[:, :5]}, "sigma"),
        ({"valid": full.valid[:, :, :3]}, "valid"),
        ({"n_ambient": 0.00027}, "n_ambient"),
        ({"cameras": (full.cameras[0],) * 3}, "different names"),
        ({"displacement": full.displacement[:, :9], "sigma": None, "valid": None, "flow_mask": None}, "image_size"),
    ):
        with pytest.raises(InputError, match=word):
            replace(full, **change)


@pytest.mark.parametrize("offset", [-5.0, 300.0], ids=["inside the box", "before the box"])
def test_background_must_be_behind_the_box(full, offset):
    camera = full.cameras[1]
    moved = replace(camera, background=replace(camera.background, offset=offset))
    with pytest.raises(InputError, match="background of view '60deg'"):
        replace(full, cameras=(full.cameras[0], moved, full.cameras[2]))


def test_wrong_attributes_name_themselves(full, tmp_path):
    full.write(tmp_path / "m.nc")
    for name, value in (("Conventions", "CF-1.8"), ("n_ambient", None), ("ambient_faces", "top")):
        dataset = xr.load_dataset(tmp_path / "m.nc")
        dataset.attrs.pop(name)
        if value:
            dataset.attrs[name] = value
        dataset.to_netcdf(tmp_path / "x.nc", engine="h5netcdf")
        with pytest.raises(InputError, match=f"x.nc.*{name}"):
            Measurement.read(tmp_path / "x.nc")


def test_normal_that_is_no_unit_vector(full, tmp_path):
    full.write(tmp_path / "m.nc")
    dataset = xr.load_dataset(tmp_path / "m.nc")
    dataset["background_normal"].values[1] *= 2
    assert np.isfinite(dataset["background_normal"].values).all()
    dataset.to_netcdf(tmp_path / "x.nc", engine="h5netcdf")
    with refused("background_normal of view '60deg'"):
        Measurement.read(tmp_path / "x.nc")


def test_a_normal_without_an_offset(full):
    cameras = tuple(camera.without_background for camera in full.cameras)
    absorbance = torch.ones(full.shape)
    plain = replace(full, cameras=cameras, displacement=None, sigma=None, maps={"absorbance": absorbance})
    dataset = plain.to_dataset()
    normals = torch.stack([camera.background.normal for camera in full.cameras]).numpy()
    dataset["background_normal"] = ("view", "i"), normals
    with refused("background_offset of view '0deg'"):
        Measurement.from_dataset(dataset)
    dataset["background_normal"] = ("view", "i"), np.full_like(normals, np.nan)
    assert Measurement.from_dataset(dataset).cameras[0].background is None


def test_sigma_and_displacement_that_no_camera_measures_are_left_out(full):
    """Extreme sigma would weigh one pixel against all others, and overflow in single precision."""
    sigma, d = full.sigma.clone(), full.displacement.clone()
    sigma[0, 1, 1], sigma[0, 1, 2], d[0, 1, 3] = 1e-30, 1e30, 1e30
    m = replace(full, sigma=sigma, displacement=d, valid=None)
    assert m.bad_pixels == 3
    assert not bool(m.usable[0, 1, 1:4].any())
    with refused("displacement of view '0deg'"):
        replace(full, sigma=torch.full_like(sigma, 1e-30))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 0, 1e300])
def test_image_size_that_is_no_size(full, tmp_path, value):
    dataset = full.to_dataset()
    dataset["image_size"] = dataset["image_size"].astype(float)
    dataset["image_size"].values[1] = value
    with pytest.raises(InputError, match="image_size"):
        Measurement.from_dataset(dataset)


def test_units_are_checked_and_axes_are_known_by_their_names(full):
    dataset = full.to_dataset()
    turned = dataset.assign(displacement=dataset["displacement"].transpose("row", "component", "view", "column"))
    assert torch.equal(Measurement.from_dataset(turned).displacement.nan_to_num(), full.displacement.nan_to_num())
    for name, unit in (("translation", "m"), ("background_normal", "deg"), ("box", np.array([1.0, 2.0]))):
        other = full.to_dataset()
        other[name].attrs["units"] = unit
        with pytest.raises(InputError, match=f"variable '{name}': expected units"):
            Measurement.from_dataset(other)


def test_truncated_file_is_refused_in_silence(full, tmp_path, capfd):
    full.write(tmp_path / "m.nc")
    content = (tmp_path / "m.nc").read_bytes()
    for share in (0.2, 0.6, 0.95):
        (tmp_path / "cut.nc").write_bytes(content[: int(share * len(content))])
        with pytest.raises(InputError, match=r"cut.nc: not a readable NetCDF-4 file, or truncated"):
            Measurement.read(tmp_path / "cut.nc")
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("distortion", [0.0, -0.1])
def test_rows_and_corners_without_a_wanted_pixel_are_passed_over(measurement, monkeypatch, distortion):
    """Pixels are traced in blocks of rows; one that is masked, or beyond a smaller image, has none."""
    monkeypatch.setattr("nerif.data.measurement.PIXELS_AT_A_TIME", 3 * measurement.displacement.shape[2])
    cameras = [replace(c, distortion=torch.tensor([distortion, 0, 0, 0, 0]).double()) for c in measurement.cameras]
    height, width = cameras[1].image_size
    cameras[1] = cameras[1].view(0, 0, height - 12, width)
    valid = torch.ones(measurement.displacement.shape[:3], dtype=torch.bool)
    valid[0, :10] = False
    rays, _, _ = replace(measurement, cameras=tuple(cameras), valid=valid).rays()
    for i, camera in enumerate(cameras):
        rows = slice(10, None) if i == 0 else slice(None, height - 12) if i == 1 else slice(None)
        pixels = measurement.cameras[i].pixel_grid()[rows].reshape(-1, 2)
        expected = camera.rays(pixels).clip(measurement.box)
        mine = rays[(rays.origin - camera.centre.float()).norm(dim=-1) < 1e-2]
        assert len(mine) == int(expected.crosses.sum()) > 0


RIGS = Path(__file__).parents[3] / "shared" / "data" / "rigs"


@pytest.mark.skipif(not RIGS.is_dir(), reason="the measurements of others are not beside the project (shared/data)")
@pytest.mark.parametrize(("name", "known"), [("all", True), ("window6", False)])
def test_files_of_others_are_read(name, known):
    m = Measurement.read(RIGS / f"{name}.nc")
    assert all((camera.pose_sigma is not None) == known for camera in m.cameras)
    assert len(m.cameras) == 9
    assert {c.lens for c in m.cameras} == {Lens(6.25) if name == "all" else Lens(window=6.0)}


def test_units_of_a_list_may_have_commas(full, tmp_path):
    turned = torch.full((len(full.cameras), 6), 1e-3, dtype=torch.float64)
    cameras = tuple(replace(camera, pose_sigma=sigma) for camera, sigma in zip(full.cameras, turned, strict=True))
    replace(full, cameras=cameras).write(tmp_path / "m.nc")
    dataset = xr.load_dataset(tmp_path / "m.nc")
    dataset["pose_sigma"].attrs["units"] = "rad, rad, rad, mm, mm, mm"
    dataset.to_netcdf(tmp_path / "commas.nc", engine="h5netcdf")
    back = Measurement.read(tmp_path / "commas.nc").cameras
    assert torch.equal(torch.stack([camera.pose_sigma for camera in back]), turned)
