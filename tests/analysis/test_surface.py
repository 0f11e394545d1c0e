"""Index and density on the surface of bodies."""

from __future__ import annotations

import math
from xml.etree import ElementTree

import pytest
import torch

from bodies import ball, cuboid
from nerif.analysis.wall_values import surface_map
from nerif.data.surface import SurfaceMap
from nerif.fields.phantoms import make_phantom
from nerif.geometry import Box
from nerif.geometry.body import fine_triangles
from nerif.physics.gas import GasSettings
from nerif.physics.gas_optics import gladstone_dale

BOX = Box.cube(40.0)
N_AMBIENT = 1.00027


@pytest.fixture(scope="module")
def surface() -> SurfaceMap:
    bodies = [ball(6.0, (15.0, 0.0, 0.0))]
    return surface_map(make_phantom("gaussians", BOX, 0), bodies, BOX, N_AMBIENT, 1.0, medium=GasSettings())


def test_fine_triangles_cover_the_surface_and_have_short_edges():
    body = cuboid((-5.0, -3.0, -1.0), (5.0, 3.0, 1.0))
    vertices, faces, outwards = fine_triangles(body, 0.7)
    corners = vertices[faces]
    assert float((corners - corners.roll(1, dims=1)).norm(dim=-1).max()) <= 0.7 + 1e-9
    across = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert float(across.norm(dim=-1).sum()) / 2 == pytest.approx(2 * (60 + 20 + 12))
    assert bool(((across * outwards[faces[:, 0]]).sum(dim=-1) > 0).all())
    assert float(body.distance(vertices).abs().max()) < 1e-9


def test_the_surface_has_the_index_of_the_field_and_its_density(surface):
    finite = surface.quantities["index_excess"].isfinite()
    expected = make_phantom("gaussians", BOX, 0).value(surface.vertices[finite].float())
    torch.testing.assert_close(surface.quantities["index_excess"][finite], expected)
    k = gladstone_dale("air", 532.0)
    torch.testing.assert_close(surface.quantities["density"][finite], ((N_AMBIENT - 1) + expected) / k)
    beyond = surface.vertices[:, 0] > 20.0
    assert torch.equal(~finite, beyond)
    assert 0.0 < float(beyond.double().mean()) < 0.2  # of triangles that reach into the box
    assert not bool(beyond[surface.faces].all(dim=1).any())


def test_a_large_surface_has_larger_triangles(monkeypatch):
    monkeypatch.setattr("nerif.analysis.wall_values.MOST_TRIANGLES", 3000)
    large = surface_map(make_phantom("gaussians", BOX, 0), [ball(15.0)], BOX, N_AMBIENT, 0.2)
    assert 1000 < len(large.faces) < 12000


def test_a_surface_comes_back_from_its_file(surface, tmp_path):
    surface.write(tmp_path / "surface.nc")
    again = SurfaceMap.read(tmp_path / "surface.nc")
    assert torch.equal(again.vertices, surface.vertices)
    assert torch.equal(again.faces, surface.faces)
    for name, values in surface.quantities.items():
        torch.testing.assert_close(again.quantities[name], values, equal_nan=True, rtol=0, atol=0)
    assert math.isclose(float(again.attributes["n_ambient"]), N_AMBIENT)


def test_the_file_for_paraview_has_the_triangles_and_the_quantities(surface, tmp_path):
    surface.write(tmp_path / "surface.vtp")
    pyvista = pytest.importorskip("pyvista", reason="PyVista (extra movie) is not installed")
    mesh = pyvista.read(tmp_path / "surface.vtp")
    assert mesh.n_points == len(surface.vertices)
    assert mesh.n_cells == len(surface.faces)
    torch.testing.assert_close(torch.tensor(mesh["density"]), surface.quantities["density"], equal_nan=True)


def test_the_file_for_paraview_is_xml_with_counts(surface, tmp_path):
    surface.write(tmp_path / "surface.vtp")
    content = (tmp_path / "surface.vtp").read_bytes()
    root = ElementTree.fromstring(content[: content.index(b"<AppendedData")] + b"</VTKFile>")
    piece = root.find("PolyData/Piece")
    assert piece.get("NumberOfPoints") == str(len(surface.vertices))
    assert [a.get("Name") for a in piece.findall("PointData/DataArray")] == ["density", "index_excess"]
