"""Demonstrations of continuous control: collected by several processes, described, and played again."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import gymnasium
import numpy as np
from imagine_bench.tasks.continuous.env import MotionEnv
from imagine_bench.tasks.world import World
from tqdm import tqdm

from imagine_bench import registry, statistics
from imagine_bench.appearance import appearance_name, appearance_typed
from imagine_bench.arrays import Array, Arrays, Info, Observed
from imagine_bench.data.folder import FORMATS, new_folder, read_files, write_card
from imagine_bench.data.motion import CAMERAS, OBSERVATIONS, OUTCOMES, Demonstrations, Digest
from imagine_bench.errors import ArtefactError, InvalidValueError, RunFailedError, brief, require, require_known
from imagine_bench.registry.machine import describe_environment
from imagine_bench.running.collect import MOST_EPISODES
from imagine_bench.running.launchers.jobs import at_a_time, work_through
from imagine_bench.seeding import SEEDS, SeedTree, episode_seed
from imagine_bench.store.files import read_arrays, write_arrays
from imagine_bench.values import Json

from .demonstrator import Demonstrator

POLICIES = {
    "expert": "optimal macro-actions, as planned",
    "noisy": "optimal macro-actions with errors of perception and command, planned again where they have no effect",
    "random": "commands by chance, each held for 0.4 s",
    "mixed": "expert, noisy and random, an episode each in turn",
}
_IN_TURN = ("expert", "noisy", "random")
_SAME_M = 2e-3
"""How far the arm's own sense (rad and m) may be off in a replay: kinds of CPU differ in the last bits."""


class Actor(Protocol):
    """Plays an episode."""

    @property
    def macro_action(self) -> int:
        """The macro-action under way, -1 where there is none."""

    def act(self) -> Array | None:
        """The next command, or None, which leaves the episode."""


@dataclass(frozen=True, kw_only=True)
class DemonstrationSettings:
    """All that decides the episodes of a set."""

    task: str  #: the task of macro-actions
    policy: str  #: one of :data:`POLICIES`
    seed: int
    appearance: str
    size: int  #: edge of images in pixels


Watch = Callable[[Array | None, Observed, float, Info], None]
"""Is shown each period: the command, and the results of the step; at the start None, the observation, 0 and
``info``.
"""
_Item = tuple[DemonstrationSettings, int, Path]
"""The played task, the number of the episode, and the file that it is written to."""


def collect(
    task: str,
    *,
    policy: str,
    episodes: int,
    seed: int,
    appearance: str,
    size: int,
    format: str,
    folder: Path,
    workers: int | None = None,
) -> Demonstrations:
    """Play episodes of a task's environment of continuous control into a new folder.

    The same arguments give the same episodes, whatever the number of ``workers``.

    Raises:
        UnknownNameError: No such policy, appearance or format.
        InvalidValueError: A number out of range, or the folder exists.
        SetupError: A library is missing, or the folder cannot be written.
        RunFailedError: An episode could not be played.
    """
    require_known("policy", policy, POLICIES)
    if not 1 <= episodes <= MOST_EPISODES or not 0 <= seed < SEEDS:
        allowed = f"1 to {MOST_EPISODES:,} episodes and a seed from 0 to {SEEDS - 1}"
        raise InvalidValueError(f"episodes is {episodes} and seed {seed}; give {allowed}.")
    look = appearance_name(appearance)
    settings = DemonstrationSettings(task=task, policy=policy, seed=seed, appearance=look, size=size)
    stage(task, look, size)  # raises its errors before any process begins
    with new_folder(folder, format) as partial:
        (partial / "episodes").mkdir()
        files = [partial / f"episodes/{index:06}.npz" for index in range(episodes)]
        _collect_all(settings, files, at_a_time(workers))
        tally = _EpisodeCounts()
        card = {**_card(settings), "format": format}
        registry.load(FORMATS[format]).write_motion(partial, tally.through(files), card)
        if format != "npz":
            shutil.rmtree(partial / "episodes")
        whole = write_card(partial, {**card, **tally.facts()}, {"privileged": tally.hidden()})
    return Demonstrations(folder=folder, card=whole)


def _card(settings: DemonstrationSettings) -> dict[str, Json]:
    """The facts of a set that are known before it is played."""
    spec = registry.task(settings.task)
    env, _ = stage(settings.task, settings.appearance, settings.size)
    facts = env.task.facts()  # a grip that slips costs nothing here
    environment = describe_environment()
    return {
        **dataclasses.asdict(settings),
        "task": spec.id,
        "description": spec.description,
        "env_id": registry.motion_id(spec.env_id),
        "played": POLICIES[settings.policy],
        "control": env.controls.control,
        "control_names": list(env.control_names),
        "rate_hz": round(1.0 / env.period_s, 6),
        "action_names": list(spec.action_names),
        "macrostate_names": list(spec.macrostate_names),
        "optimum": facts.optimum,
        "optimal_return": facts.optimal_return,
        **{name: environment[name] for name in ("commit", "command", "versions")},
    }


