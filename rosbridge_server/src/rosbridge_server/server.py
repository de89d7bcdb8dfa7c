# SPDX-License-Identifier: BSD-3-Clause
"""The websocket server: listens, accepts clients, and gives each a protocol with an outbox in front of its
connection.

Which protocol a client gets is a table from the websocket subprotocol that it asks for; one that is not in
the table is ignored, not refused, and a client without any gets the entry of None. Any path, host and origin
is accepted (robots are reached by names and pages of all sorts), but for the null origin where that is
forbidden.
"""

from __future__ import annotations

import asyncio
import dataclasses
import errno
import logging
import socket
import ssl
from typing import TYPE_CHECKING, Any, Awaitable, Callable, Dict, List, Mapping, Optional, Protocol, Union

from tornado.httpserver import HTTPServer
from tornado.netutil import bind_sockets
from tornado.web import Application, RequestHandler
from tornado.websocket import WebSocketHandler, WebSocketProtocol

from rosbridge_library.foxglove.messages import SUBPROTOCOLS
from rosbridge_library.payload import Outbox
from rosbridge_server.connection import WebSocketConnection
from rosbridge_server.outbox import ClientOutbox
from rosbridge_server.settings import Settings
from rosbridge_server.transport import StreamTransport

if TYPE_CHECKING:
    from rosbridge_server.clients import Clients

logger = logging.getLogger("rosbridge.server")

_BACKLOG = 1024
_HEADER_TIMEOUT_S = 60.0
_MAX_BODY_BYTES = 65536  # of a plain HTTP request: there is nothing to upload
_GOING_AWAY, _POLICY_VIOLATION, _NORMAL = 1001, 1008, 1000


class ClientProtocol(Protocol):
    """What speaks with one client. `incoming` gets the bytes of each message, and raises only because of a
    bug; what it returns is waited for before the client is read on."""

    def incoming(self, message: Union[str, bytes]) -> Optional[Awaitable[None]]: ...

    def dropped(self, messages: Mapping[str, int]) -> None:
        """The client is slow, and so many messages of these topics were dropped since this was called last; at most
        once a second."""
        ...

    def finish(self) -> None: ...


ProtocolFactory = Callable[[str, Mapping[str, Any], Outbox], ClientProtocol]
"""Makes the protocol of a client from its id, the parameters, and its outbox."""


class ListenError(Exception):
    """The address can't be listened on, and trying again would not help."""


