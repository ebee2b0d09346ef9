"""A row of a leaderboard: a folder with a card and the test episodes, so that a stranger can play them again.

``card.json`` keeps two kinds of statements apart: ``vouched`` holds the numbers that follow from the episodes, and
``claimed`` those for which the author's word is all that there is. ``episodes.json`` holds the tests of each run and
budget, in the card's order. No file of a row is an archive or is ever carried out, and none holds a path.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from imagine_bench.errors import InvalidValueError, brief, require
from imagine_bench.interfaces import TaskSpec
from imagine_bench.protocols.control import Protocol
from imagine_bench.protocols.data import require_types
from imagine_bench.running.evaluation import EpisodeLog
from imagine_bench.seeding import is_tuning_seed
from imagine_bench.store.files import make_folder, read_json, reading, write_bytes, write_json
from imagine_bench.store.results import Checkpoint, KeptEpisodes
from imagine_bench.values import Json, unpack

T = TypeVar("T")

FORMAT = "imagine_bench board row 1"
CARD = "card.json"
EPISODES = "episodes.json"
OPEN = "open starts"
"""Of tests whose starts everybody could know while training."""
TUNING = "tuning starts"
"""Of the tests of tuning seeds: others than those of reported seeds, and known to whoever chose settings by them."""
ROWS = "rows"
"""The folder of a board that holds its rows."""
LARGEST = {CARD: 1 << 18, EPISODES: 1 << 24}
"""The files of a row, and the most bytes that each may have."""
VERSION = re.compile(r"(0|[1-9][0-9]{0,3})(\.(0|[1-9][0-9]{0,3})){2}(\.(dev|post)[1-9][0-9]{0,11})?")
"""A release of MuJoCo, in the one way that pip writes it."""
NAME = re.compile(r"(?!index$)[a-z0-9][a-z0-9_.,=-]{0,79}")
"""Names of rows and rounds: of characters that every file system and every address on the web takes as they are. The
page of a row called index would replace that of the board."""
LONGEST_NAME = 80
"""Characters of a name."""
_OF_PLAYER = 60
"""Characters of a row's name that say its player, if there is room."""
LONGEST = 300
"""Characters of a claim."""
MOST_FRAMES = 10**12
"""Frames that an author can claim: more than anybody has, and few enough for a page."""


@dataclass(frozen=True, kw_only=True)
class Figures:
    """The tests of one run after a budget, in numbers that follow from the episodes."""

    seed: int  #: The run
    episodes: int  #: The budget
    test_episodes: int
    successes: int
    mean_return: float  #: Undiscounted
    mean_length: float  #: Macro-actions
    faults: int  #: Macro-actions whose physics disagreed with the rules


@dataclass(frozen=True, kw_only=True)
class Cost:
    """The cost of one run until a budget, as its author says it."""

    env_steps: int  #: Real training macro-actions
    train_cpu_s: float  #: CPU seconds of training
    agent_sha256: str = ""  #: Digest of the agent's weights at the end of its run; empty where it has none

    def __post_init__(self) -> None:
        require_types(self)


@dataclass(frozen=True, kw_only=True)
class Claims:
    """Statements that no replay shows."""

    agent: str  #: The player, as commands name it
    author: str = ""  #: Who files the row
    commit: str = ""  #: Version of the code
    command: str = ""  #: The command that made the bench
    machine: str = ""  #: Processor
    seen_beforehand: str = ""  #: Encoders, datasets, demonstrations and earlier tasks before the first episode
    frames_beforehand: int | None = None  #: Frames in that; None where nobody knows
    prices: tuple[Cost, ...] = ()  #: One for each of the row's figures

    def __post_init__(self) -> None:
        require_types(self)
        for name, value in vars(self).items():
            if isinstance(value, str) and (len(value) > LONGEST or not value.isprintable()):
                raise InvalidValueError(
                    f"The claim {name!r} is {brief(value)}; give at most {LONGEST} printable characters in one line."
                )
        if self.frames_beforehand is not None and not 0 <= self.frames_beforehand <= MOST_FRAMES:
            raise InvalidValueError(f"frames_beforehand is {brief(self.frames_beforehand)}; give 0 to {MOST_FRAMES:,}.")


