"""The page of a study: whole at any moment, nothing loaded from elsewhere, no figure empty."""

from __future__ import annotations

import base64
import re
from typing import Any

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.study_records import ABOUT, MADE, page, pairs, results
from nerif.plotting.drawing import style
from study.cases import QUICK, SECTIONS, Case, cases
from study.page import markdown, write_page
from study.page_figures import page_figures
from study.page_html import render

NAN = re.compile(r"\bnan\b", re.IGNORECASE)


def rows_of(text: str, heading: str) -> list[list[str]]:
    """Cells of the first table after a heading."""
    lines = text.split(f"{heading}\n")[1].split("\n")
    start = next(i for i, line in enumerate(lines) if line.startswith("| ---"))
    found = []
    for line in lines[start + 1 :]:
        if not line.startswith("|"):
            break
        found.append([cell.strip() for cell in line.strip("|").split(" | ")])
    return found


def test_every_section_is_there_with_its_labels():
    text = page()
    for heading in SECTIONS.values():
        assert f"\n## {heading}\n" in text
    for case, _ in pairs():
        for name, label in case.labels.items():
            assert label in text, name
    assert not NAN.search(text)
    assert f"**{len(pairs())} of {len(pairs())} reconstructions are done.**" in text
    assert "## Left out" not in text
    assert "## Failed" not in text


def test_cells_are_here_and_paper_and_worse_ones_are_marked():
    def change(case: Case) -> dict[str, Any]:
        return {"2-0-nerif": {"l2": 0.0050, "cc": 0.9999}, "2-0-tikhonov": {"l2": 0.0200, "cc": 0.5}}.get(case.key, {})

    text = page(change)
    second = rows_of(text, "### L2 error, |n_gt − n_rec| / |n_gt − 1|")[1]
    assert second[1] == "▲ **0.500%** (0.423%)"
    assert second[4] == "2.000% (2.761%)"
    second = rows_of(text, "### Correlation coefficient")[1]
    assert second[1] == "0.9999 (0.9944)"
    assert second[4] == "▲ **0.5000** (0.6526)"
    assert "(" not in second[6]  # the paper has no total variation


def test_what_is_not_there_yet_and_what_failed_show_as_such():
    def change(case: Case) -> dict[str, Any] | None:
        if case.key == "2-0-nerif":
            return {"failed": "ValueError: <module> | `x`"}
        return None if case.phantom == "3" else {}

    text = page(change)
    table = rows_of(text, "### Correlation coefficient")
    assert table[1][1] == "failed (0.9944)"
    assert table[2][1] == "– (0.9981)"
    assert table[2][6] == "–"
    waiting = sum(case.phantom == "3" for case, _ in pairs())
    assert f"1 failed (listed at the end); {waiting} are still to come" in text
    body = render(text, {})
    assert "<td>2-0-nerif</td>\n<td>ValueError: &lt;module&gt; | `x`</td>" in body


@pytest.mark.parametrize("name", SECTIONS)
def test_a_section_alone(name):
    found = [pair for pair in pairs() if name in pair[0].labels]
    text = markdown(found, {**ABOUT, "sections": (name,)})
    assert re.findall("^## (.*)$", text, re.MULTILINE) == ["Claims", SECTIONS[name], "Left out", "Made by"]
    assert not NAN.search(text)


@pytest.mark.parametrize("change", [lambda case: None, lambda case: {"failed": "killed"}])
def test_a_page_without_any_result_has_every_section_and_no_figure(change, tmp_path):
    write_page(tmp_path, pairs(change), ABOUT)
    text = (tmp_path / "study.md").read_text()
    assert all(f"## {heading}" in text for heading in SECTIONS.values())
    assert "![" not in text
    assert not list((tmp_path / "figures").iterdir())


def test_values_that_are_no_numbers_show_as_nothing():
    nothing = dict.fromkeys(("l2", "l2_variation", "cc", "ssim"), float("nan"))
    for value in (float("nan"), None):
        text = page(lambda case, v=value: {**dict.fromkeys(nothing, v), "loss": v, "epochs": v, "outcome": "diverged"})
        assert not NAN.search(text)
        assert "None" not in text
        assert page_figures(results(lambda case, v=value: dict.fromkeys(nothing, v))) is not None


def test_forward_models_show_where_they_are_known():
    assert "curved rays [px]" not in page()
    forward = {"lever_arm": {"rms_px": 0.00123, "relative": 0.001}, "paraxial": {"rms_px": 0.0456, "relative": 0.04}}
    text = page(lambda case: {"forward": forward} if case.key == "2-0-nerif" else {})
    assert "| lever\\_arm | 0.00123 | 0.100% |" in text
    assert "| paraxial | 0.0456 | 4.000% |" in text


