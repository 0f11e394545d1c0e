"""What every page is given: the project, its runs, what was typed, and a way to work beside the page."""

from __future__ import annotations

import asyncio
import errno
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from nerif.app.image_files import ImageFiles
from nerif.app.jobs import Jobs
from nerif.app.project import OWN, Project
from nerif.common.files import write_json

__all__ = ["READ_ONLY", "Workspace"]

P = ParamSpec("P")
T = TypeVar("T")

NOT_WRITABLE = (errno.EACCES, errno.EPERM, errno.EROFS)
READ_ONLY = "This folder may not be written to: everything can be looked at, and nothing kept or started."
"""What is said of such a folder."""


class Workspace:
    """One project, as all pages and tabs see it.

    Parameters
    ----------
    project : Project

    Raises
    ------
    InputError
        If what the app writes into the folder would be outside of it, by a link.
    """

    def __init__(self, project: Project) -> None:
        for name in (OWN, f"{OWN}/jobs"):
            project.path(name)
        self.project, self.jobs, self.files = project, Jobs(project.folder), ImageFiles(project)
        self._drafts: dict[str, dict[str, Any]] = {}

    @property
    def _file(self) -> Path:
        return self.project.folder / OWN / "drafts.json"

    def draft(self, page: str) -> dict[str, Any]:
        """Return what was typed on a page and is not the default: kept over a reload, and over another start."""
        if not self._drafts and self._file.is_file():
            try:
                result = json.loads(self._file.read_text())
            except ValueError:  # damaged: nothing but what was typed is lost
                result = {}
            memory = result if isinstance(result, dict) else {}
            self._drafts = {name: values for name, values in memory.items() if isinstance(values, dict)}
        return self._drafts.setdefault(page, {})

    def keep(self, page: str, values: dict[str, Any]) -> None:
        """Keep what was typed on a page; a folder that may not be written to keeps it as long as the server runs."""
        self.draft(page)
        self._drafts[page] = dict(values)
        try:
            self._file.parent.mkdir(exist_ok=True)
            write_json(self._file, self._drafts)
        except OSError as error:
            if error.errno not in NOT_WRITABLE:
                raise

    async def beside(self, work: Callable[P, T], *arguments: P.args, **named: P.kwargs) -> T:
        """Do blocking work in a thread, while pages go on answering; its InputError comes back as it is."""
        return await asyncio.to_thread(work, *arguments, **named)
