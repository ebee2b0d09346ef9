"""A task over HTTP: words that are enough, three protocols, refusals, and a fuzz after which every episode holds."""

from __future__ import annotations

import base64
import http.client
import io
import json
import os
import random
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from imagine_bench_serving import server as module
from imagine_bench_serving.players import Players, Served
from imagine_bench_serving.server import MOST_BYTES, Server, announce, serve
from imagine_bench_serving.sockets import TextSocket, accept_key
from imagine_bench_serving.words import briefing, seen_in_words
from PIL import Image
from whole_outputs import KEPT, expected_of

from imagine_bench import registry
from imagine_bench.errors import ImagineBenchError, SetupError
from imagine_bench.interfaces import State, TaskSpec
from imagine_bench.judge.verify import verify_runs
from imagine_bench.running.player import played_run, protocol_of_player
from imagine_bench.version import __version__

SPEC = registry.task("arrow_puzzle")


@contextmanager
def served(root: Path, **options: Any) -> Iterator[Server]:
    """A server in a thread of this process."""
    found: list[Server] = []
    is_ready = threading.Event()

    def ready(one: Server) -> None:
        found.append(one)
        is_ready.set()

    task = Served(**{"task": "arrow_puzzle", "tests": 3, "execution": "kinematic", "out": root, **options})
    thread = threading.Thread(target=serve, args=(task,), kwargs={"port": 0, "ready": ready})
    thread.start()
    assert is_ready.wait(60)
    try:
        yield found[0]
    finally:
        found[0].shutdown()
        thread.join(60)


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    with served(tmp_path) as one:
        yield one


@pytest.mark.slow
def test_the_real_clients_play(server: Server, tmp_path: Path) -> None:
    """``clients.sh`` installs the packages mcp and openenv, each in an environment of its own."""
    script = Path(__file__).with_name("clients.sh")
    command = [str(script), f"http://127.0.0.1:{server.server_port}", str(tmp_path / "clients")]
    own = {**os.environ, "PYTHON": sys.executable}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=own)
    if "No matching distribution" in done.stderr or "Could not fetch" in done.stderr:
        pytest.skip("the packages cannot be installed here")
    assert done.returncode == 0, done.stderr
    assert [line.split()[0] for line in done.stdout.splitlines()] == ["mcp", "mcp", "openenv:"]


def ask(one: Server, path: str, body: object = None, **headers: str) -> tuple[int, Any]:
    """The status and the answer; a body is sent by POST, and bytes as they are."""
    line = http.client.HTTPConnection("127.0.0.1", one.server_port, timeout=30)
    content = body if isinstance(body, bytes) else None if body is None else json.dumps(body).encode()
    line.request("GET" if body is None else "POST", path, content, headers)
    answer = line.getresponse()
    text = answer.read().decode()
    line.close()
    is_json = answer.headers["Content-Type"] == "application/json"
    return answer.status, json.loads(text) if is_json and text else text


def told(spec: TaskSpec, answer: Any) -> State:
    """The macrostate that the words of an answer tell."""
    words = answer["observation"]["words"].partition("Seen now: ")[2].rstrip(".")
    named = dict(pair.split(": ") for pair in words.split("; "))
    pairs = zip(spec.macrostate_names, spec.macrostate_values, strict=True)
    return tuple(values.index(named[name]) for name, values in pairs)


def play_all(one: Server, player: str) -> None:
    """Play by the words alone, knowing the rules."""
    spec = one.players.spec
    all_done = False
    while not all_done:
        _, answer = ask(one, "/reset", {"player": player})
        moves = answer["metadata"]["step_count"]
        while not answer["done"]:
            action = spec.action_names[spec.rules.optimal_action(told(spec, answer))]
            _, answer = ask(one, "/step", {"player": player, "action": action})
            moves += 1
            assert answer["metadata"]["step_count"] == moves, "also after the last macro-action of the last test"
        all_done = answer["metadata"]["all_done"]
        then = " Now all 3 episodes are played. " if all_done else " Reset begins the next one. "
        assert then in answer["observation"]["words"]


def played_bench(root: Path, player: str) -> Path:
    """The bench of a player; all of its episodes hold."""
    (folder,) = root.glob(f"*/*/*-{player}")
    assert not any(verdict.complaint or verdict.unshown for verdict in verify_runs(folder.parent))
    return folder.parent


