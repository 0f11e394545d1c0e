"""The paper's results: He et al., arXiv:2409.14722, Tables III (correlation) and IV (L2), Sec. IV and Apps. A and D."""

from __future__ import annotations

COLUMNS = ("NeRIF 0", "NeRIF 0.1", "NeRIF 0.15", "Tikhonov", "Landweber")
"""Method and noise of the columns of both tables; the voxel methods were run without noise."""

CORRELATION: dict[str, tuple[float, ...]] = {
    "1": (0.9997, 0.9996, 0.9992, 0.9917, 0.9931),
    "2": (0.9944, 0.9964, 0.9958, 0.6526, 0.7600),
    "3": (0.9981, 0.9969, 0.9971, 0.8259, 0.8809),
    "4": (0.9984, 0.9984, 0.9984, 0.8806, 0.9155),
    "5": (0.9987, 0.9979, 0.9982, 0.8933, 0.9256),
    "6": (0.9966, 0.9980, 0.9973, 0.9012, 0.9316),
    "7": (0.9981, 0.9981, 0.9983, 0.9092, 0.9370),
}
"""By phantom."""

L2: dict[str, tuple[float, ...]] = {
    "1": (0.00585, 0.00817, 0.00821, 0.02140, 0.01820),
    "2": (0.00423, 0.00419, 0.00343, 0.02761, 0.02360),
    "3": (0.00394, 0.00503, 0.00610, 0.03406, 0.02857),
    "4": (0.00485, 0.00590, 0.00438, 0.03477, 0.02948),
    "5": (0.00456, 0.00542, 0.00501, 0.03734, 0.03143),
    "6": (0.00783, 0.00639, 0.00810, 0.04023, 0.03372),
    "7": (0.00906, 0.00837, 0.01041, 0.04304, 0.03607),
}
"""By phantom, |n_gt - n_rec| / |n_gt - 1|."""

RESOLUTION = 61.58  # line pairs per unit, at an MTF of 10 %; a unit is a quarter of the edge of the phantom's box
MINUTES = {"NeRIF": 20, "Tikhonov": 600, "Landweber": 600}  # "just over 20 minutes", "over 10 hours"
MEMORY_GB = {"NeRIF": 10, "Tikhonov": 184, "Landweber": 184}  # on the GPU; the matrix alone, over 400 GB in between
NETWORK_LOSS = {"multi-head": 0.07, "plain": 0.8}  # mean loss, App. A


def paper_value(table: dict[str, tuple[float, ...]], phantom: str, method: str, noise: float) -> float | None:
    """Return the paper's value for a phantom, method and noise, or None."""
    column = f"NeRIF {noise:g}" if method == "NeRIF" else method if noise == 0 else ""
    return table[phantom][COLUMNS.index(column)] if phantom in table and column in COLUMNS else None
