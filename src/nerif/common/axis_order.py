"""Arrays whose axes are in another order than expected: which ones, and how to move them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations

__all__ = ["order_remedy"]


def order_remedy(name: str, axes: Sequence[str], expected: Sequence[int], actual: Sequence[int]) -> str:
    """Return which axes of an array are swapped and the line of NumPy that undoes it; empty if none are.

    Expected and actual are its sizes along the axes.
    """
    if tuple(actual) == tuple(expected) or sorted(actual) != sorted(expected):
        return ""

    def moved(order: tuple[int, ...]) -> int:
        return sum(i != place for i, place in enumerate(order))

    orders = permutations(range(len(actual)))
    order = min((o for o in orders if all(actual[i] == n for i, n in zip(o, expected, strict=True))), key=moved)
    others = [i for i, place in enumerate(order) if i != place]
    if len(others) == 2:
        a, b = others
        return f"; {axes[a]} and {axes[b]} swapped? Transpose the array: np.swapaxes({name}, {a}, {b})"
    return f"; axes in another order? Transpose the array: np.transpose({name}, {order})"
