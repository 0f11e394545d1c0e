"""The documentation site builds without a warning, loads nothing from the web, and its links lead somewhere."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from pkgutil import resolve_name
from typing import Any
from urllib.parse import unquote

import pytest

ROOT = Path(__file__).parents[1]
PAGES = (
    "index", "tutorial", "images", "sequences", "particles", "python", "projector", "choosing", "limits", "conventions",
    "method", "pixels", "decisions/index",
    "formats", "benchmarks", "api", "contributing", "architecture", "changelog", "api/geometry", "api/reconstruction",
    "repository/benchmarks/results/methods-cpu", "repository/examples/own_data",
)  # fmt: skip
DRAWINGS = ("axes", "displacement", "volume", "lever_arm", "cone")


class Page(HTMLParser):
    """What a page loads, where it links to, and what can be linked to in it."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.links: list[str] = []
        self.ids: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attributes}
        self.ids |= {values[name] for name in ("id", "name") if name in values}
        if "src" in values:
            self.loads.append(values["src"])
        if tag == "link" and values.get("rel") not in ("index", "search", "next", "prev", "canonical"):
            self.loads.append(values.get("href", ""))
        if tag == "a" and "href" in values:
            self.links.append(values["href"])


@pytest.mark.parametrize("page", sorted(p.name for p in (ROOT / "docs" / "api").glob("*.md")))
def test_pages_of_the_api_list_what_is_there(page: str) -> None:
    names = re.findall(r"(?:auto\w+::|% modules) (\S+)", (ROOT / "docs" / "api" / page).read_text())
    assert names
    for name in names:
        resolve_name(name)


def test_every_decision_is_in_the_index():
    decisions = ROOT / "docs" / "decisions"
    index = (decisions / "index.md").read_text()
    pages = sorted(p.name for p in decisions.glob("0*.md"))
    assert pages
    assert [name for name in pages if f"({name})" not in index] == []


def build_site(folder: Path) -> Path:
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html"]
    command += ["-d", str(folder / "trees"), str(ROOT / "docs"), str(folder / "html")]
    result = subprocess.run(command, capture_output=True, text=True, timeout=900, cwd=ROOT)
    assert result.returncode == 0, result.stdout + result.stderr
    return folder / "html"


@pytest.mark.slow
def test_site_is_whole_and_loads_nothing_from_the_web(tmp_path: Path) -> None:
    """A site of `make docs` is tested instead of a new one where NERIF_SITE names its folder."""
    built = os.environ.get("NERIF_SITE")
    site = (Path(built) if built else build_site(tmp_path)).resolve()
    for name in PAGES:
        assert (site / f"{name}.html").is_file(), name
    pages = {path: path.read_text() for path in site.rglob("*.html")}
    parsed = {path: Page(text) for path, text in pages.items()}
    for path, page in parsed.items():
        for target in page.loads:
            assert not re.match(r"(https?:)?//", target), f"{path.name} loads {target}"
            file = target.split("?")[0].split("#")[0]
            assert target.startswith("data:") or (path.parent / unquote(file)).is_file(), f"{path.name}: {target}"
        assert "mathjax" not in pages[path].lower(), path.name
    for style in site.rglob("*.css"):
        assert not re.search(r"(@import|url\()\s*['\"]?(https?:)?//", style.read_text()), style.name
    for script in site.rglob("*.js"):
        text = script.read_text(encoding="utf-8")
        assert not re.search(r"(fetch|import|open|URL)\(\s*['\"`](https?:)?//", text), script.name
    assert (site / "searchindex.js").is_file()

    # links within the site, fragments included
    for path, page in parsed.items():
        for link in page.links:
            if re.match(r"[a-z]+:", link) or path.name in ("genindex.html", "search.html"):
                continue
            name, _, fragment = link.partition("#")
            target = (path.parent / unquote(name)).resolve() if name else path.resolve()
            assert target.is_file(), f"{path.name} links to {link}"
            if fragment and target in parsed:
                assert unquote(fragment) in parsed[target].ids, f"{path.name} links to {link}"

    method = pages[site / "method.html"]
    assert method.count("<math ") > 50
    assert "$" not in re.sub(r"<(script|style|title)\b.*?</\1>", "", method, flags=re.DOTALL)
    assert 'class="eqno"' in method
    for name in DRAWINGS:
        [drawing] = site.rglob(f"{name}.svg")
        assert drawing.stat().st_size > 5000
        page = {"lever_arm": "method", "cone": "pixels"}.get(name, "conventions")
        assert f"{name}.svg" in pages[site / f"{page}.html"]


def test_links_of_the_readme_lead_somewhere() -> None:
    links = re.findall(r"\]\(([^)\s]+)\)", (ROOT / "README.md").read_text())
    assert len(links) > 5
    for link in links:
        if not re.match(r"[a-z]+:", link):
            assert (ROOT / link.split("#")[0]).exists(), link


@pytest.mark.parametrize("page", sorted(p.name for p in (ROOT / "docs").glob("*.md")))
def test_links_of_a_page_lead_somewhere_on_a_forge_too(page: str) -> None:
    text = re.sub(r"^```.*?^```", "", (ROOT / "docs" / page).read_text(), flags=re.MULTILINE | re.DOTALL)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if not re.match(r"[a-z]+:", link):
            file = link.split("#")[0]
            assert not file or (ROOT / "docs" / file).exists(), link


def blocks_of(page: str) -> list[str]:
    """The blocks of Python of a page."""
    return re.findall(r"^```python\n(.*?)^```", (ROOT / "docs" / page).read_text(), flags=re.MULTILINE | re.DOTALL)


def test_the_page_of_the_projector_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, measurement: Any) -> None:
    """On fewer voxels: ten lines to a field that explains most of the data, total variation, and LSMR."""
    monkeypatch.chdir(tmp_path)
    measurement.write("m.nc")
    names: dict[str, Any] = {}
    landweber, variation, lsmr = (block.replace("range(200)", "range(40)") for block in blocks_of("projector.md"))
    assert len([line for line in landweber.splitlines() if line]) <= 11
    exec(compile(landweber.replace(", 32)", ", 12)"), "projector.md", "exec"), names)
    A, x = names["A"], names["x"]
    misfit = float((A.data - A(x)).norm() / A.data.norm())
    assert misfit < 0.4
    assert (tmp_path / "mine.vti").is_file()
    for block in (variation, lsmr):
        exec(compile(block, "projector.md", "exec"), names)
        assert float((A.data - A(names["x"].detach())).norm() / A.data.norm()) < misfit


@pytest.mark.slow
def test_the_page_of_python_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every block in order, in one namespace, as in a notebook."""
    blocks = blocks_of("python.md")
    assert len(blocks) >= 8
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for block in blocks:
        exec(compile(block, "python.md", "exec"), names)
    assert names["scores"]["cc"] > 0.9
    assert names["losses"][-1] < names["losses"][0]
    for noun in ("measurement", "result", "temperature"):
        assert "<img" in names[noun]._repr_html_()
    assert {p.name for p in tmp_path.iterdir()} >= {"flame.nc", "flame.vti", "flame_volume.nc", "truth.nc", "flame"}
    assert (tmp_path / "flame" / "report.html").is_file()
