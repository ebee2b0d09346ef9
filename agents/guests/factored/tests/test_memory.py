"""The memory of ``factored`` within an episode: chosen by evidence alone, and worth as much as it should be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from unittest import mock

import fake_codes
import numpy as np
import pytest
from fake_pictures import HIDDEN, agent, hidden, played
from imagine_bench_factored import learned as own
from imagine_bench_factored.factors import CodeTransition, Memory, contradictions, remembering
from imagine_bench_factored.learned import LearnedPerceptionAgent
from imagine_bench_factored.model import FactoredModel, choose
from imagine_bench_factored.settings import LEARNED
from numpy.typing import NDArray

from imagine_bench.interfaces import AgentState, Frame

SIZES, ACTIONS = (3, 3, 3), fake_codes.ACTIONS


def lived(episodes: int, rng: np.random.Generator, *, covered: bool) -> tuple[list[CodeTransition], list[bool]]:
    """Random episodes of the world of two wheels and a lamp, which decides where the goal is."""
    rows, begins = [], []
    for _ in range(episodes):
        for step, row in enumerate(fake_codes.drawn(rng)):
            seen = (hidden(row.code) if step else row.code, hidden(row.following))
            rows.append(row._replace(code=seen[0], following=seen[1]) if covered else row)
            begins.append(step == 0)
    return rows, begins


def test_the_last_informative_value_is_remembered() -> None:
    shown_values = [[2, 0, 2, 1, 2], [2, 2, 1], [0, 2]]
    rows, begins = [], []
    for episode in shown_values:
        for index, (before, after) in enumerate(pairwise(episode)):
            rows.append(CodeTransition((7, before), 0, (7, after), 0.0, terminated=False))
            begins.append(index == 0)
    found = remembering(rows, begins, Memory(factor=1, hidden=2))
    remembered = [(2, 0), (0, 0), (0, 1), (1, 1), (2, 2), (2, 1), (0, 0)]
    assert [(row.code[2], row.following[2]) for row in found] == remembered
    assert [row.code[:2] for row in found] == [row.code for row in rows], "a seen value stays as it is"
    assert remembering(rows, begins, None) == rows


def flickering(episodes: int, rng: np.random.Generator) -> tuple[list[CodeTransition], list[bool]]:
    """A wheel that action 0 turns, and a lamp of one color an episode, which every second frame hides, by chance."""
    rows, begins = [], []
    for _ in range(episodes):
        color, wheels = int(rng.integers(2)), [0]
        actions = rng.integers(2, size=4).tolist()
        for action in actions:
            wheels.append(wheels[-1] ^ (action == 0))
        codes = [(wheel, color if rng.random() < 0.5 else HIDDEN) for wheel in wheels]
        rows += [CodeTransition(*row, 0.0, terminated=False) for row in zip(codes, actions, codes[1:], strict=False)]
        begins += [True, False, False, False]
    return rows, begins


def test_what_is_remembered_follows_from_what_is_seen() -> None:
    """A model of both apart would have a color shown and another one remembered."""
    memory, rng = Memory(1, HIDDEN), np.random.default_rng(0)
    rows, settings = remembering(*flickering(400, rng), memory), LEARNED.resolve("fast", {}, "chapter_5")
    code = (0, HIDDEN, HIDDEN)
    found = {}
    for known in (memory, None):
        model = FactoredModel((2, 3, 3), 2, settings, known)
        for row in rows:
            model.add(row)
        model.outcomes.fit()
        moves = model.moves(np.array([code]))
        pairs = zip(moves.following[0, 0].tolist(), moves.chance[0, 0].tolist(), strict=True)
        found[known] = {tuple(after): chance for after, chance in pairs if chance > 0.0}
        drawn = {model.sample(code, 0, rng)[0] for _ in range(200)}
        assert (drawn == set(found[known])) == (known is not None)
        (probability,), (unknown,) = model.probabilities([CodeTransition(code, 0, (1, 0, 0), 0.0, terminated=False)])
        assert probability == pytest.approx(0.25 if known else 0.0625, abs=0.05) and unknown < 0.05
    wanted = {(1, HIDDEN, HIDDEN): 0.5, (1, 0, 0): 0.25, (1, 1, 1): 0.25}
    assert found[memory] == pytest.approx(wanted, abs=0.08)
    assert found[None][1, 0, 1] > 0.03, "apart, they would contradict each other"


@pytest.mark.parametrize(
    ("covered", "by_chance", "evidence", "wanted"),
    [
        (True, False, 10.0, Memory(factor=2, hidden=HIDDEN)),
        (True, False, 1e6, None),  # a sceptic
        (False, False, 10.0, None),
        (False, True, 10.0, None),  # rewards by chance contradict one another, and no memory explains them better
    ],
)
def test_what_was_covered_is_remembered_and_nothing_else(
    covered: bool, by_chance: bool, evidence: float, wanted: Memory | None
) -> None:
    rng = np.random.default_rng(0)
    rows, begins = lived(150, rng, covered=covered)
    if by_chance:
        rows = [row if row.terminated else row._replace(reward=float(rng.integers(2))) for row in rows]
    settings = LEARNED.resolve("fast", {"memory_evidence": evidence}, "chapter_5")
    assert bool(contradictions(rows)) == (covered or by_chance)
    assert choose(rows, begins, SIZES, ACTIONS, settings) == wanted


def watched(learner: LearnedPerceptionAgent, episodes: range, *, covered: bool = False, worth: float = 1.0) -> None:
    """Let it learn from episodes of drawn macro-actions, whose rewards are multiplied by their worth.

    After each episode it has learned from the codes that it acted on.
    """
    for episode in episodes:
        for transition in played(None, np.random.default_rng(episode), covered=covered):
            learner.observe(replace(transition, reward=worth * transition.reward), episode=episode)
        if memory := learner.perception.memory:
            found = [row._replace(code=row.code[:-1], following=row.following[:-1]) for row in learner.replay]
            assert learner.replay == remembering(found, learner.perception.begins, memory)


@pytest.fixture(scope="module")
def rememberer() -> LearnedPerceptionAgent:
    learner = agent(seed=0)
    watched(learner, range(42), covered=True)
    return learner


def test_from_images_it_learns_to_remember_hidden_values(
    rememberer: LearnedPerceptionAgent,
) -> None:
    assert rememberer.perception.memory is not None
    assert rememberer.model.memory == rememberer.perception.memory
    ends = [
        list(played(rememberer, np.random.default_rng(100 + each), covered=True, steps=3))[-1] for each in range(30)
    ]
    assert np.mean([end.reward > 0.0 for end in ends]) >= 0.9


@pytest.fixture(scope="module")
def seeing() -> AgentState:
    """The snapshot of an agent that sees everything well, after episodes in which nothing was covered."""
    learner = agent(perception__growth_if_known=1.25)
    watched(learner, range(30))
    assert learner.perception.sizes == (3, 3, 2)
    return learner.state()


Factors = list[own.appearance.SeenFactor]


def without_lamp(factors: Factors) -> Factors:
    return [factor for factor in factors if len(factor.joint) == 3]


def with_a_blurred_wheel(factors: Factors) -> Factors:
    """The first two values of a wheel are one."""
    place = next(place for place, factor in enumerate(factors) if len(factor.joint) == 3)
    (part,) = factors[place].parts
    blurred = own.appearance.SeenFactor((part._replace(values=np.maximum(part.values - 1, 0)),), np.arange(2)[:, None])
    return [*factors[:place], blurred, *factors[place + 1 :]]


@pytest.mark.parametrize(("worse", "worth"), [(without_lamp, 1.0), (with_a_blurred_wheel, 0.0)])
def test_factors_are_kept_where_new_ones_are_worse(
    seeing: AgentState, worse: Callable[[Factors], Factors], worth: float
) -> None:
    """Once it sees well, a look that loses the lamp is not believed, because of outcomes that contradict it.

    Nor is one that merges two values of a wheel, because of what follows them, even if no outcome contradicts it.
    """
    learner, resumed = (agent(seed=seed, perception__growth_if_known=1.25) for seed in (0, 5))
    learner.restore(seeing)
    if not worth:
        learner.reset_for_new_task()  # which has no rewards
    find = own.appearance.find

    def look(frames: Frame, begins: NDArray[np.bool_], actions: NDArray[np.int64]) -> Factors:
        return worse(find(frames, begins, actions))

    with mock.patch.object(own.appearance, "find", side_effect=look) as found:
        watched(learner, range(30, 41), worth=worth)
    assert found.called, "it looked again"
    assert learner.perception.sizes == (3, 3, 2)
    resumed.restore(learner.state())
    assert resumed.perception.sizes == learner.perception.sizes
    assert resumed.perception.found_in < resumed.perception.looked_at


def test_another_task_is_no_reason_to_remember(seeing: AgentState) -> None:
    """Its goals are elsewhere, so the same code and action bring other outcomes; memories do not see that."""
    learner = agent(perception__growth_if_known=1.25)
    learner.restore(seeing)
    learner.reset_for_new_task()
    with mock.patch.object(own, "choose", return_value=None) as chosen:
        watched(learner, range(30, 41), worth=-1.0)
    assert contradictions(learner.replay) > 0
    assert chosen.called and not any(contradictions(call.args[0]) for call in chosen.call_args_list)
