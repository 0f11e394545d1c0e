"""State that all pages share: project, runs, image files and drafts."""

from __future__ import annotations

import asyncio
import errno
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from nerif.app.project.folder import OWN, Contents, ProjectFolder
from nerif.app.project.image_cache import ImageCache
from nerif.app.project.jobs import Jobs
from nerif.cli.settings import COMMAND_LINE_ONLY
from nerif.common.files import write_json
from nerif.common.locks import locked

__all__ = ["READ_ONLY", "Workspace"]

P = ParamSpec("P")
T = TypeVar("T")

NOT_WRITABLE = (errno.EACCES, errno.EPERM, errno.EROFS)
READ_ONLY = "This folder is read-only: files can be viewed, but nothing can be saved or started."


class Workspace:
    """One project, shared by all pages and tabs; InputError if a link leads its files outside of the folder."""

    def __init__(self, project: ProjectFolder) -> None:
        for name in (OWN, f"{OWN}/jobs", f"{OWN}/checks", f"{OWN}/masks"):
            project.path(name)
        self.project, self.jobs, self.files = project, Jobs(project.folder), ImageCache(project)
        self._drafts: dict[str, dict[str, Any]] = {}

    @property
    def _file(self) -> Path:
        return self.project.folder / OWN / "drafts.json"

    def draft(self, page: str) -> dict[str, Any]:
        """Return the entries of a page that differ from the defaults; they survive a reload and a restart.

        The file may come from another person: COMMAND_LINE_ONLY survive no restart.
        """
        if not self._drafts:
            self._drafts = self._stored()
        return self._drafts.setdefault(page, {})

    def _stored(self) -> dict[str, dict[str, Any]]:
        """Return the entries of all pages as on disk."""
        if not self._file.is_file():
            return {}
        try:
            entries = json.loads(self._file.read_text(encoding="utf-8"), object_hook=_harmless)
        except (ValueError, RecursionError):  # damaged: only drafts are lost
            entries = {}
        drafts = entries if isinstance(entries, dict) else {}
        return {name: values for name, values in drafts.items() if isinstance(values, dict)}

    def keep(self, page: str, values: dict[str, Any]) -> None:
        """Store the entries of a page; in a read-only folder, only until the server ends."""
        self.draft(page)
        self._drafts[page] = dict(values)
        try:
            with locked(self._file, wait=True):  # another server may store other pages
                write_json(self._file, {**self._drafts, **self._stored(), page: self._drafts[page]})
        except OSError as error:
            if error.errno not in NOT_WRITABLE:
                raise

    def forget_drafts(self) -> bool:
        """Drop the drafts of all pages, and return whether there were any."""
        drafts, self._drafts = self._drafts, {"forgotten": {}}
        return any(drafts.values())

    async def contents(self) -> Contents:
        """Return the files of the project as they are now."""
        return await self.in_thread(self.project.contents)

    async def measurements(self) -> tuple[str, ...]:
        """Return the measurement files as they are now."""
        return (await self.contents()).measurements

    async def models(self) -> tuple[str, ...]:
        """Return the surfaces of bodies as they are now."""
        return (await self.contents()).models

    async def in_thread(self, work: Callable[P, T], *arguments: P.args, **keywords: P.kwargs) -> T:
        """Run blocking work in a thread, so that pages stay responsive."""
        return await asyncio.to_thread(work, *arguments, **keywords)


def _harmless(entries: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in entries.items() if name not in COMMAND_LINE_ONLY}
