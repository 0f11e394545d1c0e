"""Sliders: a native range input for keyboard and screen reader, and the scale of its steps."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from html import escape
from typing import Any

from nicegui import ui

from nerif.app.forms.elements import html

__all__ = ["RangeSlider", "SliderScale"]

STEPS = 400
DECADES = 1.3  # from this range on a scale is logarithmic
DIGITS = 3


class RangeSlider:
    """A slider over whole steps, 0 to `last`, with a label and the text of its value.

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
            self._output = html().classes("at")
            self._input = ui.element("input").classes("range").props("type=range min=0 step=1")
            self._input.props.update({"max": max(last, 0), "value": value, "aria-label": label})

        async def move(event: Any) -> None:
            self.value = int(event.args)
            self._show()
            await on_change(self.value)

        event = "change" if on_release else "input"
        self._input.on(event, move, throttle=0.04, js_handler="(event) => emit(event.target.value)")
        self._show()

    def put(self, value: int) -> None:
        """Set the step without a call of `on_change`."""
        self.value = value
        self._input.run_method("setAttribute", "value", str(value))
        self._input.props["value"] = value
        self._show()

    def _show(self) -> None:
        text = self._text(self.value)
        self._output.set_content(f"<span>{escape(self._label)}</span> <b>{escape(text)}</b>")
        self._input.props["aria-valuetext"] = text


@dataclass(frozen=True)
class SliderScale:
    """Steps 0 to `last` of a slider between two values, logarithmic if these span decades."""

    low: float  #: value of the left end
    high: float  #: value of the right end
    whole: bool = False  #: whether the values are whole numbers

    @property
    def last(self) -> int:
        """The highest step."""
        return round(self.high - self.low) if self.whole else STEPS

    @property
    def logarithmic(self) -> bool:
        """Whether the scale is logarithmic."""
        return not self.whole and self.low > 0 and math.log10(self.high / self.low) >= DECADES

    def value(self, step: int) -> float:
        """Return the value of a step, rounded."""
        if step in (0, self.last):
            return self.low if step == 0 else self.high
        share = step / self.last
        if self.logarithmic:
            return float(f"{self.low * (self.high / self.low) ** share:.{DIGITS}g}")
        return self.low + step if self.whole else float(f"{self.low + share * (self.high - self.low):.{DIGITS}g}")

    def step(self, value: float) -> int:
        """Return the step nearest to a value, which is clipped to the ends."""
        value = min(max(value, self.low), self.high)
        if self.logarithmic:
            return round(math.log(value / self.low) / math.log(self.high / self.low) * self.last)
        return round((value - self.low) / (self.high - self.low) * self.last)
