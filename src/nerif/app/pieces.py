"""Elements that several pages use."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from html import escape

from nicegui import ui

from nerif.app.jobs import command_line
from nerif.common.conventions import InputError

__all__ = ["CommandLine", "card", "figures", "refusals", "text_html"]


@contextmanager
def card(title: str, note: str = "") -> Iterator[ui.element]:
    """Build a framed section with a second-level heading."""
    with ui.element("section").classes("card").props(f'aria-label="{escape(title)}"') as section:
        ui.html(f"<h2>{escape(title)}</h2>" + (f"<p class=note>{escape(note)}</p>" if note else ""), sanitize=False)
        yield section


def text_html(text: str, tag: str = "p", classes: str = "") -> ui.html:
    """Build an element with escaped text."""
    return ui.html(f'<{tag} class="{escape(classes)}">{escape(text)}</{tag}>', sanitize=False)


def figures(rows: Sequence[tuple[str, str, str]]) -> str:
    """Return a list of names, values and remarks as HTML."""
    lines = (f"<div><dt>{escape(a)}</dt><dd>{escape(b)}<small>{escape(c)}</small></dd></div>" for a, b, c in rows)
    return f"<dl class=figures>{''.join(lines)}</dl>"


class CommandLine:
    """Command line of the page's settings, with a button that copies it."""

    def __init__(self) -> None:
        with ui.element("div").classes("command").props('role="group" aria-label="Command line"'):
            self._text = ui.html("", sanitize=False).classes("line")
            button = ui.button("Copy", icon="content_copy")
            button.props('flat no-caps dense aria-label="Copy the command line"')
            button.on("click", js_handler=COPY)
        self.line = ""

    def show(self, arguments: Sequence[str]) -> None:
        """Show the command line of these arguments."""
        self.line = command_line(arguments)
        self._text.set_content(f"<code tabindex=0>{escape(self.line)}</code>")


# browsers offer navigator.clipboard over TLS or on localhost only; elsewhere execCommand copies
COPY = """(event) => {
  const text = event.currentTarget.closest('.command').querySelector('code').textContent;
  const label = event.currentTarget.querySelector('.block') || event.currentTarget;
  const old = () => { const a = document.createElement('textarea'); a.value = text; document.body.append(a); a.select();
    document.execCommand('copy'); a.remove(); };
  (navigator.clipboard ? navigator.clipboard.writeText(text).catch(old) : Promise.resolve(old())).then(() => {
    const before = label.textContent; label.textContent = 'Copied';
    setTimeout(() => { label.textContent = before }, 1500); });
}"""


@contextmanager
def refusals(say: Callable[[str], None] | None = None) -> Iterator[None]:
    """Report an InputError or OSError of the block by `say`, by default as a notification."""
    try:
        yield
    except InputError as error:
        message = str(error)
    except OSError as error:
        message = f"{error.filename or 'file'}: {error.strerror or error}"
    else:
        return
    (say or (lambda text: ui.notify(text, type="negative", timeout=10_000, close_button="Close")))(message)
