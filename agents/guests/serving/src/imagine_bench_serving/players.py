"""The players of a server: each one's run, its next episode, and its answers. One thread does all of it."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar, cast

from PIL import Image

from imagine_bench import registry
from imagine_bench.arrays import Frame, Info, Observed
from imagine_bench.errors import InvalidValueError, brief, require_integer, require_known
from imagine_bench.protocols.control import Protocol
from imagine_bench.running.bench import certificate_of
from imagine_bench.running.player import PlayedRun, played_run, protocol_of_player
from imagine_bench.values import Json

from .words import briefing, done_in_words, end_in_words, seen_in_words

T = TypeVar("T")
OBSERVATIONS = ("words", "png")
_KINDS = dict(zip(OBSERVATIONS, ("reader", "viewer"), strict=True))
MOST_PLAYERS = 16
Answer = dict[str, Json]


@dataclass(frozen=True, kw_only=True)
class Served:
    """The choices of a server: the world, the episodes of each player, and the form of observations."""

    task: str | None
    observation: str = OBSERVATIONS[0]  #: ``"words"`` or ``"png"``
    player: str | None = None  #: The player of requests that name none
    training: int | None = None  #: As of :func:`imagine_bench.running.player.protocol_of_player`, as the next
    tests: int | None = None
    like: Path | None = None
    execution: str | None = None
    appearance: str | None = None
    most_players: int = MOST_PLAYERS  #: Different players that are let in while the server runs
    out: Path = Path("runs")  #: Folder of all benches


class Players:
    """The runs of all players of a server, opened when a player first asks.

    Raises:
        ImagineBenchError: The task, the bench or a number cannot be served.
    """

    def __init__(self, served: Served) -> None:
        require_known("observation", served.observation, OBSERVATIONS)
        require_integer("players", served.most_players, 1)
        self._served = served
        self._runs: dict[str, PlayedRun] = {}
        self._held = ExitStack()
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="episodes")
        wanted = self._protocol("anybody")
        self.spec = registry.task(wanted.task)
        certificate_of(wanted.task, wanted.split)  # takes seconds once, and no player should wait for it
        self.briefing = briefing(self.spec)

    def close(self) -> None:
        """Let go of every run; each goes on where it is when its player comes back to another server."""
        self._worker.submit(self._held.close).result()
        self._worker.shutdown()

    def reset(self, given: Mapping[str, Json]) -> Answer:
        """Begin a player's next episode, or see the one again that goes on.

        ``given`` may name the ``player``. Raises ImagineBenchError: it names no player, or none more may come.
        """
        if given.get("seed") is not None:
            raise InvalidValueError("Episodes begin where everybody's begin; leave the seed out.")
        return self._on_worker(lambda: self._reset(self._run(given)))

    def step(self, given: Mapping[str, Json]) -> Answer:
        """Carry out a macro-action, by number or name, also as ``{"action": ...}``. Raises ImagineBenchError."""
        return self._on_worker(lambda: self._step(self._run(given), given.get("action")))

    def state(self, given: Mapping[str, Json]) -> Answer:
        """Where a player's run is. Raises ImagineBenchError."""
        return self._on_worker(lambda: self._state(self._run(given)))

    def _on_worker(self, work: Callable[[], T]) -> T:
        return self._worker.submit(work).result()

    def _protocol(self, name: str) -> Protocol:
        served = self._served
        return protocol_of_player(
            served.task,
            _KINDS[served.observation],
            name,
            training=served.training,
            tests=served.tests,
            like=served.like,
            execution=served.execution,
            appearance=served.appearance,
        )

    def _run(self, given: Mapping[str, Json]) -> PlayedRun:
        name = given.get("player", self._served.player)
        if not isinstance(name, str):
            raise InvalidValueError(f'The player is {brief(name)}; give a name as "player".')
        if name not in self._runs:
            if len(self._runs) >= self._served.most_players:
                raise InvalidValueError(f"{len(self._runs)} players are here already; nobody else is let in.")
            wanted = self._protocol(name)
            self._runs[name] = self._held.enter_context(played_run(wanted, self._served.out))
        return self._runs[name]

    def _reset(self, run: PlayedRun) -> Answer:
        seen, info = run.reset()
        words = [f"{run.words.capitalize()}."]
        if run.moves:
            words.append(f"It goes on after {run.moves} macro-actions.")
        return self._answer(run, seen, info, words, reward=None, done=False)

    def _step(self, run: PlayedRun, given: Json) -> Answer:
        action = self._action(given)
        seen, reward, terminated, truncated, info = run.step(action)
        over = bool(terminated or truncated)
        words = [done_in_words(self.spec, action, float(reward))]
        if over:
            words.append(end_in_words(info, terminated=bool(terminated)))
            words.append(f"Now {run.words}." if run.is_done else "Reset begins the next one.")
        else:
            words.append(f"{self.spec.horizon - run.moves} macro-actions are left.")
        return self._answer(run, seen, info, words, reward=float(reward), done=over)

    def _action(self, given: Json) -> int:
        """The number of a macro-action that was given by number, by name, or in a mapping."""
        if isinstance(given, dict):
            given = given.get("action")
        names = self.spec.action_names
        words = [*names, *map(str, range(len(names)))]
        if isinstance(given, str) and given.strip() in words:
            return words.index(given.strip()) % len(names)
        if isinstance(given, int) and not isinstance(given, bool) and 0 <= given < len(names):
            return given
        raise InvalidValueError(
            f"Action {brief(given)} does not exist; give a number from 0 to {len(names) - 1} or a name, such as "
            f"{names[0]!r}."
        )

    def _answer(
        self, run: PlayedRun, seen: Observed, info: Info, words: list[str], *, reward: float | None, done: bool
    ) -> Answer:
        shown: Answer = {}
        if self._served.observation == "png":
            shown["png"] = _png(cast("Frame", seen))
        else:
            words = [*words, seen_in_words(self.spec, info)]
        shown["words"] = " ".join(words)
        return {"observation": shown, "reward": reward, "done": done, "metadata": self._state(run)}

    @staticmethod
    def _state(run: PlayedRun) -> Answer:
        return {
            "episode_id": f"{run.player}: {run.words}",
            "step_count": run.moves,
            "player": run.player,
            "all_done": run.is_done,
        }


def _png(frame: Frame) -> str:
    """A frame as PNG, as base64 writes it."""
    file = io.BytesIO()
    Image.fromarray(frame).save(file, "PNG")
    return base64.b64encode(file.getvalue()).decode()
