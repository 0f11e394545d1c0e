"""Elements that several pages use."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from html import escape
from typing import Any

from nicegui import ui

from nerif.common.conventions import InputError
from nerif.common.installation import quoted

__all__ = [
    "CommandLine", "FileChoice", "card", "dialog", "figures", "html", "image", "images_html", "items_html", "refusals",
    "select", "table_html", "text_field", "text_html",
]  # fmt: skip

DEFAULTS: dict[type[ui.element], str] = {
    ui.button: "no-caps", ui.tabs: "no-caps", ui.toggle: "no-caps", ui.select: "outlined dense options-dense",
    ui.input: "outlined dense debounce=250", ui.number: "outlined dense debounce=250",
}  # fmt: skip
for kind, properties in DEFAULTS.items():
    kind.default_props(properties)


def html(content: str = "", tag: str = "div") -> ui.html:
    """Build an element with HTML in which texts of others are escaped."""
    return ui.html(content, sanitize=False, tag=tag)


def image(address: str = "", text: str = "") -> ui.element:
    """Build an image with its text for screen readers."""
    element = ui.element("img")
    element.props.update({"src": address, "alt": text} if address else {"alt": text})
    return element


def text_field(label: str, value: str) -> ui.input:
    """Build a field for one line of text."""
    control = ui.input(label, value=value)
    control.props["aria-label"] = label
    return control


@contextmanager
def card(title: str, note: str = "") -> Iterator[ui.element]:
    """Build a framed section with a second-level heading."""
    with ui.element("section").classes("card") as section:
        section.props["aria-label"] = title
        html(f"<h2>{escape(title)}</h2>" + (f"<p class=note>{escape(note)}</p>" if note else ""))
        yield section


def text_html(text: str, tag: str = "p", classes: str = "") -> ui.html:
    """Build an element with escaped text."""
    return html(f'<{tag} class="{escape(classes)}">{escape(text)}</{tag}>')


def figures(rows: Sequence[tuple[str, str, str]]) -> str:
    """Return a list of names, values and remarks as HTML."""
    lines = (f"<div><dt>{escape(a)}</dt><dd>{escape(b)}<small>{escape(c)}</small></dd></div>" for a, b, c in rows)
    return f"<dl class=figures>{''.join(lines)}</dl>"


def items_html(items: Sequence[str], classes: str = "notes", label: str = "") -> str:
    """Return a list of texts as HTML, empty if there are none."""
    name = f' aria-label="{escape(label)}"' if label else ""
    lines = "".join(f"<li>{escape(text)}</li>" for text in items)
    return f'<ul class="{classes}"{name}>{lines}</ul>' if lines else ""


def table_html(label: str, head: Sequence[str], rows: Mapping[str, Sequence[str]]) -> str:
    """Return a table as HTML: the rows by their names, which are the first column."""
    lines = (
        f"<tr><th scope=row>{escape(name)}</th>{''.join(f'<td>{escape(cell)}</td>' for cell in cells)}</tr>"
        for name, cells in rows.items()
    )
    titles = "".join(f"<th scope=col>{escape(title)}</th>" for title in head)
    table = f"<table><thead><tr>{titles}</tr></thead><tbody>{''.join(lines)}</tbody></table>"
    return f'<div class=tabled tabindex=0 role=region aria-label="{escape(label)}">{table}</div>'


def images_html(images: Sequence[tuple[str, str, str]]) -> str:
    """Return a row of images as HTML: address, text for screen readers, caption."""
    figures = (
        f'<figure><img src="{address}" alt="{escape(text)}"><figcaption>{escape(caption)}</figcaption></figure>'
        for address, text, caption in images
    )
    return f"<div class=images>{''.join(figures)}</div>"


@contextmanager
def dialog(classes: str = "") -> Iterator[None]:
    """Build and open a dialog with a button that closes it."""
    with ui.dialog(value=True) as box, ui.card().classes(classes):
        yield
        ui.button("Close", on_click=box.close).props("flat")


def select(label: str, options: Any, value: Any = None) -> ui.select:
    """Build a choice between options, a list or texts by their values; another value selects the first."""
    first = value if value in list(options) else next(iter(options), None)
    control = ui.select(options, label=label, value=first)
    control.props["aria-label"] = label
    return control


class FileChoice:
    """A choice of one of the project's files, read from disk each time it is opened.

    Parameters
    ----------
    label : label of the control
    names : names of the files
    value : initial name; one that is not among the names selects the first
    look_up : returns the current names
    on_change : called when another file is selected
    """

    def __init__(
        self, label: str, names: Sequence[str], value: object, look_up: Callable[[], Awaitable[Sequence[str]]],
        on_change: Callable[[], Awaitable[None] | None],
    ) -> None:  # fmt: skip
        self.select, self._look_up = select(label, list(names), value), look_up
        self.select.on("popup-show", lambda: self.choose(self.name))
        self.select.on_value_change(on_change)

    @property
    def name(self) -> str:
        """The selected file; empty if there is none."""
        return str(self.select.value or "")

    async def choose(self, name: str) -> None:
        """Select one of the present files; another name changes nothing."""
        names = list(await self._look_up())
        value = next((n for n in (name, self.name) if n in names), next(iter(names), None))
        if names != self.select.options or value != self.select.value:
            self.select.set_options(names, value=value)


class CommandLine:
    """Command line of the page's settings, with a button that copies it."""

    def __init__(self) -> None:
        with ui.element("div").classes("command").props('role="group" aria-label="Command line"'):
            self._text = html().classes("line")
            button = ui.button("Copy", icon="content_copy").props('flat dense aria-label="Copy the command line"')
            button.on("click", js_handler=COPY)

    def show(self, arguments: Sequence[str]) -> None:
        """Show the command line of these arguments."""
        words = (f"<span>{escape(quoted(word))}</span>" for word in ("nerif", *arguments))  # lines break between them
        self._text.set_content(f"<code tabindex=0>{' '.join(words)}</code>")


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
