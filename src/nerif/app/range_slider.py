"""A slider of the browser's own, with a label and what it stands at: keys and screen readers know it."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from html import escape
from typing import Any

from nicegui import ui

__all__ = ["RangeSlider"]


class RangeSlider:
    """A slider over whole steps, 0 to `last`.

    Parameters
    ----------
    label : for people, the unit in it
    last : highest step
    value : to begin with
    shown : text of a step
    on_change : called with the step while it is moved
    settled : called with the step when it is released
    """

    def __init__(
        self, label: str, last: int, value: int, display: Callable[[int], str],
        on_change: Callable[[int], Awaitable[None]], settled: bool = False,
    ) -> None:  # fmt: skip
        self.value, self._shown, self._label = value, display, label
        with ui.element("div").classes("slider"):
            self._text = ui.html("", sanitize=False).classes("at")
            self._input = ui.element("input").classes("range")
            self._input.props(f'type=range min=0 max={max(last, 0)} step=1 value={value} aria-label="{escape(label)}"')

        async def moved(event: Any) -> None:
            self.value = int(event.args)
            self._say()
            await on_change(self.value)

        event = "change" if settled else "input"
        self._input.on(event, moved, throttle=0.04, js_handler="(event) => emit(event.target.value)")
        self._say()

    def put(self, value: int) -> None:
        """Move it without calling on_change."""
        self.value = value
        self._input.run_method("setAttribute", "value", str(value))
        self._input.props(f"value={value}")
        self._say()

    def _say(self) -> None:
        text = self._shown(self.value)
        self._text.set_content(f"<span>{escape(self._label)}</span> <b>{escape(text)}</b>")
        self._input.props(f'aria-valuetext="{escape(text)}"')
