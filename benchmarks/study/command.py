"""Repeat the paper's numerical study and write study.md and study.html; done again, it goes on where it was."""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from nerif.common.conventions import InputError
from nerif.reconstruction.device import resolve_device
from nerif.reconstruction.neural.presets import preset
from study.cases import FULL, QUICK, SECTIONS, Case, Scale, cases, check_sections
from study.page import write_page
from study.progress import progress_of_cases
from study.records import of_other_versions, read_record
from study.running import run_cases

__all__ = ["main", "parser", "run"]

PAGE_EVERY = 180.0  # seconds between pages while the study goes on


def parser() -> argparse.ArgumentParser:
    """Return the options, their texts computed from the two scales."""
    found = argparse.ArgumentParser(prog="study", description=__doc__)
    add = found.add_argument
    add("-o", "--out", type=Path, default=Path("out/study"), help="directory; default: %(default)s")
    small = f"{QUICK.pixels} x {QUICK.pixels} px, training of {QUICK.steps} steps, at most {QUICK.seconds:g} s"
    add("--quick", action="store_true", help=f"a small version: views of {small}")
    add("--only", nargs="+", default=[], metavar="SECTION", help=f"sections to do: {', '.join(SECTIONS)}; default: all")
    add("--device", default="auto", help="where to compute: auto, cpu, cuda, cuda:1, ...")
    add("--preset", default="auto", help="settings of NeRIF that the study starts from")
    limits = f"default: {FULL.seconds:g}, with --quick {QUICK.seconds:g}"
    add("--time-limit", type=float, help=f"seconds of training of each NeRIF reconstruction; {limits}")
    sizes = f"default: {FULL.pixels} as in the paper, with --quick {QUICK.pixels}"
    add("--pixels", type=int, help=f"of an edge of each view; {sizes}")
    add("--page-only", action="store_true", help="write the page from what is there, and reconstruct nothing")
    return found


def main(arguments: list[str] | None = None) -> int:
    """Run the study and return the exit code: 0 done, 1 some reconstructions failed, 2 bad input, 130 interrupted."""
    words = sys.argv[1:] if arguments is None else arguments
    try:
        return run(parser().parse_args(words), words)
    except InputError as error:
        print(f"study: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


def run(settings: argparse.Namespace, words: list[str]) -> int:
    """Run the cases that are missing, and write the page as they come in."""
    out: Path = settings.out
    scale = _scale(settings)
    sections = check_sections(tuple(settings.only))
    todo = cases(scale, sections)
    if out.is_file():
        raise InputError(f"{out}: expected a directory for --out, got a file")
    out.mkdir(parents=True, exist_ok=True)
    about = _about(scale, sections, words)
    old = of_other_versions(out, todo)
    if old and not settings.page_only:
        versions = ", ".join(sorted(set(old.values())))
        print(f"made by another version of nerif ({versions}), and so made again: {', '.join(old)}", flush=True)
    if settings.page_only:
        print(f"Open {_page(out, todo, about)} in a browser.")
        return 0
    started = written = time.monotonic()
    failed = []
    try:
        with progress_of_cases(len(todo)) as tell:
            for case, record in zip(todo, run_cases(todo, out, tell), strict=True):
                if "failed" in record:
                    failed.append(f"{case.key}: {record['failed']}")
                if time.monotonic() - written > PAGE_EVERY:
                    _page(out, todo, about)
                    written = time.monotonic()
    except KeyboardInterrupt:
        print(f"{_page(out, todo, about)}: the page of what is done; the same command goes on from here")
        raise
    page = _page(out, todo, about)
    minutes = (time.monotonic() - started) / 60
    print(f"{len(todo) - len(failed)} of {len(todo)} reconstructions are there, after {minutes:.1f} min")
    print("".join(f"failed: {line}\n" for line in failed) + f"Open {page} in a browser.")
    return 1 if failed else 0


def _scale(settings: argparse.Namespace) -> Scale:
    """What the settings make of the full study or the quick one."""
    scale = QUICK if settings.quick else FULL
    device = resolve_device(settings.device)  # one that is not here is refused before the long work
    preset(settings.preset)
    changes: dict[str, Any] = {"preset": settings.preset, "device": str(device)}
    if settings.time_limit is not None:
        if not settings.time_limit > 0:
            raise InputError(f"time_limit: expected seconds above 0, got {settings.time_limit}")
        changes["seconds"] = settings.time_limit
    if settings.pixels is not None:
        if settings.pixels < 8:
            raise InputError(f"pixels: expected at least 8, got {settings.pixels}")
        changes["pixels"] = settings.pixels
    return replace(scale, **changes)


def _about(scale: Scale, sections: tuple[str, ...], words: list[str]) -> dict[str, Any]:
    """What stands at the head of the page."""
    command = shlex.join(["python", "benchmarks/study", *(word for word in words if word != "--page-only")])
    return {**asdict(scale), "scale": scale.name, "command": command, "sections": sections}


def _page(folder: Path, todo: list[Case], about: dict[str, Any]) -> Path:
    pairs = [(case, read_record(folder, case)) for case in todo]
    return write_page(folder, pairs, {**about, "not_used": of_other_versions(folder, todo)})
