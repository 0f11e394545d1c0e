"""Reference against flow in one place: the one or the other by a button or the space key, or in turn by a clock."""

from __future__ import annotations

from html import escape

from nicegui import ui

__all__ = ["Blink"]

TURN = """const b = %s.closest('.blink'); const other = b.classList.toggle('other');
b.querySelector('.said').textContent = other ? 'Flow' : 'Reference';"""
SPACE = f"(event) => {{ if (event.key === ' ') {{ event.preventDefault(); {TURN % 'event.currentTarget'} }} }}"
CLICK = f"(event) => {{ {TURN % 'event.currentTarget'} }}"
# a browser that is asked for less motion has no clock: the button and the key are left
CLOCK = f"""(event) => {{ const me = event.currentTarget, box = me.closest('.blink');
const stop = () => {{ clearInterval(box.clock); box.clock = 0; me.setAttribute('aria-pressed', 'false'); }};
if (box.clock) {{ stop(); return; }}
if (matchMedia('(prefers-reduced-motion: reduce)').matches) {{
  box.querySelector('.calm').textContent = 'This browser asks for less motion: use Change or the space key.'; return; }}
me.setAttribute('aria-pressed', 'true');
box.clock = setInterval(() => {{ if (!box.isConnected) {{ stop(); return; }}
  {TURN % "box.querySelector('.both')"} }}, 600);
}}"""


class Blink:
    """Two images on each other, where the page is being built.

    Parameters
    ----------
    name : of the view
    """

    def __init__(self, name: str) -> None:
        self._name = name
        with ui.element("div").classes("blink"):
            with ui.element("div").classes("both") as both:
                both.props["aria-label"] = f"Reference and flow of {name}; the space key changes between them"
                both.props("tabindex=0 role=group").on("keydown", js_handler=SPACE)
                self._images = [ui.element("img").classes(source) for source in ("reference", "flow")]
            with ui.element("div").classes("side-by-side"):
                ui.html("<b class=said aria-live=polite>Reference</b>", sanitize=False)
                change = ui.button("Change", icon="swap_horiz").props("outline no-caps dense")
                change.on("click", js_handler=CLICK)
                clock = ui.button("Blink", icon="timer").props("outline no-caps dense aria-pressed=false")
                clock.on("click", js_handler=CLOCK)
                ui.html("<span class='calm note' role=status></span>", sanitize=False)

    def show(self, reference: str, flow: str) -> None:
        """Show these, given as addresses."""
        for image, address, source in zip(self._images, (reference, flow), ("reference", "flow"), strict=True):
            image.props["src"] = address
            image.props["alt"] = f"{source.capitalize()} of {escape(self._name)}"
            image.update()
