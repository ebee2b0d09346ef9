"""Swapped parts: every swap is a transition that the world has, unknown outcomes stay real, snapshots."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import fake_codes
import numpy as np
import pytest
import torch
from fake_codes import SIZES
from imagine_bench.agents.encoders.perception import Perception
from imagine_bench.agents.replay import Batch
from imagine_bench_controls import swaps
from imagine_bench_controls.settings import SWAPPING
from imagine_bench_controls.swaps import SwappingDQN

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import AgentContext, Observation
from imagine_bench.seeding import SeedTree

CPU = torch.device("cpu")


class FakeCodes(fake_codes.FakeCodes):
    latent_size = sum(SIZES)


def agent(**overrides: Any) -> SwappingDQN:
    few = {"controller.hidden": (16,), "controller.batch_size": 32, **overrides}
    settings = SWAPPING.resolve("fast", few, "chapter_5")
    return SwappingDQN(Perception(FakeCodes()), fake_codes.ACTIONS, settings, SeedTree(0), CPU)  # type: ignore[arg-type]


def live(learner: SwappingDQN, episodes: int) -> set[tuple[tuple[int, ...], int]]:
    """Train on the tiny world of wheels by chance; the pairs that were tried."""
    rng = np.random.default_rng(1)
    rows = [row for _ in range(episodes) for row in fake_codes.drawn(rng)]
    for row in rows:
        learner.observe(fake_codes.transition(row.code, row.action), episode=0)
    return {(row.code, row.action) for row in rows}


def read(latents: torch.Tensor) -> list[tuple[int, ...]]:
    return [tuple(row) for row in FakeCodes().read_macrostate(latents).tolist()]


@pytest.mark.parametrize("share", [1.0, 0.25])
def test_every_swap_is_as_the_world_has_it_and_some_are_new(share: float) -> None:
    """The wheels turn alike whatever else there is, and outcomes are decided by the next code."""
    learner = agent(**{"swaps.share": share})
    tried = live(learner, 15)
    new, rows = set(), set()
    for _ in range(20):
        batch = learner.draw_batch(learner.real)
        columns = (batch.action.tolist(), read(batch.next_z), batch.reward.tolist(), batch.terminated.tolist())
        for row, (before, action, after, reward, ended) in enumerate(zip(read(batch.z), *columns, strict=True)):
            assert (after, reward, bool(ended)) == fake_codes.step(before, action)
            if (before, action) not in tried:
                new.add((before, action))
                rows.add(row)
    assert new, "some pairs were never tried"
    assert 0.8 * 32 * share < max(rows) < 32 * share, "the others of a batch stay real"
    assert 0.0 < learner.diagnostics()["swaps/known"] <= 1.0


def hot(*codes: tuple[int, ...]) -> torch.Tensor:
    return FakeCodes().encode(np.stack([fake_codes.frame(code) for code in codes]))[0]


def test_a_swap_by_hand() -> None:
    """Action 0 turns the first wheel: the other factors come from elsewhere, where the outcome was seen once only."""
    learner = agent()
    learner.touched[0] = torch.tensor([True, False, False])
    learner.outcomes = {(1, 0, 1): (10.0, 1.0), (1, 1, 0): swaps.UNSURE}
    before = hot(*[(0, 2, 0)] * 4)
    after = hot(*[(1, 2, 0)] * 4)
    batch = Batch(before, torch.zeros(4, dtype=torch.int64), torch.full((4,), -1.0), after, torch.zeros(4))
    found = learner.swapped(batch, hot((2, 0, 1), (2, 1, 0), (0, 0, 0)))
    assert read(found.z) == [(0, 0, 1), *[(0, 2, 0)] * 3]
    assert read(found.next_z) == [(1, 0, 1), *[(1, 2, 0)] * 3]
    assert (found.reward.tolist(), found.terminated.tolist()) == ([10.0, -1.0, -1.0, -1.0], [1.0, 0.0, 0.0, 0.0])
    assert torch.equal(batch.z, before), "the real batch is as it was"


def test_a_factor_that_an_action_ever_changed_is_touched_for_good() -> None:
    learner = agent()
    for code in ((0, 1, 0), (1, 2, 1)):
        for then in ((0, 2, 0), code):  # the second factor, and nothing
            moved = fake_codes.transition(code, 1)
            learner.observe(replace(moved, next_observation=Observation(frame=fake_codes.frame(then))), episode=0)
    assert learner.touched.tolist() == [[False] * 3, [True] * 3, [False] * 3, [False] * 3]


def test_an_outcome_that_differs_is_unknown_for_good() -> None:
    learner = agent()
    moved = fake_codes.transition((0, 1, 0), 0)
    code = fake_codes.step((0, 1, 0), 0)[0]
    learner.observe(moved, episode=0)
    assert learner.outcomes[code] == (moved.reward, float(moved.terminated))
    for reward in (moved.reward + 1.0, moved.reward):
        learner.observe(replace(moved, reward=reward), episode=0)
        assert learner.outcomes[code] == swaps.UNSURE


def test_latents_have_no_parts_to_swap(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = SimpleNamespace(encoder=SimpleNamespace(card=SimpleNamespace(code_sizes=())))
    monkeypatch.setattr(swaps, "load_perception", lambda context: plain)
    asked = AgentContext(n_actions=4, preprocessing="gray_strips", encoder=None, seeds=SeedTree(0))
    with pytest.raises(InvalidValueError, match="swaps factors of codes"):
        swaps.make(asked)


def test_priorities_do_not_change_swaps() -> None:
    """A swapped transition's error is not that of the real one whose place it has; so no bench takes them."""
    states = []
    for own in ({}, {"memory.priority": 1.0, "memory.priority_correction": 0.9}):
        learner = agent(**own)
        live(learner, 5)
        states.append({name: array.tobytes() for name, array in learner.state().arrays.items()})
    assert states[0] == states[1]
    assert "memory.priority" in registry.inert_settings("dqn_swaps")
