"""nerif movie: volumes over time as a movie."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from nerif.cli.commands.output import check_file, counting_bar, say
from nerif.cli.commands.settings import Flat, Settings, read_settings
from nerif.common.conventions import InputError
from nerif.data.volume_sequence import VolumeSequence
from nerif.report.movie import Movie, frames_there

__all__ = ["MovieCommand", "main", "run"]


@dataclass(frozen=True)
class MovieCommand(Settings):
    """Draw an isosurface or slices of a sequence over time, off-screen, as .mp4 or .gif."""

    result: Annotated[Path, tyro.conf.Positional]
    """Result of nerif sequence (.zarr), finished or not, or the truth of nerif simulate --times."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Movie to write: NAME.mp4 (H.264) or NAME.gif."""
    every: int = 1
    """Take every so many frames."""
    force: bool = False
    """Overwrite an existing file."""
    look: Annotated[Movie, Flat] = field(default_factory=Movie)


def run(settings: MovieCommand) -> None:
    """Write the movie."""
    if settings.every < 1:
        raise InputError(f"expected 1 or more, got {settings.every}", field="every")
    check_file(settings.out, settings.force)
    store = VolumeSequence(settings.result)
    there = frames_there(store)
    frames = there[:: settings.every]
    with counting_bar("drawing frames", len(frames)) as bar:
        settings.look.write(settings.out, store, frames, bar)
    seconds = len(frames) / settings.look.frames_per_second
    say(f"{settings.out}: {len(frames)} frames, {seconds:.1f} s")
    if len(there) < len(store):
        say(f"{len(store) - len(there)} frames are missing or failed and were left out")


def main(arguments: list[str]) -> None:
    """Parse and run."""
    run(read_settings(MovieCommand(result=tyro.MISSING, out=tyro.MISSING), arguments, "movie"))
