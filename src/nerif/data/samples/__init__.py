"""Real measurements that come with nerif, each with its licence and a README on its origin."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from nerif.common.conventions import InputError
from nerif.common.files import atomic
from nerif.common.written_files import OwnFiles

__all__ = ["SAMPLES", "SampleData", "sample"]


@dataclass(frozen=True)
class SampleData:
    """A real measurement."""

    title: str  #: in a few words
    licence: str  #: SPDX identifier


SAMPLES = {
    "jet": SampleData("underexpanded supersonic jet with shock cells, one camera, two images", "MIT"),
    "blowtorch": SampleData(
        "hot gas of a blowtorch, slanted and cut by the edge of the image, one camera, two images", "MIT"
    ),
    "spray": SampleData("X-ray absorption of an impinging-jet water spray, one slice, 18 angles", "CC0-1.0"),
}


def sample(name: str, folder: str | os.PathLike[str]) -> Path:
    """Copy a real measurement into a folder, with its licence, and return the folder.

    Images lie in camera/reference and camera/flow, as nerif displacement expects them; a measurement is
    measurement.nc. The folder is new or exists; a file there of the same name that nerif did not write is renamed.

    Parameters
    ----------
    name : one of SAMPLES
    """
    if name not in SAMPLES:
        raise InputError(f"expected one of {', '.join(SAMPLES)}, got '{name}'", field="name")
    source, target = Path(__file__).parent / name, Path(folder)
    for file in sorted(path for path in source.rglob("*") if path.is_file()):
        place = target / file.relative_to(source)
        place.parent.mkdir(parents=True, exist_ok=True)
        with OwnFiles(place.parent).writing(place.name) as path, atomic(path) as temporary:
            temporary.write_bytes(file.read_bytes())
    return target
