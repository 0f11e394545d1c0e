"""The page of a study: study.md with its figures beside it, and study.html, one file with everything inside."""

from __future__ import annotations

import base64
import io
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from nerif.common.files import atomic
from study.cases import SECTIONS, Case
from study.claim import Claim, Verdict
from study.claims import claims
from study.page_figures import FigureSpec, page_figures
from study.page_html import render
from study.results import Record, Results, finite
from study.sections import section_text
from study.words import NOTHING, bare, duration, listed, markdown_table

__all__ = ["VERDICTS", "markdown", "write_page"]

Pairs = Sequence[tuple[Case, Record | None]]

PAPER = "[He et al., arXiv:2409.14722](https://arxiv.org/abs/2409.14722)"
VERDICTS: dict[Verdict, str] = {
    "reproduced": "✓ reproduced",
    "not reproduced": "✗ not reproduced",
    "not tested": "○ not tested",
}
PAPER_PIXELS = 200  # of an edge of each view

FACTS = {
    "command": "Command",
    "device": "Device",
    "preset": "Preset of NeRIF",
}
ORIGIN = {"nerif": "nerif", "torch": "PyTorch", "machine": "Machine", "date": "Date"}
"""What a record keeps of how it was made, and its heading."""

NOTES = (
    "**Phantoms 2 to 7 are not the paper's.** Its spray-flame data are not public. Here they are a simulated turbulent "
    "Bunsen flame at six instants 0.1 ms apart; Phantom 1 is Gaussian balls placed at random, as in the paper. Rows "
    "are comparable in kind, not number for number.",
    "**L2 is the paper's**, |n_gt − n_rec| / |n_gt − 1|. Most of n − 1 is the ambient, which flatters it. The *error "
    "of the variation* divides by |n_gt − n_ambient| instead and is the honest one; sections without figures of the "
    "paper lead with it.",
    "**The paper ran its voxel methods without noise only**; here they are run with it, too.",
)


def markdown(pairs: Pairs, about: Mapping[str, Any]) -> str:
    """Return the page in Markdown; its figures are files in figures/.

    Parameters
    ----------
    pairs : every case with its record, or None where there is none yet
    about : scale, command, device, preset, pixels, truth_voxels, seconds (of training), voxels, tv_voxels, sections
        (asked for), not_used (the versions of nerif, by key, whose records are not); what is missing is left out
    """
    results = Results(tuple(pairs), tuple(about.get("sections") or SECTIONS))
    return _markdown(results, about, page_figures(results))


def write_page(folder: Path, pairs: Pairs, about: Mapping[str, Any]) -> Path:
    """Write folder/study.md, folder/figures/*.svg and folder/study.html, each atomically, and return the last."""
    results = Results(tuple(pairs), tuple(about.get("sections") or SECTIONS))
    shown = page_figures(results)
    text = _markdown(results, about, shown)
    (folder / "figures").mkdir(parents=True, exist_ok=True)
    images = {}
    for spec in shown:
        name = f"figures/{spec.name}.svg"
        image = _svg(spec)
        _write(folder / name, image)
        images[name] = "data:image/svg+xml;base64," + base64.b64encode(image).decode()
    _write(folder / "study.md", text.encode())
    page = folder / "study.html"
    _write(page, render(text, images).encode())
    return page


def _markdown(results: Results, about: Mapping[str, Any], shown: list[FigureSpec]) -> str:
    blocks = [*_head(results, about), *_claims(claims(results))]
    for name in results.sections:
        blocks += [f"## {SECTIONS[name]}", *section_text(name, results)]
        for spec in shown:
            if spec.section == name:
                blocks += [f"![{spec.caption}](figures/{spec.name}.svg)", f"*{spec.caption}*"]
    left_out = [name for name in SECTIONS if name not in results.sections]
    if left_out:
        blocks += [
            "## Left out",
            f"Not asked for by --only, and so neither run nor shown: {listed(left_out, len(left_out))}.",
        ]
    if results.failed:
        rows = [[f"{case.key}", bare(reason)] for case, reason in results.failed]
        blocks += ["## Failed reconstructions", markdown_table(["Reconstruction", "Reason"], rows, left=2)]
    return "\n\n".join([*blocks, *_origins(results)]) + "\n"


