"""Flow masks: where an image may show flow, by threshold, or drawn as polygons and brush strokes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Shaped

from nerif.common.conventions import InputError, unit_shown
from nerif.common.files import atomic, ending, is_file_name
from nerif.common.image_names import FOLDER_SUFFIXES
from nerif.common.settings import Positive, check_settings
from nerif.data.measurement import Measurement
from nerif.data.measurement_data import Observation, integrals_of
from nerif.imaging.imaging_settings import MaskSettings
from nerif.imaging.readers.frames import as_float
from nerif.imaging.readers.open import read_mask

__all__ = ["MaskShape", "drawn_masks", "flow_mask", "mask_of", "with_flow_masks", "write_masks"]

PixelMask = Bool[np.ndarray, "row column"]
MIN_POINTS = {"polygon": 3, "brush": 1}
"""Least number of points by kind of shape."""


@dataclass(frozen=True)
class MaskShape:
    """A shape drawn in a view."""

    kind: str  #: polygon or brush
    points: tuple[tuple[float, float], ...]
    """(column, row) of corners, or along the stroke, px; the centre of the top-left pixel is (0, 0)."""
    inside: bool = True  #: whether it adds flow or removes it
    width: Positive = 8.0  #: of a brush, px

    def __post_init__(self) -> None:
        if self.kind not in MIN_POINTS:
            raise InputError(f"expected {' or '.join(MIN_POINTS)}, got '{self.kind}'", field="kind")
        if len(self.points) < MIN_POINTS[self.kind]:
            raise InputError(
                f"expected {MIN_POINTS[self.kind]} or more of a {self.kind}, got {len(self.points)}", field="points"
            )
        if not np.isfinite(np.array(self.points, dtype=float)).all():
            raise InputError(f"expected finite numbers, got {self.points}", field="points")
        check_settings(self)


def mask_of(shapes: Sequence[MaskShape], shape: tuple[int, int]) -> PixelMask:
    """Return the mask (height, width) of shapes; later ones cover earlier ones."""
    from PIL import Image, ImageDraw

    image = Image.new("1", (shape[1], shape[0]), 0)
    draw = ImageDraw.Draw(image)
    for s in shapes:
        fill = int(s.inside)
        if s.kind == "polygon":
            draw.polygon(list(s.points), fill=fill, outline=fill)
            continue
        if len(s.points) > 1:
            draw.line(list(s.points), fill=fill, width=max(1, round(s.width)))
        for x, y in s.points:  # round ends and joints
            r = (s.width - 1) / 2
            draw.ellipse((x - r, y - r, x + r, y + r), fill=fill)
    return np.asarray(image, dtype=bool)


def write_masks(
    folder: Path, drawings: Mapping[str, Sequence[MaskShape]], shapes: Mapping[str, tuple[int, int]]
) -> list[Path]:
    """Write VIEW.png of each view with a drawing, white inside the flow, and return the paths.

    Nothing is written if a mask is empty or covers its whole view, or the name of a view cannot be a file name.
    Drawings and shapes (height and width, px) are by the names of the views.
    """
    from PIL import Image

    for name in drawings:
        if not is_file_name(name):
            raise InputError(f"expected names that files can have, without / and \\, got {name!r}", field="view")
    masks = {name: mask_of(drawing, shapes[name]) for name, drawing in drawings.items() if drawing}
    for name, mask in masks.items():
        if mask.all() or not mask.any():
            raise InputError(
                f"expected a part of the view, got {'all' if mask.any() else 'nothing'}", field=f"mask of view '{name}'"
            )
    folder.mkdir(parents=True, exist_ok=True)
    paths = {name: folder / f"{name}.png" for name in masks}
    for name, mask in masks.items():
        with atomic(paths[name]) as part:
            Image.fromarray(mask.astype(np.uint8) * 255).save(part, format="PNG")
    return list(paths.values())


STANDARD = MaskSettings()


def flow_mask(
    values: Shaped[np.ndarray, "row column c"], sigma: Shaped[np.ndarray, "row column c"],
    settings: MaskSettings = STANDARD,
) -> PixelMask:  # fmt: skip
    """Return where |values| / sigma exceeds the threshold, without small islands and holes; and where it is unknown.

    Unknown are NaN, and a sigma that is not positive.
    """
    from scipy.ndimage import binary_dilation, gaussian_filter
    from skimage.morphology import remove_small_holes, remove_small_objects

    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = as_float(values) / np.where(sigma > 0, as_float(sigma), np.nan)
    valid = np.isfinite(ratio).all(axis=-1)
    ratio[~valid] = 0
    if settings.smooth:
        share = np.maximum(gaussian_filter(valid.astype(np.float32), settings.smooth), 1e-6)
        ratio = gaussian_filter(ratio, (settings.smooth, settings.smooth, 0)) / share[..., None]
    flow = (np.linalg.norm(ratio, axis=-1) > settings.threshold) & valid
    if settings.smallest:  # an island may extend into unknown pixels
        flow = valid & remove_small_objects(flow | ~valid, max_size=settings.smallest)
        flow = remove_small_holes(flow | ~valid, max_size=settings.smallest) & valid
    if settings.grow:
        flow = binary_dilation(flow, iterations=settings.grow)
    return np.asarray(flow | ~valid)


def drawn_masks(
    folder: Path, names: Iterable[str], say: Callable[[str], None] = lambda line: None,
    otherwise: str = "masks by threshold",
) -> dict[str, Path]:  # fmt: skip
    """Return the images of masks in a folder, VIEW.png and similar, by the names of their views.

    Any ending of an image counts, and small and capital letters are the same where only one view fits. Files that fit
    no view are reported, and views without a drawing, with what happens to them otherwise.
    """
    if not folder.is_dir():
        raise InputError("no such folder; expected one with VIEW.png for each view", field=folder)
    names = tuple(names)
    files = [p for p in sorted(folder.iterdir()) if ending(p) in FOLDER_SUFFIXES and p.name[0] != "."]
    masks: dict[str, Path] = {}
    for path in files:
        fitting = [n for n in names if n == path.stem] or [n for n in names if n.lower() == path.stem.lower()]
        if len(fitting) != 1:
            say(f"{path}: not used, it has the name of no view ({', '.join(names)})")
            continue
        if fitting[0] in masks:
            other = masks[fitting[0]].name
            raise InputError(f"a second mask of view '{fitting[0]}', beside {other}; remove one", field=path)
        masks[fitting[0]] = path
    if not masks:
        raise InputError(f"expected images with the names of the views, {', '.join(names)}, got none", field=folder)
    if missing := [name for name in names if name not in masks]:
        say(f"{folder}: no drawing of {', '.join(missing)}; {otherwise}")
    return masks


def with_flow_masks(
    measurement: Measurement, settings: MaskSettings = STANDARD, sigma: float | None = None,
    drawings: Mapping[str, Path] | None = None, on_view: Callable[[int], None] = lambda count: None,
    say: Callable[[str], None] | None = None,
) -> Measurement:  # fmt: skip
    """Return a measurement with a flow mask for each view: the drawn one, else by threshold of any technique.

    Parameters
    ----------
    measurement : pixels that are not usable are inside the mask
    sigma : noise, in the unit of the measured quantity, instead of the measurement's own
    drawings : images of masks by the names of views
    on_view : called with the number of finished views
    say : called with a line about drawings of twice the size of their views, which are binned; None to refuse them
    """
    drawings = drawings or {}
    observations = integrals_of(measurement)
    if sigma is not None and len(observations) > 1:
        names = " and ".join(o.technique.measured for o in observations)
        raise InputError(f"expected none for {names}, of different units and noise, got {sigma:g}", field="sigma")
    usable = [measurement.usable_for(o) for o in observations]
    masks = torch.zeros(measurement.shape, dtype=torch.bool)
    for i, (name, camera) in enumerate(zip(measurement.names, measurement.cameras, strict=True)):
        height, width = camera.image_size
        inside = (i, slice(0, height), slice(0, width))
        if name in drawings:
            mask = read_mask(drawings[name], camera.image_size, say)
        else:
            valid, flow = np.zeros(camera.image_size, dtype=bool), np.zeros(camera.image_size, dtype=bool)
            for o, pixels in zip(observations, usable, strict=True):
                good = pixels[inside].numpy()
                flow |= _mask_by(o, inside, good, settings, sigma, name) & good
                valid |= good
            if not flow.any():
                raise InputError(f"no flow in view '{name}'; lower it below {settings.threshold:g}", field="threshold")
            mask = flow | ~valid
        masks[inside] = torch.from_numpy(mask)
        on_view(i + 1)
    return replace(measurement, flow_mask=masks)


def _mask_by(
    observation: Observation, inside: tuple[int, slice, slice], valid: PixelMask, settings: MaskSettings,
    sigma: float | None, name: str,
) -> PixelMask:  # fmt: skip
    """The mask of a view by one technique."""
    kind = observation.technique
    if sigma is not None:
        noise = np.asarray(sigma, dtype=np.float32)
    elif observation.sigma is not None:
        noise = observation.sigma[inside].numpy()
    else:
        unit = f" in {kind.unit}" if unit_shown(kind.unit) else ""
        raise InputError(
            f"the measurement has no noise of the {kind.measured} of view '{name}', which the threshold needs; give "
            f"it{unit}, or drawn masks of all views",
            field="sigma",
        )
    values = np.where(valid[..., None], observation.values[inside].numpy(), np.nan)
    return flow_mask(values, np.broadcast_to(noise, values.shape), settings)
