"""Reference and flow image in the same place, changed by a button, the space key or a timer."""

from __future__ import annotations

from html import escape

from nicegui import ui

__all__ = ["Blink"]

TURN = """const b = %s.closest('.blink'); const other = b.classList.toggle('other');
b.querySelector('.current').textContent = other ? 'Flow' : 'Reference';"""
SPACE = f"(event) => {{ if (event.key === ' ') {{ event.preventDefault(); {TURN % 'event.currentTarget'} }} }}"
CLICK = f"(event) => {{ {TURN % 'event.currentTarget'} }}"
# with prefers-reduced-motion there is no timer; the button and the key remain
CLOCK = f"""(event) => {{ const me = event.currentTarget, box = me.closest('.blink');
const stop = () => {{ clearInterval(box.clock); box.clock = 0; me.setAttribute('aria-pressed', 'false'); }};
if (box.clock) {{ stop(); return; }}
if (matchMedia('(prefers-reduced-motion: reduce)').matches) {{
  box.querySelector('.calm').textContent = 'Reduced motion is set: use Change or the space key.'; return; }}
me.setAttribute('aria-pressed', 'true');
box.clock = setInterval(() => {{ if (!box.isConnected) {{ stop(); return; }}
  {TURN % "box.querySelector('.both')"} }}, 600);
}}"""


class Blink:
    """Two images in one place, added to the page under construction.

    Parameters
    ----------
    name : name of the view
    """

    def __init__(self, name: str) -> None:
        self._name = name
        with ui.element("div").classes("blink"):
            with ui.element("div").classes("both") as both:
                both.props["aria-label"] = f"Reference and flow of {name}; the space key changes between them"
                both.props("tabindex=0 role=group").on("keydown", js_handler=SPACE)
                self._images = [ui.element("img").classes(source) for source in ("reference", "flow")]
            with ui.element("div").classes("side-by-side"):
                ui.html("<b class=current aria-live=polite>Reference</b>", sanitize=False)
                change = ui.button("Change", icon="swap_horiz").props("outline no-caps dense")
                change.on("click", js_handler=CLICK)
                clock = ui.button("Blink", icon="timer").props("outline no-caps dense aria-pressed=false")
                clock.on("click", js_handler=CLOCK)
                ui.html("<span class='calm note' role=status></span>", sanitize=False)

    def show(self, reference: str, flow: str) -> None:
        """Show two images by their addresses."""
        for image, address, source in zip(self._images, (reference, flow), ("reference", "flow"), strict=True):
            image.props["src"] = address
            image.props["alt"] = f"{source.capitalize()} of {escape(self._name)}"
            image.update()
