"""Uses of uncertainty beside the thesis' filter: weights by confidence, the sum over a rollout so far, curiosity.

Curiosity pays real transitions for the model's uncertainty about them, and never for noise (thesis 6).
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from counting_model import CountingModel, T, imagined, make, practising
from fake_latents import ACTIONS, built, frame, live
from imagine_bench.agents.imagination import agent as imagination_agents
from imagine_bench.agents.imagination.mixture import Mixture
from imagine_bench.agents.imagination.uncertainty import decompose
from imagine_bench.agents.imagination.vector_env import ImaginedVectorEnv

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Observation
from imagine_bench.interfaces.capabilities import ImaginedRollout

UNCERTAINTY = 0.1


def unsure(sound: Mixture, z: torch.Tensor) -> Mixture:
    """As uncertain of every step as of any other."""
    spread = torch.linspace(-1.0, 1.0, T)
    spread *= (UNCERTAINTY / spread.var(correction=0)).sqrt()
    means = sound.means.clone()
    means[..., 1] += spread[:, None, None]
    return dataclasses.replace(sound, means=means)


accumulating = pytest.mark.parametrize("accumulates", [False, True])


def confidence(depth: np.ndarray, accumulates: bool) -> np.ndarray:
    """1 / (1 + u / 0.2) of the transitions that reach these depths."""
    return 1.0 / (1.0 + UNCERTAINTY * (depth if accumulates else 1.0) / 0.2)


@pytest.mark.parametrize("weighted", [False, True])
@accumulating
@pytest.mark.parametrize("filtered", [False, True])
def test_gathered_uncertainty_ends_rollouts_and_weighs_transitions(
    filtered: bool, accumulates: bool, weighted: bool
) -> None:
    """No single step is as uncertain as 0.35; three together nearly are."""
    uses = {"accumulates": accumulates, "confidence_scale": 0.2 if weighted else None}
    imagination, _ = imagined(CountingModel(change=unsure), filtered=filtered, threshold=0.35, **uses)
    rows = imagination.memory.arrays()
    depth = rows["next_z"][:, 1].round()
    assert depth.max() == (3 if filtered and accumulates else 10)
    assert ("weight" in rows) == weighted
    if weighted:
        np.testing.assert_allclose(rows["weight"], confidence(depth, accumulates), rtol=1e-4)


def graded(sound: Mixture, z: torch.Tensor) -> Mixture:
    """From (i, c) i times as uncertain."""
    more = (unsure(sound, z).means - sound.means) * z[:, 0, None, None].sqrt()
    return dataclasses.replace(sound, means=sound.means + more)


def test_what_a_rollout_has_gathered_is_its_own() -> None:
    """Of rollouts that begin in (i, 5) the unsure end early."""
    gathering = {"threshold": 0.35, "accumulates": True, "start_states": "replayed", "breadth": 60}
    imagination, _ = imagined(CountingModel(change=graded), filtered=True, states=4, **gathering)
    z = imagination.memory.arrays()["z"].round()
    assert [z[z[:, 0] == index, 1].max() - 4 for index in range(4)] == [10, 3, 1, 1]


def test_model_only_training_gathers_and_weighs_uncertainty() -> None:
    uses = {"threshold": 0.35, "accumulates": True, "confidence_scale": 0.2}
    agent = practising(CountingModel(change=unsure), filtered=True, **uses)
    agent.train_in_model()
    weights = agent.imagined.arrays()["weight"]
    np.testing.assert_allclose(weights, confidence(np.arange(1, 4), accumulates=True), rtol=1e-4)


@accumulating
def test_an_imagined_environment_gathers_uncertainty(accumulates: bool) -> None:
    """Each episode its own: side by side they begin in (i, 0), and are cut after 5 steps or where they are unsure."""
    imagination, _ = make(filtered=True, model=CountingModel(change=graded), threshold=0.25, accumulates=accumulates)
    env = ImaginedVectorEnv(imagination, np.array([[i, 0] for i in range(4)], np.float32), num_envs=6, horizon=5)
    kinds = set()
    for seed in (0, None, 2):  # nothing that counts is left of an episode that ended or that a reset cuts off
        seen, _ = env.reset(seed=seed)
        gathered, age = np.zeros((2, 6))
        for _ in range(13):
            reached = gathered + UNCERTAINTY * seen[:, 0].round()
            age = age + 1
            seen, _, _, ended, info = env.step(np.zeros(6, np.int64))
            assert info["accepted"].tolist() == (reached < 0.25).tolist()
            assert ended.tolist() == (~info["accepted"] | (age == 5)).tolist()
            gathered, age = np.where(ended, 0.0, (reached * accumulates, age))
            kinds |= set(zip(info["accepted"].tolist(), ended.tolist(), strict=True))
    assert kinds == {(True, False), (True, True), (False, True)}


def test_an_environment_that_cannot_weigh_by_confidence_refuses_it() -> None:
    imagination, _ = make(filtered=True, model=CountingModel(), confidence_scale=0.2)
    with pytest.raises(InvalidValueError, match=r"cannot weigh .* leave imagination\.confidence_scale out"):
        ImaginedVectorEnv(imagination, np.zeros((1, 2), np.float32))


def test_a_shown_rollout_is_accepted_as_far_as_it_has_gathered_little() -> None:
    def shown(**settings: float) -> ImaginedRollout:
        agent = built(
            imagination_agents.make_uncertainty, {f"imagination.{name}": value for name, value in settings.items()}
        )
        return agent.imagine(frame(0), actions=np.zeros(8, dtype=np.int64), depth=8, rng=np.random.default_rng(0))

    epistemic = shown(threshold=0.0).epistemic
    limit = float(np.cumsum(epistemic)[3]) * 1.001
    assert shown(threshold=limit, accumulates=True).accepted.tolist() == [True] * 4 + [False] * 4
    assert shown(threshold=max(limit, float(epistemic.max()))).accepted.all(), "no step alone is too uncertain"
    below = int(np.argmax(np.diff(epistemic) < 0.0))  # the first step whose next is less uncertain
    limit = float(epistemic[below : below + 2].mean())
    kept = np.logical_and.accumulate(epistemic < limit)
    assert shown(threshold=limit).accepted.tolist() == kept.tolist(), "nothing after a discarded step is kept"
    assert (epistemic < limit).sum() > kept.sum()


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


def test_the_novelty_of_a_frame_is_between_0_and_1() -> None:
    for dropout, members in ((0.5, 1), (0.0, 3), (0.0, 1)):
        agent = built(imagination_agents.make, {"model.dropout": dropout, "model.members": members})
        live(agent, range(4), np.random.default_rng(0))
        found = agent.novelty(Observation(frame=frame(1)), np.random.default_rng(3))
        if (dropout, members) == (0.0, 1):
            assert found is None, "nothing differs from a single network"
        else:
            assert found is not None and len(found) == ACTIONS
            assert 0.0 < found.min() < found.max() <= 1.0


@pytest.mark.parametrize("predicts_with", ["average", "network", "sample"])
def test_confidence_is_that_of_weight_samples_whatever_predicts(predicts_with: str) -> None:
    """Also of an agent without a filter, which compares weight samples for nothing else."""
    uses = {"imagination.confidence_scale": 0.1, "imagination.predicts_with": predicts_with}
    agent = built(imagination_agents.make, uses)
    live(agent, range(6), np.random.default_rng(0))
    weights = agent.imagination.memory.arrays()["weight"]
    assert len(weights) and 0.0 < weights.min() and weights.max() < 1.0
