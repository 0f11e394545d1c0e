"""The command line: `nerif VERB ...`. One module of nerif.cli.commands a verb, loaded on demand."""

from __future__ import annotations

import importlib
import os
import sys

from nerif import __version__

__all__ = ["main"]

VERBS = {
    "design": "before the rig is built: the displacement, sensitivity, blur and resolution to expect",
    "pattern": "make print-ready backgrounds and calibration targets",
    "calibrate": "calibrate cameras from images of a target, or import a calibration; draw the rig",
    "displacement": "turn the images of all views into a measurement",
    "mask": "add flow masks to a measurement, by threshold or drawn by hand",
    "check": "find swapped, flipped, mirrored and exchanged views in a measurement",
    "render": "render the images of an experiment, with its truth",
    "simulate": "trace curved rays through a phantom and write a measurement, with its truth",
    "reconstruct": "reconstruct the refractive-index field of a measurement",
    "project": "predict the displacement any camera would see through a reconstruction",
    "evaluate": "compare a reconstruction with a truth, or with measured views",
    "sequence": "reconstruct every frame of a recording, on one machine or a cluster",
    "movie": "draw volumes over time, as isosurface or slices, to .mp4 or .gif",
    "report": "write a page that shows a result and says whether it can be trusted",
    "figures": "write every figure of a result as PDF and PNG at journal widths",
    "export": "write a reconstruction as .vti (ParaView), .nc, .npz, .mat or .csv, on any grid",
    "app": "the whole road in a browser, on this machine: design, images, calibration, runs, results",
    "info": "print what a measurement, volume or result holds",
    "demo": "simulate, reconstruct and evaluate a small flame",
}


MENTIONED = 4
"""Files that are named of those an interrupted command has written."""

ELSEWHERE = {"app": "nerif.app.command"}
"""Modules of verbs that are no file of nerif.cli.commands."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code.

    0 done, 1 no field found (reconstruct) or a fault found (check), 2 bad input, 130 interrupted, 141 nobody reads
    what it prints any more.
    """
    try:
        if arguments is None:
            _run_nothing_of_the_folder()
            arguments = sys.argv[1:]
        code = _run(list(arguments))
        sys.stdout.flush()
    except BrokenPipeError:  # nerif info FILE | head -2
        from nerif.cli.commands.output import silence

        silence()
        return 141
    return code


def _run_nothing_of_the_folder() -> None:
    """Keep code in the current folder, which may be somebody else's, from being run, here and in all child processes.

    Python looks there for modules first where it is started with -c or -m, as workers are. Numba reads there in
    .numba_config.yaml where its compiled code is, which are pickles.
    """
    os.environ["PYTHONSAFEPATH"] = "1"
    os.environ.setdefault("NUMBA_CACHE_DIR", "")


def _run(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help"):
        print("usage: nerif VERB [options]      (nerif VERB --help tells all options, units and defaults)\n")
        print("Refractive index, density and temperature in 3-D from background-oriented schlieren images.\n")
        print("\n".join(f"  {verb:<13} {text}" for verb, text in VERBS.items()))
        return 0
    if words[0] == "--version":
        print(f"nerif {__version__}")
        return 0
    verb = words[0]
    if verb not in VERBS:
        import difflib

        near = difflib.get_close_matches(verb, VERBS, n=1, cutoff=0)
        return _refuse(f"unknown verb '{verb}'; the nearest known one is '{near[0]}'; see nerif --help")

    from nerif.common.conventions import InputError
    from nerif.common.installation import stranger

    if warning := stranger():
        print(f"nerif: {warning}", file=sys.stderr)
    try:
        command = importlib.import_module(ELSEWHERE.get(verb, f"nerif.cli.commands.{verb}"))
        importlib.import_module("nerif.reconstruction.device").keep_freed_memory()
        on_free_cores = importlib.import_module("nerif.reconstruction.device").on_free_cores
        on_free_cores(command.main)(words[1:])
    except InputError as error:
        return _refuse(str(error))
    except KeyboardInterrupt as stop:
        print(f"nerif: interrupted; {stop if str(stop) else _left_behind()}", file=sys.stderr)
        return 130
    except SystemExit as stop:
        return int(stop.code or 0)
    except BrokenPipeError:
        raise
    except OSError as error:
        return _refuse(f"{error.filename or 'file'}: {error.strerror or error}")
    return 0


def _left_behind() -> str:
    """What a command that was broken off has written, and how to go on, where nothing else is known."""
    from nerif.common.files import written

    if not written:
        return "nothing was written; the same command starts again"
    last = ", ".join(dict.fromkeys(map(str, written[-MENTIONED:])))
    more = f" and {len(written) - MENTIONED} more" if len(written) > MENTIONED else ""
    return f"written and whole: {last}{more}; the same command with --force does all of it anew"


def _refuse(message: str) -> int:
    print("nerif: " + " ".join(message.split()), file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
