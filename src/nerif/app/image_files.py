"""Cache of image statistics and small images, valid until the files change."""

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

MOST = 400  # entries of the cache


class ImageFiles:
    """Images of one project for display.

    Parameters
    ----------
    project : project whose folder contains all images
    """

    def __init__(self, project: Project) -> None:
        self.project = project
        self._cache: OrderedDict[tuple[Any, ...], Any] = OrderedDict()  # the last used entry at the end
        self._lock = Lock()  # of the cache: pages read it from threads

    def stamp(self, view: View, source: str) -> tuple[Any, ...]:
        """Return number, latest modification time (ns) and size (bytes) of the files of a source."""
        name = view.sources.get(source, "")
        path = view.folder / name
        where = path if path.exists() else path.parent
        if not where.resolve().is_relative_to(self.project.folder):
            raise InputError(f"expected images in {self.project.folder}, got images outside it", field=name)
        stats = [os.stat(where), *(entry.stat() for entry in os.scandir(where))] if where.is_dir() else [os.stat(where)]
        return len(stats), max(s.st_mtime_ns for s in stats), sum(s.st_size for s in stats)

    def look(self, view: View, source: str, most: int) -> SourceLook:
        """Return statistics of the images of a source; InputError if there is no usable image."""
        return self._once(view, source, ("look", most), lambda: look_at(view, source, most))

    def image(self, view: View, source: str, number: int, largest: int, crop: Crop | None, white: float = 0.0) -> str:
        """Return a frame, or its crop, as a data address."""

        def read() -> str:
            frames = view.open(source)
            image = frames[number]
            return jpeg_address(crop(image, frames.name(number)) if crop else image, largest, white)

        return self._once(view, source, ("image", number, largest, crop, white), read)

    def detection(self, view: View, source: str, number: int, target: CalibrationTarget) -> Detection | None:
        """Return the target detected in an image, or None."""

        def read() -> Detection | None:
            frames = view.open(source)
            return target.detect(view.cropped(frames[number], frames.name(number)))

        return self._once(view, source, ("detection", number, target), read)

    def _once(self, view: View, source: str, request: tuple[Any, ...], read: Any) -> Any:
        key = str(Path(view.folder)), view.name, view.sources.get(source), source, view.crop, request
        stamp = self.stamp(view, source) if source in view.sources else ()
        with self._lock:
            entry = self._cache.get(key)
        if entry is None or entry[0] != stamp:
            entry = (stamp, read())
        with self._lock:
            self._cache[key] = entry
            self._cache.move_to_end(key)
            while len(self._cache) > MOST:
                self._cache.popitem(last=False)
        return entry[1]