def _collect_all(settings: DemonstrationSettings, files: Sequence[Path], workers: int) -> None:
    failures: list[str] = []
    with tqdm(total=len(files), desc=f"{settings.task} {settings.policy}", unit="episode", disable=None) as bar:

        def ended(item: _Item, why: str) -> None:
            bar.update()
            if why:
                failures.append(f"Episode {item[1]} could not be played: {why}")

        items = [(settings, index, file) for index, file in enumerate(files)]
        work_through(_collect_one, items, workers=workers, on_news=lambda news: None, on_end=ended)
    if failures:
        raise RunFailedError(f"{failures[0]} Nothing was written.")


def _collect_one(item: _Item, on_news: Callable[[None], None]) -> str:
    """Play an episode into its file; returns why that failed, or an empty text."""
    settings, index, file = item
    try:
        write_arrays(file, demonstration(settings, index))
    except Exception as error:  # a sentence for the parent process, which ends the command
        return f"{type(error).__name__}: {error}"
    return ""


@functools.lru_cache(maxsize=1)
def stage(task: str, appearance: str, size: int) -> tuple[MotionEnv, World]:
    """A task's environment of continuous control with both cameras, and a world for plans."""
    env = _made(task, appearance=appearance, size=size)
    return env, env.another_world()


def _made(task: str, **options: Any) -> MotionEnv:
    env_id = registry.motion_id(registry.task(task).env_id)  # asked for, a world with options is registered
    env: Any = gymnasium.make(env_id, disable_env_checker=True, **options)
    unwrapped: MotionEnv = env.unwrapped
    return unwrapped


def demonstration(settings: DemonstrationSettings, index: int) -> Arrays:
    """An episode of a set: the arrays of :mod:`imagine_bench.data.motion`, ``macrostates`` (N + 1, M) and ``seed``."""
    env, planner = stage(settings.task, settings.appearance, settings.size)
    seed = episode_seed("dataset", settings.seed, index)
    policy = _IN_TURN[index % len(_IN_TURN)] if settings.policy == "mixed" else settings.policy
    rng = SeedTree(settings.seed).child("demonstrations", index).generator()
    return {**lived(env, seed, lambda: Demonstrator(env, planner, policy, rng)), "seed": np.array(seed)}


def lived(env: MotionEnv, seed: int, actor_of: Callable[[], Actor], watch: Watch | None = None) -> Arrays:
    """Play an episode that an actor is made for. ``watch`` sees each period."""
    observation, info = env.reset(seed=seed)
    actor = actor_of()
    seen = [observation]
    macrostates = [info["macrostate"]]
    steps = []
    if watch is not None:
        watch(None, observation, 0.0, info)
    over = False
    while not over:
        action = actor.act()
        if action is None:
            break
        said = env.instruction
        observation, reward, terminated, truncated, info = env.step(action)
        seen.append(observation)
        macrostates.append(info["macrostate"])
        steps.append((action, reward, terminated, truncated, bool(info["is_success"]), actor.macro_action, said))
        over = terminated or truncated
        if watch is not None:
            watch(action, observation, reward, info)
    names = ("actions", "rewards", "terminated", "truncated", "success", "macro_action", "instruction")
    columns = dict(zip(names, map(np.array, zip(*steps, strict=True)), strict=True))
    images = {name: np.stack([each[name] for each in seen]) for name in OBSERVATIONS if name in seen[0]}
    return {**columns, **images, "macrostates": np.array(macrostates)}


class _EpisodeCounts:
    """Counts the episodes that go through it on their way into a format, and keeps the arrays apart."""

    def __init__(self) -> None:
        self._digest = Digest()
        self._returns: list[float] = []
        self._successes = 0
        self._steps = 0
        self._hidden: list[tuple[Array, Array]] = []

    def through(self, files: Sequence[Path]) -> Iterator[Arrays]:
        """The episodes of files, without the arrays apart."""
        for file in files:
            episode = read_arrays(file)
            self._hidden.append((episode.pop("seed"), episode.pop("macrostates")))
            self._digest.add(episode)
            self._returns.append(float(episode["rewards"].sum()))
            self._successes += bool(episode["success"][-1])
            self._steps += len(episode["rewards"])
            yield episode

    def facts(self) -> dict[str, Json]:
        """For the card."""
        counts = {"episodes": len(self._returns), "transitions": self._steps, "successes": self._successes}
        return {**counts, "mean_return": float(np.mean(self._returns)), "content": str(self._digest)}

    def hidden(self) -> Arrays:
        """Seeds (E,), and macrostates of all episodes (N + E, M)."""
        seeds, macrostates = zip(*self._hidden, strict=True)
        return {"seeds": np.array(seeds), "macrostates": np.concatenate(macrostates)}


# Played again -----------------------------------------------------------------------------------------------------


class _Kept:
    """An actor with the commands of a demonstration."""

    macro_action = -1

    def __init__(self, actions: Array) -> None:
        self._actions = iter(actions)

    def act(self) -> Array | None:
        """The next command, None behind the last."""
        return next(self._actions, None)


