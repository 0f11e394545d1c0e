"""A histogram of grey values as SVG."""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["histogram"]

WIDTH, HEIGHT = 320, 64


def histogram(shares: Sequence[float], full: float, label: str) -> str:
    """Return the drawing; full scale is at its right end.

    Parameters
    ----------
    shares : of the pixels, by bin from 0 to full scale
    full : grey value of a full sensor
    label : for those who do not see it, made safe already
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
