"""Demonstrations of single macro-actions by the scripted expert, as arrays to learn from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from imagine_bench.tasks.continuous.expert import Expert
from imagine_bench.tasks.scenes.constants import CONTROL_CAMERAS
from numpy.typing import NDArray

from imagine_bench.errors import InvalidValueError, require_integer, writing
from imagine_bench.store.files import read_arrays, reading

from .instruction import GO_BACK
from .skills import HOME_COMMAND, begin, images_of, numbers_of, skill_env

NOISE_RAD = 0.004
"""Standard deviation of the noise that a joint command gets each period, in every second demonstration of an action."""
NOISE_KEPT = 0.8
"""Share of a period's noise that goes on in the next one."""

_CLOSED = 0.06
"""Fingers that are told to be nearly as close as in the whole demonstration grip: 1.4 mm of each finger."""

_NAMES = ("numbers", "instructions", "commands", "hand_m", "episode")
"""The arrays of a file, beside its images."""
MOST_TRIES = 5
"""Tries of the expert for each demonstration that is kept."""


@dataclass(frozen=True, kw_only=True)
class DemonstrationData:
    """Control periods of N demonstrations, one after the other; T of them."""

    images: dict[str, NDArray[np.uint8]]  #: by camera: (T, S, S, 3)
    numbers: NDArray[np.float32]  #: the other inputs: (T, P)
    instructions: NDArray[np.str_]  #: in words: (T,)
    commands: NDArray[np.float32]  #: the expert's, without noise: (T, C)
    hand_m: NDArray[np.float32]  #: where the hand is by these commands, in the world: (T, 3)
    episode: NDArray[np.int64]  #: which demonstration: (T,)
    observation: str = ""  #: the parts that are shown, as the environment takes them; empty of an old file
    world: str = ""  #: the task by its name, such as ``"arrows:cubes=2,horizon=10"``; empty of an old file

    @property
    def count(self) -> int:
        """How many demonstrations."""
        return int(self.episode.max()) + 1

    def first(self, count: int) -> DemonstrationData:
        """The first demonstrations alone, at least one. Raises InvalidValueError: fewer are asked for."""
        require_integer("first", count, 1)
        kept = self.episode < count
        return DemonstrationData(
            images={camera: image[kept] for camera, image in self.images.items()},
            numbers=self.numbers[kept],
            instructions=self.instructions[kept],
            commands=self.commands[kept],
            hand_m=self.hand_m[kept],
            episode=self.episode[kept],
            observation=self.observation,
            world=self.world,
        )

    def chunks(self, length: int) -> NDArray[np.int64]:
        """For each period, the rows of the next commands; the last one of a demonstration stays. Shape (T, length)."""
        rows = np.arange(len(self.episode))
        last = np.searchsorted(self.episode, self.episode, side="right") - 1
        return np.minimum(rows[:, None] + np.arange(length), last[:, None])

    def grips(self) -> NDArray[np.int64]:
        """For each period, the row of its demonstration in which the fingers close. Shape (T,).

        That is the first row of the last time that they are told to be closest: fingers may be close at a start.
        """
        starts = np.flatnonzero(np.diff(self.episode, prepend=-1))
        rows = []
        for start, end in zip(starts, [*starts[1:], len(self.episode)], strict=True):
            grip = self.commands[start:end, -1]
            is_open = grip > grip.min() + _CLOSED
            last = np.flatnonzero(~is_open)[-1]
            opened = np.flatnonzero(is_open[:last])
            rows.append(start + (opened[-1] + 1 if len(opened) else 0))
        return np.array(rows)[self.episode]

    def save(self, path: Path) -> None:
        """Write one ``.npz`` file."""
        arrays: dict[str, Any] = {f"image.{camera}": image for camera, image in self.images.items()}
        named = {name: getattr(self, name) for name in _NAMES}
        with writing(path), path.open("wb") as stream:
            np.savez(stream, **arrays, **named, observation=np.array(self.observation), world=np.array(self.world))

    @classmethod
    def load(cls, path: Path) -> DemonstrationData:
        """Read a file that :meth:`save` has written. Raises ArtefactError: there is none, or it is another file."""
        what = "a file of demonstrations"
        with reading(path, what):
            found = read_arrays(path, what)
            images = {name.removeprefix("image."): each for name, each in found.items() if name.startswith("image.")}
            named = {name: found[name] for name in _NAMES}
            observation = str(found.get("observation", ""))
            return cls(images=images, **named, observation=observation, world=str(found.get("world", "")))


