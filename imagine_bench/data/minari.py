"""Episodes as a Minari dataset; its own loader reads it from the folder that ``MINARI_DATASETS_PATH`` names.

Observations are kept as they are: by default Minari would make JPEGs of them. Datasets of its own recorder, from an
environment of ours, are read too.
"""

from __future__ import annotations

import itertools
import os
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any
from unittest import mock

import gymnasium
import minari
import numpy as np
from minari.data_collector import EpisodeBuffer

from imagine_bench import registry
from imagine_bench.arrays import Arrays
from imagine_bench.data.motion import OBSERVATIONS
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces.episodes import Episodes, joined
from imagine_bench.store.files import reading

_NAMED = {
    "rewards": "rewards",
    "terminations": "terminated",
    "truncations": "truncated",
    "actions": "actions",
}
"""Arrays of an episode in Minari's words, and in ours."""
_INFOS = {"macro_action": -1, "instruction": "", "success": False}
"""Parts of a demonstration that are infos, and each after the last command."""


def write(folder: Path, episodes: Episodes, card: Mapping[str, Any]) -> None:
    """Write the dataset ``<task>-<policy>-v0``; the card says which environment it is of."""
    env_id = registry.task_entry(card["task"]).env_id
    made = {name: card[name] for name in ("execution", "appearance")}
    _create(folder, [_buffer(episodes, index) for index in range(len(episodes))], card, env_id, made)


def _create(
    folder: Path, buffers: Iterable[EpisodeBuffer], card: Mapping[str, Any], env_id: str, made: dict[str, Any]
) -> None:
    name = re.sub(r"[^\w-]+", "_", f"{card['task']}-{card['policy']}")
    written_below = mock.patch.dict(os.environ, MINARI_DATASETS_PATH=str(folder.resolve()))
    with written_below, warnings.catch_warnings(), closing(gymnasium.make(env_id, **made)) as env:
        warnings.simplefilter("ignore")  # about facts that we do not know, such as an address for questions
        minari.create_dataset_from_buffers(
            f"{name}-v0", buffers, env=env, algorithm_name=str(card["policy"]), description=str(card["description"]),
            data_format="parquet", jpeg_encoding=False,
        )  # fmt: skip


def write_motion(folder: Path, episodes: Iterator[Arrays], card: Mapping[str, Any]) -> None:
    """Write demonstrations, one after another, likewise."""
    made = {name: card[name] for name in ("appearance", "size")}
    _create(folder, map(_motion_buffer, itertools.count(), episodes), card, card["env_id"], made)


def _motion_buffer(index: int, episode: Arrays) -> EpisodeBuffer:
    infos = {name: [*episode[name].tolist(), after] for name, after in _INFOS.items()}
    seen = {name: episode[name] for name in OBSERVATIONS}
    steps = {theirs: episode[ours] for theirs, ours in _NAMED.items()}
    return EpisodeBuffer(id=index, observations=seen, infos=infos, **steps)


def read_motion(folder: Path) -> Iterator[Arrays]:
    """Read demonstrations, one at a time. Raises ArtefactError: one is damaged."""
    with reading(folder, "a Minari dataset of demonstrations"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        (path,) = folder.glob("*/data/metadata.json")
        for episode in minari.MinariDataset(path.parent).iterate_episodes():
            steps = {ours: getattr(episode, theirs) for theirs, ours in _NAMED.items()}
            infos = {name: np.asarray(episode.infos[name][:-1]) for name in _INFOS}
            yield {**episode.observations, **steps, **infos}


def _buffer(episodes: Episodes, index: int) -> EpisodeBuffer:
    steps, frames = episodes.steps(index)
    success = [False] * int(episodes.lengths[index]) + [bool(episodes.success[index])]
    return EpisodeBuffer(
        id=index, observations=episodes.frames[frames], actions=episodes.actions[steps],
        rewards=episodes.rewards[steps], terminations=episodes.terminated[steps], truncations=episodes.truncated[steps],
        infos={"action_mask": episodes.action_masks[frames], "is_success": success},
    )  # fmt: skip


def read(path: Path) -> Episodes:
    """Read a dataset from its ``metadata.json``. Raises ArtefactError: damaged, or of an environment unlike ours."""
    with reading(path, "a Minari dataset of macro-actions"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = minari.MinariDataset(path.parent)
        try:
            parts = [_part(episode) for episode in found.iterate_episodes()]
        except FileNotFoundError as error:
            raise InvalidValueError(f"a file of it is missing ({error})") from error
        if len(parts) != found.total_episodes or sum(len(part["actions"]) for part in parts) != found.total_steps:
            raise InvalidValueError(
                f"{found.total_episodes} episodes of {found.total_steps} steps are not those that it holds"
            )
        return joined(parts)


def _part(episode: Any) -> dict[str, Any]:
    return {
        "frames": episode.observations, "actions": episode.actions, "rewards": episode.rewards,
        "terminated": episode.terminations, "truncated": episode.truncations,
        "action_masks": episode.infos["action_mask"], "success": bool(np.asarray(episode.infos["is_success"])[-1]),
    }  # fmt: skip