@pytest.mark.parametrize("task", ["arrow_puzzle", pytest.param("pick_place", marks=pytest.mark.slow)])
def test_words_are_enough_to_solve_a_task_and_its_episodes_hold(task: str, tmp_path: Path) -> None:
    with served(tmp_path, task=task) as one:
        play_all(one, "ann")
    rows = (played_bench(tmp_path, "ann") / "reader-ann" / "seed_0" / "metrics.csv").read_text().splitlines()
    assert dict(zip(rows[0].split(","), rows[1].split(","), strict=True))["solved"] == "111"


def test_words_tell_what_frames_show_and_no_more() -> None:
    """Where a frame hides the gesture, the words do; two macrostates of one frame have the same words."""
    shown = np.array([0, 1, 2, -1])
    words = {seen_in_words(SPEC, {"macrostate": np.array([0, 1, 2, goal]), "shown": shown}) for goal in (0, 1)}
    assert words == {
        "Seen now: left arrow: toward the human; middle arrow: right; right arrow: toward the agent; "
        "pointed cube: not seen."
    }
    brief = briefing(SPEC)
    assert all(name in brief for name in SPEC.action_names) and SPEC.description in brief
    assert "%" not in brief and "optimal" not in brief
    assert brief in (Path(__file__).parents[4] / "docs/how_to/players.md").read_text(), "the page shows it in full"
    turns = [SPEC.rules.outcomes((before, 0, 0, 0), 0)[0].macrostate[0] for before in range(4)]
    assert turns == [1, 2, 3, 0] and SPEC.macrostate_values[0] == (
        "toward the human",
        "right",
        "toward the agent",
        "left",
    )
    assert "toward the human to the right, from the right toward the agent, from there to the left" in brief


def test_a_viewer_is_shown_the_frame_and_no_words_of_it(tmp_path: Path) -> None:
    chosen: dict[str, Any] = {"training": 2, "appearance": "strong"}
    with served(tmp_path, observation="png", player="bo", **chosen) as one:
        status, answer = ask(one, "/reset", {})
        shown = answer["observation"]
        assert (status, shown["words"]) == (200, "Training episode 1 of 2.")
        image = np.array(Image.open(io.BytesIO(base64.b64decode(shown["png"]))))
        assert "Seen now" not in ask(one, "/step", {"action": 2})[1]["observation"]["words"]
        call = {"jsonrpc": "2.0", "id": 1, "method": "tools/call", "params": {"name": "reset"}}
        content = ask(one, "/mcp", call)[1]["result"]["content"]
        assert [part["type"] for part in content] == ["text", "image"]
    wanted = protocol_of_player("arrow_puzzle", "viewer", "cy", tests=3, execution="kinematic", **chosen)
    with played_run(wanted, tmp_path) as run:
        np.testing.assert_array_equal(run.reset()[0], image)


def test_a_player_comes_back_to_another_server(tmp_path: Path) -> None:
    ann = {"player": "ann"}
    with served(tmp_path) as one:
        start = told(SPEC, ask(one, "/reset", ann)[1])
        going_on = [action for action in range(6) if not SPEC.rules.outcomes(start, action)[0].terminated]
        said = ask(one, "/step", {**ann, "action": going_on[0]})[1]["observation"]["words"]
        assert f"{SPEC.horizon - 1} macro-actions are left." in said
        with served(tmp_path) as other:
            status, said = ask(other, "/reset", ann)
            assert status == 409 and "in use by process" in said["error"]
    with served(tmp_path) as one:
        back = ask(one, "/reset", ann)[1]
        assert "It goes on after 1 macro-actions." in back["observation"]["words"]
        here = told(SPEC, back)
        going_on = [action for action in range(6) if not SPEC.rules.outcomes(here, action)[0].terminated]
        said = ask(one, "/step", {**ann, "action": going_on[0]})[1]["observation"]["words"]
        assert f"{SPEC.horizon - 2} macro-actions are left." in said
        play_all(one, "ann")
    played_bench(tmp_path, "ann")


@pytest.mark.parametrize(
    ("body", "headers", "status"),
    [
        (b"[" * 60_000, {}, 400),
        (b"9" * 60_000, {}, 400),
        (b"x" * (MOST_BYTES + 1), {}, 413),
        (b"", {"Content-Length": "9" * 5000}, 413),
    ],
    ids=["deep", "digits", "long", "said to be long"],
)
def test_large_requests_are_refused(refusing: Server, body: bytes, headers: dict[str, str], status: int) -> None:
    found, answer = ask(refusing, "/reset", body, **headers)
    assert found == status and set(answer) == {"error"}


