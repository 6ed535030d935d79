"""The set-up page of the dashboard: the dialogue of `jointfit init` in a browser.

Invariant: the page is served on the loopback interface only. It writes only into the folder that
the command names.
"""

from __future__ import annotations

import asyncio
import json
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from typing_extensions import override

from jointfit_daemon.tools.dashboard.server import DashboardServer
from jointfit_daemon.tools.init.session import SetUpSession

if TYPE_CHECKING:
    from pathlib import Path

    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

SET_UP = "/set-up"
"""URL path of the WebSocket for the dialogue."""
PAGE = "set-up.html"


@dataclass(slots=True)
class SetUpServer(DashboardServer):
    """Dashboard server with the additional set-up page."""

    session: SetUpSession | None = None
    _turn: asyncio.Lock = field(default_factory=asyncio.Lock)

    @override
    def _answer(self, request: Request, method: str) -> Response | None:
        if request.path == SET_UP:  # super() without arguments fails in a slots class
            return self._check_tunnel(request, method)
        return super(SetUpServer, self)._answer(request, method)

    @override
    async def _serve_viewer(self, websocket: ServerConnection) -> None:
        if websocket.request is None or websocket.request.path != SET_UP:
            await super(SetUpServer, self)._serve_viewer(websocket)
            return
        async for text in websocket:
            await websocket.send(json.dumps(await self._reply(websocket, text)))

    async def _reply(self, websocket: ServerConnection, text: str | bytes) -> dict[str, Any]:
        """Process a message, and return the new state of the dialogue.

        The processing runs in a thread, because a search takes seconds.
        """
        try:
            message = json.loads(text)
        except (ValueError, RecursionError):
            message = None
        if not isinstance(message, dict) or self.session is None:
            return {"error": 'expected a JSON object, such as {"do": "show"}'}
        loop = asyncio.get_running_loop()

        def send_note(note: str) -> None:
            sending = websocket.send(json.dumps({"note": note}))
            asyncio.run_coroutine_threadsafe(sending, loop)

        async with self._turn:
            self.session.on_note = send_note
            return await asyncio.to_thread(self.session.handle, message)


def set_up_server(server: DashboardServer, path: Path) -> SetUpServer:
    """Return a server with the settings of `server`, and a page that sets up the rig at `path`."""
    return SetUpServer(
        server.broker,
        server.context,
        base=server.base,
        names=server.names,
        page_context=server.page_context,
        files=server.files,
        session=SetUpSession(path),
    )
