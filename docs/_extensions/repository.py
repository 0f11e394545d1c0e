"""Links into the repository that work on a git forge and in the built site.

Pages link to files as a forge wants it, relative to themselves: ../benchmarks/results/flame-cpu.md. Where the site has
a page for the file, the link is turned to that page:

    docs/*.md                                the page itself
    README.md, CHANGELOG.md, CONTRIBUTING.md index, changelog, contributing
    benchmarks/**/*.md, examples/*.py        pages made here, in docs/repository (not under version control)
    src/nerif/**/*.py                        the module in the API reference

Any other file is offered for download. The same is done with what a page includes from README.md, say.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

LINK = re.compile(r"(!?)\[([^\]\n]*(?:\n[^\]\n]*)?)\]\(([^)\s#:]+)(#[^)\s]*)?\)")
PAGES = {"README.md": "index", "CHANGELOG.md": "changelog", "CONTRIBUTING.md": "contributing"}
PAGES |= {"benchmarks/README.md": "benchmarks"}
MODULE = "## {0}\n\n```{{eval-rst}}\n.. automodule:: {0}\n```\n"
INTERNAL = {"nerif.cli.cli", "nerif.reconstruction.voxels.kernels_numba", "nerif.reconstruction.voxels.kernels_torch"}


def api_pages(docs: Path) -> dict[str, str]:
    """The pages of the API reference by name.

    A line `% modules nerif.imaging` stands for the modules of the package that no page names, `% methods` for the table
    of the reconstruction methods.
    """
    from nerif.reconstruction.methods import METHODS

    rows = [f"| `{name}` | {kind.title} | {kind.about()} |" for name, kind in METHODS.items()]
    methods = "\n".join(["| `--method` | name | description |", "|---|---|---|", *rows])
    pages = {path.stem: path.read_text(encoding="utf-8") for path in sorted((docs / "api").glob("*.md"))}
    named = {m for text in pages.values() for m in re.findall(r"automodule:: (\S+)", text)} | INTERNAL

    def rest(match: re.Match[str]) -> str:
        folder = docs.parent / "src" / match[1].replace(".", "/")
        paths = [path for path in sorted(folder.rglob("*.py")) if not path.stem.startswith("_")]
        modules = [".".join([match[1], *path.relative_to(folder).with_suffix("").parts]) for path in paths]
        return "\n".join(MODULE.format(m) for m in modules if m not in named)

    pages = {name: text.replace("% methods", methods) for name, text in pages.items()}
    return {name: re.sub(r"^% modules (\S+)\n", rest, text, flags=re.MULTILINE) for name, text in pages.items()}


def relink(text: str, folder: Path, docs: Path, modules: set[str]) -> str:
    """Turn the links of a Markdown text that stands in `folder` to pages of the site."""
    root = docs.parent

    def turn(match: re.Match[str]) -> str:
        image, words, target, anchor = match[1], match[2], match[3], match[4] or ""
        path = Path(os.path.normpath(folder / target))
        if not path.exists() or not path.is_relative_to(root):
            return match[0]  # Sphinx says so, if it is an error
        inside = path.relative_to(root).as_posix()
        if inside.startswith("docs/"):
            return f"{image}[{words}](/{inside.removeprefix('docs/')}{anchor})"
        if PAGES.get(inside):
            return f"[{words}](/{PAGES[inside]}.md{anchor})"
        if inside == "benchmarks":
            return f"[{words}](/benchmarks.md)"
        if inside.startswith(("benchmarks/", "examples/")) and path.suffix in (".md", ".py"):
            return f"[{words}](/repository/{inside.removesuffix(path.suffix)}.md{anchor})"
        module = inside.removeprefix("src/").removesuffix(".py").replace("/", ".")
        if module in modules:
            return f"{{py:mod}}`{words.strip('`')} <{module}>`"
        return f"{image}[{words}](/{os.path.relpath(path, docs)}{anchor})"

    # not within fences
    parts = re.split(r"(^(?:```|~~~).*?^(?:```|~~~)[ ]*$)", text, flags=re.MULTILINE | re.DOTALL)
    return "".join(p if p.startswith(("```", "~~~")) else LINK.sub(turn, p) for p in parts)


def write(path: Path, text: str) -> None:
    """Write a page unless it is there already as it should be."""
    if path.is_file() and path.read_text(encoding="utf-8") == text:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(f".{os.getpid()}")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(path)


def make_pages(app: Any) -> None:
    """Write pages of what the repository has beside docs/."""
    docs = Path(app.srcdir)
    app.nerif_api = api_pages(docs)
    app.nerif_modules = modules = {
        m for text in app.nerif_api.values() for m in re.findall(r"automodule:: (\S+)", text)
    }
    root, made = docs.parent, set()

    def page(name: str, text: str) -> None:
        made.add(docs / "repository" / name)
        write(docs / "repository" / name, text)

    for path in sorted((root / "benchmarks" / "results").rglob("*.md")):
        page(path.relative_to(root).as_posix(), relink(path.read_text(encoding="utf-8"), path.parent, docs, modules))
    for path in [*sorted((root / "benchmarks").glob("[!_]*.py")), *sorted((root / "examples").glob("*.py"))]:
        inside = path.relative_to(root)
        source = f"```{{literalinclude}} /{os.path.relpath(path, docs)}\n```\n"
        page(f"{inside.with_suffix('.md')}", f"# {inside}\n\n{source}")
    for old in set((docs / "repository").rglob("*.md")) - made:
        old.unlink()


def on_source_read(app: Any, docname: str, source: list[str]) -> None:
    docs = Path(app.srcdir)
    if docname.startswith("api/"):
        source[0] = app.nerif_api[docname.removeprefix("api/")]
    if not docname.startswith("repository/"):
        source[0] = relink(source[0], (docs / docname).parent, docs, app.nerif_modules)


def on_include_read(app: Any, path: Path, parent: str, content: list[str]) -> None:
    docs = Path(app.srcdir)
    if path.suffix == ".md":
        content[0] = relink(content[0], Path(os.path.normpath(docs / path.parent)), docs, app.nerif_modules)


def forget_builtins(app: Any) -> list[tuple[str, dict[str, Any], str]]:
    """Leave Python's own types, of which names such as Region are aliases, out of the list of sources."""
    getattr(app.env, "_viewcode_modules", {}).pop("builtins", None)
    return []


def setup(app: Any) -> dict[str, bool]:
    app.connect("html-collect-pages", forget_builtins, priority=400)  # before viewcode's
    app.connect("builder-inited", make_pages)
    app.connect("source-read", on_source_read)
    app.connect("include-read", on_include_read)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
