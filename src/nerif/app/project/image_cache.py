"""Images of a project for display, their quality and detected targets, cached until their files change."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from nerif.app.project.folder import ProjectFolder
from nerif.common.conventions import InputError
from nerif.imaging.calibration.target_images import explain_missing
from nerif.imaging.calibration.targets import CalibrationTarget, Detection
from nerif.imaging.quality.image_quality import ImageQuality, image_quality, jpeg_address
from nerif.imaging.readers.crop import Crop
from nerif.imaging.readers.views import View

__all__ = ["ImageCache"]

T = TypeVar("T")

SAMPLE = 12  # images of a source whose quality is read


class ImageCache:
    """Images, quality and detected targets of the experiments of a project, cached.

    Parameters
    ----------
    project : ProjectFolder
    """

    def __init__(self, project: ProjectFolder) -> None:
        self.project = project

    def stamp(self, view: View, source: str) -> tuple[Any, ...]:
        """Return a value that changes with the files of a source."""
        name = view.sources.get(source, "")
        path = view.folder / name
        where = path if path.exists() else path.parent
        if not where.resolve().is_relative_to(self.project.folder):
            raise InputError(f"expected images in {self.project.folder}, got some outside of it", field=name)
        result = [os.stat(where), *(entry.stat() for entry in (os.scandir(where) if where.is_dir() else ()))]
        return len(result), max(f.st_mtime_ns for f in result), sum(f.st_size for f in result)

    def quality(self, view: View, source: str) -> ImageQuality:
        """Return the quality of the images of a source; InputError if none can be used."""
        return self._from_cache(view, source, ("quality",), lambda: image_quality(view, source, SAMPLE))

    def image(self, view: View, source: str, number: int, largest: int, crop: Crop | None) -> str:
        """Return a frame as the address of an image, cropped by `crop`."""

        def read() -> str:
            frames = view.open(source)
            image = frames[number]
            return jpeg_address(crop(image, frames.name(number)) if crop else image, largest)

        return self._from_cache(view, source, ("image", number, largest, crop), read)

    def detection(self, view: View, source: str, number: int, target: CalibrationTarget) -> Detection | None:
        """Return the corners of a target in an image; None if it is not detected."""

        def read() -> Detection | None:
            frames = view.open(source)
            return target.detect(view.cropped(frames[number], frames.name(number)))

        return self._from_cache(view, source, ("detection", number, target), read)

    def explanation(self, view: View, source: str, numbers: Sequence[int], target: CalibrationTarget) -> str:
        """Return why a target is not detected in the images with these numbers."""
        what = ("explanation", tuple(numbers), target)
        return self._from_cache(view, source, what, lambda: explain_missing(view, source, target, numbers))

    def _from_cache(self, view: View, source: str, what: tuple[Any, ...], read: Callable[[], T]) -> T:
        key = str(view.folder), view.name, view.sources.get(source), source, view.crop, view.mosaic, what
        return self.project.cached("image", key, self.stamp(view, source) if source in view.sources else (), read)