@pytest.mark.parametrize(
    ("path", "headers"),
    [("/nothing", {}), ("/health", {}), ("/reset", {"Origin": "http://elsewhere"}), ("/reset", {"Host": "elsewhere"})],
)
def test_a_refused_request_leaves_nothing_of_its_body_to_the_next(
    refusing: Server, path: str, headers: dict[str, str]
) -> None:
    with closing(http.client.HTTPConnection("127.0.0.1", refusing.server_port, timeout=30)) as line:
        line.request("POST", path, b"GET /state HTTP/1.1\r\n\r\n", headers)
        with line.getresponse() as answer:
            assert answer.status >= 400 and set(json.loads(answer.read())) == {"error"}
        line.request("GET", "/health")
        with line.getresponse() as answer:
            assert (answer.status, json.loads(answer.read())) == (200, {"status": "healthy"})


class Line:
    """A WebSocket's client, as OpenEnv's: masked text, and answers of any length."""

    def __init__(self, one: Server) -> None:
        self._line = socket.create_connection(("127.0.0.1", one.server_port), timeout=30)
        key = base64.b64encode(bytes(range(16))).decode()
        head = f"GET /ws HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nSec-WebSocket-Key: {key}\r\n\r\n"
        self._line.sendall(head.encode())
        self._answers = self._line.makefile("rb")
        lines = iter(self._answers.readline, b"\r\n")
        assert f"Sec-WebSocket-Accept: {accept_key(key)}\r\n".encode() in list(lines)

    def send(self, kind: int, content: bytes, more: int = 0) -> None:
        """A frame, which says that it is longer than it is."""
        size = len(content) + more
        head = bytes([0x80 | kind, 0x80 | size]) if size < 126 else bytes([0x80 | kind, 0xFF]) + size.to_bytes(8)
        mask = b"\x01\x02\x03\x04"
        self._line.sendall(head + mask + bytes(each ^ mask[place % 4] for place, each in enumerate(content)))

    def frame(self) -> tuple[int, bytes]:
        kind, size = self._answers.read(2)
        if size == 126:
            size = int.from_bytes(self._answers.read(2))
        return kind & 15, self._answers.read(size)

    def say(self, message: bytes) -> Any:
        self.send(1, message)
        return json.loads(self.frame()[1])

    def close(self) -> None:
        self._answers.close()
        self._line.close()


def test_answers_to_requests(server: Server, pytestconfig: pytest.Config) -> None:
    """One after the other; a line of the kept file is a path, headers and, where it is sent by POST, the body.

    Plain HTTP, the Model Context Protocol, whose codes of errors are those of JSON-RPC 2.0, and OpenEnv's WebSocket.
    """
    kept = (KEPT / "requests.txt").read_text(encoding="utf-8")
    answers = []
    codes = set()
    talk = Line(server)
    for line in re.findall(r"^\$ (.*)$", kept, re.MULTILINE):
        path, headers, *body = line.split(" ", 2)
        content = body[0].encode() if body else None
        said = path == "/ws" and content is not None
        status, answer = (101, talk.say(content)) if said else ask(server, path, content, **json.loads(headers))
        refused = answer["error"] if isinstance(answer, dict) and "error" in answer else ""
        if isinstance(refused, dict):
            codes.add(refused["code"])
        else:
            assert (status >= 400) == bool(refused) and "\n" not in refused, line
        answers += [f"$ {line}", f"{status} {json.dumps(answer)}", ""]
    talk.close()
    assert codes == {-32600, -32601, -32602}
    text = "\n".join(answers).replace(json.dumps(briefing(SPEC))[1:-1], "BRIEFING").replace(__version__, "VERSION")
    expected_of(pytestconfig)("requests", text)


@pytest.mark.parametrize(
    ("kind", "content", "more", "answer"),
    [
        (9, b"beat", 0, (10, b"beat")),
        (1, b"\xff", 0, (8, (1007).to_bytes(2))),
        (1, b"", MOST_BYTES + 1, (8, (1009).to_bytes(2))),
        (8, b"\x03\xe8", 0, (8, b"\x03\xe8")),
    ],
    ids=["ping", "no text", "too long", "closed"],
)
def test_frames_of_a_websocket(
    refusing: Server, kind: int, content: bytes, more: int, answer: tuple[int, bytes]
) -> None:
    assert accept_key("dGhlIHNhbXBsZSBub25jZQ==") == "s3pPLMBiTxaQ9kYGzzhZRbK+xOo=", "the example of RFC 6455"
    line = Line(refusing)
    line.send(kind, content, more)
    assert line.frame() == answer
    line.close()


