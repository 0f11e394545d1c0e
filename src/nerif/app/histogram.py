"""A histogram of grey values as SVG."""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["histogram"]

WIDTH, HEIGHT = 320, 64


def histogram(shares: Sequence[float], full: float, label: str) -> str:
    """Return the histogram as HTML; full scale is at the right end.

    Parameters
    ----------
    shares : fraction of the pixels per bin, from 0 to full scale
    full : grey value at full scale
    label : description for screen readers, escaped
    """
    most = max(shares) or 1.0
    step = WIDTH / len(shares)
    bars = "".join(
        f"<rect x='{i * step:.2f}' y='{HEIGHT * (1 - share / most):.2f}' width='{step:.2f}' "
        f"height='{HEIGHT * share / most:.2f}'/>"
        for i, share in enumerate(shares)
        if share > 0
    )
    return (
        f"<figure class=histogram><svg viewBox='0 0 {WIDTH} {HEIGHT}' preserveAspectRatio=none role=img "
        f'aria-label="{label}">{bars}</svg><figcaption><span>0</span><span>grey value</span><span>{full:g}</span>'
        "</figcaption></figure>"
    )
