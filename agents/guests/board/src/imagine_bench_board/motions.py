"""Rows of continuous control: test episodes of any policy, kept as commands to the joints, and played again.

Whatever control a policy uses, its commands end as targets of the seven joints and the fingers, 25 times a second.
These float32 targets are kept. A replay needs no inverse kinematics, and costs little more than the simulation itself.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from imagine_bench.tasks.continuous.controls import MOST_OPEN_M, HandControl
from imagine_bench.tasks.motion.arm_model import ArmModel

from imagine_bench import registry
from imagine_bench.appearance import appearance_name
from imagine_bench.arrays import Floats32, Info, Observed
from imagine_bench.errors import ArtefactError, InvalidValueError, brief, require
from imagine_bench.registry.machine import describe_environment
from imagine_bench.store.files import make_folder, sha256, write_bytes, write_json
from imagine_bench.values import Json

from .motion_rows import COMMAND, FORMAT, RATE_HZ, MotionFigures, MotionProtocol, MotionRow, PlayedMotion, columns_of
from .rounds import POLICY, policy_row, read_round, revealed_seed
from .rows import CARD, EPISODES, LARGEST, NAME, Claims, named, one_line

if TYPE_CHECKING:
    from imagine_bench.tasks.continuous.env import MotionEnv, Period

SLACK_PERIODS = 3
"""Control periods by which an event may come earlier or later on another kind of processor."""
DISTURBED = 16
"""Replays of a test, with disturbances, that say whether its end depends on the processor or the version of MuJoCo."""
DISTURBANCE = 1e-6
"""Standard deviation of a disturbance of each joint, in rad or m: 1 micrometre.

