"""Flow images of another scene than their references: exchanged views, another run, a single bad image."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Shaped

from nerif.imaging.quality.thumbnails import Thumbnail, related, thumbnails
from nerif.imaging.readers.views import View

__all__ = ["unrelated"]

Grey = Shaped[np.ndarray, "row column"]
FRAMES = 4  # other flow images that are compared


def unrelated(reference: Grey, flow: Grey, view: View, views: Sequence[View]) -> str:
    """Return which images are the likely cause if a flow image shows another scene than the reference, else "".

    Images may have been exchanged with those of the other views of the recording.
    """
    still, moving = Thumbnail.of(reference), Thumbnail.of(flow)
    if related(still, moving):
        return ""
    text = f"does not correlate with the references of view '{view.name}'"
    if any(related(still, other) for other in thumbnails(view, "flow", FRAMES, flow.shape)):
        return f"{text}, but other flow images do; another scene, or badly exposed?"
    for other in views:
        if other.name == view.name:
            continue
        if any(related(r, moving) for r in thumbnails(other, "reference", 1, flow.shape)):
            return f"{text}, but with those of view '{other.name}'; exchanged?"
        if any(related(still, f) for f in thumbnails(other, "flow", 1, flow.shape)):
            return f"{text}; these match the flow images of view '{other.name}'; references exchanged?"
    return (
        f"{text}, nor do other flow images; are the references of another run or camera, images out of focus, or "
        "displacements too large?"
    )
