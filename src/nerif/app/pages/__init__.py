"""The pages, in the order of the work. A page is one file with `PAGE`; its line here puts it into the navigation."""

from __future__ import annotations

from nerif.app.page import Page
from nerif.app.pages import calibration, check, design, displacement, images, reconstruct, results

__all__ = ["PAGES"]

PAGES: tuple[Page, ...] = (
    design.PAGE, images.PAGE, calibration.PAGE, displacement.PAGE, check.PAGE, reconstruct.PAGE, results.PAGE,
)  # fmt: skip
