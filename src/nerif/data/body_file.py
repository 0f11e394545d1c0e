"""Files of bodies: STL, OBJ and PLY, as written by CAD programs and scanners."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nerif.common.conventions import InputError, within
from nerif.common.files import ending, instead_of_file, reading
from nerif.geometry.body import UNITS, Body

__all__ = ["FORMATS", "read_body"]

FORMATS = (".stl", ".obj", ".ply")
SAME = 1e-5  # of the size, within which vertices are one: STL has single precision, and programs round


def read_body(
    path: str | os.PathLike[str], unit: str = "mm", say: Callable[[str], object] = lambda line: None
) -> Body:  # fmt: skip
    """Read a model, in its own frame; its lengths become mm, and triangles that face inwards are turned.

    Parameters
    ----------
    unit : of its lengths, one of UNITS
    say : called with a line if triangles were turned

    Raises InputError if the file cannot be read, or the mesh is not closed.
    """
    path = Path(path)
    if unit not in UNITS:
        raise InputError(f"expected one of {', '.join(UNITS)}, got '{unit}'", field="unit")
    if ending(path) not in FORMATS:
        raise InputError(f"expected a mesh of triangles ({', '.join(FORMATS)}); export the model as STL", field=path)
    if not path.is_file():
        raise InputError(f"{instead_of_file(path)}; expected the mesh of a body", field=path)
    vertices, faces = _triangles(path)
    with within(path.parent):
        body = Body(torch.from_numpy(vertices * UNITS[unit]), torch.from_numpy(faces), path.stem)
    if not np.array_equal(body.faces.numpy(), faces):
        about = "if a program mirrored the model, it is mirrored here too"
        say(f"{path}: its triangles face inwards and were turned; {about}")
    return body


def _triangles(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a file; vertices at the same place are one, triangles without area are left out."""
    import trimesh
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    with reading("cannot be read as a mesh; export the model as STL again", path):  # trimesh has no error of its own
        mesh: Any = trimesh.load(path, force="mesh", process=False, skip_materials=True)
        vertices, faces = np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)
    if not len(faces):
        raise InputError("expected triangles, got none; export surfaces, not points or curves", field=path)
    if not np.isfinite(vertices).all():
        raise InputError("expected finite vertices, got NaN or infinity", field=path)
    size = float(np.ptp(vertices, axis=0).max()) or 1.0
    vertices, index = np.unique(vertices, axis=0, return_inverse=True)
    near = cKDTree(vertices).query_pairs(SAME * size, output_type="ndarray").T
    _, group = connected_components(coo_array((np.ones(near.shape[1]), near), (len(vertices),) * 2), directed=False)
    _, first = np.unique(group, return_index=True)
    faces = group[index.ravel()[faces]]
    a, b, c = faces.T
    return vertices[first], np.ascontiguousarray(faces[(a != b) & (b != c) & (c != a)])
