"""Formulas as MathML, converted from LaTeX when the site is built, so that a page loads nothing to show them.

latex2mathml passes on what it does not know; here that is a warning, and with `-W` an error.
"""

from __future__ import annotations

import re
from typing import Any

from docutils import nodes
from sphinx.util import logging
from sphinx.util.math import get_node_equation_number

logger = logging.getLogger(__name__)

BOLD = {chr(ord(first) + i): chr(code + i) for first, code in (("a", 0x1D41A), ("A", 0x1D400)) for i in range(26)}


def to_mathml(latex: str, display: str, node: nodes.Node | None = None) -> str:
    """Convert a formula; `display` is "inline" or "block"."""
    from latex2mathml.converter import convert

    # upright words; \mathrm of one letter would come out slanted
    mathml = convert(re.sub(r"\\(?:mathrm|operatorname)(?=\{)", r"\\text", latex.strip()), display=display)
    if re.search(r"\\|&(?!#?\w+;)", mathml):
        logger.warning("formula that latex2mathml cannot convert: %s", latex, location=node)
    # browsers know the alphabets of Unicode, no longer this attribute
    mathml = re.sub(r'<mi mathvariant="bold">(\w)</mi>', lambda m: f"<mi>{BOLD.get(m[1], m[1])}</mi>", mathml)
    left = re.search(r'mathvariant="(?!normal)[^"]*"', mathml)
    if left:
        logger.warning("formula with %s, which browsers ignore: %s", left[0], latex, location=node)
    return mathml


def visit_math(self: Any, node: nodes.math) -> None:
    self.body.append(to_mathml(node.astext(), "inline", node) + "&#8288;")  # no line break before a comma
    raise nodes.SkipNode


def visit_math_block(self: Any, node: nodes.math_block) -> None:
    identifier = f' id="{node["ids"][0]}"' if node.get("ids") else ""
    self.body.append(f'<div class="math"{identifier}>{to_mathml(node.astext(), "block", node)}')
    if node.get("number"):
        number = get_node_equation_number(self, node)
        self.body.append(f'<span class="eqno">({number})</span>')
        self.add_permalink_ref(node, "Link to this equation")
    self.body.append("</div>\n")
    raise nodes.SkipNode


def setup(app: Any) -> dict[str, bool]:
    app.add_html_math_renderer("mathml", (visit_math, None), (visit_math_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
