"""Collecting a dataset: a policy plays episodes of a task, on starts that no run is trained or tested on."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from tqdm import tqdm

from imagine_bench import registry, statistics
from imagine_bench.appearance import appearance_name, appearance_typed
from imagine_bench.arrays import Arrays, Info, State
from imagine_bench.data.folder import Apart, Dataset, read_apart
from imagine_bench.errors import InvalidValueError, UnknownNameError
from imagine_bench.exact.beliefs import optimal_policy_of
from imagine_bench.interfaces import Agent, AgentContext, ArmMotion, ArmReader, TaskSpec, Transition
from imagine_bench.interfaces.environments import Env
from imagine_bench.interfaces.episodes import Episodes, joined
from imagine_bench.registry.machine import describe_environment
from imagine_bench.rules import states_of_play
from imagine_bench.running.evaluation import play
from imagine_bench.running.trained import load_trained
from imagine_bench.seeding import SEEDS, SeedTree, episode_seed
from imagine_bench.values import Json

POLICIES = {
    "random": "every macro-action by chance",
    "uniform": "one random macro-action from a macrostate drawn uniformly, then cut off",
    "oracle": "optimal macro-actions by the rules",
    "mixed": "random and oracle, an episode each in turn",
}
MOST_EPISODES = 100_000
"""More would not fit into memory at once."""


@dataclass(frozen=True, kw_only=True)
class Policy:
    """The player, and how it plays."""

    name: str  #: One of :data:`POLICIES`, or the agent's
    players: Sequence[tuple[Agent, bool]]  #: Play an episode each in turn; whether each is shown macrostates
    facts: Mapping[str, Json]  #: More for the card


def policy_of(name: str, spec: TaskSpec, seed: int, encoder: str | None = None) -> Policy:
    """One of :data:`POLICIES`, or the agent of a run's folder, which acts greedily.

    Raises:
        UnknownNameError: Neither of them.
        InvalidValueError: The run is of another task.
        ArtefactError: It cannot be taken up again.
    """
    if name not in POLICIES:
        if not Path(name).is_dir():
            raise UnknownNameError("policy", name, (*POLICIES, "or a run's folder such as runs/.../dqn/seed_0"))
        trained = load_trained(Path(name), encoder=encoder)
        run = trained.spec
        if trained.task.id != spec.id:
            raise InvalidValueError(f"{name} learned {trained.task.id}, not {spec.id}; give a run of {spec.id}.")
        played = f"greedy after {trained.episodes:,} episodes of seed {run.seed}"
        players = [(trained.agent, registry.agent_entry(run.agent).privileged)]
        return Policy(name=run.agent, players=players, facts={"played": played, "protocol_hash": run.protocol.hash})
    names = {"oracle": (registry.DEMONSTRATOR,), "mixed": ("random", registry.DEMONSTRATOR)}.get(name, ("random",))
    context = AgentContext(
        n_actions=spec.n_actions, preprocessing=spec.preprocessing, encoder=None,
        seeds=SeedTree(seed).child("dataset", "agent"), optimal_policy=optimal_policy_of(spec),
    )  # fmt: skip
    players = [(registry.make_agent(each, context), registry.agent_entry(each).privileged) for each in names]
    return Policy(name=name, players=players, facts={"played": POLICIES[name]})


def collect(
    spec: TaskSpec, policy: Policy, *, episodes: int, seed: int, execution: str, appearance: str, motion_hz: float = 0.0
) -> tuple[Episodes, Apart, dict[str, Json]]:
    """Play episodes of a task.

    Returns:
        The episodes; apart from them ``privileged`` (``macrostates`` (N + E, M), ``seeds`` (E,)) and, at a rate above
        0, ``arm`` (the arrays of every macro-action's :class:`.ArmMotion` one behind another, and ``samples`` (N,), how
        many each has); and the card.

    Raises:
        InvalidValueError: A number of episodes, a seed or a rate out of range, or no arm whose motion can be read.
        UnknownNameError: An unknown execution or appearance.
    """
    if not 1 <= episodes <= MOST_EPISODES or not 0 <= seed < SEEDS:
        allowed = f"1 to {MOST_EPISODES:,} episodes and a seed from 0 to {SEEDS - 1}"
        raise InvalidValueError(f"episodes is {episodes} and seed {seed}; give {allowed}.")
    starts = SeedTree(seed).child("dataset", "starts").generator()
    open_states = states_of_play(spec.rules)
    seeds = [episode_seed("dataset", seed, index) for index in range(episodes)]
    parts = []
    motion = list[ArmMotion]()
    env_id = registry.task_entry(spec.id).env_id
    with closing(gymnasium.make(env_id, execution=execution, appearance=appearance)) as env:
        watch = _watching(spec.id, env, motion_hz, motion)
        for index in tqdm(range(episodes), desc=f"{spec.id} {policy.name}", unit="episode", disable=None):
            options = None
            if policy.facts.get("played") == POLICIES["uniform"]:  # an agent may have that name, too
                options = {"macrostate": open_states[int(starts.integers(len(open_states)))]}
            parts.append(_episode(env, policy.players[index % len(policy.players)], seeds[index], options, watch))
    played = joined(parts)
    macrostates = np.concatenate([part["macrostates"] for part in parts])
    apart: dict[str, Arrays] = {"privileged": {"macrostates": macrostates, "seeds": np.array(seeds)}}
    if motion:
        names = [field.name for field in dataclasses.fields(ArmMotion)]
        apart["arm"] = {name: np.concatenate([getattr(each, name) for each in motion]) for name in names}
        apart["arm"]["samples"] = np.array([len(each.time_s) for each in motion])
    made = {"seed": seed, "execution": execution, "appearance": appearance_name(appearance), "motion_hz": motion_hz}
    return played, apart, {**_card(spec, policy, played), **made, "faults": sum(part["faults"] for part in parts)}


def _watching(task: str, env: Env, motion_hz: float, motion: list[ArmMotion]) -> Callable[[], None]:
    """The call after each macro-action: None, or one that adds the arm's motion to the samples so far."""
    scene = env.unwrapped
    if not motion_hz:
        return lambda: None
    if not isinstance(scene, ArmReader):
        raise InvalidValueError(f"Task {task} tells no motion of its arm; leave --motion-hz out.")
    scene.capture_motion_hz = motion_hz
    return lambda: motion.append(scene.arm_motion())


