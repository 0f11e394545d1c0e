"""Column widths of journals."""

from __future__ import annotations

__all__ = ["JOURNALS"]

JOURNALS = {"elsevier": (90, 190), "aip": (85, 170), "aps": (86, 178), "nature": (89, 183), "springer": (84, 174)}
"""Widths of one and of two columns, mm, by the publishers' guides for authors."""
