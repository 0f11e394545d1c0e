"""Markdown to one self-contained page: figures inside, style sheet inside, a table of contents, no network."""

from __future__ import annotations

import html
import re
from collections.abc import Mapping
from typing import Any

from markdown_it import MarkdownIt

from nerif.report.html import ASSETS

STYLE = """
body { max-width: 1240px; padding-top: 18px; }
h1 { margin: .2em 0 .5em; } h2 { margin: 2.4em 0 .5em; padding-top: .5em; border-top: 2px solid var(--line); }
p, li { max-width: 62em; } a { color: var(--accent); }
nav { background: var(--ground); border: 1px solid var(--line); border-radius: 8px; padding: 10px 16px;
  margin: 1.2em 0; }
nav b { font-size: .9rem; } nav ul { margin: .3em 0; padding-left: 1.2em; columns: 3 17em; column-gap: 2.2em;
  font-size: .92rem; }
.scroll { margin: .8em 0 1.2em; } table { margin: 0; }
th, td { text-align: left; vertical-align: top; padding: 5px 11px; }
thead th { background: var(--ground); border-bottom: 2px solid var(--line); vertical-align: bottom; }
thead th:empty { padding: 0; }
.scroll:first-of-type td:first-child { white-space: nowrap; color: var(--soft); }
#claims + p + .scroll td:nth-child(3), #claims + p + .scroll td:nth-child(5) { min-width: 20em; }
#claims + p + .scroll td:nth-child(4) { min-width: 9em; }
th.right, td.right { text-align: right; white-space: nowrap; } th.right { white-space: normal; }
td.good, td.bad, td.open { font-weight: 600; white-space: nowrap; }
td.good { color: var(--good); } td.bad { color: var(--bad); } td.open { color: var(--soft); }
td strong { color: var(--warning); }
figure { margin: 1em 0 1.6em; overflow-x: auto; }
figure img { display: block; max-width: 100%; min-width: 560px; height: auto; }
figcaption { color: var(--soft); font-size: .9rem; margin-top: .3em; }
@media (max-width: 900px) { #claims + p + .scroll td:nth-child(3) { min-width: 12em; } }
@media print { nav { display: none; } h2 { break-after: avoid; } figure, tr { break-inside: avoid; } }
"""
"""Beyond the style sheet of a report."""


def render(text: str, images: Mapping[str, str]) -> str:
    """Return the page.

    Parameters
    ----------
    text : Markdown; raw HTML in it is shown literally
    images : data: URIs by the addresses of its images
    """
    parser: Any = MarkdownIt("commonmark", {"html": False}).enable("table")
    parser.validateLink = lambda address: address.startswith(("https://arxiv.org/", "figures/"))
    tokens = parser.parse(text)
    title, contents = "", []
    for token, following in zip(tokens, [*tokens[1:], *tokens[-1:]], strict=True):
        if token.type == "heading_open":
            words = following.content
            title = title or words
            if token.tag == "h2":
                name = re.sub(r"[^a-z0-9]+", "-", words.lower()).strip("-")
                token.attrSet("id", name)
                contents.append(f'<li><a href="#{name}">{html.escape(words)}</a></li>')
        right = token.type in ("th_open", "td_open") and "right" in str(token.attrGet("style"))
        if token.type in ("th_open", "td_open"):
            token.attrs = {"class": "right"} if right else {}
        for child in token.children or []:
            if child.type == "image":
                child.attrSet("src", images.get(str(child.attrGet("src")), ""))
    body: str = parser.renderer.render(tokens, parser.options, {})
    style = (ASSETS / "report.css").read_text(encoding="utf-8") + STYLE
    return PAGE.format(title=html.escape(title), style=style, body=_dress(body, "\n".join(contents)))


def _dress(body: str, contents: str) -> str:
    """Let wide tables scroll; add captions of figures, colours of verdicts, and contents after the head."""
    body = body.replace("<table>", '<div class="scroll" tabindex="0"><table>').replace("</table>", "</table></div>")
    body = re.sub(
        r"<p>(<img [^>]*>)</p>\s*<p><em>(.*?)</em></p>", r"<figure>\1<figcaption>\2</figcaption></figure>", body
    )
    for sign, kind in (("✓", "good"), ("✗", "bad"), ("○", "open")):
        body = body.replace(f"<td>{sign} ", f'<td class="{kind}">{sign} ')
    nav = f"<nav><b>Contents</b><ul>\n{contents}\n</ul></nav>\n"
    head, first, rest = body.partition("<h2")
    return head + nav + first + rest


PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
{body}</body>
</html>
"""
