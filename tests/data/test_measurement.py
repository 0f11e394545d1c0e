"""The measurement: its file, its usable pixels and rays, and what is refused (more in test_cli.py)."""

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
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.data.volume import Volume
from nerif.forward.deflection import Deflection
from nerif.forward.registry import TECHNIQUES
from nerif.geometry import Box, Grid, Lens, Ring
from nerif.geometry.interfaces import Interface
from nerif.simulation.simulate import simulate
from refusals import refused


@pytest.fixture(scope="module")
def full(ball, box) -> Measurement:
    """Views of different size, with everything that is optional."""
    cameras = Ring(views=2, arc=(0, 60), image_size=(10, 14), pixel_pitch=0.2).cameras()
    cameras += Ring(views=1, arc=(110, 110), image_size=(13, 9), pixel_pitch=0.2).cameras()
    distortion = torch.tensor([0.01, 0.02, 1e-3, 2e-3, 0.5], dtype=torch.float64)
    cameras = (replace(cameras[0], distortion=distortion), *cameras[1:])
    m = simulate(ball, cameras, box, 1.00027, noise=0.1, steps=15, wavelength_nm=532.0, ambient_faces=("x-", "z+"))
    valid = torch.rand(m.displacement.shape[:3], generator=torch.Generator().manual_seed(0)) > 0.2
    return replace(m, valid=valid, flow_mask=~valid)


def test_file_is_plain_netcdf_and_read_as_written(full, tmp_path):
    full.write(tmp_path / "m.nc")
    with xr.open_dataset(tmp_path / "m.nc") as dataset:
        assert dataset.attrs["Conventions"] == "BOST-1.0"
        assert dataset.attrs["ambient_faces"] == "x- z+"
        formats = variables()
        others = {name for k in TECHNIQUES.values() if k is not Deflection for name in (k.measured, k.sigma, *k.beside)}
        later = {"aperture_diameter", "focus_distance", "window", "pose_sigma", "tilt", "frame_offset"}
        later |= {"interface_normal", "interface_offset", "interface_index"}
        later |= {"hidden", "body_vertices", "body_faces", "body_of_face", "body_rotation", "body_translation"}
        assert set(dataset.data_vars) == set(formats) - later - others
        for name in dataset.data_vars:
            assert (dataset[name].dims, dataset[name].attrs["units"]) == formats[name]
        assert list(dataset["component"].values) == ["u", "v"]
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


def test_noise_is_stored_as_it_is_and_constant_maps_compressed(full, tmp_path):
    sigma = torch.full_like(full.sigma, 0.1)
    replace(full, sigma=sigma).write(tmp_path / "m.nc")
    with xr.open_dataset(tmp_path / "m.nc") as dataset:
        compressed = {name: dataset[name].encoding["zlib"] for name in ("displacement", "sigma")}
    assert compressed == {"displacement": False, "sigma": True}


def test_the_tilt_of_sensors_is_read_as_written(full, tmp_path):
    tilt = torch.tensor([[0.05, -0.02], [0.0, 0.0], [0.1, 0.03]], dtype=torch.float64)
    cameras = tuple(replace(c, tilt=t) for c, t in zip(full.cameras, tilt, strict=True))
    replace(full, cameras=cameras).write(tmp_path / "m.nc")
    assert torch.equal(torch.stack([c.tilt for c in Measurement.read(tmp_path / "m.nc").cameras]), tilt)
    dataset = xr.load_dataset(tmp_path / "m.nc")
    assert dataset.attrs["Conventions"] == "BOST-1.1"  # a reader of 1.0 would trace other rays
    dataset["tilt"].attrs["units"] = "degrees"
    dataset.to_netcdf(tmp_path / "degrees.nc", engine="h5netcdf")
    with refused("variable 'tilt'"):
        Measurement.read(tmp_path / "degrees.nc")


def test_optional_variables_may_be_missing(full, tmp_path):
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
    displacement, sigma = full.displacement.clone(), full.sigma.clone()
    displacement[0, 2, 3, 1], sigma[1, 4, 5] = torch.nan, 0.0
    m = replace(full, displacement=displacement, sigma=sigma, valid=torch.ones_like(full.valid))
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
    index = index[index[:, 0] == 2]
    expected = m.cameras[2].rays(index[:, [2, 1]].double()).clip(m.box)
    count = int(expected.crosses.sum())
    assert torch.allclose(rays.direction[-count:], expected.direction[expected.crosses].float())
    assert torch.equal(d[-count:], m.displacement[2][usable[2]][expected.crosses])


