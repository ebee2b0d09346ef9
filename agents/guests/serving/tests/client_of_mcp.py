"""Plays one episode with the client of the package ``mcp``; run by ``clients.sh`` in an environment of its own."""

import asyncio
import sys

from mcp.client.client import Client


async def main() -> None:
    """Play in the mode that asks for the newest revision first, and in the one of the handshake."""
    for mode in ("auto", "legacy"):
        async with Client(f"{sys.argv[1]}/mcp", mode=mode) as client:
            tools = [tool.name for tool in (await client.list_tools()).tools]
            assert tools == ["reset", "step", "state"], tools
            player = f"mcp-{mode}"
            begun = await client.call_tool("reset", {"player": player})
            assert begun.content[0].text.startswith("Test 1 of "), begun
            wrong = await client.call_tool("step", {"player": player, "action": 77})
            assert wrong.is_error and "does not exist" in wrong.content[0].text, wrong
            words = ""
            while "The episode is over" not in words:
                done = await client.call_tool("step", {"player": player, "action": 2})
                words = done.content[0].text
            print(f"mcp {mode}, revision {client.protocol_version}: {words}")


asyncio.run(main())
