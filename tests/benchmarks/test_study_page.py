"""The page of a study: whole at any moment, nothing loaded from elsewhere, no figure empty."""

from __future__ import annotations

import base64
import re
from typing import Any

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks import runner, study
from benchmarks.study.page import markdown, write_study
from benchmarks.study.page_figures import page_figures
from benchmarks.study.page_html import render
from benchmarks.study.plan import FULL, QUICK, SECTIONS, Case, study_cases
from benchmarks.study.results import Results
from nerif.plotting.drawing import style
from tests.benchmarks.study_records import ORIGIN, page, pairs, record, records, results

NAN = re.compile(r"\bnan\b", re.IGNORECASE)


def rows_of(text: str, heading: str) -> list[list[str]]:
    """Cells of the first table after a heading."""
    lines = text.split(f"{heading}\n")[1].split("\n")
    start = next(i for i, line in enumerate(lines) if line.startswith("| ---"))
    rows = []
    for line in lines[start + 1 :]:
        if not line.startswith("|"):
            break
        rows.append([cell.strip() for cell in line.strip("|").split(" | ")])
    return rows


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
    text = markdown(Results(tuple(pair for pair in pairs() if name in pair[0].labels), (name,)), FULL, records())
    assert re.findall("^## (.*)$", text, re.MULTILINE) == ["Claims", SECTIONS[name], "Left out", "Made by"]
    assert not NAN.search(text)


@pytest.mark.parametrize("change", [lambda case: None, lambda case: {"failed": "killed"}])
def test_a_page_without_any_result_has_every_section_and_no_figure(change, tmp_path):
    write_study(tmp_path / "study.md", results(change), QUICK, [])
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


def test_forward_models_are_on_the_page():
    assert "curved rays [px]" not in page()
    forward = {"lever_arm": {"rms_px": 0.00123, "relative": 0.001}, "paraxial": {"rms_px": 0.0456, "relative": 0.04}}
    text = page(lambda case: {"forward": forward} if case.key == "2-0-nerif" else {})
    assert "| lever\\_arm | 0.00123 | 0.100% |" in text
    assert "| paraxial | 0.0456 | 4.000% |" in text


@pytest.mark.slow
def test_written_page_needs_nothing_else(tmp_path):
    path = write_study(tmp_path / "study.md", results(), QUICK, records())
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
                    labels = ("phantom", "views over 180°", "epochs (passes over all rays)")
                    assert not words or words.endswith("]") or words in labels, words


def test_lines_of_a_figure_differ():
    """No two of one panel share colour and dashes, or colour and mark."""
    with style(10):
        for spec in page_figures(results()):
            figure = Figure(figsize=spec.size, layout="constrained")
            spec.draw(figure)
            for axes in figure.axes:
                lines = [line for line in axes.get_lines() if not str(line.get_label()).startswith("_")]
                looks = [(x.get_color(), x.get_linestyle(), x.get_marker(), x.get_markerfacecolor()) for x in lines]
                assert len(set(looks)) == len(looks), (spec.name, looks)
                if spec.name == "speed":
                    curves = looks[: sum(x.get_linestyle() != "None" for x in lines)]
                    assert len({look[:2] for look in curves}) == len(curves) > 7


def test_reconstructions_are_counted_and_their_origin_is_a_table():
    """Origins that differ, such as another machine or version, stand in rows of their own."""
    cases = study_cases(QUICK)
    assert f"**0 of {len(cases)} reconstructions are done" in markdown(Results(tuple((c, None) for c in cases)), QUICK)
    heading = "## Made by"
    assert rows_of(page(), heading) == [[*ORIGIN.values(), f"all {len(pairs())}"]]
    other = {**records()[0], "commit": "def", "nerif": "0.0.9"}
    text = markdown(results(), QUICK, [other, *records()[1:]])
    assert rows_of(text, heading)[0] == ["def", "0.0.9", *list(ORIGIN.values())[2:], other["settings"]["key"]]
    assert len(rows_of(text, heading)) == 2


def test_the_sections_of_a_page_are_those_whose_cases_are_there():
    settings = [case for case in study.cases(True) if "sampling" in case["sections"].split()]
    row = {**record(study_cases(QUICK)[0]), "seconds": 3.0}
    made = [
        {"settings": settings[0], **ORIGIN, "metrics": row},
        {"settings": settings[1], **ORIGIN, "failed": "killed"},
    ]
    outcome = study.results_of(settings, made)
    assert outcome.sections == ("sampling",)
    assert (outcome.done, len(outcome.failed), len(outcome.pairs)) == (1, 1, 3)
    assert outcome.rows("sampling")[0][2]["metrics"]["l2"] == row["metrics"]["l2"]
    assert study.blocks(runner.rows_of(made))[1].startswith("1 of 2 reconstructions")


def test_changes_of_settings_reach_the_cases():
    (settings, *_) = runner.select(study, True, changes={"pixels": 12, "device": "cpu"})
    assert study.scale_of(settings).pixels == 12
    assert study_cases(study.scale_of(settings))[0].ring.image_size == (12, 12)
