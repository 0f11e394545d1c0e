"""The app's pages as NiceGUI's simulated user sees them: without a browser, in the process of the test."""

from __future__ import annotations

import asyncio
import re
import shlex
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from html import unescape
from pathlib import Path
from typing import Any

from nicegui import Client, app, core, ui
from nicegui.testing import User
from nicegui.testing.user_simulation import user_simulation

from nerif.app.pages import PAGES
from nerif.app.project.folder import ProjectFolder
from nerif.app.project.workspace import Workspace
from nerif.app.server.server import _handler
from nerif.app.views.routes import routes

__all__ = ["Visitor", "visiting"]


class Visitor:
    """A user with one open page.

    Parameters
    ----------
    user : NiceGUI's simulated user
    work : workspace of the project
    """

    def __init__(self, user: User, work: Workspace) -> None:
        self.user, self.work = user, work

    async def open(self, page: str, ready: str = "") -> None:
        """Open a page, and wait for its controls or for a text on it."""
        await self.user.open(f"/{page}")
        await self.until(lambda: self.sees(ready) if ready else self.all(ui.input))

    async def until(self, condition: Callable[[], Any], seconds: float = 120.0) -> None:
        """Wait until a condition holds."""
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, self.text[-2000:]
            await asyncio.sleep(0.1)

    def all(self, kind: type[ui.element] = ui.element, **properties: str) -> list[Any]:
        """The visible elements of a kind with these properties, in the order of the page."""
        names = {name.replace("_", "-"): value for name, value in properties.items()}
        assert self.user.client is not None
        return [
            e for e in self.user.client.layout.descendants(include_self=True)
            if isinstance(e, kind) and all(e.props.get(n) == v for n, v in names.items()) and _visible(e)
        ]  # fmt: skip

    @property
    def html(self) -> str:
        """The HTML of the page and its notifications."""
        return "\n".join(map(_html, self.all())) + "\n".join(self.user.notify.messages)

    @property
    def text(self) -> str:
        """The words of the page."""
        return unescape(re.sub(r"<[^>]+>", "", self.html))

    def sees(self, *texts: str) -> bool:
        """Whether all texts are on the page."""
        return all(text in self.text for text in texts)

    async def sees_soon(self, *texts: str, seconds: float = 120.0) -> None:
        """Wait until all texts are on the page."""
        await self.until(lambda: self.sees(*texts), seconds)

    def lines(self) -> list[list[str]]:
        """The words of all command lines on the page."""
        matches = re.findall(r"<code tabindex=0>(.*?)</code>", self.html)
        return [shlex.split(unescape(re.sub(r"<[^>]+>", "", line))) for line in matches]

    def control(self, name: str) -> Any:
        """The control with a name, a label for screen readers, a label or a text."""
        for key in ("name", "aria-label", "label", "text"):
            values = ((e, getattr(e, key, "") if key == "text" else e.props.get(key)) for e in self.all())
            if matches := [e for e, value in values if value == name]:
                return matches[-1]
        raise AssertionError(f"no control {name}: {self.text}")

    def put(self, name: str, value: Any) -> None:
        """Type or choose a value."""
        assert self.user.client is not None
        with self.user.client:
            self.control(name).set_value(value)

    def put_tab(self, name: str) -> None:
        """Turn to a tab."""
        assert self.user.client is not None
        with self.user.client:
            self.all(ui.tab_panels)[0].set_value(name)

    def scene_objects(self) -> list[Any]:
        """What the 3-D scenes of the page hold."""
        return [o for scene in self.all(ui.scene) for o in scene.objects.values()]

    def click(self, label: str) -> None:
        """Press the enabled button whose label or label for screen readers begins with this."""
        texts = lambda b: (b.text, b.props.get("aria-label", ""))  # noqa: E731
        matches = [b for b in self.all(ui.button) if b.enabled and any(t.startswith(label) for t in texts(b))]
        assert matches, f"no button {label}: {self.text}"
        self.fire(matches[0], "click")

    def fire(self, element: ui.element, event: str, args: Any = None) -> None:
        """Let an event happen to an element."""
        from nicegui import events

        with self.user.client:  # type: ignore[union-attr]
            for listener in list(element._event_listeners.values()):
                if listener.type == event and listener.handler is not None:
                    arguments = events.GenericEventArguments(sender=element, client=element.client, args=args)
                    events.handle_event(listener.handler, arguments)


@asynccontextmanager
async def visiting(folder: Path) -> AsyncIterator[Visitor]:
    """Serve a project to a simulated user; its runs are started, and no page may raise an error."""
    errors: list[Exception] = []
    of_pages: list[Exception] = []
    work = Workspace(ProjectFolder(folder))
    try:
        async with user_simulation(lambda: None) as user:
            for page in PAGES:
                ui.page(page.path, response_timeout=30)(_handler(work, page))
            for path, handler in routes(work).items():
                app.add_api_route(path, handler)
            app.timer(0.2, work.jobs.advance)
            app.on_exception(errors.append)
            try:
                yield Visitor(user, work)
            finally:
                for client in list(Client.instances.values()):
                    client.delete()
                await asyncio.sleep(0.1)  # their tasks end
                Client.page_routes.clear()  # else the modules of the pages would be imported again
    finally:
        core.reset()  # the loop of this test is no one else's
    assert of_pages == []


def _visible(element: ui.element) -> bool:
    return all(e.visible for e in [element, *element.ancestors()])


def _html(element: Any) -> str:
    """What an element shows: HTML, or its text or label."""
    words: Sequence[Any] = (getattr(element, "content", ""), getattr(element, "text", ""), element.props.get("label"))
    return " ".join(str(word) for word in words if word)
