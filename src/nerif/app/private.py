"""Files that only the user can read, in $XDG_STATE_HOME/nerif (default ~/.local/state/nerif)."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from html import escape
from pathlib import Path
from urllib.parse import urlsplit

from nerif.common.conventions import InputError
from nerif.common.locks import locked

__all__ = ["page_leading_to", "secret"]

LENGTH = 32  # of the secret, bytes


def _directory() -> Path:
    """Return the directory, created if it is missing."""
    home = Path(os.environ.get("XDG_STATE_HOME", ""))
    where = (home if home.is_absolute() else Path.home() / ".local" / "state") / "nerif"
    try:
        where.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(where, error) from None
    return where


def _write(path: Path, content: bytes) -> None:
    """Write a new file with mode 600."""
    try:
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(content)
    except OSError as error:
        raise _unwritable(path.parent, error) from None


def _unwritable(where: Path, error: OSError) -> InputError:
    return InputError(
        f"expected a directory for files that only you can read, got '{error.strerror or error}'; "
        "set XDG_STATE_HOME to a directory that you can write to",
        field=where,
    )


def secret() -> bytes:
    """Return the key that signs runs, one per user; InputError if other users may have read or changed it."""
    path = _directory() / "secret"
    if not path.exists():
        part = path.with_name(f".{secrets.token_hex(8)}")
        _write(part, secrets.token_bytes(LENGTH))
        with locked(path, wait=True):  # two servers started at once share the key of the first
            part.unlink() if path.exists() else part.rename(path)
    with path.open("rb") as file:
        about, content = os.fstat(file.fileno()), file.read()
    is_private = os.name != "posix" or (about.st_uid == os.geteuid() and not about.st_mode & 0o077)
    if not is_private or len(content) != LENGTH:
        got = f"{len(content)} bytes with mode {about.st_mode & 0o777:03o} of user {about.st_uid}"
        raise InputError(
            f"expected {LENGTH} bytes that only you can read (mode 600), got {got}; delete it, and start "
            "queued runs again from their pages",
            field=path,
        )
    return content


@contextmanager
def page_leading_to(link: str) -> Iterator[str]:
    """Write a page that redirects to `link`, yield its address, and delete it at the end.

    Every user of the machine can read the command line of the browser, so the token in `link` must not be part of it.
    """
    page = _directory() / f"open-{urlsplit(link).port}.html"
    page.unlink(missing_ok=True)  # left by a server that was killed
    to = escape(link)
    _write(
        page,
        f'<!doctype html><meta charset="utf-8"><meta name="referrer" content="no-referrer"><title>nerif</title>'
        f'<meta http-equiv="refresh" content="0; url={to}"><a href="{to}">nerif</a>\n'.encode(),
    )
    try:
        yield page.as_uri()
    finally:
        page.unlink(missing_ok=True)
