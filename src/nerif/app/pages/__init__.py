"""The pages, in the order of the work. A page is one file with `PAGE`; its line here puts it into the navigation."""

from __future__ import annotations

from nerif.app.pages import calibration, check, design, displacement, images, reconstruct, results
from nerif.app.pages.page import Page

__all__ = ["PAGES"]

PAGES: tuple[Page, ...] = (
    design.PAGE, images.PAGE, calibration.PAGE, displacement.PAGE, check.PAGE, reconstruct.PAGE, results.PAGE,
)  # fmt: skip
