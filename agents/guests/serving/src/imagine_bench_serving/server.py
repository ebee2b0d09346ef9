"""``imagine-bench serve``: a task over HTTP, by the standard library alone.

``POST /reset``, ``POST /step`` and ``GET /state`` have the shapes of OpenEnv; ``/ws`` is its WebSocket and ``/mcp`` the
Model Context Protocol. There is no key, so the server binds to 127.0.0.1 unless it is told otherwise, and refuses
requests that a page of another origin makes a browser send.
"""

from __future__ import annotations

import json
import sys
import threading
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from ipaddress import ip_address
from socket import socket
from typing import Any, cast
from urllib.parse import SplitResult, parse_qsl, urlsplit

from imagine_bench.errors import BusyError, ImagineBenchError, InvalidValueError, SetupError, plain, reason
from imagine_bench.values import Json

from .mcp import INVALID_REQUEST, answer_rpc, rpc_error
from .players import Answer, Players, Served
from .sockets import ClosedError, TextSocket, accept_key

MOST_BYTES = 65_536
"""Bytes of the longest body or message that is taken."""
MOST_CONNECTIONS = 32
"""Connections that are open at a time."""
PATIENCE_S = 30.0
"""Seconds that a connection may be silent in the middle of a request, or between two."""
SOCKET_PATIENCE_S = 600.0
"""The same for a WebSocket, whose player may think for long."""
PORT = 8765
_MOST_DIGITS = 6
_LOCAL = ("localhost", "127.0.0.1", "::1")
_ROUTES = {
    "/": ("GET",),
    "/health": ("GET",),
    "/metadata": ("GET",),
    "/state": ("GET",),
    "/ws": ("GET",),
    "/reset": ("POST",),
    "/step": ("POST",),
    "/mcp": ("POST",),
}


