"""Curiosity: real transitions pay for what the model does not know of them, and never for noise (thesis 6)."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from agent_states import same
from counting_model import CountingModel, T, make
from fake_latents import ACTIONS, SMALL, context, frame, live
from imagine_bench.agents.imagination import agent as imagination_agents
from imagine_bench.agents.imagination.mixture import Mixture
from imagine_bench.agents.imagination.rollouts import Imagination
from imagine_bench.agents.imagination.settings import Settings, WorldModelSettings
from imagine_bench.agents.imagination.uncertainty import decompose
from imagine_bench.agents.replay import Batch

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Observation
from imagine_bench.interfaces.capabilities import NoveltyReader
from imagine_bench.seeding import SeedTree


def test_what_is_known_but_noisy_pays_nothing_to_the_bit() -> None:
    class Noisy(CountingModel):
        """Two far outcomes, much noise, and weight samples that agree."""

        def predict(self, z: torch.Tensor, action: torch.Tensor, weights: None) -> Mixture:
            sides = torch.tensor([[-5.0], [5.0]]).expand(T, len(z), 2, 2)
            return Mixture(torch.full((T, len(z), 2), 0.5).log(), sides, torch.full((T, len(z), 2, 2), 1.0))

    imagination, _ = make(filtered=False, model=Noisy())
    z, action = torch.zeros(3, 2), torch.zeros(3, dtype=torch.int64)
    parts = decompose(imagination.model.predict(z, action, None))
    assert (parts.aleatoric > 7.0).all() and (parts.modal == 25.0).all()
    assert imagination.ignorance(z, action, torch.Generator()).tolist() == [0.0, 0.0, 0.0]


def test_a_learned_model_pays_for_the_unseen_not_for_noise() -> None:
    """Action 0 leads to one of two far places, with noise, and was often seen; action 1 was never tried."""
    model = WorldModelSettings(components=2, dropout=0.0, members=5, dynamics_hidden=(32, 32), learning_rate=3e-3)
    device = torch.device("cpu")
    imagination = Imagination(2, 2, Settings(model=model), filtered=False, seeds=SeedTree(0), device=device)
    noise = torch.Generator().manual_seed(1)
    sides = torch.randint(2, (4000, 1), generator=noise) * 4.0 - 2.0
    next_z = sides + 0.5 * torch.randn(4000, 2, generator=noise)
    z, action, nothing = torch.zeros(4000, 2), torch.zeros(4000, dtype=torch.int64), torch.zeros(4000)
    for batch in Batch(z, action, nothing, next_z, nothing).split(200) * 10:
        imagination.model.update(batch, imagination.generators["dropout"])
    parts = decompose(imagination.model.predict(z[:1], action[:1], None))
    assert parts.aleatoric.max() == pytest.approx(0.25, abs=0.1) and parts.modal.max() == pytest.approx(4.0, abs=0.4)
    known, unknown = imagination.ignorance(z[:2], torch.tensor([0, 1]), noise).tolist()
    assert known < 0.001 and unknown > 0.03


def test_real_rewards_alone_are_paid_in_proportion(monkeypatch: pytest.MonkeyPatch) -> None:
    agents = [
        imagination_agents.make(context(monkeypatch, {"imagination.curiosity": weight})) for weight in (0.0, 0.5, 2.0)
    ]
    for agent in agents:
        live(agent, range(3), np.random.default_rng(0))
        agent._replay.manual_seed(3)
        agent.imagination.ignorance = lambda z, action, _: z[:, 0].abs().clamp(max=1.0)  # type: ignore[method-assign]
    plain, half, double = [agent.draw_batch(agent.real) for agent in agents]
    assert torch.equal(plain.z, half.z) and torch.equal(plain.next_z, double.next_z)
    unknown = plain.z[:, 0].abs().clamp(max=1.0)
    assert torch.equal(half.reward, plain.reward + 0.5 * unknown) and unknown.unique().numel() > 2
    assert torch.equal(double.reward, plain.reward + 2.0 * unknown)
    paid = agents[2].meters.read()["imagination/intrinsic_reward"]
    assert paid > 0.0 and "imagination/intrinsic_reward" not in agents[0].meters.read()
    imagination = agents[2].imagination
    imagination.memory.add(plain)
    rewards = imagination.memory.arrays()["reward"]
    assert set(agents[2].draw_batch(imagination.memory).reward.tolist()) <= set(rewards.tolist())


def test_more_than_one_squared_unit_counts_as_one() -> None:
    """Weight samples at -3, -1, 1 and 3 about their mean have variance 5."""
    imagination, _ = make(filtered=False, model=CountingModel(uncertain_at=1))
    z = torch.tensor([[0.0, 0.0], [0.0, 1.0]])
    action = torch.zeros(2, dtype=torch.int64)
    assert decompose(imagination.model.predict(z, action, None)).epistemic[:, 0].tolist() == [5.0, 0.0]
    assert imagination.ignorance(z, action, torch.Generator()).tolist() == [1.0, 0.0]


def test_curiosity_changes_what_is_learned_and_its_absence_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def weights(overrides: dict[str, float]) -> bytes:
        agent = imagination_agents.make_uncertainty(context(monkeypatch, overrides))
        live(agent, range(12), np.random.default_rng(0))
        assert agent.real.arrays()["reward"].max() == 1.0, "what is remembered is the world's reward"
        return b"".join(
            array.tobytes() for name, array in agent.state().arrays.items() if name.startswith("controller")
        )

    assert weights({}) == weights({"imagination.curiosity": 0.0}) != weights({"imagination.curiosity": 1.0})


def test_curiosity_of_one_network_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    assert SMALL["imagination.weight_samples"] > 1
    alone = {"imagination.curiosity": 1.0, "model.dropout": 0.0}
    with pytest.raises(InvalidValueError, match=r"imagination\.curiosity compares .* above 1, or set it to 0\."):
        imagination_agents.make(context(monkeypatch, alone))
    imagination_agents.make(context(monkeypatch, {**alone, "imagination.curiosity": 0.0}))
    imagination_agents.make(context(monkeypatch, {**alone, "model.members": 2}))


def test_what_it_pays_for_can_be_read_of_a_frame_and_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    agent, seen = imagination_agents.make(context(monkeypatch)), Observation(frame=frame(1))
    live(agent, range(4), np.random.default_rng(0))
    assert isinstance(agent, NoveltyReader)
    before = agent.state()
    first, again, other = (agent.novelty(seen, np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert same(before, agent.state())
    assert first is not None and first.shape == (ACTIONS,) and 0.0 < first.min() < first.max() <= 1.0
    assert np.array_equal(first, again) and not np.array_equal(first, other)
    alone = imagination_agents.make(context(monkeypatch, {"model.dropout": 0.0}))
    assert alone.novelty(seen, np.random.default_rng(3)) is None, "nothing differs from a single network"
