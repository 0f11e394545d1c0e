"""Plain English: words that no text of the project uses, and participles that are no names."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
WORDS = """\\btold|\\basked|\\bis met|\\bare met|goes? by\\b|what (is|was) (found|left|seen|known)|next to nothing
|nothing odd|is odd|\\bwish|\\banew|whoever|likewise|\\bsome \\d+ %|kept out|held[ -]out|first look|glance
|picture|as it is given|no sign\\b|(?<!cannot )\\btells?\\b|\\bsays? so|by itself|\\bmend(s|ed)?\\b|so many|\\balike\\b
|\\bsomebody\\b|what came\\b|an eye on|of its own accord"""
NAMES = "found seen kept own told asked known given said shown chosen drawn held meant taken".split()  # noqa: SIM905
FOLDERS = "src", "examples", "benchmarks", "paper", "tests"
SOURCES = sorted(p for folder in FOLDERS for p in (ROOT / folder).rglob("*.py") if p != Path(__file__))
DOCS = [p for p in (ROOT / "docs").rglob("*.md") if not {"repository", "_build"} & {*p.parts}]  # made by Sphinx
PAGES = sorted([*ROOT.glob("*.md"), *DOCS, ROOT / "benchmarks" / "README.md", ROOT / "paper" / "paper.md"])


@pytest.mark.parametrize("path", [*SOURCES, *PAGES], ids=lambda path: str(path.relative_to(ROOT)))
def test_texts_are_plain_and_names_are_nouns(path: Path) -> None:
    text = path.read_text()
    names: set[str] = set()
    if path.suffix == ".py":
        nodes = list(ast.walk(ast.parse(text)))
        text = "\n".join(n.value for n in nodes if isinstance(n, ast.Constant) and isinstance(n.value, str))
        names = {str(getattr(n, a)) for n in nodes for a in ("id", "arg", "name", "attr") if hasattr(n, a)}
        text += "\n".join(name.replace("_", " ") for name in names if name.startswith("test_"))
    assert not re.findall(WORDS.replace("\n", ""), text, re.IGNORECASE)
    assert not names & set(NAMES)
