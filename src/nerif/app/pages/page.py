"""A page of the app, and its hint in a demo project."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from nerif.app.project.workspace import Workspace

__all__ = ["Hint", "Page"]


@dataclass(frozen=True)
class Hint:
    """What the guide of a demo project says on a page.

    Parameters
    ----------
    purpose : what the page does
    click : what to click now
    look : what to look at then
    before : name of the page whose step must be done before; empty if there is none
    values : entries that the button fills into the forms of the page, by the key of their draft
    done : whether the output of the step is in the project; None for a step without output
    """

    purpose: str
    click: str
    look: str
    before: str = ""
    values: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    done: Callable[[Workspace], bool] | None = None


@dataclass(frozen=True)
class Page:
    """One page of the app.

    Parameters
    ----------
    name : one word, its address and the key of its draft
    title : its heading
    about : one sentence below the title
    build : builds it within the frame; a coroutine function where it waits for something
    hint : of the guide; None for a page that the guide passes over
    """

    name: str
    title: str
    about: str
    build: Callable[[Workspace], Awaitable[None] | None]
    hint: Hint | None = None

    @property
    def path(self) -> str:
        """The path of its address."""
        return f"/{self.name}"