def collect(
    count: int, *, seed: int, observation: str, appearances: Sequence[str] = ("clean", "mild"), **options: Any
) -> DemonstrationData:
    """Let the expert demonstrate each macro-action in turn, the same number of times.

    Arms start off their observation pose. In every second demonstration of each macro-action, at each appearance, the
    commands are disturbed, and the expert's own ones are kept: so there are ways back from small errors (Laskey et al.
    2017). A demonstration without the event that was wanted is not kept.

    Args:
        count: How many are kept.
        seed: Of everything random.
        observation: The parts that are kept of each moment, as the environment takes them.
        appearances: Levels, in turn.
        **options: Of the world, and its ``family``.

    Raises:
        InvalidValueError: The expert fails too often in this world, none is to be kept, or images alone.
    """
    require_integer("count", count, 1)
    require_integer("seed", seed, 0)
    if set(observation.split(",")) <= set(CONTROL_CAMERAS):
        raise InvalidValueError(f"observation is {observation}, images alone; give proprio too.")
    rng = np.random.default_rng(seed)
    stages = [_Stage(observation, appearance, options) for appearance in appearances]
    kept: list[_Episode] = []
    for _ in range(MOST_TRIES * count):
        if len(kept) == count:
            break
        turn = turn_of(len(kept), len(stages), stages[0].env.task.n_actions)
        found = stages[turn.appearance].demonstrate(turn.macro_action, rng, disturbed=turn.disturbed)
        if found is not None:
            kept.append(found)
    if len(kept) < count:
        raise InvalidValueError(
            f"Of {MOST_TRIES * count} tries of the expert only {len(kept)} succeeded; give another world."
        )
    cameras = kept[0].images[0]
    return DemonstrationData(
        images={camera: np.stack([image[camera] for each in kept for image in each.images]) for camera in cameras},
        numbers=np.stack([row for each in kept for row in each.numbers]),
        instructions=np.array([words for each in kept for words in each.instructions]),
        commands=np.stack([row for each in kept for row in each.commands]),
        hand_m=np.stack([row for each in kept for row in each.hand_m]),
        episode=np.repeat(np.arange(len(kept)), [len(each.commands) for each in kept]),
        observation=observation,
        world=stages[0].env.task.id,
    )


class NextTurn(NamedTuple):
    """The next demonstration."""

    appearance: int  #: its place among the appearances
    macro_action: int
    disturbed: bool


def turn_of(index: int, appearances: int, n_actions: int) -> NextTurn:
    """The turn of a demonstration, by its place among those that are kept.

    Each macro-action at each appearance is disturbed every second time. Neighbouring appearances begin differently, so
    that two of them have half of each macro-action's demonstrations disturbed after one round already.
    """
    place, appearance = divmod(index, appearances)
    before, macro_action = divmod(place, n_actions)
    return NextTurn(appearance, macro_action, (before + appearance) % 2 == 1)


class _Episode:
    """One demonstration as it grows."""

    def __init__(self) -> None:
        self.images: list[dict[str, NDArray[np.uint8]]] = []
        self.numbers: list[NDArray[np.float32]] = []
        self.instructions: list[str] = []
        self.commands: list[NDArray[np.float32]] = []
        self.hand_m: list[NDArray[np.float32]] = []


class _Stage:
    """An environment at one appearance, and its expert, which plans in a scene of its own."""

    def __init__(self, observation: str, appearance: str, options: dict[str, Any]) -> None:
        self.env = skill_env(observation, appearance, **options)
        self._expert = Expert(self.env, self.env.another_world())

    def demonstrate(self, macro_action: int, rng: np.random.Generator, *, disturbed: bool) -> _Episode | None:
        env = self.env
        observation = begin(env, macro_action, rng)
        self._expert.begin(macro_action)
        instruction = env.task.action_names[macro_action]
        found = _Episode()
        off_rad = np.zeros(len(HOME_COMMAND) - 1)
        done = False
        while not self._expert.is_done:
            command = np.asarray(self._expert.act(), dtype=np.float32)
            found.images.append(images_of(observation))
            found.numbers.append(numbers_of(observation))
            found.instructions.append(GO_BACK if done else instruction)
            found.commands.append(command)
            found.hand_m.append(env.controls.hand_pose(command[:-1].astype(np.float64))[0].astype(np.float32))
            told = command.copy()
            if disturbed:
                off_rad = NOISE_KEPT * off_rad + rng.normal(0.0, NOISE_RAD, len(off_rad))
                told[:-1] += off_rad.astype(np.float32)
            observation, _, _, truncated, info = env.step(told)
            if truncated or info["fault"]:
                return None
            done |= int(info["macro_action"]) == macro_action
        return found if done else None
