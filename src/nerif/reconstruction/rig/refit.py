"""The cameras of views that a reconstruction has not seen, refined against its field, which stays as it is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from nerif.data.measurement import Measurement
from nerif.fields.base import Field
from nerif.forward.path_integral import PathIntegral, project
from nerif.geometry import Rays
from nerif.reconstruction.rig.refinement import Refinement, drawn
from nerif.reconstruction.sources import of_source
from nerif.reconstruction.target import Part, Target

__all__ = ["refit"]

STEPS, EACH = 6, 600  # and pixels of a view for each
SAMPLES = 64  # of a ray


@torch.no_grad()
def refit(
    field: Field, measurement: Measurement, settings: Mapping[str, Any], device: torch.device | str = "cpu",
    steps: int = STEPS, each: int = EACH,
) -> list[dict[str, Any]]:  # fmt: skip
    """Return the table of the refined numbers of views (Refinement.table) that fit a given field best.

    Views of which there are but images, whose brightness is not known, have none.

    Parameters
    ----------
    field : which does not follow
    measurement : of these views
    settings : of the reconstruction
    steps, each : of Gauss and Newton, and the pixels of a view that each is taken from
    """
    if "images" in of_source(measurement, "auto", preferred="displacements").maps:
        return []
    measurement = of_source(measurement, "auto", preferred="displacements")
    rig = Refinement.of_table(measurement, settings, (), gauged=False)
    target = Target.of(measurement, tuple(settings["open_faces"]), linear=True).to(device)

    def predict(part: Part, rays: Rays) -> Tensor:
        return project(PathIntegral(part.model.integral, SAMPLES), field, rays, device)

    for i in range(steps):
        rig.step(drawn(target, len(measurement.names), i, each), predict, target.sigma_known, momentum=0.0)
    return rig.table()
