"""The world model: losses, weight samples, and a chain it must learn."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from imagine_bench.agents.imagination import mixture as mdn
from imagine_bench.agents.imagination.settings import WorldModelSettings
from imagine_bench.agents.imagination.uncertainty import decompose
from imagine_bench.agents.imagination.world_model import EnvironmentModel, log_cosh
from imagine_bench.agents.replay import Batch
from plain_torch import PlainWorldModel

from imagine_bench.errors import DivergedError

Z, A, N_STATES = 3, 2, 5
CODES = torch.from_numpy(np.random.default_rng(2).normal(size=(N_STATES, Z)).astype(np.float32))
SETTINGS = WorldModelSettings(
    dynamics_hidden=(32, 32), components=2, reward_hidden=(32,), termination_hidden=(32,), dropout=0.5
)


def make(**changes: object) -> EnvironmentModel:
    if changes.get("shared_hidden"):
        changes |= {"reward_hidden": (), "termination_hidden": ()}
    return EnvironmentModel(Z, A, dataclasses.replace(SETTINGS, **changes), torch.Generator().manual_seed(0))


def chain_batch(count: int, generator: torch.Generator) -> Batch:
    """Action 1 steps up a chain of 5 states, action 0 down; the top earns 2 and ends."""
    state = torch.randint(N_STATES - 1, (count,), generator=generator)
    action = torch.randint(A, (count,), generator=generator)
    following = (state + 2 * action - 1).clamp(0, N_STATES - 1)
    top = (following == N_STATES - 1).float()
    return Batch(CODES[state], action, 2.0 * top, CODES[following], top)


def losses(model: EnvironmentModel, batch: Batch, dropout: torch.Generator) -> torch.Tensor:
    """Of dynamics, reward and termination. Shape (3,)."""
    return torch.stack(model.losses(batch, dropout))


def test_log_cosh_is_itself_and_does_not_overflow() -> None:
    x = torch.linspace(-5.0, 5.0, 101, dtype=torch.float64)
    torch.testing.assert_close(log_cosh(x), x.cosh().log())
    assert log_cosh(torch.tensor(1e4)).item() == pytest.approx(1e4 - math.log(2.0))


@pytest.mark.parametrize("predict_change", [False, True])
def test_it_learns_a_small_deterministic_chain(predict_change: bool) -> None:
    model = make(dropout=0.0, predict_change=predict_change, sigma_floor=0.1, learning_rate=5e-3)
    draws, dropout = torch.Generator().manual_seed(1), torch.Generator().manual_seed(2)
    for _ in range(600):
        model.update(chain_batch(64, draws), dropout)
    test = chain_batch(100, torch.Generator().manual_seed(3))
    predicted = mdn.mean(mdn.average(model.predict(test.z, test.action, None)))
    reward, p_terminated = model.predict_outcome(test.z, test.action, test.next_z)
    assert (predicted - test.next_z).abs().max() < 0.25  # states are 0.67 apart and more
    assert (reward - test.reward).abs().max() < 0.15
    assert ((p_terminated > 0.5).float() == test.terminated).all()
    assert test.terminated.sum() > 5, "the end of the chain must be among the tests"


def test_one_backward_pass_trains_three_independent_networks() -> None:
    """Ruining one loss leaves the updates of the other networks as they were."""
    one, other = make(), make()
    batch = chain_batch(16, torch.Generator().manual_seed(1))
    one.update(batch, torch.Generator().manual_seed(2))
    other.update(dataclasses.replace(batch, reward=batch.reward * -7.0), torch.Generator().manual_seed(2))
    for index, (name, same) in enumerate((("dynamics", True), ("reward", False), ("termination", True))):
        first, second = (model.networks[index].weights[0] for model in (one, other))
        assert torch.equal(first, second) is same, name


def test_a_shared_trunk_is_one_network_that_both_losses_train() -> None:
    one, other = make(shared_hidden=(16, 8)), make(shared_hidden=(16, 8))
    assert [network.sizes for network in one.networks[1:]] == [(Z, 16, 8, 2)]
    batch = chain_batch(16, torch.Generator().manual_seed(1))
    one.update(batch, torch.Generator().manual_seed(2))
    other.update(dataclasses.replace(batch, reward=batch.reward * -7.0), torch.Generator().manual_seed(2))
    assert torch.equal(one.dynamics.weights[0], other.dynamics.weights[0])
    assert not torch.equal(one.networks[1].weights[0], other.networks[1].weights[0])


def aliased_batch(count: int, generator: torch.Generator) -> Batch:
    """Both actions lead to state 0; action 1 earns 1 and ends, action 0 neither: the next state cannot tell them."""
    action = torch.randint(A, (count,), generator=generator)
    state = torch.randint(1, N_STATES, (count,), generator=generator)
    return Batch(CODES[state], action, action.float(), CODES[torch.zeros_like(state)], action.float())


@pytest.mark.parametrize(("shared", "told_apart"), [((), True), ((32,), True), ((32,), False)])
def test_only_a_transition_tells_apart_what_one_next_state_hides(shared: tuple[int, ...], told_apart: bool) -> None:
    read = "transition" if told_apart else "next_state"
    model = make(dropout=0.0, shared_hidden=shared, head_input=read, learning_rate=5e-3)
    draws, dropout = torch.Generator().manual_seed(1), torch.Generator().manual_seed(2)
    for _ in range(200):
        model.update(aliased_batch(64, draws), dropout)
    test = aliased_batch(100, torch.Generator().manual_seed(3))
    reward, p_terminated = model.predict_outcome(test.z, test.action, test.next_z)
    right = (p_terminated > 0.5).float() == test.terminated
    assert bool(right.all()) is told_apart
    assert bool(((reward - test.reward).abs() < 0.1).all()) is told_apart


def test_weight_samples_are_drawn_once_and_shared_by_every_state() -> None:
    model, generator = make(), torch.Generator().manual_seed(1)
    weights = model.draw_weights(6, generator)
    z, action = CODES[:4], torch.tensor([0, 1, 0, 1])
    together = model.predict(z, action, weights)
    assert together.means.shape == (6, 4, 2, Z)
    for row in range(4):
        alone = model.predict(z[row : row + 1], action[row : row + 1], weights)
        torch.testing.assert_close(together.means[:, row], alone.means[:, 0])
        torch.testing.assert_close(together.log_weights[:, row], alone.log_weights[:, 0])
    assert together.means.std(dim=0).min() > 0.0, "weight samples must disagree"
    repeated = model.predict(z, action, model.draw_weights(6, torch.Generator().manual_seed(1)))
    assert torch.equal(repeated.means, together.means)


@pytest.mark.parametrize("changes", [{}, {"shared_hidden": (16, 8)}, {"head_input": "transition"}])
def test_reward_std_is_the_spread_of_a_loop_over_weight_samples(changes: dict[str, object]) -> None:
    model = make(reward_scale=10.0, **changes)
    weights = model.draw_reward_weights(7, torch.Generator().manual_seed(1))
    assert weights is not None
    z, action, next_z = CODES[:4], torch.tensor([0, 1, 0, 1]), CODES[1:5]
    rewards = []
    for sample in range(7):  # one dropped-out network after the other
        one = tuple(mask[:, sample : sample + 1].expand(-1, 4, -1) for mask in weights)
        rest = [None] * (len(model.head.networks) - 1)
        with torch.no_grad():  # gradients would be computed in bfloat16
            reward, _ = model.head(z, action, next_z, [one, *rest])
            rewards.append(10.0 * reward)
    expected = torch.stack(rewards).std(dim=0, correction=0)  # [4]
    assert expected.min() > 0.0, "weight samples must disagree"
    torch.testing.assert_close(model.reward_std(z, action, next_z, weights), expected, rtol=1e-4, atol=1e-5)


def test_rewards_are_uncertain_where_none_was_seen() -> None:
    """Between two known states whose rewards differ the samples disagree; at the known ones they hardly do."""
    model = make(dropout=0.25, learning_rate=5e-3)
    draws, dropout = torch.Generator().manual_seed(1), torch.Generator().manual_seed(2)
    for _ in range(600):
        model.update(chain_batch(64, draws), dropout)
    weights = model.draw_reward_weights(50, dropout)
    assert weights is not None
    known, action = CODES[:3], torch.zeros(3, dtype=torch.int64)
    elsewhere = 3.0 * CODES[4] - 2.0 * CODES[:3]  # past the rewarded state, where nothing was seen
    stds = [model.reward_std(known, action, places, weights) for places in (known, elsewhere)]
    assert stds[1].min() > 2.0 * stds[0].max()


def test_dropout_acts_only_in_training_and_weight_sampling() -> None:
    model = make()
    z, action = CODES[:4], torch.zeros(4, dtype=torch.int64)
    assert torch.equal(model.predict(z, action, None).means, model.predict(z, action, None).means)
    assert torch.equal(model.predict_outcome(z, action, z)[0], model.predict_outcome(z, action, z)[0])
    batch, generator = chain_batch(16, torch.Generator().manual_seed(1)), torch.Generator().manual_seed(2)
    first, second = losses(model, batch, generator), losses(model, batch, generator)
    assert all(not torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_max_norm_holds_after_an_update() -> None:
    model = make(max_norm=0.5)
    model.update(chain_batch(16, torch.Generator().manual_seed(1)), torch.Generator().manual_seed(2))
    for network in model.networks:
        for weight in network.weights:
            assert weight.norm(dim=1).max() <= 0.5 + 1e-6


def test_without_a_max_norm_weights_grow_as_they_like() -> None:
    model = make(max_norm=None, learning_rate=1.0)
    model.update(chain_batch(16, torch.Generator().manual_seed(1)), torch.Generator().manual_seed(2))
    for network in model.networks:  # beyond the limit that the settings have by default
        assert max(float(weight.detach().norm(dim=1).max()) for weight in network.weights) > 3.0


def test_a_loss_that_is_no_number_stops_the_run() -> None:
    model, batch = make(), chain_batch(4, torch.Generator().manual_seed(1))
    with pytest.raises(DivergedError, match="world model's losses are no longer finite"):
        model.update(dataclasses.replace(batch, z=batch.z * float("inf")), torch.Generator())


def test_an_ensemble_trains_each_member_as_if_it_were_alone() -> None:
    """Two members that begin alike stay alike, and are what one network alone becomes."""
    alone, both = make(dropout=0.0), make(dropout=0.0, members=2)
    with torch.no_grad():
        for name in ("weights", "biases"):
            for one, two in zip(getattr(alone.dynamics, name), getattr(both.dynamics, name), strict=True):
                two.copy_(one.expand_as(two))
    draws = torch.Generator().manual_seed(1)
    for batch in (chain_batch(32, draws) for _ in range(3)):
        alone.update(batch, torch.Generator())
        both.update(batch, torch.Generator())
    for one, two in zip(alone.dynamics.weights, both.dynamics.weights, strict=True):
        torch.testing.assert_close(two, one.expand_as(two), rtol=1e-4, atol=1e-5)


def test_members_disagree_where_they_were_not_taught() -> None:
    model = make(dropout=0.0, members=5, components=1, sigma_floor=0.1, learning_rate=5e-3)
    draws = torch.Generator().manual_seed(1)
    for _ in range(300):
        model.update(chain_batch(64, draws), torch.Generator())
    known = chain_batch(50, torch.Generator().manual_seed(3))
    epistemic = [
        decompose(model.predict(z, known.action, None)).epistemic.sum(dim=-1).mean() for z in (known.z, 4.0 + known.z)
    ]
    assert epistemic[1] > 20.0 * epistemic[0]


def test_the_reward_may_depend_on_where_the_action_began() -> None:
    """A reward for having come from state 0, which z' alone does not tell."""
    errors = []
    for inputs in ("next_state", "transition"):
        model = make(dropout=0.0, head_input=inputs, learning_rate=5e-3)
        draws = torch.Generator().manual_seed(1)

        def batch(generator: torch.Generator) -> Batch:
            given = chain_batch(64, generator)
            first = (given.z == CODES[0]).all(dim=-1).float()
            return dataclasses.replace(given, reward=first, next_z=CODES[1].expand_as(given.z))

        for _ in range(300):
            model.update(batch(draws), torch.Generator())
        test = batch(torch.Generator().manual_seed(3))
        errors.append((model.predict_outcome(test.z, test.action, test.next_z)[0] - test.reward).abs().max().item())
    assert errors[0] > 0.4 and errors[1] < 0.1


