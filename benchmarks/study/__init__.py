"""The numerical study of the NeRIF paper, repeated.

The results of the numerical section and Apps. A and D of [He et al., arXiv:2409.14722](https://arxiv.org/abs/2409.14722),
reconstructed with nerif from simulated measurements, with the paper's numbers beside ours.

- **Phantoms 2 to 7 are not the paper's.** Its spray-flame data are not public. Here they are a simulated turbulent
  Bunsen flame at six instants 0.1 ms apart; Phantom 1 is Gaussian balls placed at random, as in the paper. Rows are
  comparable in kind, not number for number.
- **L2 is the paper's**, |n_gt − n_rec| / |n_gt − 1|. Most of n − 1 is ambient, which makes it small. The *error of the
  variation* divides by |n_gt − n_ambient| instead; sections without figures of the paper lead with it.
- **The paper ran its voxel methods without noise only**; here they are run with it, too.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterator
from typing import Any

from benchmarks.runner import Figure, Settings, literal, table
from benchmarks.study.claims import CLAIMS, VERDICTS
from benchmarks.study.figures import figures
from benchmarks.study.plan import FULL, QUICK, SECTIONS, Scale, study_cases
from benchmarks.study.results import Results
from benchmarks.study.running import run_case
from benchmarks.study.tables import TEXTS

SCALES = {scale.name: scale for scale in (FULL, QUICK)}
CHANGEABLE = ("pixels", "seconds", "preset", "device")


def cases(quick: bool) -> Iterator[Settings]:
    scale = QUICK if quick else FULL
    settings = {"scale": scale.name} | {name: getattr(scale, name) for name in CHANGEABLE}
    for case in study_cases(scale):
        yield {"key": case.key, "sections": " ".join(case.labels), **settings}


def scale_of(settings: Settings) -> Scale:
    """Return the scale of a case, with the changes of `--set`."""
    return dataclasses.replace(SCALES[settings["scale"]], **{name: settings[name] for name in CHANGEABLE})


def measure(folder: Any, key: str, **settings: Any) -> dict[str, Any]:
    return run_case(next(case for case in study_cases(scale_of(settings)) if case.key == key), folder)


def blocks(rows: list[dict[str, Any]]) -> Iterator[str | Figure]:
    """Yield the settings, the verdict on each claim, and the sections of which there are records."""
    scale = scale_of(rows[0])
    results = Results(rows, scale)
    failed = [[row["key"], literal(row["failed"])] for row in rows if "failed" in row]
    limits = f"{scale.seconds:g} s{f' or {scale.steps} steps' if scale.steps else ''}"
    yield (
        f"{len(rows) - len(failed)} of {len(study_cases(scale))} reconstructions. Views of {scale.pixels} × "
        f"{scale.pixels} px, NeRIF (preset {scale.preset}) for at most {limits}, Tikhonov and Landweber on "
        f"{scale.voxels}³ voxels, total variation on {scale.tv_voxels}³, errors on {scale.truth_voxels}³."
    )
    if scale.pixels < FULL.pixels:
        yield f"This shows that everything works; its verdicts are no test of the paper's, with {FULL.pixels} px."
    verdicts = [claim.judged(results) for claim in CLAIMS]
    counts = Counter(verdict for verdict, *_ in verdicts)
    yield "## Claims"
    yield f"Of {len(verdicts)} claims: {', '.join(f'{counts[v]} {v[2:]}' for v in VERDICTS.values() if counts[v])}."
    claims = [[f"{i}", *map(literal, claim)] for i, claim in enumerate(verdicts, start=1)]
    yield table(["", "Verdict", "Claim", "Paper", "Here"], claims)
    present = {section for row in rows for section in row["sections"].split()}
    for section, heading in SECTIONS.items():
        if section in present:
            yield f"## {heading}"
            yield from TEXTS[section](results)
            yield from figures(results, section)
    if failed:
        yield "## Failed reconstructions"
        yield table(["Reconstruction", "Reason"], failed)
