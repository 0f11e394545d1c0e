"""Files that the user alone can read, outside of every project.

They are in $XDG_STATE_HOME/nerif, by default ~/.local/state/nerif.
"""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from html import escape
from pathlib import Path
from urllib.parse import urlsplit

from nerif.common.conventions import InputError

__all__ = ["page_leading_to", "secret"]

LENGTH = 32  # of the secret, bytes


def _directory() -> Path:
    """The directory, made if it is missing.

    Raises
    ------
    InputError
        If it cannot be made or written to.
    """
    entry = Path(os.environ.get("XDG_STATE_HOME", ""))
    where = (entry if entry.is_absolute() else Path.home() / ".local" / "state") / "nerif"
    try:
        where.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(where, error) from None
    return where


def _write(path: Path, content: bytes) -> None:
    """Write a new file that its owner alone may read."""
    try:
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(content)
    except OSError as error:
        raise _unwritable(path.parent, error) from None


def _unwritable(where: Path, error: OSError) -> InputError:
    return InputError(
        f"expected a directory for files that you alone can read, got '{error.strerror or error}'; "
        "set XDG_STATE_HOME to a directory that you can write to",
        field=where,
    )


def secret() -> bytes:
    """Return the secret that runs are signed with: made the first time, the same for every server of this user.

    Raises
    ------
    InputError
        If others may have read or written it, or the directory cannot be written to.
    """
    path = _directory() / "secret"
    if not path.exists():
        part = path.with_name(f".{secrets.token_hex(8)}")
        _write(part, secrets.token_bytes(LENGTH))
        with suppress(FileExistsError):  # of two servers that start at once, the first gives the secret
            os.link(part, path)
        part.unlink()
    with path.open("rb") as file:
        about, content = os.fstat(file.fileno()), file.read()
    origin_ = os.name != "posix" or (about.st_uid == os.geteuid() and not about.st_mode & 0o077)
    if not origin_ or len(content) != LENGTH:
        got = f"{len(content)} bytes with mode {about.st_mode & 0o777:03o} of user {about.st_uid}"
        raise InputError(
            f"expected {LENGTH} bytes that you alone can read (mode 600), got {got}; delete it, and start "
            "runs that wait again from their pages",
            field=path,
        )
    return content


@contextmanager
def page_leading_to(link: str) -> Iterator[str]:
    """Give the address of a page that leads to `link`, and remove the page at the end.

    A browser is started with the address in its command line, which every user of the machine can read; `link` holds
    the token and stands in the page alone.
    """
    page = _directory() / f"open-{urlsplit(link).port}.html"
    page.unlink(missing_ok=True)  # of a server that was killed
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
