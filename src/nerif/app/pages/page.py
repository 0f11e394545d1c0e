"""A page of the app, and its hint in a demo project."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from nerif.app.project.workspace import Workspace

__all__ = ["Hint", "Page"]


@dataclass(frozen=True)
class Hint:
    """What the guide of a demo project says on a page."""

    purpose: str  #: what the page does
    click: str  #: what to click now
    look: str  #: what to look at then
    before: str = ""  #: name of the page whose step must be done before; empty if there is none
    values: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Entries that the button fills into the forms of the page, by the key of their draft."""
    done: Callable[[Workspace], bool] | None = None
    """Whether the output of the step is in the project; None for a step without output."""


@dataclass(frozen=True)
class Page:
    """One page of the app."""

    name: str  #: one word, its address and the key of its draft
    title: str  #: its heading
    about: str  #: one sentence below the title
    build: Callable[[Workspace], Awaitable[None] | None]
    """Builds it within the frame; a coroutine function where it waits for something."""
    hint: Hint | None = None  #: of the guide; None for a page that the guide passes over

    @property
    def path(self) -> str:
        """The path of its address."""
        return f"/{self.name}"
