"""What a page is."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from nerif.app.workspace import Workspace

__all__ = ["Page"]


@dataclass(frozen=True)
class Page:
    """One page of the app.

    Parameters
    ----------
    name : one word, under which what is typed on it is kept
    title : for people
    path : of its address
    about : one sentence below the title
    build : builds it within the frame; a coroutine function where it waits for something
    """

    name: str
    title: str
    path: str
    about: str
    build: Callable[[Workspace], Awaitable[None] | None]