Between processors, positions differ by their last bits, 1e-16. Between MuJoCo 3.17.0 and 4.0.0 too, until a part of the
arm that is no fingertip touches something: then they differ by 1e-6 at once, in the median of 34 tests by chance.
"""
DISTURBED_EVERY = 25
"""Control periods between disturbances: 1 s. One at the start alone would die away while the servos hold the arm."""
_TEST_BYTES = 200
_PERIOD_BYTES = 43
"""Bytes of a test in the file, and of a command of it, at most."""


class ReplayError(ArtefactError):
    """A test does not play again."""


class _EpisodeFacts:
    """The facts of an episode while it is played."""

    def __init__(self, start: Sequence[int]) -> None:
        self.total_reward = 0.0
        self.solved = self.fault = self.over = False
        self.fingerprint = 0
        self._sign(start, 0.0)

    def add(self, reward: float, *, over: bool, success: bool, fault: bool, reached: Sequence[int] | None) -> None:
        """Count a control period, and the macrostate that its event reached, if there was one."""
        self.total_reward += reward
        self.solved |= success
        self.fault |= fault
        self.over = over
        if reached is not None:
            self._sign(reached, reward)

    def _sign(self, macrostate: Sequence[int], reward: float) -> None:
        signed = json.dumps([list(map(int, macrostate)), reward]).encode()
        self.fingerprint = zlib.crc32(signed, self.fingerprint)

    def motion(self, commands: Floats32) -> PlayedMotion:
        """The episode so far."""
        return PlayedMotion(
            commands=commands,
            total_reward=self.total_reward,
            solved=self.solved,
            fault=self.fault,
            fingerprint=self.fingerprint,
        )


class MotionTests(gymnasium.Wrapper[Any, Any, Any, Any]):
    """The tests of a row as one environment: each reset begins the next of them, whatever seed it is given.

    Play ``tests`` episodes to their ends with any policy, then :meth:`write` the row. Episodes after the last test are
    not kept, so loops that reset once more, such as Stable-Baselines3's ``evaluate_policy``, may be used.

    Args:
        task: The task of macro-actions whose world it is, such as ``"arrow_puzzle"`` or ``"arrows:cubes=2"``.
        control: How the policy acts: ``"twist"``, ``"pose"``, ``"joint_delta"`` or ``"joint"``.
        observation: The policy's observation, as :class:`MotionEnv` takes it.
        size: Edge of its images in pixels.
        told: Whether the goal is given in words.
        appearance: A name, or factors, as :class:`MotionEnv` takes them.
        placement: How far, in m, objects start off their slots.
        seed: Decides the starts of all tests.
        tests: How many tests the row has.
        round_folder: The folder of a round whose seed is published; ``seed`` and ``tests`` are then those of the round.
        policy: With a round, the policy's file, as it was filed.

    Raises:
        UnknownNameError, InvalidValueError: A value that the environment does not take, or more tests than a row holds.
        ArtefactError: The seed of the round is not published, or this policy was not filed before.
    """

    def __init__(
        self,
        task: str,
        *,
        control: str = "twist",
        observation: str = "hand,front,proprio",
        size: int = 64,
        told: bool = False,
        appearance: str | Mapping[str, float] = "clean",
        placement: float = 0.0,
        seed: int = 0,
        tests: int = 100,
        round_folder: Path | str | None = None,
        policy: Path | str | None = None,
    ) -> None:
        self._policy_sha256 = ""
        self._row = ""
        if round_folder is not None and policy is not None:
            round_folder = folder = named(Path(round_folder))
            self._policy_sha256 = sha256(Path(policy))
            self._row = policy_row(folder, Path(policy))
            seed, filed = revealed_seed(folder, self._row)
            require(filed == {POLICY: self._policy_sha256}, f"{policy} is not the file that was filed as {self._row}.")
            tests = read_round(folder).tests
        elif round_folder is not None or policy is not None:
            raise InvalidValueError("A round needs round_folder and policy; give both, or none.")
        self.protocol = MotionProtocol(
            task=registry.task_name(task),
            appearance=appearance_name(appearance),
            placement=placement,
            seed=seed,
            tests=tests,
            round=Path(round_folder).name if round_folder is not None else "",
        )
        super().__init__(self.protocol.make(observation=observation, size=size, told=told))
        self._motion: MotionEnv = self.env.unwrapped  # type: ignore[assignment]
        most = int(LARGEST[EPISODES] / (_TEST_BYTES + _PERIOD_BYTES * RATE_HZ * self._motion.time_limit_s))
        if tests > most:
            raise InvalidValueError(f"tests is {tests}; a row holds {most} tests of {task}, however long; give fewer.")
        self._control = HandControl(control, ArmModel(), self._motion.period_s)
        self.action_space = self._control.space
        self._commands: list[Floats32] = []
        self._tally: _EpisodeFacts | None = None
        self.motions: list[PlayedMotion] = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observed, Info]:
        """Begin the next test. Raises InvalidValueError: the one before was left before its end."""
        del seed, options
        if self._tally is not None and self._commands:
            raise InvalidValueError(f"Test {len(self.motions)} was left before its end. Make a new MotionTests.")
        observation, info = self.env.reset(seed=self.protocol.start(len(self.motions) % self.protocol.tests))
        self._tally = _EpisodeFacts(info["macrostate"]) if len(self.motions) < self.protocol.tests else None
        self._commands = []
        return observation, info

    def step(self, action: Floats32) -> tuple[Observed, float, bool, bool, Info]:
        """One control period, by the policy's control."""
        before = self._motion.servo_targets()
        command = self._control.command(self._control.checked(action), before[:-1], float(before[-1]))
        grip = 2.0 * command.opening_m / MOST_OPEN_M - 1.0
        joints = np.append(command.joints_rad, grip).astype(COMMAND)
        observation, reward, terminated, truncated, info = self.env.step(joints)
        if self._tally is not None:
            self._commands.append(joints)
            self._tally.add(
                float(reward),
                over=terminated or truncated,
                success=bool(info["is_success"]),
                fault=bool(info["fault"]),
                reached=info["macrostate"] if info["event"] else None,
            )
            if self._tally.over:
                self.motions.append(self._tally.motion(np.stack(self._commands)))
                self._tally = None
        return observation, float(reward), terminated, truncated, {**info, "limited": command.limited}

    def write(self, out: Path | str, name: str, *, agent: str, **claims: Any) -> Path:
        """Write the row ``name`` below a folder, and return its path.

        Each test is played several times more, with tiny disturbances, to see whether it is reproducible.

        Args:
            out: The folder of rows, such as ``docs/board/rows``.
            name: Of the row; in a round, the policy file's name without its ending, ``-`` and the round's name.
            agent: Who played.
            **claims: Further fields of :class:`.rows.Claims`: ``author``, ``seen_beforehand``, ``frames_beforehand``.

        Raises:
            InvalidValueError: Not all tests were played, there is a row of this name, or no row can have it.
        """
        if len(self.motions) < self.protocol.tests:
            raise InvalidValueError(f"{len(self.motions)} of {self.protocol.tests} tests were played; play all.")
        if not NAME.fullmatch(name):
            allowed = "at most 80 of a-z, 0-9 and _.,=-, a letter or digit first, and not index"
            raise InvalidValueError(f"A row cannot be called {brief(name)}; give {allowed}.")
        if self._row and name != self._row:
            raise InvalidValueError(f"The policy was filed as {self._row}; give this name.")
        where = Path(out) / name
        if where.exists():
            raise InvalidValueError(f"{where} exists; remove it, or give another name.")
        machine = describe_environment()
        facts = {"commit": str(machine["commit"]), "command": one_line(machine["command"])}
        claimed = Claims(agent=agent, **{**facts, **claims})
        with closing(self.protocol.make(observation="state")) as env:
            unwrapped: Any = env.unwrapped
            motions = [
                dataclasses.replace(each, reproducible=_is_reproducible(unwrapped, self.protocol.start(test), each))
                for test, each in enumerate(self.motions)
            ]
        episodes = json.dumps([columns_of(each) for each in motions], separators=(",", ":")).encode()
        card: dict[str, Json] = {
            "format": FORMAT,
            "protocol": dataclasses.asdict(self.protocol),
            "policy_sha256": self._policy_sha256,
            "mujoco": metadata.version("mujoco"),
            "vouched": dataclasses.asdict(MotionFigures.of(motions)),
            "claimed": dataclasses.asdict(claimed),
            "episodes_sha256": hashlib.sha256(episodes).hexdigest(),
        }
        make_folder(where)
        write_bytes(where / EPISODES, episodes)
        write_json(where / CARD, card)
        return where