class WebSocketServer:
    """Serves websocket clients on the running loop; `protocols` maps subprotocols to what they are spoken
    with."""

    def __init__(
        self, settings: Settings, protocols: Mapping[Optional[str], ProtocolFactory], clients: Clients
    ) -> None:
        self.settings = settings
        self.protocols = protocols
        self.clients = clients
        self.parameters: Mapping[str, Any] = dataclasses.asdict(settings)
        self.port = settings.port
        """The port in use, once `listen` is done."""
        self._handlers: Dict[str, ClientHandler] = {}
        self._accepted = 0
        self._listening_too: Optional[asyncio.Future[None]] = None
        application = Application(
            [(r".*", ClientHandler, {"server": self})],
            websocket_ping_interval=settings.websocket_ping_interval,
            websocket_ping_timeout=settings.websocket_ping_timeout,
            log_function=_log_request,
        )
        self._http = HTTPServer(
            application,
            ssl_options=ssl_context(settings),
            idle_connection_timeout=_HEADER_TIMEOUT_S,
            max_body_size=_MAX_BODY_BYTES,
        )

    async def listen(self) -> None:
        """Listens on the address and port, and tries again every ``retry_startup_delay`` while they are held.

        With foxglove_port, does the same for that one meanwhile.

        Raises ListenError when the reason won't go away by itself.
        """
        settings = self.settings
        sockets = await self._bind(settings.port)
        self.port = sockets[0].getsockname()[1]
        self._http.add_sockets(sockets)
        if settings.foxglove_port and settings.foxglove_port != self.port:
            self._listening_too = asyncio.ensure_future(self._listen_too(settings.foxglove_port))

    async def _listen_too(self, port: int) -> None:
        """The second port: while another program holds it, clients of the first are served."""
        try:
            self._http.add_sockets(await self._bind(port))
        except ListenError as error:
            logger.error("%s", error)

    async def _bind(self, port: int) -> List[socket.socket]:
        settings = self.settings
        while True:
            try:
                return bind_sockets(port, settings.address or None, backlog=_BACKLOG)
            except OSError as error:
                where = f"{settings.address or 'all interfaces'}, port {port}"
                if error.errno in (errno.EACCES, errno.EPERM):
                    raise ListenError(f"may not listen on {where}: {error.strerror}") from error
                logger.warning(
                    "Unable to listen on %s: %s. Trying again in %g seconds",
                    where,
                    error.strerror or error,
                    settings.retry_startup_delay,
                )
                await asyncio.sleep(max(settings.retry_startup_delay, 0.01))

    @property
    def url(self) -> str:
        """The address in the form that clients connect to; behind a proxy, with the port that they see."""
        settings = self.settings
        host = settings.address or "0.0.0.0"
        return f"{'wss' if settings.ssl else 'ws'}://{f'[{host}]' if ':' in host else host}:{self.port}"

    def close(self) -> None:
        """Stops listening, and ends every client: its protocol at once, its connection with a close frame."""
        if self._listening_too is not None:
            self._listening_too.cancel()
        self._http.stop()
        for handler in list(self._handlers.values()):
            handler.end(_GOING_AWAY, "the server is shutting down")

    def closed(self) -> Awaitable[None]:
        """Done when no connection is left; `close` leaves each client a few seconds to answer."""
        return self._http.close_all_connections()

    # For the handlers

    def burst_bytes(self, subprotocol: Optional[str]) -> int:
        """What may wait for a client of this subprotocol before messages are dropped."""
        limit = self.settings.send_buffer_limit if subprotocol in SUBPROTOCOLS else None
        return self.settings.burst_bytes if limit is None else limit

    def next_client_id(self, address: str, port: int) -> str:
        """An id that no other client ever has, telling where it connects from."""
        self._accepted += 1
        host = f"[{address}]" if ":" in address else address
        return f"{host}:{port}#{self._accepted}"

    def connected(self, handler: ClientHandler) -> None:
        """A client has its protocol."""
        self._handlers[handler.client_id] = handler
        self.clients.add(handler.client_id, handler.ip_address)
        logger.info("Client connected: %s. %d clients total.", handler.client_id, len(self.clients))

    def disconnected(self, handler: ClientHandler) -> None:
        """The connection of a client is gone."""
        if self._handlers.pop(handler.client_id, None) is not None:
            self.clients.remove(handler.client_id)
            logger.info("Client disconnected: %s. %d clients total.", handler.client_id, len(self.clients))


