"""The two memories: what goes in comes out, in pairs, and each by itself."""

from __future__ import annotations

import pytest
import torch
from imagine_bench.agents.replay import Batch, ImaginedMemory, RealMemory

from imagine_bench.errors import InvalidValueError

CPU = torch.device("cpu")


def fill(memory: RealMemory, count: int, sigma: float = 0.0) -> None:
    """Row i leads from latent i to latent i + 0.5, so every pair is recognisable."""
    for i in range(count):
        now, then = torch.full((2,), float(i)), torch.full((2,), i + 0.5)
        spread = torch.full((2,), sigma)
        memory.add((now, spread), i % 3, float(i), (then, spread), terminated=i % 2 == 0)


def test_no_batch_pairs_states_of_different_transitions() -> None:
    memory = RealMemory(8, 2, CPU)
    fill(memory, 20)  # overwritten twice: rows 12 to 19 remain
    batch = memory.sample(500, torch.Generator().manual_seed(0))
    assert torch.equal(batch.next_z, batch.z + 0.5)
    assert torch.equal(batch.reward, batch.z[:, 0])
    assert torch.equal(batch.action, batch.z[:, 0].long() % 3)
    assert torch.equal(batch.terminated, (batch.z[:, 0] % 2 == 0).float())
    assert set(batch.z[:, 0].tolist()) == set(map(float, range(12, 20)))


def test_latents_are_drawn_anew_from_their_posteriors() -> None:
    memory, generator = RealMemory(4, 2, CPU), torch.Generator().manual_seed(0)
    fill(memory, 1, sigma=0.3)
    batch = memory.sample(20_000, generator)
    for drawn, center in ((batch.z, 0.0), (batch.next_z, 0.5)):
        torch.testing.assert_close(drawn.mean(0), torch.full((2,), center), atol=0.01, rtol=0.0)
        torch.testing.assert_close(drawn.std(0), torch.full((2,), 0.3), atol=0.01, rtol=0.0)
    both = torch.corrcoef(torch.cat([batch.z, batch.next_z], dim=1).T)
    assert (both - torch.eye(4)).abs().max() < 0.03, "noise must be independent"


def test_the_imagined_memory_keeps_only_recent_imagination() -> None:
    memory = ImaginedMemory(5, 2, CPU)
    for start in range(0, 12, 4):
        z = torch.arange(start, start + 4, dtype=torch.float32)[:, None].expand(4, 2)
        memory.add(Batch(z, torch.zeros(4, dtype=torch.int64), z[:, 0], z + 0.5, torch.zeros(4)))
    assert (len(memory), memory.added) == (5, 12)
    batch = memory.sample(300, torch.Generator().manual_seed(0))
    assert set(batch.reward.tolist()) == {7.0, 8.0, 9.0, 10.0, 11.0}
    assert torch.equal(batch.next_z, batch.z + 0.5)


def test_more_rows_than_fit_leave_the_last_ones_in_pairs() -> None:
    memory = ImaginedMemory(3, 2, CPU)
    z = torch.arange(8, dtype=torch.float32)[:, None].expand(8, 2)
    memory.add(Batch(z, torch.zeros(8, dtype=torch.int64), z[:, 0], z + 0.5, torch.zeros(8)))
    assert (len(memory), memory.added) == (3, 8)
    batch = memory.sample(100, torch.Generator().manual_seed(0))
    assert set(batch.reward.tolist()) == {5.0, 6.0, 7.0}
    assert torch.equal(batch.next_z, batch.z + 0.5)


@pytest.mark.parametrize("count", [3, 20])
def test_a_memory_is_restored_exactly_and_independently(count: int) -> None:
    memory, other = RealMemory(8, 2, CPU), RealMemory(8, 2, CPU)
    fill(memory, count, sigma=0.1)
    arrays = memory.arrays()
    assert len(arrays["mu"]) == min(count, 8), "only filled rows are stored"
    other.load(arrays, memory.added)
    fill(memory, 1)
    fill(other, 1)
    first, second = (each.sample(50, torch.Generator().manual_seed(1)) for each in (memory, other))
    assert torch.equal(first.z, second.z)
    assert torch.equal(first.reward, second.reward)


def test_a_stored_memory_does_not_follow_later_writes() -> None:
    memory = RealMemory(8, 2, CPU)
    fill(memory, 8)
    arrays = memory.arrays()
    fill(memory, 8, sigma=0.5)
    assert (memory.arrays()["sigma"] == 0.5).all()
    assert (arrays["sigma"] == 0.0).all()