def test_impossible_sigma_and_displacement_are_left_out(full):
    """Extreme sigma would outweigh all other pixels, and overflow in single precision."""
    sigma, d = full.sigma.clone(), full.displacement.clone()
    sigma[0, 1, 1], sigma[0, 1, 2], d[0, 1, 3] = 1e-30, 1e30, 1e30
    m = replace(full, sigma=sigma, displacement=d, valid=None)
    assert m.bad_pixels == 3
    assert not bool(m.usable[0, 1, 1:4].any())
    with refused("displacement of view '0deg'"):
        replace(full, sigma=torch.full_like(sigma, 1e-30))


@pytest.mark.parametrize(
    ("order", "remedy"),
    [
        ((0, 2, 1, 3), "row and column swapped? Transpose the array: np.swapaxes(displacement, 1, 2)"),
        ((0, 3, 1, 2), "axes in another order? Transpose the array: np.transpose(displacement, (0, 2, 3, 1))"),
        ((1, 2, 3, 0), "axes in another order? Transpose the array: np.transpose(displacement, (3, 0, 1, 2))"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_swapped_axes_are_named_and_the_remedy_undoes_them(measurement, order, remedy):
    d = measurement.displacement
    swapped = d.permute(order)
    with refused("displacement") as error:
        replace(measurement, displacement=swapped)
    assert str(error.value).endswith(f"; {remedy}")
    back = eval(remedy.partition("array: ")[2], {"np": np, "displacement": swapped.numpy()})
    assert np.array_equal(back, d.numpy(), equal_nan=True)


@pytest.mark.usefixtures("unchecked")
def test_swapped_masks_volumes_and_padded_maps_are_named(measurement, tmp_path):
    views, rows, columns = measurement.shape
    with refused("valid") as error:
        replace(measurement, valid=torch.ones(views, columns, rows, dtype=torch.bool))
    assert "np.swapaxes(valid, 1, 2)" in str(error.value)
    padded = torch.nn.functional.pad(measurement.displacement.swapaxes(1, 2), (0, 0, 0, 0, 0, 3))
    with refused(f"image_size of view '{measurement.names[0]}'") as error:
        replace(measurement, displacement=padded, sigma=None)
    assert "are rows and columns of the maps swapped?" in str(error.value)
    with refused("volume 'index_excess'") as error:
        Volume(torch.zeros(5, 4, 3), Grid(measurement.box, (3, 4, 5)))
    assert "z and x swapped?" in str(error.value)
    dataset = measurement.to_dataset()
    names = {"row": "column", "column": "row"}
    turned = dataset.drop_vars(["displacement", "sigma"])
    turned = turned.assign({name: dataset[name].rename(names) for name in ("displacement", "sigma")})
    turned.to_netcdf(tmp_path / "turned.nc", engine="h5netcdf")
    with refused("displacement") as error:
        Measurement.read(tmp_path / "turned.nc")
    assert str(error.value).startswith(f"{tmp_path / 'turned.nc'}: displacement: expected (view, row, column")


def test_valid_pixels_are_counted_for_each_technique(measurement):
    """Of their images, padding excluded; named where there are several techniques."""
    d = measurement.displacement.clone()
    d[0, :, :14] = torch.nan
    half = replace(measurement, displacement=d)
    (o,) = half.observations
    assert half.valid_share(o) == [0.5, 1.0, 1.0, 1.0, 1.0]
    assert dict(half.summary())["Valid pixels"] == "90.0%"
    fringes = torch.ones(half.shape)
    both = replace(half, maps={"fringes": fringes, "fringes_sigma": fringes}, wavelength_nm=532.0)
    assert dict(both.summary())["Valid pixels"] == "90.0% (displacement), 100.0% (fringes)"


@pytest.mark.parametrize("distortion", [0.0, -0.1])
def test_rays_are_traced_in_blocks_of_rows(measurement, monkeypatch, distortion):
    """A block that is masked, or beyond a smaller image, has no pixel."""
    monkeypatch.setattr("nerif.data.measurement_data.PIXELS_AT_A_TIME", 3 * measurement.displacement.shape[2])
    cameras = [replace(c, distortion=torch.tensor([distortion, 0, 0, 0, 0]).double()) for c in measurement.cameras]
    height, width = cameras[1].image_size
    cameras[1] = cameras[1].view(0, 0, height - 12, width)
    valid = torch.ones(measurement.displacement.shape[:3], dtype=torch.bool)
    valid[0, :10] = False
    rays, _, _ = replace(measurement, cameras=tuple(cameras), valid=valid).rays()
    for i, camera in enumerate(cameras):
        rows = {0: slice(10, None), 1: slice(None, height - 12)}.get(i, slice(None))
        pixels = measurement.cameras[i].pixel_grid()[rows].reshape(-1, 2)
        expected = camera.rays(pixels).clip(measurement.box)
        of_view = rays[(rays.origin - camera.centre.float()).norm(dim=-1) < 1e-2]
        assert len(of_view) == int(expected.crosses.sum()) > 0


def test_select(full):
    part = full.select([full.names[2], full.names[0]])
    assert part.names == (full.names[0], full.names[2])
    assert torch.equal(part.displacement.nan_to_num(), full.displacement[[0, 2]].nan_to_num())
    assert torch.equal(part.valid, full.valid[[0, 2]])
    for names in (["nobody"], []):
        with refused("view"):
            full.select(names)
    for names in (["nobody"], full.names):
        with refused("withhold"):
            full.without(names)


def test_techniques_are_separated(full):
    """Displacements of two views and fringes of the third, all with a background."""
    d, valid = full.displacement.clone(), torch.ones_like(full.valid)
    fringes = d[..., 0].clone()
    d[2], fringes[:2] = torch.nan, torch.nan
    maps = {"fringes": fringes, "fringes_sigma": torch.full_like(fringes, 0.1)}
    both = replace(full, displacement=d, maps=maps, valid=valid, flow_mask=None)
    deflection, interferometry = both.observations
    for alone in (interferometry.alone(both), deflection.without(both), both.without(both.names[:2])):
        assert alone.names == both.names[2:]
        assert alone.cameras[0].background is None
        assert [o.technique.name for o in alone.observations] == ["interferometry"]
    for alone in (deflection.alone(both), interferometry.without(both)):
        assert alone.names == both.names[:2]
        assert all(camera.background is not None for camera in alone.cameras)
    assert all(camera.background is not None for camera in both.select(both.names[1:]).cameras)


def test_invalid_shapes_and_numbers(full, unchecked):
    narrow = {"displacement": full.displacement[:, :9], "sigma": None, "valid": None, "flow_mask": None}
    for field, changes in {
        "displacement": {"displacement": full.displacement[:2]},
        "sigma": {"sigma": full.sigma[:, :5]},
        "valid": {"valid": full.valid[:, :, :3]},
        "maps": {"maps": {"speed": full.displacement[..., 0]}},
        "n_ambient": {"n_ambient": 0.00027},
        "wavelength_nm": {"wavelength_nm": 0.532},
        "view": {"cameras": (full.cameras[0],) * 3},
        f"image_size of view '{full.names[0]}'": narrow,
    }.items():
        with refused(field):
            replace(full, **changes)


@pytest.mark.parametrize("offset", [-5.0, 300.0], ids=["inside the box", "in front of the box"])
def test_background_must_be_behind_the_box(full, offset):
    camera = full.cameras[1]
    camera = replace(camera, background=replace(camera.background, offset=offset))
    with refused("background of view '60deg'"):
        replace(full, cameras=(full.cameras[0], camera, full.cameras[2]))


def test_invalid_attributes(full, tmp_path):
    for name, value in (("Conventions", "CF-1.8"), ("n_ambient", None), ("ambient_faces", "top")):
        dataset = full.to_dataset()
        dataset.attrs[name] = value
        if value is None:
            del dataset.attrs[name]
        dataset.to_netcdf(tmp_path / "x.nc", engine="h5netcdf")
        with refused(f"attribute {name}") as error:
            Measurement.read(tmp_path / "x.nc")
        assert str(error.value).startswith(str(tmp_path / "x.nc"))


def test_normals_and_offsets_of_backgrounds(full):
    dataset = full.to_dataset()
    dataset["background_normal"] = dataset["background_normal"].copy(deep=True)
    dataset["background_normal"].values[1] *= 2
    with refused("background_normal of view '60deg'"):
        Measurement.from_dataset(dataset)
    cameras = tuple(camera.without_background for camera in full.cameras)
    maps = {"absorbance": torch.ones(full.shape)}
    dataset = replace(full, cameras=cameras, displacement=None, sigma=None, maps=maps).to_dataset()
    normals = torch.stack([camera.background.normal for camera in full.cameras]).numpy()
    dataset["background_normal"] = ("view", "i"), normals
    with refused("background_offset of view '0deg'"):
        Measurement.from_dataset(dataset)
    dataset["background_normal"] = ("view", "i"), np.full_like(normals, np.nan)
    assert Measurement.from_dataset(dataset).cameras[0].background is None


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 0, 1e300, 20.5])
def test_invalid_image_size(full, value):
    dataset = full.to_dataset()
    dataset["image_size"] = dataset["image_size"].astype(float)
    dataset["image_size"].values[1] = value
    with pytest.raises(InputError, match="image_size"):
        Measurement.from_dataset(dataset)


def test_units_and_the_order_of_dimensions(full):
    dataset = full.to_dataset()
    transposed = dataset.assign(displacement=dataset["displacement"].transpose("row", "component", "view", "column"))
    assert torch.equal(Measurement.from_dataset(transposed).displacement.nan_to_num(), full.displacement.nan_to_num())
    for name, unit in (("translation", "m"), ("background_normal", "deg"), ("box", np.array([1.0, 2.0]))):
        dataset = full.to_dataset()
        dataset[name].attrs["units"] = unit
        with refused(f"variable '{name}'"):
            Measurement.from_dataset(dataset)
    sigma = torch.full((6,), 1e-3, dtype=torch.float64)
    dataset = replace(full, cameras=tuple(replace(camera, pose_sigma=sigma) for camera in full.cameras)).to_dataset()
    dataset["pose_sigma"].attrs["units"] = "rad, rad, rad, mm, mm, mm"
    assert all(torch.equal(camera.pose_sigma, sigma) for camera in Measurement.from_dataset(dataset).cameras)


def test_a_truncated_file_is_refused_silently(full, tmp_path, capfd):
    full.write(tmp_path / "m.nc")
    content = (tmp_path / "m.nc").read_bytes()
    for share in (0.2, 0.6, 0.95):
        (tmp_path / "cut.nc").write_bytes(content[: int(share * len(content))])
        with pytest.raises(InputError, match=r"cut.nc: not a readable NetCDF file, or truncated"):
            Measurement.read(tmp_path / "cut.nc")
    assert capfd.readouterr().err == ""


RIGS = Path(__file__).parents[3] / "shared" / "data" / "rigs"


@pytest.mark.skipif(not RIGS.is_dir(), reason="no measurements of others beside the project (shared/data)")
@pytest.mark.parametrize(("name", "pose_sigma"), [("all", True), ("window6", False)])
def test_files_of_others_are_read(name, pose_sigma):
    m = Measurement.read(RIGS / f"{name}.nc")
    assert all((camera.pose_sigma is not None) == pose_sigma for camera in m.cameras)
    assert len(m.cameras) == 9
    assert {c.lens for c in m.cameras} == {Lens(6.25) if name == "all" else Lens(window=6.0)}


@pytest.mark.parametrize("version", ["NETCDF3_CLASSIC", "NETCDF3_64BIT"])
def test_netcdf_3_is_read_as_version_4(full, tmp_path, version):
    path = tmp_path / "classic.nc"
    full.to_dataset().to_netcdf(path, engine="scipy", format=version)
    read = Measurement.read(path)
    assert read.names == full.names
    assert torch.equal(read.displacement.nan_to_num(), full.displacement.nan_to_num())
    assert torch.equal(read.valid, full.valid)
    for a, b in zip(read.cameras, full.cameras, strict=True):
        assert torch.equal(a.intrinsics, b.intrinsics)
        assert a.image_size == b.image_size
    content = path.read_bytes()
    for damaged in (content[: len(content) // 2], content[:40], b"CDF\x05" + content[4:]):
        path.write_bytes(damaged)
        words = "(not a readable NetCDF file|expected NetCDF-4 .* nccopy -k 4 classic.nc)"
        with pytest.raises(InputError, match=f"classic.nc: {words}"):
            Measurement.read(path)


def test_a_store_is_not_continued_behind_another_window(tmp_path: Path) -> None:
    camera = Ring(views=1, image_size=(6, 7)).cameras()[0]
    near, far = (replace(camera, interfaces=(Interface(camera.rotation[2], d, 1.33),)) for d in (-100.0, -200.0))
    flow = Measurement(cameras=(near,), displacement=torch.zeros(1, 6, 7, 2), box=Box.cube(50.0), n_ambient=1.33)
    store = MeasurementSequence.create(tmp_path / "film.zarr", (0.0,), flow)
    store.write_frame(0, flow)
    store.check_cameras([near])
    for other in (far, camera):
        with pytest.raises(InputError, match="got other interfaces of view"):
            store.check_cameras([other])