@pytest.mark.parametrize("size", [0, 125, 126, 65_535, 65_536])
def test_a_message_of_any_length_is_framed_as_rfc_6455_says(size: int) -> None:
    """Its length in 7 bits, or in 16 or 64 behind them, with the highest byte first."""
    text, outgoing = bytes(each % 128 for each in range(size)), io.BytesIO()
    short, more = (size, b"") if size < 126 else (126, size.to_bytes(2)) if size < 65_536 else (127, size.to_bytes(8))
    masked = bytes(each ^ b"mask"[place % 4] for place, each in enumerate(text))
    talk = TextSocket(io.BytesIO(bytes([0x81, 0x80 | short]) + more + b"mask" + masked), outgoing, 65_536)
    talk.send(talk.receive())
    assert outgoing.getvalue() == bytes([0x81, short]) + more + text


def test_a_websocket_keeps_only_the_player_of_a_reset(refusing: Server) -> None:
    """A seed, for which a reset is refused, and an action are forgotten."""
    line = Line(refusing)

    def say(kind: str, **data: Any) -> Any:
        return line.say(json.dumps({"type": kind, "data": data}).encode())

    assert "leave the seed out" in say("reset", player="eve", seed=3)["data"]["message"]
    begun = say("reset")["data"]["metadata"]
    assert (begun["player"], begun["step_count"]) == ("reader:eve", 0)
    assert say("reset", action=0)["type"] == "observation"
    assert "Action None does not exist" in say("step")["data"]["message"]
    assert say("step", action=0)["data"]["metadata"] == {**begun, "step_count": 1}
    line.close()