def _episode(
    env: Env,
    player: tuple[Agent, bool],
    seed: int,
    options: dict[str, State] | None,
    watch: Callable[[], None],
) -> dict[str, Any]:
    """One episode, its arrays as lists; with ``options`` of a start, one macro-action and then a truncation."""
    agent, privileged = player
    mask = np.ones(int(env.action_space.n), dtype=np.int8)  # type: ignore[attr-defined]
    infos = list[Info]()
    lived = list[Transition]()
    episode = play(
        env,
        agent,
        seed=seed,
        explore=False,
        privileged=privileged,
        before_acting=lambda _, info: None if infos else infos.append(info),
        options=options,
    )
    for transition, info in episode:
        watch()
        infos.append(info)
        lived.append(transition)
        if options is not None:
            lived[0] = dataclasses.replace(transition, truncated=not transition.terminated)
            break
    return {
        "frames": [lived[0].observation.frame, *(each.next_observation.frame for each in lived)],
        "action_masks": [np.asarray(info.get("action_mask", mask)) for info in infos],
        "macrostates": [np.asarray(info["macrostate"]) for info in infos],
        "actions": [each.action for each in lived],
        "rewards": [each.reward for each in lived],
        "terminated": [each.terminated for each in lived],
        "truncated": [each.truncated for each in lived],
        "success": bool(infos[-1]["is_success"]),
        "faults": sum(bool(info["fault"]) for info in infos[1:]),
    }


def _card(spec: TaskSpec, policy: Policy, played: Episodes) -> dict[str, Json]:
    """The description of a dataset: task, policy, counts, success beside chance and optimum, and its origin."""
    environment = describe_environment()
    return {
        "task": spec.id, "description": spec.description, "env_id": spec.env_id,
        "action_names": list(spec.action_names), "macrostate_names": list(spec.macrostate_names),
        "policy": policy.name, **policy.facts, "episodes": len(played), "transitions": len(played.actions),
        "successes": int(played.success.sum()), "mean_return": float(played.rewards.sum()) / len(played),
        **dataclasses.asdict(spec.facts()), **{name: environment[name] for name in ("commit", "command", "versions")},
    }  # fmt: skip


def describe(dataset: Dataset) -> str:
    """A dataset in words, for a terminal. Raises ArtefactError: a file apart or the card is damaged."""
    episodes = dataset.episodes
    card = dataset.card
    low, high = statistics.wilson(int(episodes.success.sum()), len(episodes))
    lines = {
        "episodes": f"{len(episodes):,} of {len(episodes.actions):,} transitions, as {dataset.format}",
        "success": f"{episodes.success.mean():.1%} of episodes [{low:.1%}, {high:.1%}]",
        "return": f"{episodes.rewards.sum() / len(episodes):.2f} an episode",
        "content": episodes.hash,
        "in a protocol": dataset.identity,
    }
    if card is None:
        lines["card"] = "none: it is not of this suite, and nothing says whether it is whole"
    else:
        apart = [f"{name}.npz ({', '.join(arrays)})" for name, arrays in read_apart(dataset).items()]
        lines |= {
            "task": f"{card['task']}, {card['execution']} execution, appearance {appearance_typed(card['appearance'])}",
            "policy": f"{card['policy']} ({card['played']}), seed {card['seed']}",
            "exact": f"chance {card['chance_level']:.1%}; if all is seen, optimum {card['optimum']:.1%} and "
            f"optimal return {card['optimal_return']:.2f}",
            "faults": f"{card['faults']} macro-actions whose physics disagreed with the rules",
            "apart": f"{', '.join(apart)}: never given to a learner",
            "commit": str(card["commit"]),
            "command": str(card["command"]),
        }
    return "\n".join(f"{name:<14}{value}" for name, value in lines.items())
