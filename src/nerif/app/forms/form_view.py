"""A form on a page: a control for each setting, with its help and its error."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from html import escape
from pathlib import Path
from typing import Any, Generic, TypeVar

from nicegui import ui

from nerif.app.forms.elements import html
from nerif.app.forms.form import Form, default_of, label_of, unit_of
from nerif.app.forms.sliders import SliderScale
from nerif.common.conventions import InputError
from nerif.common.settings import Option, converted

__all__ = ["FormView"]

T = TypeVar("T")


class FormView(Generic[T]):
    """Controls of a form, added to the page under construction.

    Parameters
    ----------
    form : fields and record of the settings
    on_change : called after each change, also to invalid values
    values : initial values by field; defaults for the others
    main : names of the fields at the top; the others are under "More settings". Empty: all
    sliders : lowest and highest value by name, for fields with a slider beside the number
    """

    def __init__(
        self,
        form: Form[T],
        on_change: Callable[[], None],
        values: Mapping[str, Any] | None = None,
        main: Sequence[str] = (),
        sliders: Mapping[str, tuple[float, float]] | None = None,
    ) -> None:
        self.form, self.on_change, self.sliders = form, on_change, dict(sliders or {})
        self.values: dict[str, Any] = dict(values or {})
        self.errors: dict[str, str] = {}
        self._controls: dict[str, Any] = {}
        self._messages: dict[str, ui.html] = {}
        names = [f.name for f in form.fields]
        for name in main or names:
            self._control(form.field(name))
        rest = [name for name in names if main and name not in main]
        if rest:
            self._more(rest)
        self.check()

    # -- values --------------------------------------------------------------------------------------------------

    @property
    def arguments(self) -> list[str]:
        """Arguments of nerif for the values of the form."""
        return self.form.arguments(self.values)

    @property
    def valid(self) -> bool:
        """Whether all values are valid."""
        return not self.errors

    def record(self) -> T:
        """Return the record; InputError if a value is invalid."""
        return self.form.build(self.values)

    def set(self, name: str, value: Any) -> None:
        """Set a value as by its control."""
        if name in self._controls:
            self._controls[name].set_value(_control_value(self.form.field(name), value))
        else:
            self._set_value(self.form.field(name), value)

    def check(self) -> None:
        """Show the error of each field."""
        self.errors = self.form.errors(self.values)
        for name, message in self._messages.items():
            error = self.errors.get(name, "")
            message.set_content(f"<span role=alert>{escape(error)}</span>" if error else "")
            self._controls[name].props["aria-invalid"] = "true" if error else "false"
            self._controls[name].classes(**{"add" if error else "remove": "wrong"})

    # -- controls ------------------------------------------------------------------------------------------------

    def _more(self, names: Sequence[str]) -> None:
        with ui.expansion("More settings", icon="tune").classes("more") as more:
            place = ui.element("div").classes("form")

        def fill() -> None:
            if more.value and not place.default_slot.children:
                with place:
                    for name in names:
                        self._control(self.form.field(name))
                self.check()

        more.on_value_change(fill)

    def _control(self, field: Option) -> None:
        value = self.values.get(field.name, default_of(field))
        with ui.element("div").classes("field"):
            control = self._control_of(field, _control_value(field, value))
            unit = unit_of(field)
            label = label_of(field) + (f" ({unit})" if unit else "")
            control.props["name"], control.props["aria-label"] = field.name, label
            control.on_value_change(lambda event: self._set_value(field, _record_value(field, event.value)))
            self._controls[field.name] = control
            if field.name in self.sliders:
                self._slider(field, control, f"{label}, slider")
            self._messages[field.name] = html().classes("error")
            if field.help:
                html(f"<p>{escape(field.help)}</p>").classes("help")

    def _slider(self, field: Option, control: Any, label: str) -> None:
        """Add a slider of the browser, which has keys and screen reader support."""
        scale = SliderScale(*self.sliders[field.name], whole=field.kind == "integer")
        slider = ui.element("input").classes("range").props("type=range min=0 step=1")
        slider.props["max"], slider.props["aria-label"] = scale.last, label
        position: list[float] = []

        def move(event: Any) -> None:
            position[:] = [scale.value(int(event.args))]
            control.set_value(position[0])

        def follow() -> None:
            value = control.value
            if not isinstance(value, int | float):
                return
            slider.props["aria-valuetext"] = f"{value:g} {unit_of(field)}"
            if [value] != position:  # not while the slider is moved
                slider.props["value"] = scale.step(value)

        slider.on("input", move, throttle=0.05, js_handler="(event) => emit(event.target.value)")
        control.on_value_change(follow)
        follow()

    def _control_of(self, field: Option, value: Any) -> Any:
        """Return the control for the kind of the field."""
        label, unit = label_of(field), unit_of(field) or None
        if field.kind == "switch":
            return ui.switch(label, value=bool(value))
        if field.kind == "choice":
            return ui.select(list(field.choices), label=label, value=value, clearable=field.optional)
        if field.kind in ("number", "integer"):
            return ui.number(label, value=value, suffix=unit).props('debounce=150 step="any"')
        return ui.input(label, value=value, suffix=unit)

    def _set_value(self, field: Option, value: Any) -> None:
        if self.values.get(field.name, default_of(field)) == value:
            return
        self.values[field.name] = value
        self.check()
        self.on_change()


def _control_value(field: Option, value: Any) -> Any:
    """Return the value of a field in the form of its control."""
    if field.kind == "words":
        return " ".join(f"{v:g}" if isinstance(v, float) else str(v) for v in value or ())
    return ("" if value is None else str(value)) if field.kind == "text" else value


def _record_value(field: Option, value: Any) -> Any:
    """Return the value of a control in the type of the record, which rejects invalid input."""
    if field.kind == "words":
        value = str(value or "").replace(",", " ").split()
    elif field.kind == "text":
        value = str(value or "").strip()
    if field.optional and not value and field.kind in ("words", "text"):
        return None
    with suppress(InputError):
        result = converted(field.hint, value, field.name)
        return value if isinstance(result, Path) else result  # drafts are JSON
    return value
