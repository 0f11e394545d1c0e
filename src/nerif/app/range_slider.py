"""A native range input with a label and the text of its value, for keyboard and screen reader."""

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
    label : label, with the unit
    last : highest step
    value : initial step
    text : text of a step
    on_change : called with the new step
    on_release : whether it is called only when the slider is released
    """

    def __init__(
        self, label: str, last: int, value: int, text: Callable[[int], str],
        on_change: Callable[[int], Awaitable[None]], on_release: bool = False,
    ) -> None:  # fmt: skip
        self.value, self._text, self._label = value, text, label
        with ui.element("div").classes("slider"):
            self._output = ui.html("", sanitize=False).classes("at")
            self._input = ui.element("input").classes("range")
            self._input.props(f'type=range min=0 max={max(last, 0)} step=1 value={value} aria-label="{escape(label)}"')

        async def moved(event: Any) -> None:
            self.value = int(event.args)
            self._show()
            await on_change(self.value)

        event = "change" if on_release else "input"
        self._input.on(event, moved, throttle=0.04, js_handler="(event) => emit(event.target.value)")
        self._show()

    def put(self, value: int) -> None:
        """Set the step without a call of `on_change`."""
        self.value = value
        self._input.run_method("setAttribute", "value", str(value))
        self._input.props(f"value={value}")
        self._show()

    def _show(self) -> None:
        text = self._text(self.value)
        self._output.set_content(f"<span>{escape(self._label)}</span> <b>{escape(text)}</b>")
        self._input.props(f'aria-valuetext="{escape(text)}"')
