"""Files of bodies: STL, OBJ and PLY as other programs write them, and meshes that are no body."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from bodies import ball, cuboid
from nerif.data.body_file import read_body
from refusals import refused


@pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply"])
def test_a_body_is_read_from_the_files_of_another_program(tmp_path, suffix):
    body = ball(6.0, (1.0, 2.0, 3.0), rings=12)
    path = tmp_path / f"model{suffix}"
    trimesh.Trimesh(body.vertices.numpy(), body.faces.numpy(), process=False).export(path)
    again = read_body(path)
    assert again.name == "model"
    assert again.volume == pytest.approx(body.volume, rel=1e-5)
    assert len(again.faces) == len(body.faces)
    x = (torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) - 0.5) * 16
    assert float((again.contains(x) == body.contains(x)).double().mean()) == 1.0


def test_an_stl_in_text_and_in_metres(tmp_path):
    path = tmp_path / "model.stl"
    body = cuboid((-0.005,) * 3, (0.005,) * 3)
    text = trimesh.exchange.stl.export_stl_ascii(trimesh.Trimesh(body.vertices.numpy(), body.faces.numpy()))
    path.write_text(text, encoding="utf-8")
    assert read_body(path, "m").volume == pytest.approx(1000.0, rel=1e-5)


def test_triangles_that_face_inwards_are_turned_with_a_note(tmp_path):
    path, body, lines = tmp_path / "model.stl", cuboid(), []
    trimesh.Trimesh(body.vertices.numpy(), body.faces.flip(1).numpy(), process=False).export(path)
    assert read_body(path, say=lines.append).volume == pytest.approx(1000.0)
    assert "mirrored" in lines[0]


@pytest.mark.parametrize("scale", [0.1, 1.0, 30.0])
def test_vertices_that_a_program_rounded_are_joined(tmp_path, scale):
    """Each triangle of a file has vertices of its own, 2e-6 mm from those of its neighbours."""
    path, body = tmp_path / "model.ply", ball(5.0, rings=16)
    corners = scale * body.corners.reshape(-1, 3).numpy()
    corners += np.random.default_rng(0).uniform(-1e-6, 1e-6, corners.shape)
    trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False).export(path)
    again = read_body(path)
    assert (len(again.vertices), len(again.faces)) == (len(body.vertices), len(body.faces))
    assert again.volume == pytest.approx(scale**3 * body.volume, rel=1e-5)


def test_an_open_mesh_is_refused(tmp_path):
    path, body = tmp_path / "model.ply", cuboid()
    trimesh.Trimesh(body.vertices.numpy(), body.faces[2:].numpy(), process=False).export(path)
    with refused("model") as error:
        read_body(path)
    assert "4 edges without the neighbouring triangle" in str(error.value)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("model.stl", b"not a mesh", "expected triangles, got none"),
        ("model.obj", b"v 0 0 0\nv 1 0 0\n", "expected triangles, got none"),
        ("model.step", b"ISO-10303-21;", "export the model as STL"),
        ("model.ply", b"ply\nformat ascii 1.0\nelement vertex 99\n", "cannot be read as a mesh"),
        ("model.stl", b"", "expected triangles, got none"),
    ],
)
def test_other_files_are_refused_in_a_line(tmp_path, name, content, words):
    path = tmp_path / name
    path.write_bytes(content)
    with refused(path) as error:
        read_body(path)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_a_file_that_does_not_exist_and_a_unit_that_does_not_exist(tmp_path):
    with refused(tmp_path / "none.stl"):
        read_body(tmp_path / "none.stl")
    with refused("unit"):
        read_body(tmp_path / "none.stl", "furlong")