def test_sampling_an_empty_memory_is_an_error() -> None:
    with pytest.raises(InvalidValueError, match="The memory is empty; store a transition before"):
        RealMemory(4, 2, CPU).sample(1, torch.Generator())


def test_latents_spread_as_widely_as_asked() -> None:
    memory = RealMemory(1, 2, CPU)
    sigma = torch.tensor([0.1, 0.2])
    memory.add((torch.tensor([3.0, -1.0]), sigma), 0, 0.0, (torch.zeros(2), sigma), False)
    drawn = memory.sample(4000, torch.Generator().manual_seed(0), spread=5.0)
    for values, centre in ((drawn.z, torch.tensor([3.0, -1.0])), (drawn.next_z, torch.zeros(2))):
        torch.testing.assert_close(values.mean(dim=0), centre, rtol=0.0, atol=0.06)
        torch.testing.assert_close(values.std(dim=0), 5.0 * sigma, rtol=0.06, atol=0.0)


@pytest.mark.parametrize(("balance", "expected"), [(0.0, 0.8), (0.5, 2.0 / 3.0), (1.0, 0.5)])
def test_rare_outcomes_are_drawn_as_often_as_the_balance_says(balance: float, expected: float) -> None:
    memory, nothing = RealMemory(32, 2, CPU), (torch.zeros(2), torch.zeros(2))
    for row in range(20):  # 16 of one outcome, 4 of another: n ** (1 - balance) gives 16 : 4, 4 : 2 and 1 : 1
        memory.add(nothing, 0, -1.0, nothing, terminated=row % 5 == 0)
    drawn = memory.sample(20_000, torch.Generator().manual_seed(0), balance=balance)
    assert float((drawn.terminated == 0.0).float().mean()) == pytest.approx(expected, abs=0.01)


def test_one_reward_with_and_without_an_end_is_two_outcomes() -> None:
    memory, nothing = RealMemory(8, 2, CPU), (torch.zeros(2), torch.zeros(2))
    for reward, terminated in ((1.0, True), (1.0, False), (2.0, False), (2.0, False)):
        memory.add(nothing, 0, reward, nothing, terminated)
    drawn = memory.sample(30_000, torch.Generator().manual_seed(0), balance=1.0)
    for reward, terminated in ((1.0, 1.0), (1.0, 0.0), (2.0, 0.0)):
        share = ((drawn.reward == reward) & (drawn.terminated == terminated)).float().mean()
        assert float(share) == pytest.approx(1.0 / 3.0, abs=0.01)


def test_prioritised_draws_are_in_proportion_to_errors() -> None:
    memory, generator = RealMemory(4, 2, CPU, prioritised=True), torch.Generator().manual_seed(0)
    fill(memory, 4)
    errors = torch.tensor([1.0, -4.0, 9.0, 0.0])
    memory.prioritise(torch.arange(4), errors)
    batch = memory.sample_prioritised(40_000, generator, exponent=0.5, correction=1.0)
    shares = torch.bincount(batch.rows, minlength=4) / 40_000
    torch.testing.assert_close(shares, torch.tensor([1.0, 2.0, 3.0, 0.001]) / 6.001, atol=0.01, rtol=0.0)
    assert torch.equal(batch.z[:, 0].long(), batch.rows) and float(batch.weight.max()) == 1.0
    seen = batch.rows < 3  # corrected in full, each of them counts alike in the mean
    counted = [float(batch.weight[batch.rows == row].sum()) for row in range(3)]
    assert max(counted) < 1.05 * min(counted) and seen.sum() > 39_900


def test_what_was_never_replayed_is_drawn_first() -> None:
    memory, generator = RealMemory(4, 2, CPU, prioritised=True), torch.Generator().manual_seed(0)
    fill(memory, 3)
    memory.prioritise(torch.arange(3), torch.tensor([0.0, 100.0, 0.0]))
    fill(memory, 1)
    rows = memory.sample_prioritised(2_000, generator, exponent=1.0, correction=0.0).rows
    assert set(rows.tolist()) == {1, 3}
    kept, other = memory.arrays(), RealMemory(4, 2, CPU, prioritised=True)
    other.load(kept, memory.added)
    again = [
        m.sample_prioritised(9, torch.Generator().manual_seed(1), exponent=1.0, correction=0.0) for m in (memory, other)
    ]
    assert torch.equal(again[0].rows, again[1].rows)
