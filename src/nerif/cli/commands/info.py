"""nerif info: the content of a file or a result directory."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from nerif.cli.output import say
from nerif.cli.settings import Settings, command
from nerif.common.conventions import percent, with_unit
from nerif.common.settings import Positional
from nerif.data.quantity_names import INDEX, name_of
from nerif.plotting.notebook import number

if TYPE_CHECKING:
    from torch import Tensor

    from nerif.data.measurement import Measurement
    from nerif.data.measurement_sequence import MeasurementSequence
    from nerif.data.volume import Volume

__all__ = ["Info", "main", "run"]


@dataclass(frozen=True)
class Info(Settings):
    """Describe a measurement, a measurement over time, a volume or a result directory."""

    path: Annotated[Path, Positional]
    """Measurement (.nc; over time .zarr), volume (.nc, .vti) or result directory."""


def run(settings: Info) -> None:
    """Print the description."""
    from nerif.data.kinds import MEASUREMENT, RESULT, SEQUENCE, VOLUME, check_kind, kind_of
    from nerif.data.measurement import Measurement
    from nerif.data.measurement_sequence import MeasurementSequence
    from nerif.data.volume_file import read_volume

    path = settings.path
    check_kind(path, MEASUREMENT, VOLUME, RESULT, SEQUENCE)
    if kind_of(path) is SEQUENCE:
        _film(path, MeasurementSequence.read(path))
    elif path.is_dir():
        _result(path)
    elif kind_of(path) is VOLUME:
        _volume(path, read_volume(path))
    else:
        _measurement(path, Measurement.read(path))


def _corners(lower: tuple[float, ...], upper: tuple[float, ...]) -> str:
    return " x ".join(f"{a:g}..{b:g}" for a, b in zip(lower, upper, strict=True)) + " mm (x, y, z)"


def _rms(values: Tensor, unit: str) -> str:
    return with_unit(f"{float(values.square().mean().sqrt()):.4g}", unit)


def _film(path: Path, film: MeasurementSequence) -> None:
    written = sum(map(film.is_written, range(len(film))))
    say(f"{path}: measurement over time, {written} of {len(film)} instants written")
    say(f"  times          {film.times[0]:.10g} to {film.times[-1]:.10g} s")
    _measurement(path, film.fullest())


def _measurement(path: Path, m: Measurement) -> None:
    import torch

    from nerif.data.measurement_summary import valid_pixels

    say(f"{path}: measurement, {len(m.cameras)} views of {m.shape[1]} x {m.shape[2]} px")
    say(f"  box            {_corners(m.box.lower, m.box.upper)}")
    light = f", wavelength {m.wavelength_nm:g} nm" if m.wavelength_nm else ""
    say(f"  n_ambient      {m.n_ambient:.8g}{light}")
    say(f"  ambient faces  {' '.join(m.ambient_faces) or 'none'}")
    for o in m.observations:
        (rays, values, sigma), kind = m.rays(o), o.technique
        rms = _rms(values, kind.unit)
        noise = "unknown" if sigma is None else f"rms {_rms(sigma, kind.unit)}"
        say(f"  {kind.name:<14} {len(rays)} rays cross the box; rms {kind.measured} {rms}; sigma {noise}")
    say(f"  masked         {m.bad_pixels} pixels with NaN, infinite or impossible value or sigma")
    for camera in m.cameras:
        if camera.unseen:
            say(f"  distortion     not invertible for {percent(camera.unseen)} of the pixels of '{camera.name}'")
    tilt = math.degrees(max(float(c.tilt.abs().max()) for c in m.cameras))
    if tilt:
        say(f"  sensor tilt    {tilt:.3g} deg or less (Scheimpflug)")
    lenses = {c.lens for c in m.cameras if c.lens is not None}
    for edge in sorted({lens.window for lens in lenses if lens.window}):
        say(f"  window         {edge:g} px, over which displacements are averaged")
    for lens in sorted((lens for lens in lenses if lens.diameter), key=lambda lens: lens.diameter):
        focus = "the backgrounds" if lens.focus is None else f"{lens.focus:g} mm"
        say(f"  aperture       {lens.diameter:.4g} mm, focused on {focus}")
    sigmas = [c.pose_sigma for c in m.cameras if c.pose_sigma is not None]
    if sigmas:
        turn, shift = (float(torch.stack(sigmas)[:, part].square().mean().sqrt()) for part in (slice(3), slice(3, 6)))
        say(f"  pose_sigma     {math.degrees(turn):.2g} deg, {shift:.2g} mm (for --refine cameras)")
    for planes in dict.fromkeys(tuple(plane.index for plane in c.interfaces) for c in m.cameras if c.interfaces):
        names = ", ".join(c.name for c in m.cameras if tuple(plane.index for plane in c.interfaces) == planes)
        say(f"  interfaces     index {', '.join(f'{index:g}' for index in planes)} behind them: {names}")
    for name, offset in m.frame_offsets.items():
        say(f"  frame offset   {name} {offset:+d}")
    say(f"  flow mask      {'yes' if m.flow_mask is not None else 'no'}")
    for body in m.bodies:
        say(f"  body           {body.name}: {len(body.faces)} triangles, {body.volume:.4g} mm3")
    if m.hidden is not None:
        say(f"  hidden         {int(m.hidden.sum())} pixels see a body")
    say(f"  valid pixels   {valid_pixels(m)}")
    columns = "".join(f"{f'valid {o.technique.data_name()}':>20}{f'rms {o.label}':>24}" for o in m.observations)
    say(f"  view            size [px]  pixel [mm]   centre to camera [mm]   to background [mm]{columns}")
    masks, shares = [m.usable_for(o) & m.sees_box for o in m.observations], [m.valid_share(o) for o in m.observations]
    for i, c in enumerate(m.cameras):
        centre = c.centre.new_tensor(m.box.centre)
        distance, pixel, plane = float(c.distance(centre)), float(c.pixel_size(centre)), c.background
        behind = "none" if plane is None else f"{abs(float(centre @ plane.normal.to(centre)) - plane.offset):.1f}"
        data = [o.values[i][mask[i]] for o, mask in zip(m.observations, masks, strict=True)]
        sizes = (float(x.square().mean().sqrt()) if len(x) else math.nan for x in data)
        cells = "".join(f"{valid[i]:20.1%}{size:24.4f}" for valid, size in zip(shares, sizes, strict=True))
        size = f"{c.image_size[0]} x {c.image_size[1]}"
        say(f"  {c.name:<14} {size:>10} {pixel:11.4g} {distance:23.1f} {behind:>20}{cells}")


def _volume(path: Path, v: Volume) -> None:
    import torch

    say(f"{path}: volume of {v.quantity} [{v.unit}] on {' x '.join(map(str, v.grid.shape))} voxels (z, y, x)")
    say(f"  box            {_corners(v.grid.box.lower, v.grid.box.upper)}")
    finite = v.values[v.values.isfinite()]
    finite = finite if len(finite) else torch.full((1,), torch.nan)
    say(f"  values         {finite.min():.6g} to {finite.max():.6g}, mean {finite.mean():.6g}")
    for name, value in {**v.attributes, **v.notes}.items():
        say(f"  {name:<14} {value}")


def _result(path: Path) -> None:
    from nerif.analysis.evaluation import rms_with_unit
    from nerif.results.directory import METRICS, ResultDirectory

    directory = ResultDirectory(path)
    _, box, n_ambient = directory.field()
    quantity = directory.quantity()
    say(f"{path}: reconstruction of {name_of(quantity)}")
    say(f"  box            {_corners(box.lower, box.upper)}")
    if quantity == INDEX:
        say(f"  n_ambient      {n_ambient:.8g}")
    if not directory.has(METRICS):
        say(f"  {METRICS} is missing; the run is not complete")
        return
    metrics = directory.metrics()
    for name, value in asdict(metrics).items():
        if value is not None and not isinstance(value, list | dict):
            say(f"  {name:<18} {value}")
    for v in metrics.views:
        use = "withheld" if v["withheld"] else "fitted"
        say(f"  view {v['name']:<14} {use}  CC {number(v['cc'], 5)}  rms {v['measured']} error {rms_with_unit(v)}")


main = command("info", Info, run)
