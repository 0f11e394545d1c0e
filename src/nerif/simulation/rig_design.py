"""Expected displacement and resolution of a rig before it is built.

Sources: Raffel, Background-oriented schlieren (BOS) techniques, Exp. Fluids 56 (2015) 60; Gojani, Kamishi & Obayashi,
Measurement sensitivity and resolution for background oriented schlieren, J. Vis. 16 (2013) 201.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from nerif.common.conventions import InputError
from nerif.common.settings import Positive, check_settings
from nerif.geometry.rig import Ring

__all__ = ["DesignSettings", "Expectation", "expect"]

AIRY = 2.44  # diameter of the Airy disc over wavelength and f-number
DOT = 3.0  # px


@dataclass(frozen=True)
class DesignSettings:
    """The flow, the light and the optical flow."""

    index_contrast: Positive = 2.0e-4
    """Largest difference of the index to the ambient."""
    temperature: Positive | None = None
    """Hottest (or coldest) temperature of air, K; replaces index_contrast."""
    ambient_temperature: Positive = 293.15
    """Temperature of the air around, K."""
    pressure_pa: Positive = 101325.0
    """Pressure, Pa."""
    f_number: Positive = 16.0
    """Focal length over aperture; of a telecentric lens the f-number on the sensor's side."""
    wavelength_nm: Positive = 532.0
    """Wavelength of the light, nm."""
    flow_size: Positive = 50.0
    """Width of the flow, and path length through it, mm."""
    feature_size: Positive = 5.0
    """Smallest structure of interest, which has the whole contrast, mm."""
    displacement_noise: Positive = 0.03
    """Noise of the optical flow, px."""
    window: Positive = 8.0
    """Averaging window of the optical flow, px."""

    def __post_init__(self) -> None:
        check_settings(self)
        if self.temperature == self.ambient_temperature:
            raise InputError(f"expected not ambient_temperature, {self.temperature} K", field="temperature")

    @property
    def contrast(self) -> float:
        """Largest difference of the index to the ambient, by the temperature if that is set."""
        if self.temperature is None:
            return self.index_contrast
        from nerif.physics.gas_optics import ambient_index

        flow, ambient = (
            ambient_index("air", t, self.pressure_pa, self.wavelength_nm)
            for t in (self.temperature, self.ambient_temperature)
        )
        return abs(flow - ambient)


@dataclass(frozen=True)
class Expectation:
    """Properties of a rig; lengths in mm in the plane of the flow unless stated otherwise."""

    pixel_at_flow: float  # edge of a pixel, mm
    pixel_at_background: float  # edge of a pixel on the background, mm
    field_of_view: tuple[float, float]  # width and height of the image at the flow, mm
    background_size: tuple[float, float]  # of the pattern to print, a tenth larger than the image, mm
    dot: float  # size of a dot of 3 px on the background, mm
    sensitivity: float  # displacement of a deflection in the middle of the flow, px per mrad
    deflection: float  # largest deflection by a Gaussian structure of the feature size, mrad
    displacement: float  # its displacement, px
    displacement_of_sheet: float  # of a layer of the feature size, edge-on through the whole flow: upper bound, px
    smallest_contrast: float  # index contrast whose displacement equals the noise
    cone: float  # diameter of the rays to a pixel at the flow, focused on the background, mm
    window: float  # averaging window of the optical flow, mm
    diffraction: float  # diameter of the Airy disc, mm
    resolution: float  # root of the sum of squares of the three, mm
    notes: tuple[str, ...]  # warnings


def expect(ring: Ring, flow: DesignSettings) -> Expectation:
    """Return the expected properties of the first camera of a ring for a flow around the origin.

    The largest deflection by n = dn exp(-r^2 / 2 s^2) is dn sqrt(2 pi / e), at the distance s from its centre, for any
    size; by a layer of thickness a, edge-on over a length L, it is dn L / a. The displacement is the deflection times
    the lever arm and the sensitivity S of the forward model (docs/conventions.md).
    """
    import torch

    camera = ring.cameras()[0]
    height, width = camera.image_size
    middle = torch.tensor([[(width - 1) / 2, (height - 1) / 2]], dtype=torch.float64)
    ray = camera.rays(middle)
    lever = float(ray.ends.distance[0]) - ring.distance
    # a deflection in the plane of the image's columns
    per_mrad = lever * float((ray.ends.sensitivity[0, 0] @ camera.rotation[0]).abs()) / 1000
    at_flow, at_background = (float(camera.pixel_size(p)) for p in (torch.zeros_like(ray.origin), ray.end_points))
    deflection = 1000 * flow.contrast * math.sqrt(2 * math.pi / math.e)
    displacement = per_mrad * deflection
    # the tip of the cone is on the background, where the f-number is multiplied by the magnification
    cone = lever * (ring.pixel_pitch / at_background) / flow.f_number
    airy = AIRY * flow.wavelength_nm * 1e-6 * flow.f_number / ring.pixel_pitch * at_flow
    window = flow.window * at_flow
    result = Expectation(
        pixel_at_flow=at_flow,
        pixel_at_background=at_background,
        field_of_view=(width * at_flow, height * at_flow),
        background_size=(1.1 * width * at_background, 1.1 * height * at_background),
        dot=DOT * at_background,
        sensitivity=per_mrad,
        deflection=deflection,
        displacement=displacement,
        displacement_of_sheet=per_mrad * 1000 * flow.contrast * flow.flow_size / flow.feature_size,
        smallest_contrast=flow.contrast * flow.displacement_noise / displacement,
        cone=cone,
        window=window,
        diffraction=airy,
        resolution=math.sqrt(cone**2 + window**2 + airy**2),
        notes=(),
    )
    return replace(result, notes=tuple(_notes(result, ring, flow)))


def _notes(e: Expectation, ring: Ring, flow: DesignSettings) -> list[str]:
    notes = []
    if e.displacement < 3 * flow.displacement_noise:
        notes.append(
            f"the displacement of {e.displacement:.3f} px is hardly above the noise of {flow.displacement_noise:g} px: "
            "move the background away from the flow, or increase the magnification"
        )
    if e.displacement > flow.window / 2:
        notes.append(f"the displacement of {e.displacement:.1f} px is more than half a window of {flow.window:g} px")
    if e.resolution > flow.feature_size:
        remedies = {
            "stop the lens down, or bring the background nearer": e.cone,
            "use smaller windows": e.window,
            "open the lens": e.diffraction,
        }
        notes.append(
            f"structures of {flow.feature_size:g} mm are finer than the resolution of {e.resolution:.2f} mm: "
            f"{max(remedies, key=lambda remedy: remedies[remedy])}"
        )
    if min(e.field_of_view) < flow.flow_size:
        width, height = e.field_of_view
        notes.append(f"the flow of {flow.flow_size:g} mm is larger than the image of {width:.0f} x {height:.0f} mm")
    if e.dot < 0.2:
        notes.append(f"dots of {e.dot:.2f} mm are finer than the 0.2 mm of most printers")
    if ring.background_distance < flow.flow_size:
        notes.append("the background is inside or next to the flow")
    angles = sorted(a % 180 for a in ring.angles)
    if len(angles) < 2:
        return [*notes, "one view alone gives no depth"]
    gap = max(b - a for a, b in zip(angles, [*angles[1:], angles[0] + 180], strict=True))
    if gap > 60:
        notes.append(f"no view within a gap of {gap:.0f} degrees: structures across it will be smeared")
    return notes
