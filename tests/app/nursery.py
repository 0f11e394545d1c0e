"""A process that has imported the app, and forks servers on request: the second one starts at once.

Lines on standard input ask: {"words": arguments of nerif, "out": a named pipe for what it prints, "by": command
that starts it instead, if it holds any words}. The answer is the number of its process.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import sys

WITH_PARENT = 1  # PR_SET_PDEATHSIG of Linux


def main() -> None:
    """Fork until nobody asks any more."""
    import nerif.app.server.server
    from nerif.cli.cli import main as nerif

    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # whoever has ended is not waited for
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the servers
    for line in iter(sys.stdin.readline, ""):
        request = json.loads(line)
        number = os.fork()
        if number == 0:
            if sys.platform == "linux":
                ctypes.CDLL(None).prctl(WITH_PARENT, signal.SIGKILL)  # it does not outlive tests that were broken off
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            signal.signal(signal.SIGINT, signal.default_int_handler)
            out = os.open(request["out"], os.O_WRONLY)
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            os.dup2(out, 1)
            os.dup2(out, 2)
            os.close(out)
            if request["by"]:
                os.execvp(request["by"][0], [*request["by"], sys.executable, "-m", "nerif", *request["words"]])
            sys.exit(nerif(request["words"]))
        print(number, flush=True)


if __name__ == "__main__":
    main()