@pytest.fixture(scope="module")
def refusing(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with served(tmp_path_factory.mktemp("runs")) as one:
        yield one


def test_few_players_and_few_connections_are_let_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_CONNECTIONS", 2)
    with served(tmp_path, most_players=1) as one:
        assert ask(one, "/reset", {"player": "ann"})[0] == 200
        status, said = ask(one, "/reset", {"player": "bo"})
        assert status == 400 and "1 players are here already" in said["error"]
        assert ask(one, "/reset", {"player": "ann"})[0] == 200, "who is in stays"
        silent = [silent_connection(one) for _ in range(2)]
        with pytest.raises((http.client.HTTPException, OSError)):
            ask(one, "/health")
        for each in silent:
            each.close()
        assert answers(one), "closed connections make room"


def test_a_connection_that_says_nothing_is_closed(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module.Handler, "timeout", 0.5)
    talk = Line(server)
    with socket.create_connection(("127.0.0.1", server.server_port), timeout=30) as silent:
        assert silent.recv(1) == b""
    assert ask(server, "/health")[0] == 200
    assert talk.say(b'{"type": "state", "data": {"player": "ann"}}')["type"] == "state", "who thinks for long plays on"
    talk.close()


def silent_connection(server: Server) -> socket.socket:
    """A connection that says nothing and is let in, as soon as earlier ones have made room for it."""
    for _ in range(100):
        found = socket.create_connection(("127.0.0.1", server.server_port), timeout=0.1)
        try:
            assert found.recv(1) == b"", "nothing is said before a request"
        except TimeoutError:
            return found
        except OSError:  # it was refused
            pass
        found.close()
    raise AssertionError("No connection was let in.")


def answers(server: Server) -> bool:
    """Whether a server takes a connection, within ten seconds."""
    for _ in range(100):
        with suppress(http.client.HTTPException, OSError):
            return ask(server, "/health")[0] == 200
        time.sleep(0.1)
    return False


def test_it_binds_to_this_machine_alone_and_says_where_it_cannot(
    tmp_path: Path, refusing: Server, capsys: pytest.CaptureFixture[str]
) -> None:
    announce(refusing)
    at = f"http://127.0.0.1:{refusing.server_port}"
    said = f"{SPEC.title}: {at}, MCP at {at}/mcp, OpenEnv at {at}. Ctrl-C ends it.\n"
    assert capsys.readouterr().out == said and refusing.server_address[0] == "127.0.0.1"
    players = Players(Served(task="arrow_puzzle", execution="kinematic", out=tmp_path))
    with pytest.raises(SetupError, match=r"cannot be served at: .* give another --port"):
        Server(players, "127.0.0.1", refusing.server_port)
    with pytest.raises(SetupError, match="ports end at 65535"):
        Server(players, "127.0.0.1", 70_000)
    with Server(players, "0.0.0.0", 0) as reachable:
        announce(reachable)
        threading.Thread(target=reachable.serve_forever).start()
        for origin, status in (("here", 200), ("elsewhere", 403)):
            assert ask(reachable, "/health", Host="here", Origin=f"http://{origin}")[0] == status
        reachable.shutdown()
    assert "There is no key: whoever reaches this machine can play" in capsys.readouterr().out
    players.close()
    with pytest.raises(ImagineBenchError, match="players"):
        Players(Served(task="arrow_puzzle", most_players=0))


# A fuzz -------------------------------------------------------------------------------------------------------------


def hostile(rng: random.Random) -> bytes:
    """A request that is right, nearly right, or noise."""
    player = rng.choice(["ann", "bo", "../x", "", "é", "x" * 50, 3, None, ["ann"], {"a": 1}])
    action = rng.choice(
        [*range(6), -1, 6, 10**30, 1.5, True, None, "0", SPEC.action_names[1], {"action": 2}, [], "\x00"]
    )
    method = rng.choice(["initialize", "tools/list", "tools/call", "ping", "x", 3, None])
    call = {"name": rng.choice(["reset", "step", "state", "x"]), "arguments": {"player": player, "action": action}}
    bodies = [
        {"player": player, "action": action},
        {"player": "ann", "action": rng.randrange(6)},
        {"jsonrpc": "2.0", "id": rng.choice([1, "a", None, 1.5, []]), "method": method, "params": call},
        rng.choice([[], 0, "x", None, [[[]]], {"player": {"player": "ann"}}]),
    ]
    body = json.dumps(rng.choice(bodies)).encode()
    if rng.random() < 0.3:
        cut = rng.randrange(len(body) + 1)
        body = body[:cut] + rng.randbytes(rng.randrange(9)) + body[cut + rng.randrange(3) :]
    length = rng.choice([len(body)] * 9 + [0, len(body) // 2, len(body) + 1, 10**9, -1])
    path = rng.choice(["/reset", "/step", "/mcp", "/state?player=ann", "/", "/ws", "/health", "/x", "/%00", "//[", "*"])
    verb = rng.choice(["POST"] * 6 + ["GET", "PUT", "HEAD", "POST /reset HTTP/1.1\r\nA", "\x00"])
    more = rng.choice(
        [""] * 6 + ["Origin: http://x\r\n", "Upgrade: websocket\r\nSec-WebSocket-Key: a\r\n", "\xff: \r\n"]
    )
    head = f"{verb} {path} HTTP/1.1\r\nHost: localhost\r\nContent-Length: {length}\r\n{more}\r\n"
    request = head.encode("latin-1") + body
    return rng.randbytes(rng.randrange(200)) if rng.random() < 0.05 else request


def fuzz(root: Path, count: int, monkeypatch: pytest.MonkeyPatch) -> set[int]:
    """Send so many requests, one connection each, and go on playing; returns the statuses that were answered."""
    for where, name in ((module, "PATIENCE_S"), (module.Handler, "timeout"), (module, "SOCKET_PATIENCE_S")):
        monkeypatch.setattr(where, name, 0.2)
    statuses = set()
    rng = random.Random(0)
    with served(root, tests=3, most_players=4) as one:
        for _ in range(count):
            line = socket.create_connection(("127.0.0.1", one.server_port), timeout=30)
            line.sendall(hostile(rng))
            line.shutdown(socket.SHUT_WR)
            answer = b""
            with suppress(ConnectionResetError):  # it was closed while more lay in it
                while part := line.recv(65_536):
                    answer += part
            line.close()
            if answer.startswith(b"HTTP/1.1 "):
                statuses.add(int(answer[9:12]))
        assert ask(one, "/health") == (200, {"status": "healthy"})
        for player in ("ann", "bo"):
            if not ask(one, f"/state?player={player}")[1]["all_done"]:
                play_all(one, player)
    for player in ("ann", "bo"):
        played_bench(root, player)
    return statuses


@pytest.mark.parametrize("count", [300, pytest.param(10_000, marks=pytest.mark.slow)])
def test_a_fuzz_of_many_requests(count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    statuses = fuzz(tmp_path, count, monkeypatch)
    assert {200, 400, 403, 404, 405} <= statuses and 500 not in statuses, statuses
