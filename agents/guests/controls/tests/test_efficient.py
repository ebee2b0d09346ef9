"""Data efficiency: n-step returns by hand, across ends and a ring's seam; resets; snapshots."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from fake_latents import built, live, transition, with_own_settings
from imagine_bench.agents.dqn import td_target
from imagine_bench_controls.efficient import EfficientDQN, EpisodicMemory, make

CPU = torch.device("cpu")
GAMMA = 0.5


def agent(**settings: Any) -> EfficientDQN:
    given = {name.replace("__", "."): value for name, value in settings.items()}
    return built(with_own_settings("dqn_efficient", make), given)


def filled(capacity: int, rows: list[tuple[float, str]]) -> EpisodicMemory:
    """Row i leads from latent i to i + 1 with a reward; ``"end"`` terminates there, ``"cut"`` truncates."""
    memory = EpisodicMemory(capacity, 1, CPU)
    for index, (reward, how) in enumerate(rows):
        z, after = (torch.tensor([float(index + by)]) for by in (0, 1))
        memory.add((z, torch.zeros(1)), 0, reward, (after, torch.zeros(1)), how == "end")
        if how in ("end", "cut"):
            memory.end_episode()
    return memory


def returns(memory: EpisodicMemory, steps: int) -> dict[float, tuple[float, float, float]]:
    """Of each start: the summed reward, the state bootstrapped from, and the share that is bootstrapped."""
    batch = memory.sample_returns(500, torch.Generator().manual_seed(0), steps=steps, discount=GAMMA)
    target = td_target(torch.zeros(500), batch.terminated, torch.ones(500, 1), GAMMA)
    columns = (part.ravel().tolist() for part in (batch.z, batch.reward, batch.next_z, target))
    rows = set(zip(*columns, strict=True))
    found = {z: (reward, then, share) for z, reward, then, share in rows}
    assert len(rows) == len(found), "of one start there is one return"
    return found


def test_returns_by_hand_across_ends() -> None:
    memory = filled(10, [(1.0, ""), (2.0, ""), (4.0, "end"), (8.0, ""), (16.0, "cut"), (32.0, "")])
    assert returns(memory, 3) == {
        0.0: (1.0 + 1.0 + 1.0, 3.0, 0.0),  # 1 + 2/2 + 4/4, and terminated
        1.0: (2.0 + 2.0, 3.0, 0.0),
        2.0: (4.0, 3.0, 0.0),
        3.0: (8.0 + 8.0, 5.0, GAMMA**2),  # truncation ends the sum and bootstraps after two macro-actions
        4.0: (16.0, 5.0, GAMMA),
        5.0: (32.0, 6.0, GAMMA),  # nothing followed yet
    }


def test_a_full_ring_joins_no_new_row_to_an_old_one() -> None:
    """Capacity 3: rows 3 and 4 overwrote 0 and 1, whose end is gone; row 2 goes on to 3, and 4 is the newest."""
    memory = filled(3, [(0.0, "cut"), (0.0, ""), (1.0, ""), (2.0, ""), (4.0, "")])
    assert returns(memory, 5) == {
        2.0: (1.0 + 1.0 + 1.0, 5.0, GAMMA**3),
        3.0: (2.0 + 2.0, 5.0, GAMMA**2),
        4.0: (4.0, 5.0, GAMMA),
    }


def test_a_reset_keeps_a_share_of_hidden_layers_alone() -> None:
    learner = agent(reuse__kept=1.0, controller__target_rate=0.1)
    live(learner, range(3), np.random.default_rng(0))
    before = [part.detach().clone() for part in learner.controller.network.parameters()]
    learner.reset_controller()
    after = list(learner.controller.network.parameters())
    assert [torch.equal(one, other) for one, other in zip(before, after, strict=True)][:-2] == [True] * (len(after) - 2)
    assert not torch.equal(before[-2], after[-2])
    assert not learner.controller.optimiser.state, "moments begin anew"
    slow = learner.controller.target.parameters()
    assert all(torch.equal(one, other) for one, other in zip(slow, after, strict=True))


@pytest.mark.parametrize(("every", "resets"), [(0, 0), (4, 5), (100, 0)])
def test_resets_come_as_often_as_settings_say(every: int, resets: int) -> None:
    learner = agent(reuse__reset_every=every, controller__updates_per_step=2)
    made = []
    learner.reset_controller = lambda: made.append(learner.updates)  # type: ignore[method-assign]
    for step in range(10):
        learner.observe(transition(step % 6, 0, 0.0, (step + 1) % 6), episode=step)
    assert learner.updates == 20 and len(made) == resets


def test_where_an_episode_ends_is_remembered() -> None:
    learner = agent()
    for how in ({}, {"truncated": True}, {"terminated": True}, {}):
        learner.observe(transition(0, 0, 0.0, 1, **how), episode=0)
    assert learner.real.arrays()["last"].tolist() == [False, True, True, False]
