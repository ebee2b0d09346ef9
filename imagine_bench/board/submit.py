"""Rows from benches: the tests that a bench kept, or new ones at the published starts of a round."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

from imagine_bench.board import rounds
from imagine_bench.board.rows import Claims, Figures, Price, Row, write_row
from imagine_bench.errors import ArtefactError, InvalidValueError
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
from imagine_bench.store.results import Checkpoint


@dataclasses.dataclass(frozen=True)
class Submitter:
    """An agent of a finished bench, with all of its seeds.

    Args:
        bench: The bench's folder.
        agent: The agent.
    """

    bench: Path
    agent: str

    @property
    def protocol(self) -> Protocol:
        """The bench's protocol, of this agent alone."""
        whole = read_control(self.bench)
        seeds = whole.seeds_of(self.agent)
        return dataclasses.replace(whole, agents=(self.agent,), seeds=seeds, headlines=(), few_seeds=())

    @property
    def name(self) -> str:
        """The name of its rows: that of the agent, and of the bench's protocol."""
        whole = read_control(self.bench)
        safe = re.sub("[^a-z0-9_.,=-]", "-", file_name(self.agent).lower())
        return f"{safe[:60]}-{whole.hash}"

    def run_folders(self) -> dict[int, Path]:
        """Its runs by seed. Raises ArtefactError: one is not finished."""
        store = BenchStore(self.bench, self.protocol)
        found = {seed: store.run_folder(self.agent, seed) for seed in self.protocol.seeds}
        for folder in found.values():
            if not run_folder.is_done(folder):
                raise ArtefactError(f"{folder} is not finished; run its bench again.")
        return found

    def digests(self) -> dict[int, str]:
        """The digest of the trained agent of each seed; empty where it has no weights."""
        return {seed: _weights(folder) for seed, folder in self.run_folders().items()}

    def claims(self, prices: tuple[Price, ...], author: str) -> Claims:
        """The statements beside its tests."""
        environment = bench_facts(self.bench)["environment"]
        beforehand, frames = _seen_beforehand(self.protocol, self.agent)
        return Claims(
            agent=self.agent,
            author=author,
            commit=str(environment.get("commit")),
            command=str(environment["command"]),
            machine=str(environment.get("machine", {}).get("cpu")),
            seen_beforehand=beforehand,
            frames_beforehand=frames,
            prices=prices,
        )

    def row(self, author: str) -> Row:
        """The row of the tests that the bench kept. Raises ArtefactError: it kept none."""
        parts = []
        for seed, folder in self.run_folders().items():
            weights = _weights(folder)
            parts += [(seed, each, weights) for each in run_folder.load_run(folder).checkpoints]
        return self._row(self.protocol, parts, author)

    def row_of_round(self, folder: Path, author: str, encoder: str | None) -> Row:
        """The row of new tests at the published starts of a round, played by the agents that were filed.

        Raises:
            ArtefactError: The seed is not published, or these agents were not filed before.
            InvalidValueError: An agent that cannot be taken up again.
        """
        if known_agent(self.agent).external_training_loop:
            raise InvalidValueError(f"{self.agent} cannot be taken up again; submit the tests of its bench.")
        name = f"{self.name}-{folder.name}"
        seed, filed = rounds.revealed_seed(folder, name)
        if filed != {str(number): weights for number, weights in self.digests().items()}:
            raise ArtefactError(f"The agents of {self.bench} are not those that were filed as {name}.")
        tests = rounds.read_round(folder).tests
        protocol = dataclasses.replace(self.protocol, budgets=self.protocol.budgets[-1:], evaluation_episodes=tests)
        parts = []
        for number, run in self.run_folders().items():
            last = run_folder.load_run(run).checkpoints[-1]
            log = _played(run, protocol, seed, encoder)
            again = dataclasses.replace(last, kept=log.kept(), **log.figures())
            parts.append((number, again, _weights(run)))
        row = self._row(protocol, parts, author)
        return dataclasses.replace(row, name=name, round=folder.name)

    def _row(self, protocol: Protocol, parts: list[tuple[int, Checkpoint, str]], author: str) -> Row:
        figures = []
        prices = []
        logs = []
        for seed, each, weights in parts:
            if each.kept is None:
                raise ArtefactError(f"{self.bench} kept no test episodes; run the bench anew.")
            names = {field.name for field in dataclasses.fields(Figures)} - {"seed"}
            numbers: dict[str, Any] = {name: getattr(each, name) for name in names}
            figures.append(Figures(seed=seed, **numbers))
            prices.append(Price(env_steps=each.env_steps, train_cpu_s=each.train_cpu_s, agent_sha256=weights))
            logs.append(EpisodeLog.of(each.kept))
        claimed = self.claims(tuple(prices), author)
        return Row(name=self.name, protocol=protocol, vouched=tuple(figures), claimed=claimed, logs=tuple(logs))


