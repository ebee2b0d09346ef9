"""Greedy test episodes several at a time, in the task's vector environment: the same to the bit, on all cores."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from typing import Any

import gymnasium
import numpy as np

from imagine_bench import registry
from imagine_bench.arrays import Info, Observed
from imagine_bench.errors import DivergedError
from imagine_bench.interfaces import Agent, Observation
from imagine_bench.interfaces.capabilities import EpisodeRememberer
from imagine_bench.running.evaluation import EpisodeRecord
from imagine_bench.running.run_state import Run

LEAST_EPISODES = 50
"""Fewer are over before lanes are made."""
_LANES_PER_CORE = 4


def lanes_pay(run: Run, episodes: int) -> bool:
    """Whether the episodes of a test are played in lanes.

    They are where simulating takes the time, the run has several cores, frames are all that is seen, and actions follow
    from the one that is shown: in tests, those of every learner do that does not remember its episode.
    """
    markov = run.entry.learns and not isinstance(run.agent, EpisodeRememberer)
    wanted = run.protocol
    simulated = wanted.execution == "physics" and wanted.shows_frames_alone and wanted.split is None and markov
    offered = registry.vector_id(registry.task_entry(run.task.id).env_id) in gymnasium.registry
    return simulated and offered and episodes >= LEAST_EPISODES and run.spec.cores > 1


def episodes_in_lanes(run: Run, seeds: Sequence[int]) -> Iterator[EpisodeRecord]:
    """Greedy test episodes of a run, one for each seed and in their order.

    Raises:
        DivergedError: A simulation blew up.
    """
    protocol = run.protocol
    lanes: Any = gymnasium.make_vec(
        registry.vector_id(registry.task_entry(protocol.task).env_id),
        num_envs=min(_LANES_PER_CORE * run.spec.cores, len(seeds)),
        threads=run.spec.cores,
        **protocol.world,
        appearance=protocol.appearance_in_tests,
        autoreset_mode="Disabled",
    )
    with closing(lanes):
        yield from _play(lanes, run.agent, seeds, privileged=run.entry.privileged)


def _play(lanes: Any, agent: Agent, seeds: Sequence[int], *, privileged: bool) -> Iterator[EpisodeRecord]:
    waiting = list(enumerate(seeds))[::-1]
    everyone = range(lanes.num_envs)
    playing: dict[int, tuple[int, EpisodeRecord]] = {}  # by lane: the number of its episode, and what is kept of it
    over: dict[int, EpisodeRecord] = {}  # by number, until those before it are over
    free = list(everyone)
    following = 0
    actions = dict[int, int]()

    def act(lane: int, frame: Observed, info: Info) -> None:
        actions[lane] = int(agent.act(Observation.of(frame, info, privileged=privileged), explore=False))
        lanes.send([actions[lane]], [lane])

    while following < len(seeds):
        begun = {lane: waiting.pop() for lane in free[: len(waiting)]}
        if begun:
            given = [begun[lane][1] if lane in begun else None for lane in everyone]
            frames, infos = lanes.reset(seed=given, options={"reset_mask": np.isin(everyone, list(begun))})
            for lane, (number, _) in begun.items():
                info = _row(infos, lane)
                playing[lane] = number, EpisodeRecord.begun(lanes.envs[lane], info)
                act(lane, frames[lane], info)
        frames, rewards, terminated, truncated, infos = lanes.recv(max(1, len(playing) // 2))
        free = []
        for row, lane in enumerate(infos["env_id"].tolist()):
            info = _row(infos, row)
            number, played = playing[lane]
            if truncated[row] and not lanes.envs[lane].begun:
                raise DivergedError(info["fault_reason"])
            played.add(actions[lane], float(rewards[row]), info)
            if terminated[row] or truncated[row]:
                free.append(lane)
                over[number] = playing.pop(lane)[1]
            else:
                act(lane, frames[row], info)
        while following in over:
            yield over.pop(following)
            following += 1


def _row(infos: Info, row: int) -> Info:
    return {key: values[row] for key, values in infos.items() if not key.startswith("_")}