def check_motions(row: MotionRow, env: gymnasium.Env[Any, Any], *, other_mujoco: bool = False) -> MotionRow:
    """Play every test of a row again, in an environment of its protocol.

    Returns the row, in which the tests that are not reproducible here are marked, and its figures follow from that. A
    test that the row itself marks stays marked; it may then end in another way where ``other_mujoco`` says that the
    installed MuJoCo is not the row's. The return of a test that ends in another way is the lower of both.

    Raises:
        ReplayError: A test does not play again.
        ArtefactError: Another claim does not hold.
    """
    tests = row.protocol.tests
    require(len(row.motions) == tests, f"it has {len(row.motions)} tests, and its protocol {tests}.")
    figures = MotionFigures.of(row.motions)
    for name, found in vars(figures).items():
        claimed = getattr(row.vouched, name)
        require(claimed == found, f"{name} is {found:g}, and {claimed:g} was kept.")
    unwrapped: Any = env.unwrapped
    motions = []
    for test, kept in enumerate(row.motions):
        start = row.protocol.start(test)
        played = replayed(unwrapped, start, kept.commands)
        complaint = difference(kept, played)
        if not complaint:
            motions.append(kept)
            continue
        is_excused = other_mujoco and not kept.reproducible
        if not is_excused and _same_when_disturbed(unwrapped, start, kept.commands, played):
            raise ReplayError(f"test {test}: {complaint}")
        lowest = kept.total_reward if played is None else min(kept.total_reward, played.total_reward)
        motions.append(dataclasses.replace(kept, reproducible=False, total_reward=lowest))
    return dataclasses.replace(row, motions=tuple(motions), vouched=MotionFigures.of(motions))


def difference(kept: PlayedMotion, played: PlayedMotion | None) -> str:
    """The first result in which an episode is not as it was kept, in words; empty if there is none."""
    if played is None:
        return "it does not end where its commands do."
    for name, claimed in kept.facts.items():
        found = played.facts[name]
        if found != claimed:
            return f"its {name.replace('_', ' ')} is {found}, and {claimed} was kept."
    return ""


def _is_reproducible(env: MotionEnv, seed: int, kept: PlayedMotion) -> bool:
    """Whether all disturbed replays of a test have the results that were kept."""
    return all(not difference(kept, replayed(env, seed, kept.commands, disturbance=k)) for k in range(DISTURBED))


def _same_when_disturbed(env: MotionEnv, seed: int, commands: Floats32, played: PlayedMotion | None) -> bool:
    """Whether all disturbed replays of some commands have the results of an undisturbed one."""
    wanted = None if played is None else played.facts
    for number in range(DISTURBED):
        disturbed = replayed(env, seed, commands, disturbance=number)
        if (None if disturbed is None else disturbed.facts) != wanted:
            return False
    return True


def replayed(env: MotionEnv, seed: int, commands: Floats32, *, disturbance: int | None = None) -> PlayedMotion | None:
    """The episode of some commands, None where it does not end with the last of them, give or take the slack.

    With the number of a disturbance, each joint of arm and objects moves a little, once a second.
    """
    env.restart(seed=seed)
    tally = _EpisodeFacts(env.episode.macrostate)
    after_last = np.repeat(commands[-1:], SLACK_PERIODS, axis=0)
    length = 0
    for each in control_periods(env, np.concatenate([commands, after_last]), disturbance):
        length += 1
        tally.add(
            each.reward,
            over=each.terminated or each.truncated,
            success=each.success,
            fault=each.fault is not None,
            reached=each.reached,
        )
    is_near = length >= len(commands) - SLACK_PERIODS
    return tally.motion(commands) if tally.over and is_near else None


def control_periods(env: MotionEnv, commands: Floats32, disturbance: int | None) -> Iterator[Period]:
    """The control periods of some commands, until the episode is over."""
    if disturbance is None:
        yield from env.carry_out(commands)
        return
    rng = np.random.default_rng(disturbance)
    for begin in range(0, len(commands), DISTURBED_EVERY):
        env.data.qpos += DISTURBANCE * rng.standard_normal(env.model.nq)
        periods = env.carry_out(commands[begin : begin + DISTURBED_EVERY])
        yield from periods
        if not periods or periods[-1].terminated or periods[-1].truncated:
            return