@dataclass(frozen=True, kw_only=True)
class Row:
    """A row."""

    name: str  #: That of its folder
    protocol: Protocol  #: World, seeds, budgets and number of tests of this row's player alone
    round: str = ""  #: The round whose starts its tests have; empty for starts that everybody knows
    vouched: tuple[Figures, ...]  #: One for each seed and budget
    claimed: Claims
    logs: tuple[EpisodeLog, ...] = field(repr=False)  #: The tests, likewise

    def checkpoint(self, place: int) -> Checkpoint:
        """The figures and tests of a place, in the form in which runs keep them."""
        figures = dataclasses.asdict(self.vouched[place])
        figures.pop("seed")
        cost = self.claimed.prices[place]
        return Checkpoint(
            **figures,
            solved=self.logs[place].solved,
            env_steps=cost.env_steps,
            train_cpu_s=cost.train_cpu_s,
            eval_cpu_s=0.0,
            kept=self.kept(place),
        )

    def kept(self, place: int) -> KeptEpisodes:
        """The tests of a place."""
        return self.logs[place].kept()

    @property
    def starts(self) -> str:
        """The kind of starts of its tests."""
        is_tuning = not self.round and is_tuning_seed(self.protocol.seeds[0])
        return TUNING if is_tuning else starts_words(self.round)

    @property
    def agents(self) -> dict[str, str]:
        """The digest of the agent of each seed, as a round has them."""
        both = zip(self.vouched, self.claimed.prices, strict=True)
        return {str(figures.seed): cost.agent_sha256 for figures, cost in both}

    @property
    def world(self) -> str:
        """The world of its tests in words; rows of equal words stand in one table."""
        return world_words(self.protocol)


def row_name(player: str, ending: str) -> str:
    """The name of a row: its player's in the characters of names, and its ending.

    Where both are too long, the player's is cut, and digits of its digest tell it from others.
    """
    safe = re.sub("[^a-z0-9_.,=-]", "-", player.lower()).lstrip("_.,=-") or "row"
    room = min(_OF_PLAYER, LONGEST_NAME - len(ending) - 1)
    if len(safe) > room:
        safe = f"{safe[: room - 7]}-{hashlib.sha256(player.encode()).hexdigest()[:6]}"
    return f"{safe}-{ending}"


def starts_words(round_name: str) -> str:
    """The kind of starts of tests: those of a round, or, without one, open starts."""
    return f"round {round_name}" if round_name else OPEN


def one_line(text: object) -> str:
    """A text in one line, without control characters, cut where a claim is too long."""
    return "".join(filter(str.isprintable, " ".join(str(text).split())))[:LONGEST]


def world_words(protocol: Protocol) -> str:
    """All that decides how hard the tests of a protocol are: task, execution, physics, looks and starts."""
    words = [protocol.task, protocol.execution, protocol.appearance_in_words]
    words += [f"{name}={value}" for name, value in protocol.physics]
    if protocol.split is not None:
        words.append(f"starts split by {protocol.split}")
    return ", ".join(words)


def place_of(folder: Path, name: str) -> Path:
    """The folder of a new row below ``folder``. Raises InvalidValueError: there is one of this name."""
    where = folder / name
    if where.exists():
        raise InvalidValueError(f"{where} exists; remove it, or give another folder to --out.")
    return where


def write_row(folder: Path, row: Row) -> Path:
    """Write a row below ``folder``, under its name. Raises as :func:`place_of`."""
    where = place_of(folder, row.name)
    episodes = json.dumps([_columns(log) for log in row.logs], separators=(",", ":")).encode()
    card: dict[str, Json] = {
        "format": FORMAT,
        "protocol": row.protocol.as_dict(),
        "round": row.round,
        "vouched": [dataclasses.asdict(each) for each in row.vouched],
        "claimed": dataclasses.asdict(row.claimed),
        "episodes_sha256": hashlib.sha256(episodes).hexdigest(),
    }
    make_folder(where)
    write_bytes(where / EPISODES, episodes)
    write_json(where / CARD, card)
    return where


def _columns(log: EpisodeLog) -> dict[str, Json]:
    """Episodes as the file has them: the macro-actions of each in a list of their own, and no lengths."""
    columns = dict(vars(log))
    ends = [sum(columns["lengths"][:place]) for place in range(log.episodes + 1)]
    columns["actions"] = [log.actions[begin:end] for begin, end in itertools.pairwise(ends)]
    del columns["lengths"]
    return columns


def _log(columns: Mapping[str, Any]) -> EpisodeLog:
    """The inverse of :func:`_columns`."""
    actions = columns["actions"]
    flat = [action for each in actions for action in each]
    return EpisodeLog(**{**columns, "actions": flat, "lengths": [len(each) for each in actions]})


