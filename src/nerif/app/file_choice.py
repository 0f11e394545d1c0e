"""A choice among files of the project, which looks anew whenever it is opened."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence

from nicegui import ui

__all__ = ["FileChoice"]


class FileChoice:
    """A select, where the page is being built.

    Parameters
    ----------
    label : for people
    names : of the files that are there
    value : of them, to begin with; another one, or none, is the first
    look : looks for the names as they are now
    turned : done when another one is chosen
    """

    def __init__(
        self, label: str, names: Sequence[str], value: object, look: Callable[[], Awaitable[Sequence[str]]],
        turned: Callable[[], Awaitable[None] | None],
    ) -> None:  # fmt: skip
        first = str(value) if value in names else next(iter(names), None)
        self.select = ui.select(list(names), label=label, value=first)
        self.select.props("outlined dense options-dense").props["aria-label"] = label
        self._look = look
        self.select.on("popup-show", self.look)
        self.select.on_value_change(turned)

    @property
    def name(self) -> str:
        """The file that is chosen; empty if there is none."""
        return str(self.select.value or "")

    async def look(self) -> None:
        """See which files there are now."""
        self._take(await self._look(), self.name)

    async def choose(self, name: str) -> None:
        """Choose a file that has just been written, if it is there."""
        names = await self._look()
        self._take(names, name if name in names else self.name)

    def _take(self, names: Sequence[str], value: str) -> None:
        if list(names) != self.select.options or value != self.name:
            self.select.set_options(list(names), value=value if value in names else next(iter(names), None))