def test_a_member_s_update_does_not_depend_on_another_member() -> None:
    """Gradients, Adam and the max-norm constraint: to the bit."""
    one, other = make(members=3, max_norm=0.5), make(members=3, max_norm=0.5)
    with torch.no_grad():
        for weight in other.dynamics.parameters():
            weight[1:] *= -3.0
    draws = torch.Generator().manual_seed(1)
    dropout = [torch.Generator().manual_seed(2) for _ in range(2)]
    for batch in (chain_batch(32, draws) for _ in range(3)):
        one.update(batch, dropout[0])
        other.update(batch, dropout[1])
    for first, second in zip(one.dynamics.parameters(), other.dynamics.parameters(), strict=True):
        assert torch.equal(first[0], second[0])
        assert not torch.equal(first[1:], second[1:])


def test_each_network_s_gradient_is_clipped_by_itself() -> None:
    """A huge reward loss, clipped, leaves the steps of the other networks as they were."""
    one, other = make(gradient_clip=1e-3), make(gradient_clip=1e-3)
    batch = chain_batch(16, torch.Generator().manual_seed(1))
    one.update(batch, torch.Generator().manual_seed(2))
    other.update(dataclasses.replace(batch, reward=1e4 + batch.reward), torch.Generator().manual_seed(2))
    for index, same in enumerate((True, False, True)):
        first, second = (model.networks[index].weights[0] for model in (one, other))
        assert torch.equal(first, second) is same
        norm = torch.stack([weight.grad.norm() for weight in other.networks[index].parameters()]).norm()
        assert norm <= 1.001e-3


