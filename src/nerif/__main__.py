"""`python -m nerif` is `nerif`."""

import sys

if __name__ == "__main__":
    if not sys.flags.safe_path:
        del sys.path[0]  # the current folder, which may not be the user's own: its numpy.py is not the one to import

    from nerif.cli.cli import main

    sys.exit(main())
