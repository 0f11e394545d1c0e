"""A phantom and the settings of its measurement: the simulated data of nerif simulate."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from annotated_types import Ge, Lt

from nerif.common.conventions import AMBIENT_INDEX, DEFAULT_AMBIENT_FACES, InputError
from nerif.common.files import ending
from nerif.common.settings import Count, NonNegative, check_settings
from nerif.data.quantity_names import INDEX

if TYPE_CHECKING:
    from nerif.data.measurement import Measurement
    from nerif.data.measurement_sequence import MeasurementSequence
    from nerif.data.volume import Volume
    from nerif.data.volume_sequence import VolumeSequence
    from nerif.fields.field import Field
    from nerif.geometry import Box, Camera

__all__ = ["Simulation"]

Finite = Annotated[float, Ge(0), Lt(math.inf)]
MOVING = ("flame", "2", "3", "4", "5", "6", "7")
PEAK_VOXELS = 64  # along the longest edge, to find the largest value of a phantom


@dataclass(frozen=True)
class Simulation:
    """A phantom, and the settings of its measurement."""

    phantom: str = "flame"
    """One of gaussians, flame, octahedron, turbulence, fire, gaussian-jet, plume, underexpanded (axisymmetric flows),
    1-7 (the paper's numbers), or your own volume file (.nc, .vti)."""
    technique: tuple[str, ...] = ("deflection",)
    """Data of a pixel: deflection, absorption, emission or interferometry; several if they share one field."""
    peak: Finite = 0.0
    """Largest extinction or emission, 1/mm, that a phantom is scaled to; 0 for one that gives about 1 along a ray."""
    noise: NonNegative = 0.0
    """Standard deviation of the noise as a share of the rms over rays that cross the box."""
    counts: Finite = 0.0
    """Detected quanta, for shot noise instead: without the medium (absorption) or where it is brightest."""
    seed: int = 0
    """Seed of phantom and noise."""
    time: float = 0.0
    """Instant of the flame, s."""
    box: tuple[float, float, float] = (50.0, 50.0, 50.0)
    """Edges of the box around the origin, along x y z, mm; a volume file has its own."""
    n_ambient: float | None = None
    """Refractive index around the flow; default: that of the volume file, else 1.00027."""
    wavelength_nm: float = 532.0
    """Wavelength of the light, nm (stored in the file)."""
    ambient_faces: tuple[str, ...] = DEFAULT_AMBIENT_FACES
    """Faces of the box on which the index is ambient (stored in the file)."""
    truth_voxels: Count = 100
    """Voxels of the truth along the longest edge."""
    steps: int = 120
    """Runge-Kutta steps of a ray through the box."""

    def __post_init__(self) -> None:
        check_settings(self)
        if self.technique != Simulation.technique or self.peak:
            self._check_technique()
        if self.counts and self.noise:
            raise InputError("expected without --noise, which it replaces", field="counts")

    def _check_technique(self) -> None:
        from nerif.forward.registry import TECHNIQUES, check_simulated, technique

        if not self.technique:
            raise InputError(f"expected one or more of {', '.join(TECHNIQUES)}, got none", field="technique")
        kinds = [technique(name) for name in self.technique]
        check_simulated(kinds)
        if self.peak and (self._is_file or kinds[0].quantity == INDEX):
            what = "a volume file, which is not scaled" if self._is_file else f"{kinds[0].name}, of an index"
            raise InputError(f"expected for the extinction or emission of a phantom, got {what}; omit it", field="peak")

    def __call__(
        self, cameras: Sequence[Camera], on_view: Callable[[int], None] | None = None, frame: int = 0
    ) -> tuple[Measurement, Volume]:
        """Return the simulated measurement and the true field; each frame has different noise."""
        from nerif.data.volume import Volume
        from nerif.forward.registry import technique
        from nerif.geometry import Grid
        from nerif.simulation.simulate import add_quantum_noise, simulate

        field, box, n_ambient = self._field()
        kinds = [technique(name) for name in self.technique]
        measurement = simulate(
            field, cameras, box, n_ambient, self.noise, self.seed + frame, self.steps, self.wavelength_nm,
            self.ambient_faces, on_view, kinds,
        )  # fmt: skip
        if self.counts:
            measurement = add_quantum_noise(measurement, self.counts, self.seed + frame)
        grid = Grid.of_resolution(box, self.truth_voxels)
        return measurement, Volume.of(field.sample(grid), grid, measurement.quantity, n_ambient)

    def over_time(
        self,
        times: Sequence[float],
        cameras: Sequence[Camera],
        out: Path,
        truth: Path,
        force: bool = False,
        on_frame: Callable[[int, int], None] = lambda count, total: None,
    ) -> tuple[MeasurementSequence, VolumeSequence]:
        """Write the measurements at several times (s) and the true fields as two stores, and return these."""
        from nerif.data.measurement_sequence import MeasurementSequence
        from nerif.data.volume_sequence import VolumeSequence

        if self.phantom not in MOVING:
            raise InputError(f"expected a phantom that moves (flame, 2-7), got '{self.phantom}'", field="times")
        for i, time in enumerate(times):
            measurement, volume = replace(self, time=time)(cameras, frame=i)
            if i == 0:
                sequence = MeasurementSequence.create(out, times, measurement, force)
                store = VolumeSequence.create(truth, times, volume.grid, (volume.quantity,), measurement.n_ambient)
            sequence.write_frame(i, measurement)
            store.write(i, [volume])
            on_frame(i + 1, len(times))
        return sequence, store

    @property
    def _is_file(self) -> bool:
        return ending(self.phantom) in (".nc", ".vti")

    def _field(self) -> tuple[Field, Box, float]:
        """The field, its box, and the ambient index."""
        from nerif.data.volume_file import read_volume
        from nerif.fields.phantoms import make_phantom
        from nerif.fields.voxel_field import VoxelField
        from nerif.forward.registry import technique
        from nerif.geometry import Box

        path, quantity = Path(self.phantom), technique(self.technique[0]).quantity
        if not self._is_file:
            box = Box.around_origin(self.box)
            n_ambient = AMBIENT_INDEX if self.n_ambient is None else self.n_ambient
            phantom = make_phantom(self.phantom, box, self.seed, self.time)
            return phantom if quantity == INDEX else self._scaled(phantom, box), box, n_ambient
        volume = read_volume(path, None if quantity == INDEX else quantity)
        if quantity != INDEX:
            return VoxelField.through(volume.values, volume.grid), volume.grid.box, AMBIENT_INDEX
        try:
            n_ambient = next(n for n in (self.n_ambient, volume.n_ambient, AMBIENT_INDEX) if n is not None)
            excess = volume.relative_to(n_ambient)
        except InputError as error:
            raise error.inside(path) from None
        return VoxelField.through(excess.values, excess.grid), excess.grid.box, n_ambient

    def _scaled(self, phantom: Field, box: Box) -> Field:
        """The phantom, scaled to the peak of its deviation from ambient."""
        from nerif.fields.phantoms import Scaled
        from nerif.geometry import Grid

        values = phantom.sample(Grid.of_resolution(box, PEAK_VOXELS))
        peak = self.peak or 2 / min(box.edges[:2])
        return Scaled(phantom, peak / float(values.flatten()[values.abs().argmax()]))
