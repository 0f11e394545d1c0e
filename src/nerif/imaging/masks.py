"""Flow masks: where there may be flow in an image, by threshold or drawn by hand as polygons and brush strokes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Shaped

from nerif.common.conventions import InputError, unit_shown
from nerif.common.files import atomic
from nerif.data.measurement import Measurement, Observation, integrals_of
from nerif.imaging.readers.frames import as_float
from nerif.imaging.readers.open import open_frames

__all__ = [
    "MaskSettings",
    "MaskShape",
    "drawn_masks",
    "flow_mask",
    "mask_of",
    "read_mask",
    "with_flow_masks",
    "write_masks",
]

KINDS = {"polygon": 3, "brush": 1}
"""Kinds of shapes, and the fewest points of each."""


@dataclass(frozen=True)
class MaskShape:
    """A shape in a view.

    Parameters
    ----------
    kind : polygon or brush
    points : (column, row) of corners, or along the stroke, px; the centre of the top-left pixel is (0, 0)
    inside : whether it is flow, or takes flow away
    width : of a brush, px

    Raises
    ------
    InputError
        If there is no such kind, there are too few points, one is not finite, or the width is not positive.
    """

    kind: str
    points: tuple[tuple[float, float], ...]
    inside: bool = True
    width: float = 8.0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f"expected {' or '.join(KINDS)}, got '{self.kind}'", field="kind")
        if len(self.points) < KINDS[self.kind]:
            raise InputError(
                f"expected {KINDS[self.kind]} or more of a {self.kind}, got {len(self.points)}", field="points"
            )
        if not np.isfinite(np.array(self.points, dtype=float)).all():
            raise InputError(f"expected finite numbers, got {self.points}", field="points")
        if not self.width > 0:
            raise InputError(f"expected px above 0, got {self.width}", field="width")


def mask_of(shapes: Sequence[MaskShape], shape: tuple[int, int]) -> Bool[np.ndarray, "row column"]:
    """Return where shapes leave flow, later ones over earlier ones.

    Parameters
    ----------
    shapes : in the order they were drawn
    shape : height and width of the view, px
    """
    from PIL import Image, ImageDraw

    image = Image.new("1", (shape[1], shape[0]), 0)
    draw = ImageDraw.Draw(image)
    for s in shapes:
        if s.kind == "polygon":
            draw.polygon(list(s.points), fill=int(s.inside), outline=int(s.inside))
            continue
        if len(s.points) > 1:
            draw.line(list(s.points), fill=int(s.inside), width=max(1, round(s.width)))
        for x, y in s.points:  # round ends and joints
            r = (s.width - 1) / 2
            draw.ellipse((x - r, y - r, x + r, y + r), fill=int(s.inside))
    return np.asarray(image, dtype=bool)


def write_masks(
    folder: Path, drawn: Mapping[str, Sequence[MaskShape]], shapes: Mapping[str, tuple[int, int]]
) -> list[Path]:
    """Write VIEW.png of each view that something was drawn in, white where the flow is, and return their paths.

    Parameters
    ----------
    drawn : shapes by the name of the view
    shapes : height and width of the views, px

    Raises
    ------
    InputError
        If what was drawn covers nothing of a view, or all of it, or the name of a view can be no file's name: nothing
        is written then.
    """
    from PIL import Image

    for name in drawn:
        if name in ("", ".", "..") or any(sign in name for sign in "/\\\0"):
            raise InputError(
                f"expected names that files can have, without / and \\, got {name!r}; rename it", field="view"
            )
    masks = {name: mask_of(own, shapes[name]) for name, own in drawn.items() if own}
    for name, mask in masks.items():
        if mask.all() or not mask.any():
            raise InputError(
                f"expected some of it, got {'all' if mask.any() else 'nothing'}", field=f"mask of view '{name}'"
            )
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, mask in masks.items():
        path = folder / f"{name}.png"
        with atomic(path) as part:
            Image.fromarray(mask.astype(np.uint8) * 255).save(part, format="PNG")
        written.append(path)
    return written


@dataclass(frozen=True)
class MaskSettings:
    """How flow is told from noise."""

    threshold: float = 4.0
    """Flow is where what was measured (of displacements |d|) exceeds this many sigma."""
    smooth: float = 1.5
    """Standard deviation of a Gaussian over the values / sigma before the threshold, px."""
    smallest: int = 64
    """Islands and holes of fewer pixels are removed."""
    grow: int = 3
    """Pixels added all around, so that the edge of the flow is inside."""

    def __post_init__(self) -> None:
        for name in ("threshold", "smooth", "smallest", "grow"):
            if not getattr(self, name) >= 0:
                raise InputError(f"expected 0 or more, got {getattr(self, name)}", field=name)


STANDARD = MaskSettings()


def flow_mask(
    values: Shaped[np.ndarray, "row column c"],
    sigma: Shaped[np.ndarray, "row column c"],
    settings: MaskSettings = STANDARD,
) -> Bool[np.ndarray, "row column"]:
    """Return where |values| / sigma exceeds a threshold, cleaned up, and where that is not known.

    Parameters
    ----------
    values : what was measured; NaN where not known
    sigma : in the same unit; NaN or not positive where not known
    settings : of the threshold
    """
    from scipy.ndimage import binary_dilation, gaussian_filter
    from skimage.morphology import remove_small_holes, remove_small_objects

    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = as_float(values) / np.where(sigma > 0, as_float(sigma), np.nan)
    known = np.isfinite(ratio).all(axis=-1)
    ratio[~known] = 0
    if settings.smooth:
        share = np.maximum(gaussian_filter(known.astype(np.float32), settings.smooth), 1e-6)
        ratio = gaussian_filter(ratio, (settings.smooth, settings.smooth, 0)) / share[..., None]
    flow = (np.linalg.norm(ratio, axis=-1) > settings.threshold) & known
    if settings.smallest:  # an island may go on where nothing is known
        flow = known & remove_small_objects(flow | ~known, max_size=settings.smallest)
        flow = remove_small_holes(flow | ~known, max_size=settings.smallest) & known
    if settings.grow:
        flow = binary_dilation(flow, iterations=settings.grow)
    return np.asarray(flow | ~known)


def read_mask(path: Path, shape: tuple[int, int]) -> Bool[np.ndarray, "row column"]:
    """Read a mask drawn as an image: anything above half of its range counts.

    Raises
    ------
    InputError
        If it cannot be read, is of another size than the view, or of one grey.
    """
    image = open_frames(path)[0]
    if image.shape != shape:
        raise InputError(
            f"expected a mask of {shape[0]} x {shape[1]} px (height x width) as the view, got "
            f"{image.shape[0]} x {image.shape[1]}",
            field=path,
        )
    low, high = float(image.min()), float(image.max())
    if low == high:
        raise InputError(f"expected a mask with black and white in it, got one grey of {high:g}", field=path)
    return np.asarray(image > (low + high) / 2)


def drawn_masks(folder: Path, names: Iterable[str]) -> dict[str, Path]:
    """Return the images of masks in a folder, VIEW.png and the like, by the names of their views.

    Raises
    ------
    InputError
        If there is no such folder, or none for any view.
    """
    if not folder.is_dir():
        raise InputError("no such folder; expected one with VIEW.png for each view", field=folder)
    found = {p.stem: p for p in sorted(folder.iterdir()) if p.suffix in (".png", ".tif", ".tiff", ".bmp")}
    known = {name: found[name] for name in names if name in found}
    if not known:
        raise InputError(f"expected images named as the views, {', '.join(names)}, found none", field=folder)
    return known


def with_flow_masks(
    measurement: Measurement,
    settings: MaskSettings = STANDARD,
    sigma: float | None = None,
    drawn: Mapping[str, Path] | None = None,
    on_view: Callable[[int], None] = lambda done: None,
) -> Measurement:
    """Return a measurement with a flow mask for each view: drawn where there is a drawing, else by threshold.

    Flow is where one of the techniques of a measurement shows it.

    Parameters
    ----------
    measurement : what was measured; pixels that are not usable are in the mask
    settings : of the threshold
    sigma : noise, in the unit of what was measured, in the place of the measurement's own
    drawn : images of masks by the names of views
    on_view : called with the number of views done

    Raises
    ------
    InputError
        If there is no noise to measure by, or one for several techniques, or a mask holds no flow.
    """
    drawn = drawn or {}
    observations = integrals_of(measurement)
    if sigma is not None and len(observations) > 1:
        names = " and ".join(o.technique.measured for o in observations)
        raise InputError(
            f"expected none for {names}, which have units and noise of their own, got {sigma:g}", field="sigma"
        )
    seen = [(o, measurement.usable_for(o)) for o in observations]
    masks = torch.zeros(measurement.shape, dtype=torch.bool)
    for i, (name, camera) in enumerate(zip(measurement.names, measurement.cameras, strict=True)):
        height, width = camera.image_size
        inside = (slice(0, height), slice(0, width))
        if name in drawn:
            mask = read_mask(drawn[name], camera.image_size)
        else:
            known, flow = np.zeros(camera.image_size, dtype=bool), np.zeros(camera.image_size, dtype=bool)
            for o, usable in seen:
                own = usable[i][inside].numpy()
                flow |= _mask_by(o, (i, *inside), own, settings, sigma, name) & own
                known |= own
            if not flow.any():
                raise InputError(
                    f"no flow is left in view '{name}'; give less than {settings.threshold:g}", field="threshold"
                )
            mask = flow | ~known
        masks[i][inside] = torch.from_numpy(mask)
        on_view(i + 1)
    return replace(measurement, flow_mask=masks)


def _mask_by(
    observation: Observation, inside: tuple[int, slice, slice], known: Bool[np.ndarray, "row column"],
    settings: MaskSettings, sigma: float | None, name: str,
) -> Bool[np.ndarray, "row column"]:  # fmt: skip
    """The mask of a view by one technique."""
    kind = observation.technique
    if sigma is None and observation.sigma is None:
        unit = f" in {kind.unit}" if unit_shown(kind.unit) else ""
        raise InputError(
            f"the measurement holds no noise to measure the {kind.measured} of view '{name}' by; give it{unit}, "
            "or drawn masks of all views",
            field="sigma",
        )
    values = np.where(known[..., None], observation.values[inside].numpy(), np.nan)
    own = observation.sigma[inside].numpy() if sigma is None and observation.sigma is not None else sigma
    return flow_mask(values, np.broadcast_to(np.asarray(own, dtype=np.float32), values.shape), settings)