class RefusedError(Exception):
    """A request that is refused, with its status and one sentence."""

    def __init__(self, status: HTTPStatus, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status


class Handler(BaseHTTPRequestHandler):
    """One connection. Every refusal is JSON of one sentence: ``{"error": ...}``."""

    protocol_version = "HTTP/1.1"
    server_version = "imagine-bench"
    sys_version = ""
    timeout = PATIENCE_S
    wbufsize = -1  # an answer goes out as one packet: two would wait for one another
    disable_nagle_algorithm = True

    def do_GET(self) -> None:
        """Answer a GET."""
        self._answer()

    def do_POST(self) -> None:
        """Answer a POST."""
        self._answer()

    def log_message(self, *args: object) -> None:
        """Say nothing; the episodes are the record."""

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Refuse requests that the library refuses, such as a request line that is none, in the same form."""
        del explain
        self.close_connection = True
        self._send(HTTPStatus(code), {"error": f"{message or HTTPStatus(code).phrase}."})

    @property
    def _players(self) -> Players:
        return cast("Server", self.server).players

    def _answer(self) -> None:
        try:
            self._require_own_page()
            self._route(_split(self.path).path)
        except RefusedError as error:
            self.close_connection = True  # its body may not have been read
            self._send(error.status, {"error": str(error)})
        except BusyError as error:
            self._send(HTTPStatus.CONFLICT, {"error": plain(error)})
        except ImagineBenchError as error:
            self._send(HTTPStatus.BAD_REQUEST, {"error": plain(error)})
        except OSError:  # the client has gone
            raise
        except Exception:
            traceback.print_exc()
            self.close_connection = True
            self._send(HTTPStatus.INTERNAL_SERVER_ERROR, {"error": "Something failed here; the server says more."})

    def _route(self, path: str) -> None:
        methods = _ROUTES.get(path)
        if methods is None:
            raise RefusedError(HTTPStatus.NOT_FOUND, f"There is no such page; there are {', '.join(_ROUTES)}.")
        if self.command not in methods:
            raise RefusedError(HTTPStatus.METHOD_NOT_ALLOWED, f"{path} takes {methods[0]} alone.")
        players = self._players
        if path == "/ws":
            self._talk()
        elif path == "/":
            self._send(HTTPStatus.OK, f"{players.briefing}\n\n{_HELP}\n")
        elif path == "/health":
            self._send(HTTPStatus.OK, {"status": "healthy"})
        elif path == "/metadata":
            self._send(HTTPStatus.OK, {"name": players.spec.id, "description": players.briefing})
        elif path == "/state":
            self._send(HTTPStatus.OK, players.state(dict(parse_qsl(_split(self.path).query))))
        elif path == "/mcp":
            self._rpc()
        else:
            act = players.reset if path == "/reset" else players.step
            self._send(HTTPStatus.OK, act(_mapping(self._body())))

    def _require_own_page(self) -> None:
        """Refuse requests of a page of another origin, also where its name now leads to this machine."""
        host = _split(f"//{self.headers.get('Host', '')}").hostname
        origin = self.headers.get("Origin")
        if cast("Server", self.server).is_local and host not in _LOCAL:
            raise RefusedError(HTTPStatus.FORBIDDEN, "This server answers to 127.0.0.1 and localhost alone.")
        if origin is not None and _split(origin).hostname != host:
            raise RefusedError(HTTPStatus.FORBIDDEN, "Pages of other origins are not answered.")

    def _body(self) -> Json:
        """The JSON of a request; none is an empty mapping."""
        if "Transfer-Encoding" in self.headers:
            raise RefusedError(HTTPStatus.LENGTH_REQUIRED, "Give the body's length as Content-Length.")
        said = self.headers.get("Content-Length", "0")
        if not (said.isascii() and said.isdecimal()):
            raise RefusedError(HTTPStatus.BAD_REQUEST, "The Content-Length is no number.")
        if len(said) > _MOST_DIGITS or int(said) > MOST_BYTES:
            raise RefusedError(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"The body has more than {MOST_BYTES:,} bytes.")
        content = self.rfile.read(int(said))
        if len(content) < int(said):
            raise RefusedError(HTTPStatus.BAD_REQUEST, "The body is shorter than its Content-Length.")
        return read_json(content) if content else {}

    def _rpc(self) -> None:
        try:
            message = self._body()
        except InvalidValueError as error:
            self._send(HTTPStatus.BAD_REQUEST, rpc_error(None, INVALID_REQUEST, str(error)))
            return
        answer = answer_rpc(self._players, message)
        self._send(HTTPStatus.ACCEPTED if answer is None else HTTPStatus.OK, answer)

    def _talk(self) -> None:
        """OpenEnv's WebSocket: messages of a type, ``reset``, ``step``, ``state`` or ``close``, with data."""
        key = self.headers.get("Sec-WebSocket-Key")
        if key is None or self.headers.get("Upgrade", "").lower() != "websocket":
            raise RefusedError(HTTPStatus.UPGRADE_REQUIRED, "/ws is a WebSocket.")
        self.send_response(HTTPStatus.SWITCHING_PROTOCOLS)
        self.send_header("Upgrade", "websocket")
        self.send_header("Connection", "Upgrade")
        self.send_header("Sec-WebSocket-Accept", accept_key(key))
        self.end_headers()
        self.wfile.flush()
        self.close_connection = True
        self.connection.settimeout(SOCKET_PATIENCE_S)
        talk = TextSocket(self.rfile, self.wfile, MOST_BYTES)
        player: dict[str, Json] = {}
        try:
            while True:
                talk.send(json.dumps(self._said(talk.receive(), player)))
        except ClosedError:
            return

    def _said(self, text: str, player: dict[str, Json]) -> Answer:
        """The answer to a message; ``player`` is whom the last reset named, for messages that name nobody."""
        try:
            message = _mapping(read_json(text.encode()))
            kind = message.get("type")
            data = _mapping(message.get("data", {}))
            if kind == "close":
                raise ClosedError
            if kind == "state":
                return {"type": "state", "data": self._players.state({**player, **data})}
            if kind == "reset":
                player.update({"player": data["player"]} if "player" in data else {})
                return {"type": "observation", "data": self._players.reset({**data, **player})}
            if kind == "step":
                return {"type": "observation", "data": self._players.step({**player, **data})}
            raise InvalidValueError("A message has the type reset, step, state or close.")
        except ImagineBenchError as error:
            return {"type": "error", "data": {"message": plain(error), "code": "VALIDATION_ERROR"}}

    def _send(self, status: HTTPStatus, answer: Json) -> None:
        is_text = isinstance(answer, str)
        content = b"" if answer is None else (answer if isinstance(answer, str) else json.dumps(answer)).encode()
        self.send_response(status)
        self.send_header("Content-Type", "text/plain; charset=utf-8" if is_text else "application/json")
        self.send_header("Content-Length", str(len(content)))
        self.send_header("X-Content-Type-Options", "nosniff")
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(content)


def read_json(content: bytes) -> Json:
    """A value that JSON has a word for. Raises InvalidValueError: the content is none."""
    try:
        found: Json = json.loads(content, parse_constant=_no_number)
    except (ValueError, RecursionError) as error:
        raise InvalidValueError("The body is no JSON.") from error
    return found


def _split(address: str) -> SplitResult:
    """The parts of an address; all are empty of one that is none."""
    try:
        return urlsplit(address)
    except ValueError:
        return urlsplit("")


def _no_number(word: str) -> Json:
    raise ValueError(word)


def _mapping(value: Json) -> Mapping[str, Json]:
    if not isinstance(value, dict):
        raise InvalidValueError('Give a mapping, such as {"player": "me", "action": 0}.')
    return value


class Server(ThreadingHTTPServer):
    """A thread a connection, of which few are open at a time; the episodes are played in one thread.

    Args:
        players: The players.
        host: Address that is bound to.
        port: Port; 0 is any free one.

    Raises:
        SetupError: The address cannot be bound to.
    """

    daemon_threads = True
    request_queue_size = MOST_CONNECTIONS

    def __init__(self, players: Players, host: str, port: int) -> None:
        self.players = players
        self._free = threading.BoundedSemaphore(MOST_CONNECTIONS)
        try:
            super().__init__((host, port), Handler)
        except (OSError, OverflowError) as error:
            why = reason(error) if isinstance(error, OSError) else "ports end at 65535"
            raise SetupError(f"{host}, port {port}, cannot be served at: {why}; give another --port.") from error
        self.is_local = ip_address(str(self.server_address[0])).is_loopback

    def process_request(self, request: socket | tuple[bytes, socket], client_address: object) -> None:
        """Answer a connection in a thread of its own, or close it where too many are open."""
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: socket | tuple[bytes, socket], client_address: object) -> None:
        """Answer a connection."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: object, client_address: object) -> None:
        """A client that goes away, or says nothing for long, is no news."""


def announce(server: Server) -> None:
    """Say where a server is, and how to end it."""
    host = str(server.server_address[0])
    port = server.server_port
    address = f"http://{host}:{port}"
    print(f"{server.players.spec.title}: {address}, MCP at {address}/mcp, OpenEnv at {address}. Ctrl-C ends it.")
    if not server.is_local:
        print("There is no key: whoever reaches this machine can play, and fill its disk with episodes.")
    sys.stdout.flush()


def serve(
    served: Served, *, host: str = "127.0.0.1", port: int = PORT, ready: Callable[[Server], None] = announce
) -> None:
    """Serve until Ctrl-C; ``ready`` is called with the server that is about to.

    Raises:
        ImagineBenchError: The task, the bench, a number or the address cannot be served.
    """
    players = Players(served)
    try:
        with Server(players, host, port) as server, suppress(KeyboardInterrupt):
            ready(server)
            server.serve_forever()
    finally:
        players.close()


def serve_command(*, host: str, port: int, **served: Any) -> None:
    """The command ``imagine-bench serve``; the other options are fields of :class:`Served`."""
    serve(Served(**served), host=host, port=port)


_HELP = """\
POST /reset {"player": "NAME"} begins the next episode, or shows the one again that goes on.
POST /step {"player": "NAME", "action": 0} carries out a macro-action.
GET /state?player=NAME says which episode goes on.
POST /mcp is the Model Context Protocol, /ws OpenEnv's WebSocket."""
