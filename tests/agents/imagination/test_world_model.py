"""The world model: losses, weight samples, and a chain it must learn."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from imagine_bench.agents.imagination import mixture as mdn
from imagine_bench.agents.imagination.settings import WorldModelSettings
from imagine_bench.agents.imagination.world_model import EnvironmentModel, log_cosh
from imagine_bench.agents.replay import Batch
from plain_torch import PlainWorldModel
from torch.nn import functional

from imagine_bench.errors import DivergedError

Z, A, N_STATES = 3, 2, 5
CODES = torch.from_numpy(np.random.default_rng(2).normal(size=(N_STATES, Z)).astype(np.float32))
SETTINGS = WorldModelSettings(
    dynamics_hidden=(32, 32), components=2, reward_hidden=(32,), termination_hidden=(32,), dropout=0.5
)


def draws(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def make(**changes: object) -> EnvironmentModel:
    if changes.get("shared_hidden"):
        changes |= {"reward_hidden": (), "termination_hidden": ()}
    return EnvironmentModel(Z, A, dataclasses.replace(SETTINGS, **changes), draws(0))


def chain_batch(count: int, generator: torch.Generator) -> Batch:
    """Action 1 steps up a chain of 5 states, action 0 down; the top earns 2 and ends."""
    state = torch.randint(N_STATES - 1, (count,), generator=generator)
    action = torch.randint(A, (count,), generator=generator)
    following = (state + 2 * action - 1).clamp(0, N_STATES - 1)
    top = (following == N_STATES - 1).float()
    return Batch(CODES[state], action, 2.0 * top, CODES[following], top)


def test_log_cosh_is_itself_and_does_not_overflow() -> None:
    x = torch.linspace(-5.0, 5.0, 101, dtype=torch.float64)
    torch.testing.assert_close(log_cosh(x), x.cosh().log())
    assert log_cosh(torch.tensor(1e4)).item() == pytest.approx(1e4 - math.log(2.0))


def test_losses_compare_what_is_predicted() -> None:
    model, batch = make(dropout=0.0, reward_scale=10.0, precision="float32"), chain_batch(16, draws(1))
    mixture = model.predict(batch.z, batch.action, None).map(lambda part: part[0])
    reward, p_terminated = model.predict_outcome(batch.z, batch.action, batch.next_z)
    found = model.losses(batch, draws(2))
    torch.testing.assert_close(found[0], -mdn.log_likelihood(mixture, batch.next_z).mean(), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(found[1], log_cosh((reward - batch.reward) / 10.0).mean(), rtol=1e-4, atol=1e-5)
    crossed = functional.binary_cross_entropy(p_terminated, batch.terminated)
    torch.testing.assert_close(found[2], crossed, rtol=1e-4, atol=1e-5)


def test_a_predicted_change_is_added_to_where_it_began() -> None:
    batch = chain_batch(8, draws(1))
    place, change = (make(predict_change=changes).predict(batch.z, batch.action, None) for changes in (False, True))
    torch.testing.assert_close(change.means, place.means + batch.z.unsqueeze(1))


@pytest.mark.parametrize("clip", [None, 1e-3])
def test_one_backward_pass_trains_three_independent_networks(clip: float | None) -> None:
    """Ruining one loss leaves the updates of the other networks as they were, clipped or not."""
    one, other = (make(gradient_clip=clip) for _ in range(2))
    batch = chain_batch(16, draws(1))
    one.update(batch, draws(2))
    other.update(dataclasses.replace(batch, reward=1e4 - 7.0 * batch.reward), draws(2))
    for mine, ruined, same in zip(one.networks, other.networks, (True, False, True), strict=True):
        assert torch.equal(mine.weights[0], ruined.weights[0]) is same
        norm = torch.stack([weight.grad.norm() for weight in ruined.parameters()]).norm()
        assert clip is None or norm <= 1.001 * clip


def test_weight_samples_are_drawn_once_and_shared_by_every_state() -> None:
    model = make()
    weights = model.draw_weights(6, draws(1))
    batch = chain_batch(4, draws(2))
    together = model.predict(batch.z, batch.action, weights)
    for row in range(4):
        alone = model.predict(batch.z[row : row + 1], batch.action[row : row + 1], weights)
        torch.testing.assert_close(together.means[:, row], alone.means[:, 0])
        torch.testing.assert_close(together.log_weights[:, row], alone.log_weights[:, 0])
    assert together.means.std(dim=0).min() > 0.0, "weight samples must disagree"


def test_a_loss_that_is_no_number_stops_the_run() -> None:
    batch = chain_batch(4, draws(1))
    with pytest.raises(DivergedError, match="world model's losses are no longer finite"):
        make().update(dataclasses.replace(batch, z=batch.z * float("inf")), draws(2))


@pytest.mark.parametrize("shared", [(), (32,)])
@pytest.mark.parametrize("read", ["transition", "next_state"])
def test_only_a_head_that_reads_the_transition_sees_where_it_began(shared: tuple[int, ...], read: str) -> None:
    model = make(shared_hidden=shared, head_input=read)
    z, action = CODES[[0, 1, 0]], torch.tensor([0, 0, 1])
    for outcomes in model.predict_outcome(z, action, CODES[[2, 2, 2]]):
        assert (outcomes[0] != outcomes[1:]).tolist() == [read == "transition"] * 2


@pytest.mark.parametrize("changes", [{}, {"shared_hidden": (16, 8)}, {"head_input": "transition"}])
def test_reward_std_is_the_spread_of_a_loop_over_weight_samples(changes: dict[str, object]) -> None:
    model = make(reward_scale=10.0, **changes)
    weights = model.draw_reward_weights(7, draws(1))
    assert weights is not None
    transition = (CODES[:4], torch.tensor([0, 1, 0, 1]), CODES[1:5])
    rewards = []
    for sample in range(7):  # one dropped-out network after the other
        one = tuple(mask[:, sample : sample + 1].expand(-1, 4, -1) for mask in weights)
        rest = [None] * (len(model.head.networks) - 1)
        with torch.no_grad():  # gradients would be computed in bfloat16
            rewards.append(model.head(*transition, [one, *rest])[0])
    expected = 10.0 * torch.stack(rewards).std(dim=0, correction=0)  # [4]
    assert expected.min() > 0.0, "weight samples must disagree"
    torch.testing.assert_close(model.reward_std(*transition, weights), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("precision", "tolerance"), [("float32", 1e-3), ("bfloat16", 0.05)])
def test_it_trains_as_the_plain_model_does(precision: str, tolerance: float) -> None:
    """Without dropout nothing is random: the same weights and batches must go the same way."""
    ours = make(dropout=0.0, members=2, max_norm=0.8, precision=precision)
    assert {str(network.hidden_dtype) for network in ours.networks} == {f"torch.{precision}"}
    plain = PlainWorldModel(Z, A, ours.settings, torch.Generator())
    for mine, other in zip(ours.networks, plain.networks, strict=True):
        other.load_state_dict(mine.state_dict())
    generator = draws(1)
    test = chain_batch(256, draws(9))
    first = [loss.item() for loss in plain.losses(test)]
    for _ in range(50):
        batch = chain_batch(64, generator)
        ours.update(batch, generator)
        plain.update(batch)
    for mine, other, before in zip(ours.losses(test, generator), plain.losses(test), first, strict=True):
        gain = before - other.item()
        assert gain > 0.1 * abs(before), "the plain model must have learned"
        assert abs(mine.item() - other.item()) < tolerance * gain
    assert max(weight.norm(dim=1).max() for network in ours.networks for weight in network.weights) <= 0.8 + 1e-6
