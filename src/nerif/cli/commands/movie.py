"""nerif movie: volumes over time as a movie."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from nerif.cli.arguments import check_output
from nerif.cli.output import counting_bar, say
from nerif.cli.settings import Settings, command
from nerif.common.settings import Count, Flat, Positional
from nerif.report.movie_settings import MovieSettings

__all__ = ["MovieCommand", "main", "run"]


@dataclass(frozen=True)
class MovieCommand(Settings):
    """Draw an isosurface or slices of a sequence over time as .mp4 or .gif, without a window."""

    result: Annotated[Path, Positional]
    """Result of nerif sequence (.zarr), complete or not, true field of nerif simulate --times, or velocity."""
    out: Path
    """Movie to write: NAME.mp4 (H.264) or NAME.gif."""
    every: Count = 1
    """Draw every Nth frame."""
    force: bool = False
    """Overwrite an existing file."""
    look: Annotated[MovieSettings, Flat] = field(default_factory=MovieSettings)


def run(settings: MovieCommand) -> None:
    """Write the movie."""
    from nerif.data.velocity_sequence import open_volumes
    from nerif.report.volume_movie import Movie, finished_frames

    check_output(settings.out, settings.force)
    store = open_volumes(settings.result)
    complete = finished_frames(store)
    frames = complete[:: settings.every]
    with counting_bar("drawing frames", len(frames)) as bar:
        Movie(**vars(settings.look)).write(settings.out, store, frames, bar)
    say(f"{settings.out}: {len(frames)} frames, {len(frames) / settings.look.frames_per_second:.1f} s")
    if len(complete) < len(store):
        say(f"{len(store) - len(complete)} missing or failed frames were left out")


main = command("movie", MovieCommand, run)
