"""The Model Context Protocol over plain HTTP: ``initialize``, ``tools/list`` and ``tools/call``, one answer a request.

It is the transport *streamable HTTP* of the revisions 2025-03-26 to 2025-11-25, without its stream and without
sessions: a server may answer each POST with JSON, and nothing here is sent unasked. The revision 2026-07-28 is not
offered; its clients fall back to these where ``server/discover`` is unknown.
"""

from __future__ import annotations

from collections.abc import Mapping

from imagine_bench.errors import ImagineBenchError, brief
from imagine_bench.values import Json
from imagine_bench.version import __version__

from .players import Answer, Players

VERSIONS = ("2025-11-25", "2025-06-18", "2025-03-26")
INVALID_REQUEST = -32600
_NO_METHOD = -32601
_INVALID_PARAMS = -32602
_PLAYER: Answer = {"type": "string", "description": "Your name as a player, always the same."}


def rpc_error(number: Json, code: int, message: str) -> Answer:
    """An error as JSON-RPC has it."""
    return {"jsonrpc": "2.0", "id": number, "error": {"code": code, "message": message}}


class _RpcError(Exception):
    """A request that is answered by an error of this code."""

    def __init__(self, code: int, message: str) -> None:
        super().__init__(message)
        self.code = code


def answer_rpc(players: Players, message: Json) -> Answer | None:
    """The answer to one JSON-RPC message; None to a notification."""
    number: Json = None
    try:
        if not isinstance(message, dict) or message.get("jsonrpc") != "2.0":
            raise _RpcError(INVALID_REQUEST, "This is no request of JSON-RPC 2.0.")
        if "id" not in message and isinstance(message.get("method"), str):
            return None
        if not isinstance(message.get("id"), str | int) or isinstance(message["id"], bool):
            raise _RpcError(INVALID_REQUEST, "The id of a request is a text or a whole number.")
        number = message["id"]
        params = message.get("params") or {}
        if not isinstance(params, dict):
            raise _RpcError(_INVALID_PARAMS, "The params of a request are a mapping.")
        return {"jsonrpc": "2.0", "id": number, "result": _result(players, message.get("method"), params)}
    except _RpcError as error:
        return rpc_error(number, error.code, str(error))


def _result(players: Players, method: Json, params: Mapping[str, Json]) -> Answer:
    """The result of a method. Raises _RpcError: there is no such one."""
    if method == "initialize":
        return _initialized(players, params)
    if method == "ping":
        return {}
    if method == "tools/list":
        return {"tools": _tools(players)}
    if method == "tools/call":
        return _called(players, params)
    raise _RpcError(_NO_METHOD, f"The method {brief(method)} is not offered here.")


def _initialized(players: Players, params: Mapping[str, Json]) -> Answer:
    asked = params.get("protocolVersion")
    return {
        "protocolVersion": asked if asked in VERSIONS else VERSIONS[0],
        "capabilities": {"tools": {}},
        "serverInfo": {"name": "imagine-bench", "version": __version__},
        "instructions": players.briefing,
    }


def _tools(players: Players) -> list[Json]:
    actions = "; ".join(f"{number}: {name}" for number, name in enumerate(players.spec.action_names))
    most = players.spec.n_actions - 1
    number: Answer = {"type": "integer", "minimum": 0, "maximum": most, "description": f"A macro-action. {actions}"}
    return [
        {
            "name": "reset",
            "description": f"Begin the next episode, or see the one again that goes on. {players.briefing}",
            "inputSchema": {"type": "object", "properties": {"player": _PLAYER}},
        },
        {
            "name": "step",
            "description": "Carry out a macro-action of the episode that goes on.",
            "inputSchema": {
                "type": "object",
                "properties": {"action": number, "player": _PLAYER},
                "required": ["action"],
            },
        },
        {
            "name": "state",
            "description": "Say which episode goes on, and how many macro-actions it has had.",
            "inputSchema": {"type": "object", "properties": {"player": _PLAYER}},
        },
    ]


def _called(players: Players, params: Mapping[str, Json]) -> Answer:
    """The result of a tool; a mistake of a player is a result, too. Raises _RpcError: there is no such tool."""
    tools = {"reset": players.reset, "step": players.step, "state": players.state}
    name = params.get("name")
    arguments = params.get("arguments") or {}
    if not isinstance(name, str) or name not in tools or not isinstance(arguments, dict):
        raise _RpcError(_INVALID_PARAMS, "There is no such tool; tools/list names them.")
    try:
        found = tools[name](arguments)
    except ImagineBenchError as error:
        return {"content": [{"type": "text", "text": str(error)}], "isError": True}
    shown = found.get("observation")
    if not isinstance(shown, dict):
        return {"content": [{"type": "text", "text": str(found["episode_id"])}], "isError": False}
    content: list[Json] = [{"type": "text", "text": shown["words"]}]
    if "png" in shown:
        content.append({"type": "image", "data": shown["png"], "mimeType": "image/png"})
    return {"content": content, "isError": False}