def named(folder: Path) -> Path:
    """The same folder by its own name, which ``.`` and ``..`` do not say."""
    return folder.resolve() if folder.name in ("", "..") else folder


def require_files(folder: Path) -> None:
    """Raise ArtefactError, before anything is read, for another name, a link, a file too many or too large a one."""
    require(bool(NAME.fullmatch(folder.name)), f"a row cannot be called {brief(folder.name)}.")
    require(folder.is_dir() and not folder.is_symlink(), "it is no folder.")
    for path in folder.iterdir():
        most = LARGEST.get(path.name, 0)
        require(most > 0, f"it also holds {brief(path.name)}; a row holds {' and '.join(LARGEST)} alone.")
        require(path.is_file() and not path.is_symlink(), f"{path.name} is no plain file.")
        size = path.stat().st_size
        require(size <= most, f"{path.name} has {size:,} bytes; at most {most:,} are read.")


def read_card(folder: Path) -> dict[str, Any]:
    """The card of a row. Raises ArtefactError: it is damaged, or has text that no page can show."""
    require_files(folder)
    card: dict[str, Any] = read_json(folder / CARD, "the card of a row")
    with reading(folder / CARD, "the card of a row"):
        json.dumps(card, ensure_ascii=False).encode()  # JSON can hold half a character, which no file can
    return card


def read_episodes(folder: Path, card: Mapping[str, Any], unpacked: Callable[[dict[str, Any]], T]) -> tuple[T, ...]:
    """The episodes of a row, each part unpacked. Raises ArtefactError: they are damaged, or not those of the card."""
    content = (folder / EPISODES).read_bytes()
    found = hashlib.sha256(content).hexdigest()
    require(found == card["episodes_sha256"], f"{EPISODES} has the digest {found}, and its card says another.")
    with reading(folder / EPISODES, "the episodes of a row"):
        return tuple(map(unpacked, json.loads(content)))


def read_row(folder: Path) -> Row:
    """Read a row; nothing is played. Raises ArtefactError: it is damaged, or holds more than a row may."""
    card = read_card(folder)
    with reading(folder / CARD, f"a card of the format {FORMAT!r}"):
        require(card["format"] == FORMAT, f"its format is {brief(card['format'])}, and {FORMAT!r} is read.")
        require("@" not in str(card["protocol"]["task"]), "its task names a file; write the world out in one line.")
        protocol = Protocol.from_dict(card["protocol"])
        claimed: Claims = unpack(Claims, card["claimed"], {})
        vouched = tuple(Figures(**each) for each in card["vouched"])
        for each in vouched:
            require_types(each)
        round_name = str(card["round"])
        require(not round_name or bool(NAME.fullmatch(round_name)), f"its round is {brief(round_name)}.")
    logs = read_episodes(folder, card, _log)
    return Row(name=folder.name, protocol=protocol, round=round_name, vouched=vouched, claimed=claimed, logs=logs)


def require_whole(row: Row, task: TaskSpec) -> None:
    """Raise ArtefactError where figures, prices and tests are not those of each seed and budget, or are no numbers."""
    protocol = row.protocol
    wanted = [(seed, budget) for seed in protocol.seeds for budget in protocol.budgets]
    found = [(each.seed, each.episodes) for each in row.vouched]
    require(protocol.agents == (row.claimed.agent,), f"its protocol is of {brief(protocol.agents)}.")
    require(found == wanted, f"it has tests of (seed, budget) {brief(found)}, and its protocol has {brief(wanted)}.")
    both = (len(row.logs), len(row.claimed.prices))
    require(both == (len(found), len(found)), f"it has {both[0]} sets of tests and {both[1]} prices for {len(found)}.")
    for log in row.logs:
        tests = protocol.evaluation_episodes
        require(log.episodes == tests, f"it has {log.episodes} tests, and its protocol {tests}.")
    for figures, cost in zip(row.vouched, row.claimed.prices, strict=True):
        steps = cost.env_steps
        is_possible = steps == 0 or figures.episodes <= steps <= figures.episodes * task.horizon
        require(is_possible, f"{steps:,} macro-actions cannot be those of {figures.episodes:,} training episodes.")
        require(0.0 <= cost.train_cpu_s < math.inf, f"its CPU seconds are {brief(cost.train_cpu_s)}.")
