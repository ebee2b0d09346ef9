"""Agents built to fail for one known reason, trained and tested in real benches, are charged exactly that."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import pytest
from flawed_agents import Sound
from small_runs import Inline

from imagine_bench import registry
from imagine_bench.cli import observers
from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.interfaces import AgentContext, Rules, State
from imagine_bench.interfaces.capabilities import FrameReader
from imagine_bench.judge import causes as why
from imagine_bench.protocols.control import protocol
from imagine_bench.rules import states_of
from imagine_bench.running.bench import bench, load_bench
from imagine_bench.running.trained import load_trained
from imagine_bench.seeding import SeedTree, episode_seed
from imagine_bench.store.results import Checkpoint, RunResult


def finished(root: Path, agent: str, task: str, **changes: Any) -> RunResult:
    """The run of a bench of one agent."""
    few: dict[str, Any] = {
        "agents": (agent,), "seeds": (0,), "budgets": (80,), "evaluation_episodes": 24, "execution": "kinematic",
        "open_loop_starts": 0, "recorded_episodes": 0,
    }  # fmt: skip
    Sound.task = task
    folder = bench(protocol(task, "smoke", **{**few, **changes}), {}, root=root, launcher=Inline()).folder
    return load_bench(folder).runs[0]


def asked(root: Path, agent: str, task: str, **changes: Any) -> tuple[Checkpoint, why.Tested]:
    """A bench of one agent, and the causes of its first test's failures."""
    run = finished(root, agent, task, **changes)
    found = why.causes_of(load_trained(run.folder))
    for row, each in zip(run.checkpoints, found, strict=True):
        failed = [test for test, solved in enumerate(row.solved or "") if solved == "0"]
        assert list(each.causes) == failed, "every failure has a cause, and nothing else has"
    return run.checkpoints[0], found[0]


@pytest.mark.parametrize(
    ("agent", "cause", "task"),
    [
        ("blind", "misread", "arrows:cubes=2"),
        ("bad", "values", "arrows:cubes=2"),
        ("not_greedy", "planning", "arrows:cubes=2"),
        ("wrong_model", "model", "arrows:cubes=2"),
        pytest.param("wrong_model", "model", "pick_place", marks=pytest.mark.slow),
        ("timid", "unexperienced", "arrows:cubes=2"),
        ("forgetful", "forgotten", "arrows:gesture=first"),
        ("bad", "values", "arrows:cubes=2,gesture=first"),
        ("timid_modeller", "unexperienced", "arrows:cubes=2"),
    ],
)
def test_one_flaw_is_the_cause_of_every_failure(agent: str, cause: str, task: str, tmp_path: Path) -> None:
    _, found = asked(tmp_path, agent, task)
    assert set(found.causes.values()) == {cause} and len(found.causes) > 12


def test_grasps_that_slip_are_the_cause_of_every_failure(tmp_path: Path) -> None:
    """In contact physics, where the planner takes cubes to be elsewhere."""
    changes: dict[str, Any] = {"execution": "physics", "physics": (("plan_error_mm", 30.0),), "budgets": (1,)}
    row, found = asked(tmp_path, "sound", "arrows:cubes=2", evaluation_episodes=6, **changes)
    assert set(found.causes.values()) == {"execution"} and row.faults > 0 and row.kept is not None
    rules = registry.task("arrows:cubes=2").rules
    with closing(gymnasium.make(registry.task("arrows:cubes=2").env_id, physics={"plan_error_mm": 30.0})) as env:
        agent = Sound(AgentContext(n_actions=4, preprocessing="", encoder=None, seeds=SeedTree(0)))
        for test, count in enumerate(row.kept.faults):
            seed = episode_seed("evaluation", 0, test)
            lived = why.lived_again(env, agent, rules, seed, row.kept.actions_of(test))
            assert sum(lived.faults) == count


def test_what_came_later_was_not_known_before(tmp_path: Path) -> None:
    _, found = asked(tmp_path, "bad", "arrows:cubes=2", budgets=(2, 150))
    assert "unexperienced" in found.causes.values()


def test_a_course_is_what_was_seen_before_each_action(tmp_path: Path) -> None:
    run = finished(tmp_path, "half_blind", "arrows:cubes=2", budgets=(20,))
    (row,), agent, spec = run.checkpoints, load_trained(run.folder).agent, registry.task("arrows:cubes=2")
    assert isinstance(agent, FrameReader) and row.kept is not None
    seen = set[tuple[bool, ...]]()
    with closing(gymnasium.make(spec.env_id, execution="kinematic")) as env:
        for test in range(row.test_episodes):
            seed = episode_seed("evaluation", 0, test)
            episode = why.lived_again(env, agent, spec.rules, seed, row.kept.actions_of(test))
            frame, info = env.reset(seed=seed)
            for action, state, misread in zip(episode.actions, episode.states, episode.misread, strict=False):
                assert state == tuple(info["macrostate"].tolist())
                assert misread == (tuple(agent.read_frames(frame[None])[0].tolist()) != state)
                frame, _, terminated, _, info = env.step(action)
            assert episode.states[-1] == tuple(info["macrostate"].tolist()) and episode.terminated == terminated
            seen.add(tuple(episode.misread))
    assert {(True,), (False,)} <= {each[:1] for each in seen} and any(len(set(each)) == 2 for each in seen)


