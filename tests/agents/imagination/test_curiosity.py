"""Curiosity: real transitions pay for the model's uncertainty about them, and never for noise (thesis 6)."""

from __future__ import annotations

import numpy as np
import torch
from agent_states import same
from counting_model import CountingModel, T, make
from fake_latents import ACTIONS, built, frame, live
from imagine_bench.agents.imagination import agent as imagination_agents
from imagine_bench.agents.imagination.mixture import Mixture
from imagine_bench.agents.imagination.uncertainty import decompose

from imagine_bench.interfaces import Observation


def test_known_noise_pays_nothing_to_the_bit() -> None:
    def noisy(sound: Mixture, z: torch.Tensor) -> Mixture:
        """Two far outcomes, much noise, and weight samples that agree."""
        sides = torch.tensor([[-5.0], [5.0]]).expand(T, len(z), 2, 2)
        return Mixture(torch.full((T, len(z), 2), 0.5).log(), sides, torch.full((T, len(z), 2, 2), 1.0))

    imagination, _ = make(filtered=False, model=CountingModel(change=noisy))
    z = torch.zeros(3, 2)
    action = torch.zeros(3, dtype=torch.int64)
    parts = decompose(imagination.model.predict(z, action, None))
    assert (parts.aleatoric > 7.0).all()
    assert (parts.modal == 25.0).all()
    assert imagination.ignorance(z, action, torch.Generator()).tolist() == [0.0, 0.0, 0.0]


def test_more_than_one_squared_unit_counts_as_one() -> None:
    """Weight samples at -3, -1, 1 and 3 about their mean have variance 5."""
    imagination, _ = make(filtered=False, model=CountingModel(uncertain_at=1))
    z = torch.tensor([[0.0, 0.0], [0.0, 1.0]])
    assert imagination.ignorance(z, torch.zeros(2, dtype=torch.int64), torch.Generator()).tolist() == [1.0, 0.0]


def test_real_rewards_alone_are_paid_in_proportion() -> None:
    agents = [built(imagination_agents.make, {"imagination.curiosity": weight}) for weight in (0.0, 2.0)]
    for agent in agents:
        agent.imagination.ignorance = lambda z, action, _: z[:, 0].abs().clamp(max=1.0)  # type: ignore[method-assign]
        live(agent, range(1), np.random.default_rng(0))
    plain, double = [agent.draw_batch(agent.real) for agent in agents]
    assert torch.equal(plain.z, double.z)
    assert torch.equal(double.reward, plain.reward + 2.0 * plain.z[:, 0].abs().clamp(max=1.0))
    assert ["imagination/intrinsic_reward" in agent.meters.read() for agent in agents] == [False, True]
    memory = agents[1].imagination.memory
    memory.add(plain)
    assert set(agents[1].draw_batch(memory).reward.tolist()) <= set(plain.reward.tolist())


def test_the_novelty_of_a_frame_can_be_read_and_changes_nothing() -> None:
    agent, alone = (built(imagination_agents.make, {"model.dropout": share}) for share in (0.5, 0.0))
    live(agent, range(4), np.random.default_rng(0))
    before = agent.state()
    first, again, nothing = (
        each.novelty(Observation(frame=frame(1)), np.random.default_rng(3)) for each in (agent, agent, alone)
    )
    assert same(before, agent.state())
    assert first is not None and first.tolist() == again.tolist() and len(first) == ACTIONS
    assert 0.0 < first.min() < first.max() <= 1.0
    assert nothing is None, "nothing differs from a single network"
