"""Rows of continuous control as they are kept: commands to the joints, and the numbers that follow from the tests.

A command has the float32 targets of the seven joints in rad and of the grip, 25 times a second.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from imagine_bench import registry
from imagine_bench.appearance import appearance_name, appearance_typed
from imagine_bench.arrays import Floats32
from imagine_bench.errors import InvalidValueError, brief, require
from imagine_bench.protocols.data import require_types
from imagine_bench.seeding import SEEDS, episode_seed
from imagine_bench.store.files import reading
from imagine_bench.values import unpack

from .rounds import POLICY
from .rows import CARD, NAME, VERSION, Claims, read_card, read_episodes, starts_words

FORMAT = "imagine_bench board motions 2"
RATE_HZ = 25.0
"""Commands a second."""
FAILED_RETURN = -5.0
"""The return of a test that is not reproducible, unless it is lower: that of a fault at once."""
MOST_TESTS = 1000
COMMAND = np.dtype("<f4")
_WIDTH = 8
"""Numbers of a command: seven joints in rad, and the grip."""


@dataclass(frozen=True, kw_only=True)
class MotionProtocol:
    """All that decides the tests of a row: the world, and the starts."""

    task: str  #: The task of macro-actions, whose world it is
    appearance: str = "clean"
    placement: float = 0.0  #: How far, in m, objects start off their slots
    seed: int = 0  #: Decides the starts of all tests
    tests: int = 100
    round: str = ""  #: The round whose starts the tests have; empty for starts that everybody knows

    def __post_init__(self) -> None:
        require_types(self)
        if not 1 <= self.tests <= MOST_TESTS or not 0 <= self.seed < SEEDS:
            allowed = f"1 to {MOST_TESTS:,} tests and a seed from 0 to {SEEDS - 1:,}"
            raise InvalidValueError(f"tests is {self.tests} and seed {self.seed}; give {allowed}.")
        require(not self.round or bool(NAME.fullmatch(self.round)), f"its round is {brief(self.round)}.")
        require("@" not in self.task, "its task names a file; write the world out in one line.")
        object.__setattr__(self, "task", registry.task_name(self.task))
        object.__setattr__(self, "appearance", appearance_name(self.appearance))

    def start(self, test: int) -> int:
        """The environment's seed of a test."""
        return episode_seed("board" if self.round else "evaluation", self.seed, test)

    def make(self, **options: Any) -> gymnasium.Env[Any, Any]:
        """The environment, controlled by joints. Raises whatever :func:`gymnasium.make` does for a wrong value."""
        env_id = registry.motion_id(registry.task(self.task).env_id)
        given: dict[str, Any] = {"appearance": self.appearance, "placement": self.placement, "control": "joint"}
        return gymnasium.make(env_id, disable_env_checker=True, **given, **options)

    @property
    def world(self) -> str:
        """The world in words."""
        off = f", objects up to {100 * self.placement:g} cm off their slots" if self.placement else ""
        return f"{self.task}, continuous control at 25 Hz, {appearance_typed(self.appearance)}{off}"


@dataclass(frozen=True, kw_only=True)
class PlayedMotion:
    """A test episode."""

    commands: Floats32 = field(repr=False)  #: shape (N, 8)
    total_reward: float
    solved: bool
    fault: bool  #: whether a fault ended it
    fingerprint: int  #: CRC-32 of the start and of each event: macrostates and rewards
    reproducible: bool = True  #: whether its end is the same with tiny disturbances; if not, it counts as failed

    @property
    def periods(self) -> int:
        """Its length in control periods."""
        return len(self.commands)

    @property
    def facts(self) -> dict[str, float | bool | int]:
        """The results that a replay must have, by name."""
        return {name: getattr(self, name) for name in ("total_reward", "solved", "fault", "fingerprint")}


@dataclass(frozen=True, kw_only=True)
class MotionFigures:
    """Numbers that follow from the tests. A test that is not reproducible counts as failed."""

    successes: int
    faults: int  #: among the reproducible tests
    mean_return: float
    mean_periods: float  #: of 1/25 s
    not_reproducible: int  #: tests

    def __post_init__(self) -> None:
        require_types(self)

    @classmethod
    def of(cls, motions: Sequence[PlayedMotion]) -> MotionFigures:
        """Those of some tests."""
        sure = [each for each in motions if each.reproducible]
        failed = [min(each.total_reward, FAILED_RETURN) for each in motions if not each.reproducible]
        return cls(
            successes=sum(each.solved for each in sure),
            faults=sum(each.fault for each in sure),
            mean_return=float(np.mean([each.total_reward for each in sure] + failed)),
            mean_periods=float(np.mean([each.periods for each in motions])),
            not_reproducible=len(failed),
        )


@dataclass(frozen=True, kw_only=True)
class MotionRow:
    """A row."""

    name: str  #: That of its folder
    protocol: MotionProtocol
    policy_sha256: str = ""  #: In a round, the digest of the policy's file
    mujoco: str  #: The version of MuJoCo that played, as its author says it
    vouched: MotionFigures
    claimed: Claims
    motions: tuple[PlayedMotion, ...] = field(repr=False)

    @property
    def round(self) -> str:
        """The round whose starts its tests have; empty for starts that everybody knows."""
        return self.protocol.round

    @property
    def starts(self) -> str:
        """The kind of starts of its tests."""
        return starts_words(self.round)

    @property
    def agents(self) -> dict[str, str]:
        """The digest of its policy, as a round has it."""
        return {POLICY: self.policy_sha256}

    @property
    def world(self) -> str:
        """The world of its tests in words."""
        return self.protocol.world


def columns_of(motion: PlayedMotion) -> dict[str, Any]:
    """An episode as the file has it."""
    commands = motion.commands.astype(COMMAND).tobytes()
    return {**vars(motion), "commands": base64.b64encode(commands).decode()}


def _motion_of(columns: dict[str, Any]) -> PlayedMotion:
    """The inverse of :func:`columns_of`. Raises ArtefactError: it has no commands, or some that are no numbers."""
    content = base64.b64decode(columns["commands"], validate=True)
    commands = np.frombuffer(content, COMMAND).reshape(-1, _WIDTH).astype(np.float32)
    require(len(commands) > 0 and bool(np.isfinite(commands).all()), "a test has commands that are no finite numbers.")
    motion = PlayedMotion(**{**columns, "commands": commands})
    kinds = {"total_reward": float, "solved": bool, "fault": bool, "fingerprint": int, "reproducible": bool}
    for name, kind in kinds.items():
        require(type(getattr(motion, name)) is kind, f"a test's {name} is no {kind.__name__}.")
    return motion


def read_motions(folder: Path) -> MotionRow:
    """Read a row; nothing is played. Raises ArtefactError: it is damaged, or holds parts that no row has."""
    card = read_card(folder)
    with reading(folder / CARD, f"a card of the format {FORMAT!r}"):
        protocol: MotionProtocol = unpack(MotionProtocol, card["protocol"], {})
        vouched: MotionFigures = unpack(MotionFigures, card["vouched"], {})
        claimed: Claims = unpack(Claims, card["claimed"], {})
        policy_sha256 = str(card.get("policy_sha256", ""))
        mujoco = str(card["mujoco"])
    require(bool(VERSION.fullmatch(mujoco)), f"its MuJoCo is {brief(mujoco)}, and no version such as 3.17.0.")
    return MotionRow(
        name=folder.name,
        protocol=protocol,
        policy_sha256=policy_sha256,
        mujoco=mujoco,
        vouched=vouched,
        claimed=claimed,
        motions=read_episodes(folder, card, _motion_of),
    )
