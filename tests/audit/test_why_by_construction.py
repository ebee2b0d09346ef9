"""Agents built to fail for one known reason, trained and tested in real benches, are charged exactly that."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
from flawed_agents import HalfBlind, Sound
from small_runs import made_bench, small

from imagine_bench import registry
from imagine_bench.cli import observers
from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.interfaces import AgentContext, Rules, State
from imagine_bench.judge import causes as why
from imagine_bench.protocols.control import protocol
from imagine_bench.rules import states_of
from imagine_bench.running.bench import load_bench
from imagine_bench.running.player import played_run, protocol_of_player
from imagine_bench.running.trained import load_trained
from imagine_bench.seeding import SeedTree, episode_seed
from imagine_bench.store.results import Checkpoint, RunResult

CUBES = "arrows:cubes=2"


def finished(root: Path, agent: str, task: str, **changes: Any) -> RunResult:
    """The run of a bench of one agent."""
    few: dict[str, Any] = {"agents": (agent,), "budgets": (80,), "evaluation_episodes": 24, **changes}
    Sound.task = task
    return load_bench(made_bench(small(task, **few), root).folder).runs[0]


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
        ("half_blind", "misread", CUBES),
        ("bad", "values", CUBES),
        ("not_greedy", "planning", CUBES),
        ("wrong_model", "model", CUBES),
        pytest.param("wrong_model", "model", "pick_place", marks=pytest.mark.slow),
        ("timid", "unexperienced", CUBES),
        ("forgetful", "forgotten", "arrows:gesture=first"),
        ("bad", "values", "arrows:cubes=2,gesture=first"),
        ("timid_modeller", "unexperienced", CUBES),
    ],
)
def test_one_flaw_is_the_cause_of_every_failure(agent: str, cause: str, task: str, tmp_path: Path) -> None:
    """Also of seeds for tuning, whose tests begin elsewhere."""
    for seed in (0, 1000) if agent == "half_blind" else (0,):
        _, found = asked(tmp_path / str(seed), agent, task, seeds=(seed,))
        assert set(found.causes.values()) == {cause} and len(found.causes) > 12


def test_what_is_misread_in_the_appearance_of_tests_alone_is_misread(tmp_path: Path) -> None:
    row, found = asked(tmp_path, "dazzled", CUBES, test_appearance="noise=1")
    assert set(found.causes.values()) == {"misread"} and row.successes == 0
    row, _ = asked(tmp_path / "clean", "dazzled", CUBES)
    assert row.successes > 12, "it reads most clean frames"


def test_grasps_that_slip_are_the_cause_of_every_failure(tmp_path: Path) -> None:
    """In contact physics, where the planner takes cubes to be elsewhere."""
    changes: dict[str, Any] = {"execution": "physics", "physics": (("plan_error_mm", 30.0),), "budgets": (1,)}
    row, found = asked(tmp_path, "sound", CUBES, evaluation_episodes=6, **changes)
    assert set(found.causes.values()) == {"execution"} and row.faults > 0 and row.kept is not None
    rules = registry.task(CUBES).rules
    with closing(gymnasium.make(registry.task(CUBES).env_id, physics={"plan_error_mm": 30.0})) as env:
        agent = Sound(AgentContext(n_actions=4, preprocessing="", encoder=None, seeds=SeedTree(0)))
        for test, count in enumerate(row.kept.faults):
            seed = episode_seed("evaluation", 0, test)
            lived = why.lived_again(env, agent, rules, seed, row.kept.actions_of(test))
            assert sum(lived.faults) == count


@pytest.mark.parametrize("hides", ["", ",gesture=first", ",gesture=0.5", ",lag=1"])
def test_a_course_is_what_was_seen_before_each_action(hides: str) -> None:
    """A frame is misread where the agent reads something else than it shows; a hidden part cannot be misread."""
    Sound.task = CUBES + hides
    spec = registry.task(Sound.task)
    agent = HalfBlind(AgentContext(n_actions=4, preprocessing="", encoder=None, seeds=SeedTree(0)))
    rng = np.random.default_rng(0)
    misread, hidden = list[list[bool]](), list[bool]()
    with closing(gymnasium.make(spec.env_id, execution="kinematic")) as env:
        for seed in range(12):
            frame, info = env.reset(seed=seed)
            states, actions, wrong, hides_some, over = [info["macrostate"].tolist()], [], [], [], False
            while not over and len(actions) < 5:
                shown = info.get("shown", info["macrostate"]).tolist()
                read = agent.read_frames(frame[None])[0].tolist()
                wrong.append(any(one not in (other, -1) for one, other in zip(shown, read, strict=True)))
                hides_some.append(-1 in shown)
                outcomes = [spec.rules.outcomes(tuple(states[-1]), action)[0] for action in range(4)]
                safe = [action for action, outcome in enumerate(outcomes) if not outcome.terminated]
                actions.append(int(rng.choice(safe or range(4))))
                frame, _, over, _, info = env.step(actions[-1])
                states.append(info["macrostate"].tolist())
            episode = why.lived_again(env, agent, spec.rules, seed, actions)
            assert (episode.misread, episode.hidden, episode.terminated) == (wrong, hides_some, over)
            assert list(map(list, episode.states)) == states and not any(episode.faults)
            misread.append(wrong)
            hidden += hides_some
    assert {True, False} == {each[0] for each in misread} and any(len(set(each)) == 2 for each in misread)
    assert any(hidden) == ("gesture" in hides)


def test_what_cannot_be_asked_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for words, task, changes in (
        ("are old, or hide something that changes", "arrows:cubes=2,gesture=0.5", {}),
        ("are old, or hide something that changes", "arrows:cubes=2,lag=1", {}),
        ("in a dataset or an earlier task", "arrow_puzzle", {"dataset": "some-1@0123456789ab"}),
        ("in a dataset or an earlier task", "arrow_puzzle", {"after": ("arrow_puzzle_hard",)}),
        ("saw more than frames", "arrow_puzzle", {"observation": "state", "agents": ("random",)}),
    ):
        spec = SimpleNamespace(protocol=protocol(task, "smoke", **{"agents": ("factored:given",), **changes}))
        trained: Any = SimpleNamespace(spec=spec, task=registry.task(task))
        with pytest.raises(InvalidValueError, match=words):
            why.causes_of(trained)
    monkeypatch.setattr(observers, "can_be_asked", lambda spec: False)
    with pytest.raises(ArtefactError, match="keeps no answers about macrostates; run its bench anew"):
        asked(tmp_path / "before", "bad", CUBES, evaluation_episodes=2, budgets=(1,))
    monkeypatch.setattr(why, "MOST_STATES", 31)
    with pytest.raises(InvalidValueError, match="too many macrostates"):
        asked(tmp_path, "bad", CUBES, evaluation_episodes=2, budgets=(1,))


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
    "task", ["arrows:cubes=2,slip=0.7", pytest.param("arrows:cubes=2,fickle=0.3,slip=0.7", marks=pytest.mark.slow)]
)
def test_unlucky_is_what_an_optimal_policy_fails_with_the_same_draws(task: str, tmp_path: Path) -> None:
    """An optimal policy lives each test again in the real environment, whose generator draws the same.

    Among equals it takes the agent's action, as 'unlucky' says.
    """
    row, found = asked(tmp_path, "bad", task, evaluation_episodes=70, budgets=(1,))
    assert row.kept is not None and row.beliefs is not None
    spec = registry.task(task)
    sets, usual = best_sets(spec.rules, spec.horizon), dict(zip(states_of(spec.rules), row.beliefs.action, strict=True))
    missed, whole = set[int](), set[int]()
    with closing(gymnasium.make(spec.env_id, execution="kinematic")) as env:
        for test in found.causes:
            seed = episode_seed("evaluation", 0, test)
            env.reset(seed=seed)
            if any([env.step(action)[2] for action in row.kept.actions_of(test)]):
                continue  # later draws are not known, and an end hides whether the human changed their mind
            whole.add(test)
            _, info = env.reset(seed=seed)
            over = False
            for best in reversed(sets):
                state = tuple(info["macrostate"].tolist())
                if not over:
                    chosen = usual[state] if usual[state] in best[state] else min(best[state])
                    _, _, over, _, info = env.step(chosen)
            missed |= set() if info["is_success"] else {test}
    assert {test for test in whole if found.causes[test] == "unlucky"} == missed
    assert 3 < len(missed) < len(whole) - 5


def test_a_persons_failures_are_bad_luck_or_decisions(tmp_path: Path) -> None:
    wanted = protocol_of_player("arrows:cubes=2,slip=0.7", "person", "anna", tests=30, execution="kinematic")
    with played_run(wanted, tmp_path) as run:
        while not run.is_done:
            run.reset()
            while not any(run.step(0)[2:4]):
                pass
    *_, tested = why.causes_of_player(run.folder)
    assert {*tested.causes.values()} == {"unlucky", "decision"}