@pytest.mark.parametrize(("precision", "tolerance"), [("float32", 1e-3), ("bfloat16", 0.05)])
def test_it_trains_as_the_plain_model_does(precision: str, tolerance: float) -> None:
    """Without dropout nothing is random: the same weights and batches must go the same way."""
    settings = dataclasses.replace(SETTINGS, dropout=0.0, members=2, max_norm=0.8, precision=precision)
    ours, plain = make(**dataclasses.asdict(settings)), PlainWorldModel(Z, A, settings, torch.Generator())
    for mine, other in zip(ours.networks, plain.networks, strict=True):
        other.load_state_dict(mine.state_dict())
    draws, dropout = torch.Generator().manual_seed(1), torch.Generator()
    test = chain_batch(256, torch.Generator().manual_seed(9))
    first = [loss.item() for loss in plain.losses(test)]
    for _ in range(50):
        batch = chain_batch(64, draws)
        ours.update(batch, dropout)
        plain.update(batch)
    for mine, other, before in zip(losses(ours, test, dropout), plain.losses(test), first, strict=True):
        gain = before - other.item()
        assert gain > 0.1 * abs(before), "the plain model must have learned"
        assert abs(mine.item() - other.item()) < tolerance * gain
    for network in ours.networks:
        assert max(weight.norm(dim=1).max().item() for weight in network.weights) <= 0.8 + 1e-6
