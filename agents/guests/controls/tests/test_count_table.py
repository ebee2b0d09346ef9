"""The count table: value iteration against exact values, R-max on a chain, snapshots, success on the arrow puzzle."""

from __future__ import annotations

import fake_codes
import numpy as np
import pytest
from fake_pictures import played
from imagine_bench_controls.tabular.count_table import CodeCountTableAgent
from imagine_bench_controls.tabular.counts import CountTable
from imagine_bench_controls.tabular.own import OwnCountTableAgent
from imagine_bench_controls.tabular.settings import HYPERPARAMETERS, OWN
from imagine_bench_factored.perception import CodePerception

from imagine_bench import registry, rules
from imagine_bench.interfaces import Observation
from imagine_bench.seeding import SeedTree

LENGTH = 6
LEFT = 0


def agent(
    *, directed: bool, n_actions: int = fake_codes.ACTIONS, seed: int = 0, name: str = "fast"
) -> CodeCountTableAgent:
    perception = CodePerception(fake_codes.FakeCodes(), factored=False)  # type: ignore[arg-type]
    settings = HYPERPARAMETERS.resolve(name, {}, "chapter_5")
    return CodeCountTableAgent(perception, n_actions, settings, SeedTree(seed), directed=directed)


def live(learner: CodeCountTableAgent, steps: int, seed: int = 1) -> None:
    """Train on the tiny world of wheels."""
    rng = np.random.default_rng(seed)
    code = fake_codes.starts()[0]
    for _ in range(steps):
        action = learner.act(Observation(frame=fake_codes.frame(code)), explore=True)
        learner.observe(fake_codes.transition(code, action), episode=0)
        code, _, ended = fake_codes.step(code, action)
        if ended:
            code = fake_codes.starts()[int(rng.integers(len(fake_codes.starts())))]


@pytest.mark.parametrize("task", ["arrow_puzzle", "pick_place"])
def test_a_complete_table_has_the_exact_values(task: str) -> None:
    """Outcomes of chance are counted in proportion to their probabilities, so the counts are the rules."""
    spec = registry.task(task)
    tables = rules.tabulate(spec.rules)
    index = {state: i for i, state in enumerate(spec.rules.states)}
    table = CountTable(spec.n_actions)
    for state, i in index.items():
        for action in range(0 if spec.rules.is_terminal(state) else spec.n_actions):
            for outcome in spec.rules.outcomes(state, action):
                for _ in range(round(outcome.probability * 360)):
                    table.add(i, action, index[outcome.macrostate], outcome.reward, outcome.terminated)
    exact = rules.optimal_values(tables)
    found = table.action_values(1.0, untried=0.0)
    going_on = [i for state, i in index.items() if not spec.rules.is_terminal(state)]
    np.testing.assert_allclose([found[i].max() for i in going_on], exact.max(axis=0)[going_on], atol=1e-3)


def test_what_chance_decides_is_worth_its_mean() -> None:
    table = CountTable(2)
    assert table.action_values(0.5, untried=9.0) == {}
    assert [table.add(7, 0, 8, 4.0, False), table.add(7, 0, 7, 0.0, True)] == [True, True]
    assert table.add(7, 0, 7, 0.0, True) and table.add(7, 0, 7, 0.0, True)
    values = table.action_values(0.5, untried=8.0)
    assert values[8].tolist() == [8.0, 8.0]
    assert values[7].tolist() == pytest.approx([(4.0 + 0.5 * 8.0) / 4, 8.0])
    assert (table.states, table.pairs, table.largest_reward) == (2, 1, 4.0)


def test_only_news_change_what_is_predicted() -> None:
    table = CountTable(2)
    assert table.add(0, 0, 1, -1.0, False)
    assert not table.add(0, 0, 1, -1.0, False), "a certain transition seen again"
    assert table.largest_reward == 0.0


def test_directed_exploration_ends_in_greedy_actions() -> None:
    learner = agent(directed=True)
    live(learner, 600)
    pairs = learner.table.pairs
    live(learner, 100, seed=2)
    assert learner.table.pairs == pairs == len(fake_codes.starts()) * fake_codes.ACTIONS
    for code in fake_codes.starts():
        seen = Observation(frame=fake_codes.frame(code))
        values = learner.q_values(seen)
        assert values[learner.act(seen, explore=True)] == pytest.approx(values.max())
    assert fake_codes.success(learner) == 1.0


def test_every_transition_is_counted_once_however_often_it_sees_anew() -> None:
    learner = OwnCountTableAgent(fake_codes.ACTIONS, OWN.resolve("fast", {}, "chapter_5"), SeedTree(0))
    lived, sights = 0, set()
    for episode in range(8):
        for transition in played(None, np.random.default_rng(episode)):
            learner.observe(transition, episode=episode)
            lived += 1
            assert learner.table.arrays()["count"].sum() == lived
            sights.add(learner.diagnostics()["perception/looked_at"])
    assert len(sights) > 2
