"""Docstrings as they are written here, to reStructuredText.

They are prose, indented formulas in plain characters, and sections of lines `name : shape and unit`; no markup. So what
reStructuredText would take for markup (|x|, x_i, *) is escaped, and formulas are kept as they stand.
"""

from __future__ import annotations

import re
from typing import Any

from sphinx import addnodes

LONGEST_VALUE = 60  # characters
RULE = re.compile(r"-{3,}\s*")
ENTRY = re.compile(r"(\*{0,2}\w[\w, .*\[\]]*) : (.*)")
NUMBERED = re.compile(r"(\d+\.) +")


def escape(text: str) -> str:
    """Escape what is markup, keep `code`."""
    parts = re.split(r"(``[^`]+``|`[^`]+`)", text)
    return "".join(
        f"``{p.strip('`')}``" if p.startswith("`") and len(p) > 2 else re.sub(r"([\\*_|`])", r"\\\1", p) for p in parts
    )


def blocks(lines: list[str]) -> list[list[str]]:
    """Split at empty lines, and where the indentation of a formula begins or ends."""
    found: list[list[str]] = [[]]
    for line in lines:
        if not line.strip():
            found.append([])
            continue
        if found[-1] and line.startswith("    ") != found[-1][-1].startswith("    ") and not RULE.match(found[-1][-1]):
            found.append([])
        found[-1].append(line)
    return [b for b in found if b]


def prose(lines: list[str]) -> list[str]:
    """A paragraph, a numbered list, or a formula."""
    if all(line.startswith("    ") for line in lines) or any(re.search(r"\S {3,}\S", line) for line in lines):
        return [".. code-block:: text", "", *("    " + line for line in lines), ""]
    if NUMBERED.match(lines[0]):
        items: list[str] = []
        for line in lines:
            if NUMBERED.match(line):
                items.append(line)
            else:
                items[-1] += " " + line.strip()
        return [*(escape(item) for item in items), ""]
    return [escape(" ".join(line.strip() for line in lines)), ""]


def section(name: str, lines: list[str]) -> list[str]:
    """The entries of a section, as a field."""
    entries: list[list[str]] = []
    for line in lines:
        if line.startswith(" ") and entries:
            entries[-1].append(line.strip())
        else:
            entries.append([line.strip()])
    out = [f":{name}:"]
    for first, *rest in entries:
        match = ENTRY.fullmatch(first)
        if match:
            text = f"**{escape(match[1])}** – {escape(' '.join([match[2], *rest]))}"
        elif name == "Raises":
            text = f"**{escape(first)}** – {escape(' '.join(rest))}"
        else:
            text = escape(" ".join([first, *rest]))
        out.append(f"    * {text}" if len(entries) > 1 else f"    {text}")
    return [*out, ""]


def to_rst(lines: list[str]) -> list[str]:
    """Convert a docstring."""
    out: list[str] = []
    i = 0
    while i < len(lines):
        if i + 1 < len(lines) and lines[i].strip() and RULE.fullmatch(lines[i + 1]):
            name, i, body = lines[i].strip(), i + 2, []
            while i < len(lines) and lines[i].strip():
                body.append(lines[i])
                i += 1
            out += section(name, body)
            continue
        body = []
        while i < len(lines) and not (i + 1 < len(lines) and RULE.fullmatch(lines[i + 1])):
            body.append(lines[i])
            i += 1
        for block in blocks(body):
            out += prose(block)
    return out


def process(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    lines[:] = to_rst(lines)


def process_signature(
    app: Any, what: str, name: str, obj: Any, options: Any, signature: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    """Write a default that is made anew each time as ..., which Sphinx can parse."""
    return (signature.replace("<factory>", "...") if signature else signature), returns


def hide_long_values(app: Any, domain: str, kind: str, content: addnodes.desc_content) -> None:
    """Leave out values that tell nobody anything: long ones, and addresses of functions."""
    for value in content.parent.findall(addnodes.desc_annotation):
        text = value.astext()
        if text.lstrip().startswith("=") and (len(text) > LONGEST_VALUE or " at 0x" in text):
            value.parent.remove(value)


def setup(app: Any) -> dict[str, bool]:
    app.connect("autodoc-process-docstring", process)
    app.connect("autodoc-process-signature", process_signature)
    app.connect("object-description-transform", hide_long_values)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