def test_what_cannot_be_asked_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cases: tuple[tuple[str, dict[str, Any], str], ...] = (
        ("arrows:cubes=2,gesture=0.5", {}, "are old, or hide something that changes"),
        ("arrows:cubes=2,lag=1", {}, "are old, or hide something that changes"),
        ("arrow_puzzle", {"dataset": "some-1@0123456789ab"}, "in a dataset or an earlier task"),
        ("arrow_puzzle", {"after": ("arrow_puzzle_hard",)}, "in a dataset or an earlier task"),
        ("arrow_puzzle", {"observation": "state", "agents": ("random",)}, "saw more than frames"),
    )
    for task, changes, words in cases:
        spec = SimpleNamespace(protocol=protocol(task, "smoke", **{"agents": ("factored:given",), **changes}))
        trained: Any = SimpleNamespace(spec=spec, task=registry.task(task))
        with pytest.raises(InvalidValueError, match=words):
            why.causes_of(trained)
    monkeypatch.setattr(why, "MOST_STATES", 31)
    with pytest.raises(InvalidValueError, match="too many macrostates"):
        asked(tmp_path, "bad", "arrows:cubes=2", evaluation_episodes=2, budgets=(1,))


def test_a_run_from_before_is_to_be_run_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(observers, "can_be_asked", lambda spec: False)
    with pytest.raises(ArtefactError, match="keeps no answers about macrostates; run its bench anew"):
        asked(tmp_path, "bad", "arrows:cubes=2", evaluation_episodes=2, budgets=(1,))


def best_sets(rules: Rules, horizon: int) -> list[dict[State, set[int]]]:
    """The macro-actions of largest return with 1 to ``horizon`` left, by the definition."""
    value, found = dict.fromkeys(states_of(rules), 0.0), list[dict[State, set[int]]]()
    for _ in range(horizon):
        q = {
            state: [
                sum(o.probability * (o.reward + (0.0 if o.terminated else value[o.macrostate])) for o in outcomes)
                for outcomes in (rules.outcomes(state, action) for action in range(rules.n_actions))
            ]
            for state in value
        }
        value = {state: max(each) for state, each in q.items()}
        found.append({s: {a for a, each in enumerate(q[s]) if each > value[s] - 1e-6} for s in value})
    return found


@pytest.mark.parametrize(
    "task",
    [
        "arrows:cubes=2,slip=0.7",
        pytest.param("arrows:cubes=2,fickle=0.3,slip=0.7", marks=pytest.mark.slow),
    ],
)
def test_unlucky_is_what_an_optimal_policy_fails_with_the_same_draws(task: str, tmp_path: Path) -> None:
    """An optimal policy lives each test again in the real environment, whose generator draws the same.

    Among equals it takes the agent's action, as 'unlucky' says.
    """
    row, found = asked(tmp_path, "bad", task, evaluation_episodes=70, budgets=(1,))
    assert row.kept is not None and row.beliefs is not None
    spec = registry.task(task)
    sets, usual = best_sets(spec.rules, spec.horizon), dict(zip(states_of(spec.rules), row.beliefs.action, strict=True))
    env, missed = gymnasium.make(spec.env_id, execution="kinematic"), set[int]()
    whole = set[int]()
    for test in found.causes:
        terminated = False
        env.reset(seed=episode_seed("evaluation", 0, test))
        for action in row.kept.actions_of(test):
            _, _, terminated, _, _ = env.step(action)
        if terminated:
            continue  # later draws are not known, and an end hides whether the human changed their mind
        whole.add(test)
        _, info = env.reset(seed=episode_seed("evaluation", 0, test))
        over, left = False, spec.horizon
        while not over:
            state, left = tuple(info["macrostate"].tolist()), left - 1
            best = sets[left][state]
            _, _, terminated, truncated, info = env.step(usual[state] if usual[state] in best else min(best))
            over = terminated or truncated
        missed |= set() if info["is_success"] else {test}
    env.close()
    assert {test for test in whole if found.causes[test] == "unlucky"} == missed
    assert 3 < len(missed) < len(whole) - 5
