"""The two memories: stored rows come out again, in pairs, and each by itself."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fake_latents import built, live, make_dqn
from imagine_bench.agents.replay import Batch, ImaginedMemory, RealMemory

from imagine_bench.errors import InvalidValueError

CPU = torch.device("cpu")
NOTHING = (torch.zeros(2), torch.zeros(2))


def draws(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def filled(capacity: int, count: int, **how: bool) -> RealMemory:
    return fill(RealMemory(capacity, 2, CPU, **how), count)


def fill(memory: RealMemory, count: int, sigma: float = 0.0) -> RealMemory:
    """Row i leads from latent i to latent i + 0.5, so every pair is recognisable."""
    spread = torch.full((2,), sigma)
    for i in range(count):
        now = torch.full((2,), float(i))
        memory.add((now, spread), i % 3, float(i), (now + 0.5, spread), terminated=i % 2 == 0)
    return memory


def test_no_batch_pairs_states_of_different_transitions() -> None:
    batch = filled(8, 20).sample(500, draws())  # overwritten twice: rows 12 to 19 remain
    assert torch.equal(batch.next_z, batch.z + 0.5)
    assert torch.equal(batch.reward, batch.z[:, 0])
    assert torch.equal(batch.action, batch.z[:, 0].long() % 3)
    assert torch.equal(batch.terminated, (batch.z[:, 0] % 2 == 0).float())
    assert set(batch.z[:, 0].tolist()) == set(range(12, 20))


@pytest.mark.parametrize("spread", [1.0, 5.0])
def test_latents_are_drawn_anew_as_widely_as_set(spread: float) -> None:
    sigma = torch.tensor([0.1, 0.3])
    memory = RealMemory(1, 2, CPU)
    memory.add((torch.tensor([3.0, -1.0]), sigma), 0, 0.0, (NOTHING[0], sigma), terminated=False)
    batch = memory.sample(20_000, draws(), spread=spread)
    for drawn, centre in ((batch.z, torch.tensor([3.0, -1.0])), (batch.next_z, torch.zeros(2))):
        torch.testing.assert_close(drawn.mean(0), centre, atol=0.03 * spread, rtol=0.0)
        torch.testing.assert_close(drawn.std(0), spread * sigma, atol=0.0, rtol=0.03)
    both = torch.corrcoef(torch.cat([batch.z, batch.next_z], dim=1).T)
    assert (both - torch.eye(4)).abs().max() < 0.03, "noise must be independent"


def test_prioritised_draws_are_in_proportion_to_errors() -> None:
    memory = filled(4, 4, prioritised=True)
    memory.prioritise(torch.arange(4), torch.tensor([1.0, -4.0, 9.0, 0.0]))
    batch = memory.sample_prioritised(40_000, draws(), exponent=0.5, correction=1.0)
    shares = torch.bincount(batch.rows, minlength=4) / 40_000
    torch.testing.assert_close(shares, torch.tensor([1.0, 2.0, 3.0, 0.001]) / 6.001, atol=0.01, rtol=0.0)
    assert torch.equal(batch.z[:, 0].long(), batch.rows)
    assert float(batch.weight.max()) == 1.0
    counted = [float(batch.weight[batch.rows == row].sum()) for row in range(3)]
    assert max(counted) < 1.05 * min(counted), "corrected in full, each of them counts alike in the mean"


def test_a_new_transition_is_drawn_first_and_priorities_come_back() -> None:
    memory, other = filled(4, 3, prioritised=True), RealMemory(4, 2, CPU, prioritised=True)
    memory.prioritise(torch.arange(3), torch.tensor([0.0, 100.0, 0.0]))
    fill(memory, 1)
    other.load(memory.arrays(), memory.added)
    for each in (memory, other):
        rows = each.sample_prioritised(2_000, draws(), exponent=1.0, correction=0.0).rows
        assert set(rows.tolist()) == {1, 3}


def test_a_learner_replays_by_the_errors_that_it_had_last() -> None:
    agent = built(make_dqn, {"memory.priority": 0.3, "memory.priority_correction": 0.8})
    live(agent, range(6), np.random.default_rng(0))
    generator = torch.Generator()
    generator.set_state(torch.from_numpy(agent.state().arrays["generator/replay"]))
    batch = agent.real.sample_prioritised(8, generator, exponent=0.3, correction=0.8)
    agent.learn_values(agent.real, 1)
    errors = agent.controller.errors(batch).abs()
    kept = torch.from_numpy(agent.real.arrays()["error"])
    assert all(kept[row] in errors[batch.rows == row] for row in batch.rows)


@pytest.mark.parametrize("at_once", [4, 8])
def test_the_imagined_memory_keeps_the_last_rows_in_pairs(at_once: int) -> None:
    memory = ImaginedMemory(5, 2, CPU)
    for z in torch.arange(12.0)[:, None].expand(-1, 2).split(at_once):
        memory.add(Batch(z, torch.zeros(len(z), dtype=torch.int64), z[:, 0], z + 0.5, torch.zeros(len(z))))
        batch = memory.sample(300, draws())
        assert set(batch.reward.tolist()) == {*range(memory.added)[-5:]}
        assert torch.equal(batch.next_z, batch.z + 0.5)
        assert torch.equal(batch.reward, batch.z[:, 0])
    assert (len(memory), memory.added) == (5, 12)


@pytest.mark.parametrize("count", [3, 20])
def test_a_memory_is_restored_exactly_and_independently(count: int) -> None:
    memory, other = filled(8, count), RealMemory(8, 2, CPU)
    with pytest.raises(InvalidValueError, match="The memory is empty; store a transition before"):
        other.sample(1, draws())
    arrays = memory.arrays()
    assert len(arrays["mu"]) == min(count, 8), "only filled rows are stored"
    other.load(arrays, memory.added)
    first, second = (fill(each, 1).sample(50, draws(1)) for each in (memory, other))
    assert torch.equal(first.z, second.z)
    assert torch.equal(first.reward, second.reward)
    fill(memory, 8, sigma=0.5)
    assert not arrays["sigma"].any(), "stored rows do not follow later writes"


@pytest.mark.parametrize("balance", [0.5, 1.0])
def test_rare_outcomes_are_drawn_as_often_as_the_balance_says(balance: float) -> None:
    """An outcome that n transitions had, in proportion to n ** (1 - balance); another reward or end is another one."""
    memory = RealMemory(32, 2, CPU)
    counts = {(-1.0, False): 16, (-1.0, True): 4, (2.0, False): 4}
    for (reward, terminated), count in counts.items():
        for _ in range(count):
            memory.add(NOTHING, 0, reward, NOTHING, terminated)
    drawn = memory.sample(20_000, draws(), balance=balance)
    total = sum(count ** (1.0 - balance) for count in counts.values())
    for (reward, terminated), count in counts.items():
        share = ((drawn.reward == reward) & (drawn.terminated == float(terminated))).double().mean().item()
        assert share == pytest.approx(count ** (1.0 - balance) / total, abs=0.015)
