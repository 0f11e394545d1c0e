"""Images of a project as a page shows them: looks and small images, kept until their files change."""

from __future__ import annotations

import os
from collections import OrderedDict
from pathlib import Path
from threading import Lock
from typing import Any

from nerif.app.project import Project
from nerif.common.conventions import InputError
from nerif.imaging.calibration.targets import CalibrationTarget, Detection
from nerif.imaging.image_quality import ImageQuality, image_quality, jpeg_address
from nerif.imaging.readers.crop import Crop
from nerif.imaging.readers.views import View

__all__ = ["ImageFiles"]

MOST = 400  # entries that are kept


class ImageFiles:
    """What is shown of the images of one project.

    Parameters
    ----------
    project : Project
    """

    def __init__(self, project: Project) -> None:
        self.project = project
        self._kept: OrderedDict[tuple[Any, ...], Any] = OrderedDict()  # least recently used first
        self._lock = Lock()  # of what is kept: pages ask in threads

    def stamp(self, view: View, source: str) -> tuple[Any, ...]:
        """Return what changes with the files of a source."""
        name = view.sources.get(source, "")
        path = view.folder / name
        where = path if path.exists() else path.parent
        if not where.resolve().is_relative_to(self.project.folder):
            raise InputError(f"expected images in {self.project.folder}, got some outside of it", field=name)
        result = (
            [os.stat(where), *(entry.stat() for entry in os.scandir(where))] if where.is_dir() else [os.stat(where)]
        )
        return len(result), max(f.st_mtime_ns for f in result), sum(f.st_size for f in result)

    def look(self, view: View, source: str, most: int) -> ImageQuality:
        """Return how the images of a source are; InputError where there are none of use."""
        return self._once(view, source, ("look", most), lambda: image_quality(view, source, most))

    def image(self, view: View, source: str, number: int, largest: int, crop: Crop | None, white: float = 0.0) -> str:
        """Return an image in a data address: of a frame, or of the part that `crop` leaves of it."""

        def read() -> str:
            frames = view.open(source)
            image = frames[number]
            return jpeg_address(crop(image, frames.name(number)) if crop else image, largest, white)

        return self._once(view, source, ("image", number, largest, crop, white), read)

    def result(self, view: View, source: str, number: int, target: CalibrationTarget) -> Detection | None:
        """Return the corners of a target in an image; None if it is not detected."""

        def read() -> Detection | None:
            frames = view.open(source)
            return target.detect(view.cropped(frames[number], frames.name(number)))

        return self._once(view, source, ("found", number, target), read)

    def _once(self, view: View, source: str, what: tuple[Any, ...], read: Any) -> Any:
        key = str(Path(view.folder)), view.name, view.sources.get(source), source, view.crop, what
        stamp = self.stamp(view, source) if source in view.sources else ()
        with self._lock:
            memory = self._kept.get(key)
        if memory is None or memory[0] != stamp:
            memory = (stamp, read())
        with self._lock:
            self._kept[key] = memory
            self._kept.move_to_end(key)
            while len(self._kept) > MOST:
                self._kept.popitem(last=False)
        return memory[1]
