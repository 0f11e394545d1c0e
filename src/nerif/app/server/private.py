"""A page that only the user can read, in $XDG_STATE_HOME/nerif (default ~/.local/state/nerif)."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from html import escape
from pathlib import Path
from urllib.parse import urlsplit

from nerif.common.conventions import InputError

__all__ = ["page_leading_to"]


@contextmanager
def page_leading_to(link: str) -> Iterator[str]:
    """Write a page that redirects to `link`, yield its address, and delete it at the end.

    Every user of the machine can read the command line of the browser, so the token in `link` must not be part of it.
    """
    home = Path(os.environ.get("XDG_STATE_HOME", ""))
    where = (home if home.is_absolute() else Path.home() / ".local" / "state") / "nerif"
    page, to = where / f"open-{urlsplit(link).port}.html", escape(link)
    try:
        where.mkdir(mode=0o700, parents=True, exist_ok=True)
        page.unlink(missing_ok=True)  # left by a server that was killed
        with os.fdopen(os.open(page, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as file:
            file.write(
                '<!doctype html><meta charset="utf-8"><meta name="referrer" content="no-referrer"><title>nerif</title>'
                f'<meta http-equiv="refresh" content="0; url={to}"><a href="{to}">nerif</a>\n'
            )
    except OSError as error:
        raise InputError(
            f"expected a directory for files that only you can read, got '{error.strerror or error}'; "
            "set XDG_STATE_HOME to a directory that you can write to",
            field=where,
        ) from None
    try:
        yield page.as_uri()
    finally:
        page.unlink(missing_ok=True)