def _weights(run: Path) -> str:
    """The digest of a run's trained agent; empty where it has no weights."""
    snapshot = run_folder.load_newest(run / run_folder.CHECKPOINTS)
    return part_digest(snapshot.agent) if snapshot is not None and snapshot.agent.arrays else ""


def _seen_beforehand(protocol: Protocol, agent: str) -> tuple[str, int | None]:
    """The data that an agent had before its first episode, in words, and the number of frames in it."""
    entry = known_agent(agent)
    words = []
    frames: int | None = 0 if entry.make else None
    if entry.make and entry.needs_encoder:
        used = protocol.encoder_of(entry.encoder_kind)
        card = encoders.card(used)
        words.append(f"encoder {used}")
        frames = None if card is None or card.get("offer") else int(card["recipe"]["frames"])
    if entry.learns:
        words += [f"dataset {protocol.dataset}"] if protocol.dataset else []
        words += [f"{protocol.demonstrations} demonstrations"] if protocol.demonstrations else []
        words += [f"{protocol.after_episodes} episodes of {task}" for task in protocol.after]
        words += [f"{protocol.queries} queries an episode"] if protocol.queries else []
        words += ["a teacher's feedback"] if protocol.feedback else []
    if entry.privileged:
        words.append("privileged: true macrostates")
    return "; ".join(words) or "nothing", frames


def _played(run: Path, protocol: Protocol, seed: int, encoder: str | None) -> EvaluationCounts:
    """Greedy tests of a run's trained agent, at the starts of a round's seed."""
    agent = load_trained(run, encoder=encoder).agent
    log = EvaluationCounts()
    with environments(protocol) as (_, env):
        for test in range(protocol.evaluation_episodes):
            start = episode_seed("board", seed, test)
            privileged = known_agent(protocol.agents[0]).privileged
            log.add(play_test_episode(env, agent, seed=start, privileged=privileged))
    return log


def submitters(path: Path) -> list[Submitter]:
    """The agent of a run's folder or, of a bench's folder, all of its agents.

    Raises ArtefactError: the path is neither, or holds kept results without episodes.
    """
    if (path / "config.json").is_file():
        bench = path.absolute().parents[1]
        protocol = read_control(bench)
        names = {file_name(protocol.written_name(agent)): agent for agent in protocol.agents}
        return [Submitter(bench, names[path.absolute().parent.name])]
    protocol = read_control(path)
    if is_archive(path):
        raise ArtefactError(f"{path} holds kept results without episodes; give the folder of a bench of your own.")
    return [Submitter(path, agent) for agent in protocol.agents]


def submit(path: Path, out: Path, *, author: str, round_folder: Path | None, encoder: str | None) -> list[Path]:
    """Write the rows of a run or a bench below ``out``. Errors as of :class:`Submitter` and :func:`.write_row`."""
    written = []
    for each in submitters(path):
        row = each.row(author) if round_folder is None else each.row_of_round(round_folder, author, encoder)
        written.append(write_row(out, row))
    return written


def file_agents(path: Path, round_folder: Path) -> list[Path]:
    """File the agents of a run or a bench in a round. Errors as of :func:`.rounds.file_agents`."""
    filed = []
    for each in submitters(path):
        filed.append(rounds.file_agents(round_folder, f"{each.name}-{round_folder.name}", each.digests()))
    return filed