def replay_env(card: Mapping[str, Any], observation: str = "proprio,state") -> MotionEnv:
    """The environment that demonstrations were made in, by default without images."""
    options = {"appearance": card["appearance"], "size": card["size"], "control": card["control"]}
    return _made(card["task"], observation=observation, **options)


def replay(env: MotionEnv, seed: int, actions: Array, watch: Watch | None = None) -> Arrays:
    """Play the commands of a demonstration again from its start, as :func:`lived`."""
    return lived(env, seed, lambda: _Kept(actions), watch)


def verify(kept: Demonstrations) -> str:
    """Play every episode again, from its seed and its commands alone. Returns one line.

    Raises:
        ArtefactError: Something in the folder does not follow from them, or is not of its card.
    """
    hidden = read_files(kept.folder, kept.card)["privileged"]
    seeds = hidden["seeds"]
    digest = Digest()
    begin = 0
    count = 0
    with closing(replay_env(kept.card)) as env:
        for episode in tqdm(kept, total=len(seeds), unit="episode", disable=None):
            require(count < len(seeds), f"{kept.folder} has more episodes than seeds, which are {len(seeds)}.")
            end = begin + len(episode["rewards"]) + 1
            found = replay(env, int(seeds[count]), episode["actions"])
            episode["macrostates"] = hidden["macrostates"][begin:end]
            _compare(f"{kept.folder}, episode {count}", episode, found)
            del episode["macrostates"]
            digest.add(episode)
            begin = end
            count += 1
    require(count == len(seeds), f"{kept.folder} has {count} episodes and {len(seeds)} seeds.")
    require(str(digest) == kept.card["content"], f"{kept.folder}: its episodes are not those of its card.")
    return f"Holds. {count} of {count} episodes replay from seed and commands to equal rewards and macrostates."


def record(kept: Demonstrations, index: int, path: Path) -> None:
    """Play an episode again and record it for Rerun.

    Raises:
        InvalidValueError: There is no such episode.
        SetupError: Rerun is not installed, or the file cannot be written.
    """
    seeds = read_files(kept.folder, kept.card)["privileged"]["seeds"]
    if not 0 <= index < len(seeds):
        raise InvalidValueError(f"Episode {index} is not in {kept.folder}; give 0 to {len(seeds) - 1}.")
    (episode,) = itertools.islice(kept, index, index + 1)
    recording = registry.load("imagine_bench_motion.control.recording:motion_recording")
    with closing(replay_env(kept.card, "hand,front,proprio")) as env, recording(path, env) as watch:
        replay(env, int(seeds[index]), episode["actions"], watch)


def _compare(where: str, kept: Arrays, found: Arrays) -> None:
    """Raise ArtefactError for the first array of an episode that is not as it was kept."""
    lengths = [len(each["rewards"]) for each in (found, kept)]
    ends = found["terminated"][-1] or found["truncated"][-1]
    require(lengths[0] == lengths[1] and bool(ends), f"{where}: its commands do not end it, or go on after its end.")
    for name in (*OUTCOMES, "macrostates"):
        then = kept[name]
        now = found[name]
        require(then.shape == now.shape, f"{where}: {name} has shape {now.shape}, and the file has {then.shape}.")
        differs = np.flatnonzero((then != now).reshape(len(then), -1).any(axis=1))
        if len(differs):
            row = int(differs[0])
            said = f"{name}[{row}] is {brief(now[row].tolist())}, and the file says {brief(then[row].tolist())}"
            raise ArtefactError(f"{where}: {said}.")
    n_rows = len(kept["proprio"])
    off = np.abs(kept["proprio"] - found["proprio"][:n_rows]).max(axis=1)
    if off.max() > _SAME_M:
        row = int(off.argmax())
        raise ArtefactError(
            f"{where}: the arm of row {row} is off by {off[row]:.3f} rad or m, where its commands lead."
        )


def describe(kept: Demonstrations) -> str:
    """Demonstrations in words, for a terminal."""
    card = kept.card
    episodes = card["episodes"]
    low, high = statistics.wilson(card["successes"], episodes)
    lines = {
        "episodes": f"{episodes:,} of {card['transitions']:,} commands at {card['rate_hz']:g} Hz, as {card['format']}",
        "success": f"{card['successes'] / episodes:.1%} of episodes [{low:.1%}, {high:.1%}]",
        "return": f"{card['mean_return']:.2f} an episode; optimum {card['optimal_return']:.2f} if all is seen",
        "content": card["content"],
        "task": f"{card['env_id']}, control {card['control']}, appearance {appearance_typed(card['appearance'])}",
        "images": f"{' and '.join(CAMERAS)}, {card['size']} pixels",
        "policy": f"{card['policy']} ({card['played']}), seed {card['seed']}",
        "apart": "privileged.npz (seeds, macrostates): never given to a learner",
        "commit": str(card["commit"]),
        "command": str(card["command"]),
    }
    return "\n".join(f"{name:<14}{value}" for name, value in lines.items())
