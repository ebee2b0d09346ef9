"""A WebSocket (RFC 6455), as far as OpenEnv's client needs it: whole text messages, pings, and a close."""

from __future__ import annotations

import base64
import hashlib
import struct
from contextlib import suppress
from io import BufferedIOBase

_MAGIC = "258EAFA5-E914-47DA-95CA-C5AB0DC85B11"
"""The text that a server adds to the client's key, RFC 6455, section 1.3."""
_TEXT = 1
_CLOSE = 8
_PING = 9
_PONG = 10
_TOO_LARGE = 1009
_NOT_TAKEN = 1003
_NO_TEXT = 1007
"""Codes of a close, RFC 6455, section 7.4.1."""


class ClosedError(Exception):
    """The other side has closed the connection, or sent something that is not taken."""


def accept_key(key: str) -> str:
    """The answer to a client's key in the handshake."""
    return base64.b64encode(hashlib.sha1((key + _MAGIC).encode(), usedforsecurity=False).digest()).decode()


class TextSocket:
    """Text messages over an open connection.

    Args:
        incoming: The bytes from the client.
        outgoing: The bytes to the client.
        most_bytes: Bytes of the longest message that is taken.
    """

    def __init__(self, incoming: BufferedIOBase, outgoing: BufferedIOBase, most_bytes: int) -> None:
        self._incoming = incoming
        self._outgoing = outgoing
        self._most_bytes = most_bytes

    def receive(self) -> str:
        """The next message. Raises ClosedError."""
        while True:
            kind, content = self._frame()
            if kind == _TEXT:
                with suppress(UnicodeDecodeError):
                    return content.decode()
                self.close(struct.pack("!H", _NO_TEXT))
            if kind == _PING:
                self._send(_PONG, content)
            elif kind == _CLOSE:
                self.close(content[:2])
            elif kind != _PONG:
                self.close(struct.pack("!H", _NOT_TAKEN))

    def send(self, text: str) -> None:
        """Send a message."""
        self._send(_TEXT, text.encode())

    def close(self, code: bytes) -> None:
        """Say why, and raise ClosedError."""
        self._send(_CLOSE, code)
        raise ClosedError

    def _frame(self) -> tuple[int, bytes]:
        first, second = self._read(2)
        is_whole = bool(first & 0x80)
        is_masked = bool(second & 0x80)
        length = second & 0x7F
        if not is_whole or first & 0x70 or not is_masked:  # a part of a message, an extension, or no client
            self.close(struct.pack("!H", _NOT_TAKEN))
        if length == 126:
            (length,) = struct.unpack("!H", self._read(2))
        elif length == 127:
            (length,) = struct.unpack("!Q", self._read(8))
        if length > self._most_bytes:
            self.close(struct.pack("!H", _TOO_LARGE))
        mask = self._read(4)
        content = self._read(length)
        return first & 0x0F, bytes(byte ^ mask[place % 4] for place, byte in enumerate(content))

    def _read(self, count: int) -> bytes:
        found = self._incoming.read(count)
        if len(found) < count:
            raise ClosedError
        return found

    def _send(self, kind: int, content: bytes) -> None:
        length = len(content)
        if length < 126:
            head = bytes([0x80 | kind, length])
        elif length < 1 << 16:
            head = struct.pack("!BBH", 0x80 | kind, 126, length)
        else:
            head = struct.pack("!BBQ", 0x80 | kind, 127, length)
        self._outgoing.write(head + content)
        self._outgoing.flush()
