"""Several rollouts sampled from one start: who gets them, what reality they stand beside, and how they are drawn."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from fake_agents import FakeImaginer
from numpy.typing import NDArray

from imagine_bench import registry
from imagine_bench.interfaces import Frame, TaskSpec
from imagine_bench.interfaces.capabilities import ImaginedRollout
from imagine_bench.judge import filmstrips
from imagine_bench.judge.imagination_quality import (
    SAMPLED_ROLLOUTS,
    compare_rollout,
    examples,
    imagine_sampled_rollouts,
)
from imagine_bench.rules import is_random
from imagine_bench.seeding import SeedTree
from imagine_bench.store.results import ComparedRollout

START = np.array([0, 0, 0, 0])
"""The human points at the left object."""
ASKS_MIDDLE, ASKS_RIGHT, IMPOSSIBLE = (1, 0, 0, 1), (1, 0, 0, 2), (1, 1, 0, 2)


@pytest.fixture(scope="module")
def spec() -> TaskSpec:
    return registry.task("pick_place")


class Dreamer(FakeImaginer):
    """Imagines a given sequence of macro-actions and macrostates."""

    def __init__(self, *steps: tuple[int, tuple[int, ...]]) -> None:
        super().__init__()
        self.steps = steps

    def imagine(
        self, frame: Frame, *, actions: NDArray[np.int64] | None, depth: int, rng: np.random.Generator
    ) -> ImaginedRollout:
        chosen = np.array([action for action, _ in self.steps])
        rollout = super().imagine(frame, actions=chosen, depth=depth, rng=rng)
        return dataclasses.replace(rollout, macrostates=np.array([state for _, state in self.steps]))


def compared(spec: TaskSpec, seed: int, *steps: tuple[int, tuple[int, ...]]) -> ComparedRollout:
    frame = np.zeros((64, 64, 3), dtype=np.uint8)
    rng = np.random.default_rng(seed)
    rollout = Dreamer(*steps).imagine(frame, actions=None, depth=9, rng=rng)
    return compare_rollout(spec, frame=frame, macrostate=START, rollout=rollout, appearance="clean", rng=rng)


def test_reality_goes_as_was_imagined_where_it_may(spec: TaskSpec) -> None:
    """Three wishes are possible: by luck, twenty draws would not all be the imagined one (3e-10)."""
    for seed in range(10):
        for wish in (ASKS_MIDDLE, ASKS_RIGHT):
            assert tuple(compared(spec, seed, (0, wish)).real_macrostates[0]) == wish


def test_where_the_imagined_is_impossible_reality_is_drawn(spec: TaskSpec) -> None:
    reached = {tuple(compared(spec, seed, (0, IMPOSSIBLE)).real_macrostates[0]) for seed in range(30)}
    assert reached == {outcome.macrostate for outcome in spec.rules.outcomes(tuple(START), 0)}


def test_only_a_task_with_chance_has_sampled_rollouts(spec: TaskSpec) -> None:
    puzzle = registry.task("arrow_puzzle")
    assert is_random(spec.rules)
    assert not is_random(puzzle.rules)
    assert imagine_sampled_rollouts(FakeImaginer(), puzzle, appearance="clean", seeds=SeedTree(0)) == ()
    sampled_rollouts = imagine_sampled_rollouts(Dreamer((0, ASKS_RIGHT)), spec, appearance="clean", seeds=SeedTree(0))
    assert len(sampled_rollouts) == SAMPLED_ROLLOUTS
    for one in sampled_rollouts:
        assert np.array_equal(one.start_frame, sampled_rollouts[0].start_frame)
        assert np.array_equal(one.start_macrostate, sampled_rollouts[0].start_macrostate)


def test_a_task_with_few_starts_has_examples_too(spec: TaskSpec) -> None:
    assert len(spec.rules.start_states) < 5
    found = examples(Dreamer((0, ASKS_RIGHT)), spec, appearance="clean", seeds=SeedTree(0))
    assert len({tuple(each.start_macrostate) for each in found}) > 1


def test_changes_are_named_and_judged_by_the_rules(spec: TaskSpec) -> None:
    wish = np.array(ASKS_RIGHT)
    assert filmstrips.changes(START, wish, spec) == "left object picked, gesture right"
    assert filmstrips.changes(wish, wish, spec) == "nothing changes"
    assert filmstrips.is_possible(spec.rules, START, 0, wish)
    assert not filmstrips.is_possible(spec.rules, START, 0, np.array(IMPOSSIBLE))
    assert not filmstrips.is_possible(spec.rules, START, 1, wish), "another macro-action leads elsewhere"
    assert not filmstrips.is_possible(spec.rules, np.array(IMPOSSIBLE), 0, wish), "nothing follows the impossible"


def test_impossible_steps_are_marked_and_the_longest_fits(spec: TaskSpec) -> None:
    right, wrong = compared(spec, 0, (0, ASKS_RIGHT)), compared(spec, 0, (0, IMPOSSIBLE), (0, ASKS_RIGHT))
    short, long = (filmstrips.sampled_filmstrips(rows, spec) for rows in ((right, right), (right, wrong)))
    assert short.dtype == np.uint8
    assert long.shape[0] > short.shape[0], "more values change, and all are written out"
    assert long.shape[1] > short.shape[1]

    def inked(sheet: NDArray[np.uint8], color: tuple[int, int, int]) -> bool:
        return bool((sheet == color).all(axis=2).any())

    assert inked(short, filmstrips.RIGHT)
    assert inked(long, filmstrips.WRONG)
    assert not inked(short, filmstrips.WRONG)
