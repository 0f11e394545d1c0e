"""The page of the study: Markdown with its figures beside it, and HTML, one file with everything inside."""

from __future__ import annotations

import base64
import io
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from benchmarks.runner import Record, origins, table
from benchmarks.study.claims import Claim, Verdict, claims
from benchmarks.study.page_figures import FigureSpec, page_figures
from benchmarks.study.page_html import render
from benchmarks.study.plan import SECTIONS, Scale
from benchmarks.study.results import Results, finite
from benchmarks.study.sections import section_text
from benchmarks.study.words import NOTHING, bare, duration, listed
from nerif.common.files import atomic

PAPER = "[He et al., arXiv:2409.14722](https://arxiv.org/abs/2409.14722)"
VERDICTS: dict[Verdict, str] = {
    "reproduced": "✓ reproduced",
    "not reproduced": "✗ not reproduced",
    "not tested": "○ not tested",
}
PAPER_PIXELS = 200  # of an edge of each view
NOTES = (
    "**Phantoms 2 to 7 are not the paper's.** Its spray-flame data are not public. Here they are a simulated turbulent "
    "Bunsen flame at six instants 0.1 ms apart; Phantom 1 is Gaussian balls placed at random, as in the paper. Rows "
    "are comparable in kind, not number for number.",
    "**L2 is the paper's**, |n_gt − n_rec| / |n_gt − 1|. Most of n − 1 is ambient, which makes it small. The *error "
    "of the variation* divides by |n_gt − n_ambient| instead; sections without figures of the paper lead with it.",
    "**The paper ran its voxel methods without noise only**; here they are run with it, too.",
)


def write_study(path: Path, results: Results, scale: Scale, records: Sequence[Record]) -> Path:
    """Write the page at `path` (.md), its figures beside it and the page as .html, and return the last."""
    figures = page_figures(results)
    text = markdown(results, scale, records, figures)
    (path.parent / "figures").mkdir(parents=True, exist_ok=True)
    images = {}
    for spec in figures:
        name, image = f"figures/{spec.name}.svg", _svg(spec)
        _write(path.parent / name, image)
        images[name] = "data:image/svg+xml;base64," + base64.b64encode(image).decode()
    _write(path, text.encode())
    page = path.with_suffix(".html")
    _write(page, render(text, images).encode())
    return page


def markdown(
    results: Results, scale: Scale, records: Sequence[Record] = (), figures: Sequence[FigureSpec] | None = None
) -> str:
    """Return the page in Markdown; its figures are files in figures/."""
    blocks = [*_head(results, scale), *_claims(claims(results))]
    for name in results.sections:
        blocks += [f"## {SECTIONS[name]}", *section_text(name, results)]
        for spec in page_figures(results) if figures is None else figures:
            if spec.section == name:
                blocks += [f"![{spec.caption}](figures/{spec.name}.svg)", f"*{spec.caption}*"]
    left_out = [name for name in SECTIONS if name not in results.sections]
    if left_out:
        blocks += ["## Left out", f"By --only: {listed(left_out, len(left_out))}."]
    if results.failed:
        rows = [[f"{case.key}", bare(reason)] for case, reason in results.failed]
        blocks += ["## Failed reconstructions", table(["Reconstruction", "Reason"], rows)]
    keys = {case.key for case, _ in results.pairs}
    used = [record for record in records if record["settings"]["key"] in keys]
    return "\n\n".join([*blocks, *(["## Made by", origins(used, "reconstruction")] if used else [])]) + "\n"


def _head(results: Results, scale: Scale) -> list[str]:
    """Return title, number of reconstructions and settings."""
    count, failed, total = results.done, len(results.failed), len(results.pairs)
    state = f"**{count} of {total} reconstructions are done"
    state += f", {failed} failed (listed at the end)" if failed else ""
    waiting = total - count - failed
    state += f"; {waiting} are still to come and show as {NOTHING}.**" if waiting else ".**"
    seconds = sum(finite(record.get("seconds")) or 0.0 for _, record in results.pairs if record)
    steps = f", {scale.steps} steps" if scale.steps else ""
    settings = (
        f"{scale.name}: views of {scale.pixels} × {scale.pixels} px, at most {scale.seconds:g} s{steps} of training "
        f"of each NeRIF reconstruction, Tikhonov and Landweber on {scale.voxels}³ voxels, total variation on "
        f"{scale.tv_voxels}³, errors taken on {scale.truth_voxels}³"
    )
    rows = [["Scale", settings], ["Device", scale.device], ["Preset of NeRIF", scale.preset]]
    rows += [["Reconstructing took", duration(seconds)]] if seconds else []
    blocks = [
        "# The numerical study of the NeRIF paper, repeated",
        f"The results of the numerical section and Apps. A and D of {PAPER}, reconstructed with nerif from simulated "
        "measurements, with the paper's figures.",
        state,
        table(["", ""], rows),
    ]
    if scale.pixels < PAPER_PIXELS:
        text = f"Views of {scale.pixels} px and short runs: this shows that everything works. Its figures and verdicts "
        blocks.append(f"{text}are no test of the paper's, which has {PAPER_PIXELS} px.")
    return [*blocks, "\n".join(f"- {note}" for note in NOTES)]


def _claims(results: list[Claim]) -> list[str]:
    """Return the table of claims, and how many hold."""
    counts = Counter(claim.verdict for claim in results)
    parts = [f"{counts[verdict]} {verdict}" for verdict in VERDICTS if counts[verdict]]
    rows = [
        [f"{i}", VERDICTS[claim.verdict], bare(claim.text), bare(claim.paper), bare(claim.here)]
        for i, claim in enumerate(results, start=1)
    ]
    return [
        "## Claims",
        f"Of {len(results)} claims: {', '.join(parts)}. Every verdict is computed from the reconstructions below.",
        table(["", "Verdict", "Claim", "Paper", "Here"], rows),
    ]


def _svg(spec: FigureSpec) -> bytes:
    """Return a figure as SVG; letters as outlines, so that it looks the same everywhere."""
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
