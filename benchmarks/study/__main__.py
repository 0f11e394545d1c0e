"""python benchmarks/study [--quick], or in the folder benchmarks: python -m study [--quick]."""

import sys
from pathlib import Path

if not __package__:  # the folder was named, and is on the path in place of the one that it lies in
    sys.path[0] = str(Path(__file__).resolve().parents[1])

from study.command import main

if __name__ == "__main__":
    sys.exit(main())