@pytest.mark.slow
def test_written_page_needs_nothing_else(tmp_path):
    path = write_page(tmp_path, pairs(), ABOUT)
    assert path == tmp_path / "study.html"
    text = path.read_text()
    for address in re.findall(r'(?:src|href)="([^"]*)"', text):
        assert address.startswith(("data:image/svg+xml;base64,", "#", "https://arxiv.org/abs/2409.14722")), address[:80]
    assert "@import" not in text
    assert "url(" not in text
    assert not NAN.search(re.sub(r'src="[^"]*"', "", text))
    written = sorted(p.name for p in (tmp_path / "figures").iterdir())
    assert written == sorted(f"{spec.name}.svg" for spec in page_figures(results()))
    for image in re.findall(r"base64,([^\"]*)", text):
        assert b"<path" in base64.b64decode(image)
    for name in re.findall(r"\]\((figures/.*?)\)", (tmp_path / "study.md").read_text()):
        assert (tmp_path / name).is_file()
    assert not list(tmp_path.rglob("*.part"))
    assert text.count("<h2 ") == text.count('<li><a href="#') == 2 + len(SECTIONS)
    assert 'class="good">✓ reproduced' in text


@pytest.mark.slow
def test_every_figure_is_whole():
    """Nothing beyond the edge, a unit or a count on every axis, something drawn in every panel."""
    with style(10):
        for spec in page_figures(results()):
            figure = Figure(figsize=spec.size, layout="constrained")
            FigureCanvasAgg(figure)
            spec.draw(figure)
            figure.canvas.draw()
            box, (width, height) = figure.get_tightbbox().extents, figure.get_size_inches()
            assert box[0] > -0.01, spec.name
            assert box[1] > -0.01, spec.name
            assert box[2] < width + 0.01, spec.name
            assert box[3] < height + 0.01, spec.name
            for axes in figure.axes:
                assert axes.has_data() or axes.get_legend() or axes.get_label() == "<colorbar>", spec.name
                for words in (axes.get_xlabel(), axes.get_ylabel()):
                    known = ("phantom", "views over 180°", "epochs (passes over all rays)")
                    assert not words or words.endswith("]") or words in known, words


def test_lines_of_a_figure_can_be_told_apart():
    """No two of one panel share colour and dashes, or colour and mark."""
    with style(10):
        for spec in page_figures(results()):
            figure = Figure(figsize=spec.size, layout="constrained")
            spec.draw(figure)
            for axes in figure.axes:
                drawn = [line for line in axes.get_lines() if not str(line.get_label()).startswith("_")]
                looks = [(x.get_color(), x.get_linestyle(), x.get_marker(), x.get_markerfacecolor()) for x in drawn]
                assert len(set(looks)) == len(looks), (spec.name, looks)
                if spec.name == "speed":
                    curves = looks[: sum(x.get_linestyle() != "None" for x in drawn)]
                    assert len({look[:2] for look in curves}) == len(curves) > 7


def test_a_page_of_what_is_asked_for_by_name_has_the_cases_of_it():
    for name in SECTIONS:
        asked = cases(QUICK, (name,))
        text = markdown([(case, None) for case in asked], {**ABOUT, "sections": (name,)})
        assert f"**0 of {len(asked)} reconstructions are done" in text


def test_each_record_is_shown_with_version_date_and_machine():
    """Reconstructions made elsewhere, or by another version, stand in a row of their own."""
    heading = "## Made by"
    assert rows_of(page(), heading) == [["0.1.0", "2.6.0", "2 cores", "2025-01-02", f"all {len(pairs())}"]]
    other = {"nerif": "0.0.9", "torch": "2.5.0", "machine": "a laptop", "date": "2024-12-31"}
    found = rows_of(page(lambda case: {"made": other} if case.key == "2-0-nerif" else {}), heading)
    assert [*other.values(), "2-0-nerif"] in found
    assert [row[:4] for row in found] == [list(MADE.values()), list(other.values())]


def test_records_of_another_version_are_named_on_the_page():
    text = page(not_used={"2-0-nerif": "0.0.9", "octahedron-tikhonov": "unknown"})
    assert "Made by another version of nerif (0.0.9 and unknown) and so not used" in text
    assert "2-0-nerif and octahedron-tikhonov." in text
    assert "another version" not in page()
