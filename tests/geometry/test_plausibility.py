"""Implausible rigs are reported with the likely cause, plausible ones without any finding."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from nerif.common.conventions import InputError
from nerif.data.measurement import Measurement
from nerif.geometry import Box, Camera, Plane, Ring, paper_rig
from nerif.geometry.plausibility import in_one_plane, likely_cause, rig_findings

BOX = Box((-25.0, -20.0, -15.0), (20.0, 25.0, 30.0))


def ring(**changed) -> tuple[Camera, ...]:
    return Ring(**{"views": 5, "arc": (0.0, 150.0), "image_size": (40, 48), "pixel_pitch": 0.09, **changed}).cameras()


def general(count: int = 6) -> tuple[Camera, ...]:
    """Cameras in general position, turned about their axes, aimed near the middle of the box."""
    generator, cameras = torch.Generator().manual_seed(3), []
    for i in range(count):
        outward, up = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator, dtype=torch.float64))
        right = torch.nn.functional.normalize(torch.linalg.cross(-outward, up), dim=0)
        rotation = torch.stack([right, torch.linalg.cross(-outward, right), -outward])
        k = torch.tensor([[500.0, 0.0, 24.0], [0.0, 500.0, 19.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
        centre = (600.0 + 20 * i) * outward + torch.tensor([3.0, -2.0, 1.0], dtype=torch.float64)
        plane, zero = Plane(outward, -400.0), torch.zeros(5, dtype=torch.float64)
        cameras.append(Camera(k, rotation, -rotation @ centre, (40, 48), plane, zero, f"cam{i}"))
    return tuple(cameras)


def in_metres(camera: Camera) -> Camera:
    return replace(camera, translation=camera.translation / 1000)


def all_in_metres(camera: Camera) -> Camera:
    return replace(in_metres(camera), background=Plane(camera.plane.normal, camera.plane.offset / 1000))


def to_world(camera: Camera) -> Camera:
    return replace(camera, rotation=camera.rotation.T.contiguous(), translation=camera.centre)


def of_opengl(camera: Camera) -> Camera:
    axes = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    return replace(camera, rotation=axes[:, None] * camera.rotation, translation=axes * camera.translation)


WRONG = {
    "metres": (in_metres, "translation in metres"),
    "metres of all": (all_in_metres, "translation and background_offset in metres"),
    "to world": (to_world, "poses from camera to world, where rotation and translation map world to camera"),
    "position": (lambda c: replace(c, translation=c.centre), "translation holds the position of the camera"),
    "transposed": (lambda c: replace(c, rotation=c.rotation.T.contiguous()), "rotation is transposed"),
    "OpenGL": (of_opengl, "axes of OpenGL"),
    "NeRF": (lambda c: to_world(of_opengl(c)), "poses from camera to world, where rotation and translation map world "
             "to camera; and axes of OpenGL"),
}  # fmt: skip


@pytest.mark.parametrize("rig", [ring, general])
@pytest.mark.parametrize("name", WRONG)
def test_the_likely_cause_is_named(rig, name):
    change, words = WRONG[name]
    assert likely_cause([change(c) for c in rig()], BOX).startswith(f"likely {words}")


def scaled(factor: float) -> Box:
    return Box(tuple(factor * x for x in BOX.lower), tuple(factor * x for x in BOX.upper))  # type: ignore[arg-type]


def test_the_unit_of_the_box_is_named():
    assert likely_cause(ring(), scaled(1e-3)).startswith("likely box in metres")
    assert likely_cause(ring(), scaled(1e3)).startswith("likely box in micrometres")


def test_without_a_likely_cause_the_general_checks_are_named():
    aside = [replace(c, translation=c.translation + torch.tensor([300.0, 0.0, 0.0])) for c in ring()]
    assert likely_cause(aside, BOX) == "check units (mm), poses (world to camera) and names of views"


@pytest.mark.parametrize("which", [(0, 1, 2, 3, 4), (1,), (1, 3)])
def test_cameras_inside_the_box_are_named(which):
    (finding,) = rig_findings([in_metres(c) if i in which else c for i, c in enumerate(ring())], BOX)
    assert finding.code == "inside"
    assert finding.views == tuple(ring()[i].name for i in which)
    assert "likely translation in metres" in finding.sentence


def test_a_camera_that_looks_past_the_box_is_named():
    cameras = list(general())
    cameras[2] = of_opengl(cameras[2])
    (finding,) = rig_findings(cameras, BOX)
    assert (finding.code, finding.views) == ("beside", ("cam2",))
    assert "likely axes of OpenGL" in finding.sentence


@pytest.mark.parametrize(("edge", "code"), [(0.05, "small_box"), (5e4, "large_box")])
def test_a_box_of_another_unit_is_named(edge, code):
    """All of the rig is in it, so that nothing else is wrong."""
    factor = edge / 50
    cameras = [
        replace(c, translation=factor * c.translation, background=Plane(c.plane.normal, factor * c.plane.offset))
        for c in paper_rig(16)[0]
    ]
    assert [finding.code for finding in rig_findings(cameras, Box.cube(edge))] == [code]


def test_a_view_whose_rays_pass_beside_all_others_is_named():
    low, high = (Ring(views=3, image_size=(40, 48), pixel_pitch=0.09).cameras() for _ in range(2))
    cameras = [c.view(0, 0, 18, 48) for c in low[:2]] + [high[2].view(24, 0, 16, 48)]
    (finding,) = rig_findings(cameras, BOX)
    assert (finding.code, finding.views) == ("apart", ("170deg",))


RIGHT = {
    "ring": (ring(), BOX),
    "paper": paper_rig(20),
    "general": (general(), BOX),
    "telecentric": (ring(projection="telecentric"), BOX),
    "telecentric, from within": (tuple(in_metres(c) for c in ring(projection="telecentric")), BOX),
    "two views": (ring(views=2), BOX),
    "one view": (ring(views=1), BOX),
    "elevated": (ring(elevation=35.0), BOX),
    "a part of the box": (ring(focal_length=400.0), BOX),
    "a small box in large images": (ring(), Box.cube(2.0)),
    "lines": (tuple(c.view(20, 0, 1, 48) for c in ring()), BOX),
    "parts that overlap": (tuple(c.view(5 * i, 0, 20, 48) for i, c in enumerate(ring())), BOX),
    "a thin box": (ring(), Box((-25.0, -25.0, -0.2), (25.0, 25.0, 0.2))),
    "two sides": (ring(arc=(0.0, 180.0)), BOX),
    "without backgrounds": (tuple(c.without_background for c in ring()), BOX),
}


@pytest.mark.parametrize("name", RIGHT)
def test_plausible_rigs_have_no_finding(name):
    assert rig_findings(*RIGHT[name]) == []


def test_a_file_that_is_refused_says_why():
    zero = torch.zeros(5, 40, 48, 2)
    with pytest.raises(InputError, match=r"no ray.* crosses it.*likely poses from camera to world"):
        Measurement(tuple(to_world(c) for c in ring()), zero, BOX, 1.00027)
    with pytest.raises(InputError, match=r"background of view.*likely translation and background_offset in metres"):
        Measurement(tuple(all_in_metres(c) for c in ring()), zero, BOX, 1.00027)


@pytest.mark.parametrize("views", [1, 2, 5])
def test_cameras_that_look_along_one_plane(views):
    ring = Ring(views=views, arc=(0.0, 120.0))
    assert bool(in_one_plane(ring.cameras())) == (views > 1)
    assert not in_one_plane(replace(ring, elevation=15.0).cameras())
