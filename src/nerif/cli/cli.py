"""The command line, `nerif COMMAND ...`: each command is a module of nerif.cli.commands, imported on demand."""

from __future__ import annotations

import importlib
import io
import os
import signal
import sys
from contextlib import chdir

from nerif import __version__

__all__ = ["main"]

COMMANDS = {
    "design": "predict displacement, sensitivity, blur and resolution of a planned rig",
    "pattern": "make backgrounds and calibration targets to print",
    "calibrate": "calibrate cameras from images of a target, import a calibration, or draw the rig",
    "displacement": "compute a measurement from the images of all views",
    "vectors": "read displacement vectors of PIVlab, OpenPIV, DaVis, and others as a measurement",
    "mask": "add flow masks to a measurement, by threshold or from drawings",
    "body": "add opaque bodies to a measurement, from STL, OBJ or PLY",
    "check": "detect swapped, flipped, mirrored and exchanged views, or pose errors, in a measurement",
    "render": "render the images of an experiment, with the true field",
    "simulate": "simulate a measurement of a phantom by ray tracing, with the true field",
    "reconstruct": "reconstruct the field of a measurement",
    "project": "predict the measurement of any camera from a reconstruction",
    "evaluate": "compare a reconstruction with a true field, or with measured views",
    "sequence": "reconstruct all frames of a measurement sequence, on one machine or a cluster",
    "velocity": "compute velocity and pressure from the densities of a film",
    "movie": "draw volumes over time as isosurface or slices (.mp4, .gif)",
    "report": "write an HTML report of a result",
    "figures": "write the figures of a result as PDF and PNG at journal column widths",
    "export": "write a reconstruction as .vti or .pvd (ParaView), .dat (Tecplot), .nc, .npz, .mat, .csv",
    "app": "open the browser interface: design, images, calibration, runs, results",
    "info": "describe a measurement, volume or result",
    "demo": "simulate, reconstruct and evaluate a small flame",
}
MODULES = {"app": "nerif.app.command"}  # of commands outside nerif.cli.commands
MAX_FILES_LISTED = 4  # after an interruption


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code.

    0: success; 1: no field (reconstruct, sequence) or a fault in the data (check --strict); 2: bad input;
    130: interrupted; 141: standard output closed; 143: ended by SIGTERM, whatever was complete by then.
    """
    from nerif.common.interruption import handle_signals, received

    try:
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, io.TextIOWrapper) and stream.encoding.lower() not in ("utf-8", "utf8"):
                stream.reconfigure(errors="replace")  # a console without Greek letters shows question marks
        if arguments is None:
            _obey_nothing_in_the_current_folder()
            handle_signals()
            arguments = sys.argv[1:]
        code = _run(list(arguments))
        sys.stdout.flush()
    except OSError as error:
        from nerif.cli.closed_output import is_closed_output, silence

        if not is_closed_output(error):
            raise
        silence()
        return 141
    return 143 if signal.SIGTERM in received else code


def _obey_nothing_in_the_current_folder() -> None:
    """Keep Python and Numba, here and in child processes, and Matplotlib from obeying files of the current folder.

    Python started with -c or -m, as workers are, imports from it. Numba reads the place of its compiled code, which is
    pickled, from .numba_config.yaml in it; Matplotlib, when it is imported, whether LaTeX writes the texts, from
    matplotlibrc in it, before the file in the user's home.
    """
    os.environ["PYTHONSAFEPATH"] = "1"
    os.environ.setdefault("NUMBA_CACHE_DIR", "")
    if os.path.lexists("matplotlibrc"):
        with chdir(os.path.dirname(os.path.abspath(__file__))):
            import matplotlib  # noqa: F401


def _run(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help"):
        print("usage: nerif COMMAND [options]      (nerif COMMAND --help: options, units and defaults)\n")
        print("Refractive index, density and temperature in 3-D from background-oriented schlieren images.\n")
        print("\n".join(f"  {command:<13} {text}" for command, text in COMMANDS.items()))
        return 0
    if words[0] == "--version":
        print(f"nerif {__version__}")
        return 0
    if words[0] not in COMMANDS:
        import difflib

        nearest = difflib.get_close_matches(words[0], COMMANDS, n=1, cutoff=0)[0]
        return _fail(f"unknown command '{words[0]}'; did you mean '{nearest}'? See nerif --help")

    from nerif.cli.arguments import check_arguments
    from nerif.common.conventions import InputError
    from nerif.common.installation import package_conflict

    if warning := package_conflict():
        print(f"nerif: {warning}", file=sys.stderr)
    try:
        check_arguments(words[0], words[1:])
        command = importlib.import_module(MODULES.get(words[0], f"nerif.cli.commands.{words[0]}"))
        command.main(words[1:])
    except InputError as error:
        return _fail(str(error))
    except KeyboardInterrupt as stop:
        print(f"nerif: interrupted; {stop if str(stop) else _files_written()}", file=sys.stderr)
        return 130
    except SystemExit as stop:
        return int(stop.code or 0)
    except OSError as error:
        from nerif.cli.closed_output import is_closed_output

        if is_closed_output(error):
            raise
        return _fail(f"{error.filename or 'file'}: {error.strerror or error}")
    except (MemoryError, RuntimeError) as error:
        from nerif.common.memory import is_out_of_memory

        if not is_out_of_memory(error):
            raise
        remedy = "close other programs, or reduce --voxels, --batch, the views or their size"
        return _fail(f"not enough memory ({str(error) or 'refused by the system'}); {remedy}")
    return 0


def _files_written() -> str:
    """Return what an interrupted command has written, and how to continue."""
    from nerif.common.files import written

    if not written:
        return "nothing was written; run the same command again"
    names = list(dict.fromkeys(map(str, written)))
    files, more = ", ".join(names[-MAX_FILES_LISTED:]), " and others" * (len(names) > MAX_FILES_LISTED)
    return f"complete files: {files}{more}; run the same command with --force to start again"


def _fail(message: str) -> int:
    from nerif.common.conventions import printable

    print("nerif: " + printable(" ".join(message.split())), file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
