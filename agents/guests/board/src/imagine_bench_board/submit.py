"""Rows from benches: the tests that a bench kept, or new ones at the published starts of a round."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from imagine_bench.errors import ArtefactError, InvalidValueError, require
from imagine_bench.protocols.control import Protocol
from imagine_bench.registry.entries import file_name
from imagine_bench.report.data import known_agent
from imagine_bench.running.evaluation import EpisodeLog, EvaluationCounts, play_test_episode
from imagine_bench.running.retraining import part_digest
from imagine_bench.running.run_state import environments
from imagine_bench.running.trained import load_trained
from imagine_bench.seeding import episode_seed
from imagine_bench.store import encoders, run_folder
from imagine_bench.store.bench_folder import BenchStore, bench_facts, is_archive, read_control
from imagine_bench.store.files import require_writable, sha256
from imagine_bench.store.results import Checkpoint

from . import rounds
from .rows import Claims, Cost, Figures, Row, one_line, place_of, row_name, write_row

T = TypeVar("T")


class Submitter:
    """An agent of a finished bench, with all of its seeds.

    Args:
        bench: The bench's folder.
        agent: The agent.

    Raises:
        ArtefactError: A run is not finished.
    """

    def __init__(self, bench: Path, agent: str) -> None:
        whole = read_control(bench)
        seeds = whole.seeds_of(agent)
        self.bench = bench
        self.hash = whole.hash
        self.name = row_name(file_name(agent), whole.hash)
        self.protocol = dataclasses.replace(whole, agents=(agent,), seeds=seeds, headlines=(), few_seeds=())
        self.agent = agent
        self.runs = {seed: BenchStore(bench, whole).run_folder(agent, seed) for seed in seeds}
        for folder in self.runs.values():
            require(run_folder.is_done(folder), f"{folder} is not finished; run its bench again.")

    def name_in(self, round_folder: Path) -> str:
        """The name of its row in a round."""
        return row_name(file_name(self.agent), f"{self.hash}-{round_folder.name}")

    def require_player(self) -> None:
        """Raise InvalidValueError for an agent that cannot play the tests of a round."""
        entry = known_agent(self.agent)
        if entry.external_training_loop or entry.is_player or not self.protocol.shows_frames_alone:
            raise InvalidValueError(f"{self.agent} cannot be taken up again; submit the tests of its bench.")

    def digests(self) -> dict[int, str]:
        """The digest of the trained agent of each seed; empty where it has no weights."""
        found = {}
        for seed, folder in self.runs.items():
            snapshot = run_folder.load_newest(folder / run_folder.CHECKPOINTS)
            found[seed] = part_digest(snapshot.agent) if snapshot is not None and snapshot.agent.arrays else ""
        return found

    def row(self, author: str) -> Row:
        """The row of the tests that the bench kept. Raises ArtefactError: it kept none."""
        found = {seed: run_folder.load_run(folder).checkpoints for seed, folder in self.runs.items()}
        return self._row(self.protocol, found, author)

    def row_of_round(self, folder: Path, author: str, encoder: str | None) -> Row:
        """The row of new tests at the published starts of a round, played by the agents that were filed.

        Raises:
            ArtefactError: The seed is not published, or these agents were not filed before.
            InvalidValueError: An agent that cannot be taken up again.
        """
        self.require_player()
        name = self.name_in(folder)
        start_seed, filed = rounds.revealed_seed(folder, name)
        digests = {str(seed): weights for seed, weights in self.digests().items()}
        require(digests == filed, f"The agents of {self.bench} are not those that were filed as {name}.")
        tests = rounds.read_round(folder).tests
        protocol = dataclasses.replace(self.protocol, budgets=self.protocol.budgets[-1:], evaluation_episodes=tests)
        found = {}
        for seed, run in self.runs.items():
            log = _played(run, protocol, start_seed, encoder)
            last = run_folder.load_run(run).checkpoints[-1]
            found[seed] = (dataclasses.replace(last, kept=log.kept(), **log.figures()),)
        return dataclasses.replace(self._row(protocol, found, author), name=name, round=folder.name)

    def _row(self, protocol: Protocol, found: Mapping[int, Sequence[Checkpoint]], author: str) -> Row:
        digests = self.digests()
        figures = []
        prices = []
        logs = []
        for seed, checkpoints in found.items():
            for each in checkpoints:
                if each.kept is None:
                    raise ArtefactError(f"{self.bench} kept no test episodes; run the bench anew.")
                values = {**vars(each), "seed": seed, "agent_sha256": digests[seed]}
                figures.append(_some(Figures, values))
                prices.append(_some(Cost, values))
                logs.append(EpisodeLog.of(each.kept))
        environment = bench_facts(self.bench)["environment"]
        claimed = Claims(
            agent=self.agent,
            author=author,
            commit=str(environment.get("commit")),
            command=one_line(environment["command"]),
            machine=one_line(environment.get("machine", {}).get("cpu")),
            seen_beforehand=one_line(_seen_beforehand(protocol, self.agent)),
            frames_beforehand=_frames_beforehand(protocol, self.agent),
            prices=tuple(prices),
        )
        return Row(name=self.name, protocol=protocol, vouched=tuple(figures), claimed=claimed, logs=tuple(logs))


def _some(kind: type[T], values: Mapping[str, Any]) -> T:
    """A dataclass from those of the values that are its fields."""
    return kind(**{name: values[name] for name in get_type_hints(kind)})


def _seen_beforehand(protocol: Protocol, agent: str) -> str:
    """The data that an agent had before its first episode, in words."""
    entry = known_agent(agent)
    words = {
        f"encoder {protocol.encoder_of(entry.encoder_kind)}": entry.make and entry.needs_encoder,
        f"dataset {protocol.dataset}": entry.learns and protocol.dataset,
        f"{protocol.demonstrations} demonstrations": entry.learns and protocol.demonstrations,
        f"{protocol.episodes_before} episodes of {', '.join(protocol.after)}": entry.learns and protocol.after,
        f"{protocol.queries} oracle queries an episode": entry.learns and protocol.queries,
        "a teacher's feedback": entry.learns and protocol.feedback,
        "privileged: true macrostates": entry.privileged,
    }
    return "; ".join(word for word, is_seen in words.items() if is_seen) or "nothing"


def _frames_beforehand(protocol: Protocol, agent: str) -> int | None:
    """The frames that an agent had before its first episode; None where nobody counted them."""
    entry = known_agent(agent)
    if entry.learns and (protocol.dataset or protocol.demonstrations or protocol.after):
        return None
    if not entry.make or not entry.needs_encoder:
        return 0 if entry.make else None
    card = encoders.card(protocol.encoder_of(entry.encoder_kind))
    return None if card is None or card.get("offer") else int(card["recipe"]["frames"])


def _played(run: Path, protocol: Protocol, seed: int, encoder: str | None) -> EvaluationCounts:
    """Greedy tests of a run's trained agent, at the starts of a round's seed."""
    agent = load_trained(run, encoder=encoder).agent
    privileged = known_agent(protocol.agents[0]).privileged
    log = EvaluationCounts()
    with environments(protocol) as (_, env):
        for test in range(protocol.evaluation_episodes):
            log.add(play_test_episode(env, agent, seed=episode_seed("board", seed, test), privileged=privileged))
    return log


def submitters(path: Path) -> list[Submitter]:
    """The agent of a run's folder or, of a bench's folder, all of its agents.

    Raises ArtefactError: the path is neither, or holds kept results without episodes.
    """
    if (path / "config.json").is_file():
        run = Path(os.path.abspath(path))
        protocol = read_control(run.parents[1])
        names = {file_name(protocol.written_name(agent)): agent for agent in protocol.agents}
        return [Submitter(run.parents[1], names[run.parent.name])]
    protocol = read_control(path)
    if is_archive(path):
        raise ArtefactError(f"{path} holds kept results without episodes; give the folder of a bench of your own.")
    return [Submitter(path, agent) for agent in protocol.agents]


def submit(path: Path, out: Path, *, author: str, round_folder: Path | None, encoder: str | None) -> list[Path]:
    """Write the rows of a run or a bench below ``out``. Errors as of :class:`Submitter` and :func:`.write_row`."""
    Claims(agent="", author=author)  # raises its error before any test is played, as the next two do
    require_writable(out)
    found = submitters(path)
    for each in found:
        place_of(out, each.name if round_folder is None else each.name_in(round_folder))
    written = []
    for each in found:
        row = each.row(author) if round_folder is None else each.row_of_round(round_folder, author, encoder)
        written.append(write_row(out, row))
    return written


def file_agents(path: Path, round_folder: Path) -> list[Path]:
    """File the agents of a run or a bench, or the file of a policy of continuous control, in a round.

    Errors as of :func:`.rounds.file_agents`.
    """
    if path.is_file():
        return [rounds.file_agents(round_folder, rounds.policy_row(round_folder, path), {rounds.POLICY: sha256(path)})]
    found = submitters(path)
    for each in found:
        each.require_player()
    return [rounds.file_agents(round_folder, each.name_in(round_folder), each.digests()) for each in found]