class ClientHandler(WebSocketHandler):
    """One client: the handshake, and from then on what joins connection, outbox and protocol."""

    _connection: Optional[WebSocketConnection] = None
    _outbox: Optional[ClientOutbox] = None
    _protocol: Optional[ClientProtocol] = None

    def initialize(self, server: WebSocketServer) -> None:
        self.server = server
        self.client_id = ""
        self.ip_address = ""

    # Handshake

    async def get(self, *args: Any, **kwargs: Any) -> None:
        headers = self.request.headers
        if headers.get("Upgrade", "").lower() != "websocket":
            self._tell_what_this_is()
            return
        if headers.get("Origin") == "null" and not self.server.settings.websocket_null_origin:
            self.set_status(403)
            self.finish("Clients with the origin null are not accepted here (websocket_null_origin is false).\n")
            return
        # Everybody else is welcome. Tornado would compare these, and refuse what it can't parse before it
        # asks.
        for name in ("Origin", "Sec-Fetch-Site"):
            headers.pop(name, None)
        await super().get(*args, **kwargs)

    def _tell_what_this_is(self) -> None:
        settings = self.server.settings
        host = self.request.host_name
        port = settings.websocket_external_port or self.server.port
        self.set_status(426)
        self.set_header("Upgrade", "websocket")
        self.set_header("Connection", "Upgrade")
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(
            "This is a rosbridge websocket server. Web clients connect to it with a websocket at "
            f"{'wss' if settings.ssl else 'ws'}://{host}:{port}\n"
        )

    def check_origin(self, origin: str) -> bool:
        return True

    def select_subprotocol(self, subprotocols: List[str]) -> Optional[str]:
        return next((name for name in subprotocols if name in self.server.protocols), None)

    def get_websocket_protocol(self) -> Optional[WebSocketProtocol]:
        if self.request.headers.get("Sec-WebSocket-Version") != "13":
            return None
        settings = self.server.settings
        self._connection = WebSocketConnection(
            self, settings.max_incoming_size or None, settings.use_compression, self._lost
        )
        return self._connection

    # The connection's life

    def open(self, *args: str, **kwargs: str) -> None:
        server, connection = self.server, self._connection
        assert connection is not None
        self.set_nodelay(True)
        self.ip_address, port = _peer(self)
        self.client_id = server.next_client_id(self.ip_address, port)
        outbox = ClientOutbox(
            StreamTransport(connection.stream, connection.frame, self._drained, self._give_up),
            asyncio.get_event_loop().call_later,
            burst_bytes=server.burst_bytes(self.selected_subprotocol),
            max_bytes=server.settings.max_client_bytes,
            delay_between_messages=server.settings.delay_between_messages,
            stall_timeout=server.settings.stall_timeout,
        )
        make_protocol = server.protocols[self.selected_subprotocol]
        self._outbox = outbox
        self._protocol = make_protocol(self.client_id, server.parameters, outbox)
        outbox.on_dropped = self._protocol.dropped
        server.connected(self)

    def on_message(self, message: Union[str, bytes]) -> Optional[Awaitable[None]]:
        return self._protocol.incoming(message) if self._protocol is not None else None

    def on_close(self) -> None:
        self.server.disconnected(self)
        self._finish_protocol()

    def end(self, code: int, reason: str) -> None:
        """Ends the protocol now, and the connection when the client has answered a close frame, or 5 s are
        over."""
        self._finish_protocol()
        self.close(code, reason)

    def log_exception(self, typ: Any, value: Any, tb: Any) -> None:
        """Whatever is raised while a client is served is a bug; it ends that client alone."""
        if self.client_id:
            logger.error("Client %s is closed because of an internal error", self.client_id, exc_info=(typ, value, tb))
        else:
            super().log_exception(typ, value, tb)

    def _finish_protocol(self) -> None:
        protocol, self._protocol = self._protocol, None
        if self._outbox is not None:
            self._outbox.close()
        if protocol is not None:
            try:
                protocol.finish()
            except Exception:
                logger.exception("Client %s could not be cleaned up after", self.client_id)

    def _drained(self) -> None:
        if self._outbox is not None:
            self._outbox.drained()

    def _lost(self) -> None:
        timeout = self.server.settings.websocket_ping_timeout
        logger.warning("Client %s is closed: nothing came from it for %g s after a ping", self.client_id, timeout)

    def _give_up(self, reason: str) -> None:
        logger.warning("Client %s is closed, since it does not read: %s", self.client_id, reason)
        if self._connection is not None:
            asyncio.get_event_loop().call_soon(self._connection.abort)


def ssl_context(settings: Settings) -> Optional[ssl.SSLContext]:
    """The TLS context that the settings ask for, if any. Raises ListenError when the files are no good."""
    if not settings.ssl:
        return None
    if settings.certfile is None:
        raise ListenError("ssl is on, but no certfile is given")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_cert_chain(settings.certfile, settings.keyfile)
    except (OSError, ssl.SSLError) as error:
        files = settings.certfile + (f" and {settings.keyfile}" if settings.keyfile else "")
        raise ListenError(f"can't use {files} for ssl: {error}") from error
    return context


def _peer(handler: WebSocketHandler) -> Any:
    """The client's address and port."""
    address = getattr(getattr(handler.request.connection, "context", None), "address", None)
    port = address[1] if isinstance(address, tuple) else 0
    return handler.request.remote_ip or "unknown", port


def _log_request(handler: RequestHandler) -> None:
    logger.debug("%d %s", handler.get_status(), handler._request_summary())
