"""A selection of one of the project's files, read from disk each time it is opened."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence

from nicegui import ui

__all__ = ["FileChoice"]


class FileChoice:
    """A select control, added to the page under construction.

    Parameters
    ----------
    label : label of the control
    names : names of the files
    value : initial name; one that is not among the names selects the first
    look : returns the current names
    on_change : called when another file is selected
    """

    def __init__(
        self, label: str, names: Sequence[str], value: object, look: Callable[[], Awaitable[Sequence[str]]],
        on_change: Callable[[], Awaitable[None] | None],
    ) -> None:  # fmt: skip
        first = str(value) if value in names else next(iter(names), None)
        self.select = ui.select(list(names), label=label, value=first)
        self.select.props("outlined dense options-dense").props["aria-label"] = label
        self._look = look
        self.select.on("popup-show", self.look)
        self.select.on_value_change(on_change)

    @property
    def name(self) -> str:
        """The selected file; empty if there is none."""
        return str(self.select.value or "")

    async def look(self) -> None:
        """Update the names from disk."""
        self._take(await self._look(), self.name)

    async def choose(self, name: str) -> None:
        """Select a file that has just been written, if it exists."""
        names = await self._look()
        self._take(names, name if name in names else self.name)

    def _take(self, names: Sequence[str], value: str) -> None:
        if list(names) != self.select.options or value != self.name:
            self.select.set_options(list(names), value=value if value in names else next(iter(names), None))
