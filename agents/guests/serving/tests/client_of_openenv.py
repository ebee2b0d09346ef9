"""Plays one episode with the client of the package ``openenv``; run by ``clients.sh`` in an environment of its own."""

import sys

from openenv import GenericEnvClient

with GenericEnvClient(base_url=sys.argv[1]).sync() as env:
    result = env.reset(player="openenv")
    assert result.observation["words"].startswith("Test 1 of "), result
    assert env.state()["step_count"] == 0
    try:
        env.step({"action": 77})
    except RuntimeError as error:
        assert "does not exist" in str(error), error
    else:
        raise AssertionError("a macro-action that does not exist was taken")
    while not result.done:
        result = env.step({"action": 2})
    print(f"openenv: {result.observation['words']}")