def _origins(results: Results) -> list[str]:
    """By which version, where and when each reconstruction was made; those alike in all of it share a row."""
    rows: dict[tuple[str, ...], list[str]] = {}
    for case, record in results.pairs:
        if record is not None:
            made = record.get("made", {})
            rows.setdefault(tuple(bare(made.get(name, NOTHING)) for name in ORIGIN), []).append(case.key)
    if not rows:
        return []
    cells = [[*made, f"all {len(keys)}" if len(rows) == 1 else listed(keys, len(keys))] for made, keys in rows.items()]
    return ["## Made by", markdown_table([*ORIGIN.values(), "Reconstructions"], cells, left=5)]


def _head(results: Results, about: Mapping[str, Any]) -> list[str]:
    """What this is, how far it is, and where it was computed."""
    count, failed, todo = results.done, len(results.failed), len(results.pairs)
    state = f"**{count} of {todo} reconstructions are done"
    state += f", {failed} failed (listed at the end)" if failed else ""
    waiting = todo - count - failed
    state += f"; {waiting} are still to come and show as {NOTHING}.**" if waiting else ".**"
    scale = str(about.get("scale", ""))
    rows = [["Scale", bare(f"{scale}: {_settings(about)}".strip(": "))]] if scale or _settings(about) else []
    rows += [[title, bare(about[name])] for name, title in FACTS.items() if about.get(name)]
    seconds = sum(finite(record.get("seconds")) or 0.0 for _, record in results.pairs if record)
    rows += [["Reconstructing took", duration(seconds)]] if seconds else []
    blocks = [
        "# The numerical study of the NeRIF paper, repeated",
        f"What the numerical section and Apps. A and D of {PAPER} report, reconstructed with nerif from simulated "
        "measurements; the paper's figures stand beside ours.",
        state,
        *_not_used(about.get("not_used") or {}),
        markdown_table(["", ""], rows, left=2),
    ]
    if 0 < float(about.get("pixels") or PAPER_PIXELS) < PAPER_PIXELS:
        text = (
            f"Views of {about['pixels']} px and short runs: this shows that everything works. Its figures and verdicts "
        )
        blocks.append(f"{text}are no test of the paper's, which has {PAPER_PIXELS} px.")
    return [*blocks, "\n".join(f"- {note}" for note in NOTES)]


def _not_used(versions: Mapping[str, str]) -> list[str]:
    """That there are records of other versions of nerif, which ones, and that they are made again."""
    if not versions:
        return []
    names = listed(sorted({bare(version) for version in versions.values()}))
    text = f"Made by another version of nerif ({names}) and so not used, but made again when the study goes on: "
    return [text + f"{listed(versions, len(versions))}."]


def _settings(about: Mapping[str, Any]) -> str:
    """The settings of the scale, in words."""
    form = {
        "pixels": "views of {0} × {0} px",
        "seconds": "at most {0:g} s of training of each NeRIF reconstruction",
        "steps": "at most {0} steps",
        "voxels": "Tikhonov and Landweber on {0}³ voxels",
        "tv_voxels": "total variation on {0}³",
        "truth_voxels": "errors taken on {0}³",
    }
    return ", ".join(text.format(about[name]) for name, text in form.items() if about.get(name))


def _claims(found: list[Claim]) -> list[str]:
    """The table of claims, and how many hold."""
    counts = Counter(claim.verdict for claim in found)
    parts = [f"{counts[verdict]} {verdict}" for verdict in VERDICTS if counts[verdict]]
    rows = [
        [f"{i}", VERDICTS[claim.verdict], bare(claim.text), bare(claim.paper), bare(claim.here)]
        for i, claim in enumerate(found, start=1)
    ]
    return [
        "## Claims",
        f"Of {len(found)} claims: {', '.join(parts)}. Every verdict is computed from the reconstructions below.",
        markdown_table(["", "Verdict", "Claim", "Paper", "Here"], rows, left=5),
    ]


def _svg(spec: FigureSpec) -> bytes:
    """A figure as SVG; letters as outlines, so that it looks the same everywhere."""
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    from nerif.plotting.drawing import style

    with style(size=10), mpl.rc_context({"svg.fonttype": "path", "svg.hashsalt": spec.name}):
        figure = Figure(figsize=spec.size, layout="constrained")
        FigureCanvasSVG(figure)
        spec.draw(figure)
        image = io.BytesIO()
        figure.savefig(image, format="svg", metadata={"Date": None, "Creator": None, "Title": spec.caption})
    return image.getvalue()


def _write(path: Path, content: bytes) -> None:
    with atomic(path) as part:
        part.write_bytes(content)
