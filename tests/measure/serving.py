"""How long a step takes over HTTP, beside the same steps of the environment alone: median of one process.

    python tests/measure/serving.py [STEPS]

Both play random macro-actions from the same starts. The client is in the process of the server.
"""

from __future__ import annotations

import http.client
import json
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from imagine_bench_serving.players import Served
from imagine_bench_serving.server import Server, serve

from imagine_bench import registry
from imagine_bench.running.player import protocol_of_player
from imagine_bench.running.run_state import make_env
from imagine_bench.seeding import episode_seed

TASK = "arrow_puzzle"


def alone(execution: str, steps: int) -> list[float]:
    """Milliseconds of each step of the environment."""
    wanted = protocol_of_player(TASK, "person", "nobody", execution=execution)
    env = make_env(wanted, TASK, testing=True)
    rng = np.random.default_rng(0)
    taken: list[float] = []
    episode = 0
    while len(taken) < steps:
        env.reset(seed=episode_seed("evaluation", 0, episode))
        episode += 1
        over = False
        while not over:
            action = int(rng.integers(6))
            begun_s = time.perf_counter()
            _, _, terminated, truncated, _ = env.step(action)
            taken.append(1000.0 * (time.perf_counter() - begun_s))
            over = terminated or truncated
    env.close()
    return taken


def over_http(execution: str, observation: str, steps: int) -> list[float]:
    """Milliseconds of each step as a client sees it, on one connection."""
    found: list[Server] = []
    is_ready = threading.Event()

    def ready(server: Server) -> None:
        found.append(server)
        is_ready.set()

    with tempfile.TemporaryDirectory() as folder:
        served = Served(
            task=TASK, observation=observation, player="me", execution=execution, tests=steps, out=Path(folder)
        )
        thread = threading.Thread(target=serve, args=(served,), kwargs={"port": 0, "ready": ready})
        thread.start()
        is_ready.wait()
        line = http.client.HTTPConnection("127.0.0.1", found[0].server_port)

        def ask(path: str, **body: object) -> dict[str, object]:
            line.request("POST", path, json.dumps(body))
            answer: dict[str, object] = json.loads(line.getresponse().read())
            return answer

        rng = np.random.default_rng(0)
        taken: list[float] = []
        while len(taken) < steps:
            answer = ask("/reset")
            while not answer["done"]:
                action = int(rng.integers(6))
                begun_s = time.perf_counter()
                answer = ask("/step", action=action)
                taken.append(1000.0 * (time.perf_counter() - begun_s))
        line.close()
        found[0].shutdown()
        thread.join()
    return taken


def main() -> None:
    """Print a line for each way."""
    steps = int(sys.argv[1]) if len(sys.argv) > 1 else 300
    print(f"{registry.task(TASK).title}, {steps} steps; milliseconds of wall time, median (95 % of them below)")
    for execution in ("kinematic", "physics"):
        base = alone(execution, steps)
        print(f"{execution}, environment alone: {np.median(base):.2f} ({np.quantile(base, 0.95):.2f})")
        for observation in ("words", "png"):
            taken = over_http(execution, observation, steps)
            ratio = np.median(taken) / np.median(base)
            print(
                f"{execution}, HTTP, {observation}: {np.median(taken):.2f} ({np.quantile(taken, 0.95):.2f}), "
                f"{ratio:.2f} times the environment alone"
            )


if __name__ == "__main__":
    main()
