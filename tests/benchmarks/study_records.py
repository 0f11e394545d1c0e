"""Synthetic records of the study."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any

from benchmarks.study.page import markdown
from benchmarks.study.plan import QUICK, Case, study_cases
from benchmarks.study.results import Results

ERRORS = {"NeRIF": 0.003, "TV": 0.008, "Landweber": 0.02, "Tikhonov": 0.025}
"""L2 without noise, by method."""

ORIGIN = {"commit": "abc", "nerif": "0.1.0", "torch": "2.6.0", "machine": "2 cores", "date": "2025-01-02"}


@cache
def all_cases() -> tuple[Case, ...]:
    return tuple(study_cases(QUICK))


def record(case: Case, **changes: Any) -> dict[str, Any]:
    """A record with NeRIF as accurate as in the paper; `l2`, `cc`, ... change its metrics, other names the rest."""
    l2 = ERRORS[case.method] * (1 + 0.5 * case.noise)
    near = 0.9 + 8 * (0.01 - l2) if case.method != "NeRIF" else 1.0 - 1e-4 * case.noise
    metrics = {"l2": l2, "l2_variation": 2.5 * l2, "cc": near, "ssim": near - 0.02, "psnr": 30.0}
    metrics |= {name: changes.pop(name) for name in tuple(changes) if name in metrics}
    slices = [{"z_mm": -20 + 4.0 * i, "cc": metrics["cc"], "ssim": metrics["ssim"], "psnr": 30.0} for i in range(10)]
    values: dict[str, Any] = {
        "phantom": case.phantom, "noise": case.noise, "method": case.method,
        "views": case.ring.views, "metrics": metrics | {"slices": slices},
        "seconds": 6.0 if case.method == "NeRIF" else 2.0, "peak_memory_bytes": 900_000_000, "device": "cpu",
        "outcome": "time_limit", "steps": 500, "epochs": 60.0, "loss": 0.02,
    }  # fmt: skip
    if case.snapshots:
        shares = (0.03, 0.1, 0.3, 0.6, 1.0)
        values["curve"] = [
            {"step": 500 * s, "epoch": 60 * s, "seconds": 6 * s, "loss": 0.02 / s, "cc": 0.99}
            | {name: (metrics[name] or math.nan) / s**0.6 for name in ("l2", "l2_variation")}
            for s in shares
        ]
    if case.phantom == "octahedron":
        values |= {"resolution": resolution(20.0 if case.method == "NeRIF" else 8.0), "pixels_per_unit": 50.0}
    return values | changes


def resolution(lp_per_unit: float | None) -> dict[str, Any]:
    """The result of study.resolution.to_plain, of eight patches."""
    t = [-5 + 10 * (i + 0.5) / 32 for i in range(32)]
    sides = [(x, y, z) for x in (1, -1) for y in (1, -1) for z in (1, -1)]
    patches = [[[10 * x, 4 * y, 4 * z], [4 * x, 10 * y, 4 * z], [4 * x, 4 * y, 10 * z]] for x, y, z in sides]
    per_mm = None if lp_per_unit is None else lp_per_unit / 12.5
    return {
        "lp_per_mm": per_mm, "lp_per_unit": lp_per_unit, "coarsest_lp_per_unit": 1.4, "finest_lp_per_unit": 128.0,
        "unit_mm": 12.5, "half_length_mm": 5.0, "distance_mm": t, "edge_spread": [(math.tanh(v) - 1) / 2 for v in t],
        "line_spread_per_mm": [math.cosh(v) ** -2 / 2 for v in t[1:]],
        "frequency_lp_per_mm": [i / 8 for i in range(64)], "mtf": [math.exp(-i / 5) for i in range(64)],
        "patches_mm": patches, "local_lp_per_mm": [per_mm] * 8,
    }  # fmt: skip


Change = Callable[[Case], dict[str, Any] | None]


def pairs(change: Change = lambda case: {}) -> list[tuple[Case, dict[str, Any] | None]]:
    """Every case with its record; `change` returns the differences, or None for no record."""
    result: list[tuple[Case, dict[str, Any] | None]] = []
    for case in all_cases():
        different = change(case)
        if different is not None and "failed" in different:
            result.append((case, dict(different)))
        else:
            result.append((case, None if different is None else record(case, **different)))
    return result


def results(change: Change = lambda case: {}) -> Results:
    return Results(tuple(pairs(change)))


def records(change: Change = lambda case: {}) -> list[dict[str, Any]]:
    return [{"settings": {"key": case.key}, **ORIGIN} for case, record in pairs(change) if record is not None]


def page(change: Change = lambda case: {}) -> str:
    return markdown(results(change), QUICK, records(change))
