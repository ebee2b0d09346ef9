"""Model-only training: what is tested was trained in the model alone, and training resumes to the bit."""

from __future__ import annotations

import copy
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from counting_model import CountingModel, remembering
from counting_model import make as counting
from fake_latents import CODES, context, frame, live, make_dqn, transition
from imagine_bench.agents.dqn import Controller, epsilon
from imagine_bench.agents.dqn_settings import ControllerSettings
from imagine_bench.agents.imagination import agent as imagination_agents
from imagine_bench.agents.imagination import model_only
from imagine_bench.agents.imagination.mixture import Mixture
from imagine_bench.agents.imagination.model_only import ModelOnlyAgent, ModelOnlyTraining
from imagine_bench.agents.imagination.rollouts import Imagination
from imagine_bench.agents.imagination.settings import Settings
from imagine_bench.agents.meters import Meters

from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Observation
from imagine_bench.interfaces.capabilities import ModelOnlyTrainer
from imagine_bench.seeding import SeedTree

GOAL = 10
STATES = 6


def make(monkeypatch: pytest.MonkeyPatch, **changes: Any) -> ModelOnlyAgent:
    overrides = {"imagination.model_only_episodes": 8, **changes}
    return model_only.make(context(monkeypatch, overrides))


def weights(controller: Controller) -> torch.Tensor:
    return torch.nn.utils.parameters_to_vector(controller.parameters()).detach().clone()


def train_in_model(agent: ModelOnlyAgent, at_most: int = 10_000) -> int:
    """Train until nothing is left, or so often; how many episodes it were."""
    return next((done for done in range(at_most) if not agent.train_in_model()), at_most)


def learn_the_task(agent: Any, episodes: int) -> None:
    """One action in three is right; it earns 1, the others cost 1, and all of them end the episode."""
    rng = np.random.default_rng(0)
    for episode in range(episodes):
        state = int(rng.integers(STATES))
        action = agent.act(Observation(frame=frame(state)), explore=True)
        right = action == state % 3
        after = GOAL if right else GOAL + 1
        agent.observe(transition(state, action, 1.0 if right else -1.0, after, terminated=True), episode=episode)


def solved(agent: Any) -> float:
    return float(np.mean([agent.act(Observation(frame=frame(s)), explore=False) == s % 3 for s in range(STATES)]))


def test_a_controller_trained_in_the_model_alone_beats_chance(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = {"controller.hidden": (64, 64), "controller.batch_size": 32, "controller.epsilon_decay": 0.003}
    model = {"model.dynamics_hidden": (32,), "model.dropout": 0.0, "model.batch_size": 32, "model.learning_rate": 5e-3}
    agent = make(monkeypatch, **sizes, **model, **{"imagination.model_only_episodes": 400, "memory.imagined": 400})
    learn_the_task(agent, 250)
    untrained = solved(agent)
    assert train_in_model(agent) == 400
    assert solved(agent) >= 5 / 6 > untrained  # chance 1 / 3; five of six by luck: 1 in 56


def test_what_is_tested_is_untouched_by_real_transitions(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = make(monkeypatch)
    live(agent, range(4), np.random.default_rng(0))
    before = weights(agent.tested)
    live(agent, range(4, 12), np.random.default_rng(1))
    assert torch.equal(weights(agent.tested), before)
    assert train_in_model(agent) == 8
    assert not torch.equal(weights(agent.tested), before)


def test_the_explorer_acts_and_learns_like_the_dqn(monkeypatch: pytest.MonkeyPatch) -> None:
    plain, agent = make_dqn(context(monkeypatch)), make(monkeypatch)
    first, second = np.random.default_rng(0), np.random.default_rng(0)
    for episodes in (range(6), range(6, 14)):
        assert live(plain, episodes, first) == live(agent, episodes, second)
        train_in_model(agent)
    assert torch.equal(weights(plain.controller), weights(agent.controller))


def test_only_new_experience_asks_for_new_training(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = make(monkeypatch)
    assert isinstance(agent, ModelOnlyTrainer)
    assert not isinstance(imagination_agents.make(context(monkeypatch)), ModelOnlyTrainer)
    assert not agent.train_in_model(), "nothing was learned yet"
    live(agent, range(3), np.random.default_rng(0))
    assert train_in_model(agent) == 8
    before = agent.state()
    assert not agent.train_in_model()
    assert np.array_equal(before.arrays["model_only/generator"], agent.state().arrays["model_only/generator"])
    live(agent, range(3, 4), np.random.default_rng(0))
    assert train_in_model(agent) == 8


def test_training_twice_from_equal_experience_gives_equal_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Earlier training, at another budget, leaves no trace in later training."""
    often, once = make(monkeypatch), make(monkeypatch)
    for agent in (often, once):
        rng = np.random.default_rng(0)
        live(agent, range(5), rng)
        if agent is often:
            train_in_model(agent)
        live(agent, range(5, 9), rng)
        train_in_model(agent)
    first, second = often.state().arrays, once.state().arrays
    assert all(np.array_equal(first[name], second[name]) for name in first if name.startswith("model_only/"))


@pytest.mark.parametrize("rate", [1.0, 0.1])
def test_interrupted_training_goes_on_to_the_same_bits(monkeypatch: pytest.MonkeyPatch, rate: float) -> None:
    """With a target network and without."""
    overrides = {"controller.target_rate": rate}
    agent = make(monkeypatch, **overrides)
    live(agent, range(5), np.random.default_rng(0))
    assert train_in_model(agent, 3) == 3
    saved = copy.deepcopy(agent.state())
    assert train_in_model(agent) == 5
    resumed = make(monkeypatch, **overrides)
    resumed.restore(saved)
    assert train_in_model(resumed) == 5
    one, other = agent.state().arrays, resumed.state().arrays
    assert one.keys() == other.keys()
    assert all(np.array_equal(one[name], other[name]) for name in one)


def test_imagined_episodes_begin_where_real_ones_did(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = make(monkeypatch, **{"imagination.depth": 1})
    for episode in range(3):
        agent.observe(transition(episode, 0, 0.0, 4), episode=episode)
        agent.observe(transition(4, 0, 0.0, 5), episode=episode)
    assert np.array_equal(agent.state().arrays["starts/mu"], CODES[:3].numpy())
    train_in_model(agent)
    begun = agent.state().arrays["model_only/memory/z"]
    distance = np.linalg.norm(begun[:, None] - CODES[:3].numpy()[None], axis=-1).min(axis=1)
    assert len(begun) == 8
    assert distance.max() < 0.5, "drawn from the posteriors of starts, whose sigma is 0.05"


def test_the_filter_ends_an_imagined_episode_and_stores_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    overrides = {"imagination.model_only_episodes": 6, "imagination.threshold": 0.0}
    strict = model_only.make_uncertainty(context(monkeypatch, overrides))
    live(strict, range(4), np.random.default_rng(0))
    strict.diagnostics()
    assert train_in_model(strict) == 6
    assert len(strict.state().arrays["model_only/memory/z"]) == 0
    assert strict.diagnostics()["imagination/acceptance_rate"] == 0.0


def model_only_training(
    model: CountingModel, *, filtered: bool = False, **changes: Any
) -> tuple[ModelOnlyTraining, Callable[[], None]]:
    """Model-only training in a world model that counts, and what lets it imagine one episode from latents of 0."""
    imagination, _ = counting(filtered=filtered, model=model, **changes)
    controller = ControllerSettings(hidden=(8,), batch_size=4, epsilon_decay=0.1)
    settings = Settings(imagination=imagination.settings, controller=controller)
    practice = ModelOnlyTraining(imagination, 2, settings, SeedTree(0), torch.device("cpu"))
    starts: Any = SimpleNamespace(sample=lambda count, generator: torch.zeros(count, 2))
    return practice, lambda: practice.episode(starts, remembering(4), Meters())


def test_an_imagined_episode_ends_where_the_model_says_so() -> None:
    practice, one_episode = model_only_training(CountingModel(end_at=2), depth=10)
    for episode in range(1, 6):
        one_episode()
        assert practice.steps == practice.values()["imagined"] == 2 * episode
    assert practice.arrays()["memory/terminated"].tolist() == [0.0, 1.0] * 5
    practice, one_episode = model_only_training(CountingModel(), depth=7)
    one_episode()
    assert practice.steps == 7, "without an end its depth is"


def test_exploration_falls_to_that_of_the_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    practice, one_episode = model_only_training(CountingModel(), depth=30, exploration=0.2)
    chances: list[float] = []

    def act(controller: Controller, z: torch.Tensor, chance: float, generator: torch.Generator) -> torch.Tensor:
        chances.append(chance)
        return Imagination.act(controller, z, chance, generator)

    monkeypatch.setattr(practice.imagination, "act", act)
    one_episode()
    settings = practice.settings.controller
    assert chances == [max(epsilon(step, settings), 0.2) for step in range(30)]
    assert chances[0] == 0.8 and chances[-1] == 0.2


def test_a_moving_threshold_moves_in_model_only_training_too() -> None:
    practice, one_episode = model_only_training(
        CountingModel(), filtered=True, depth=1, threshold=99.0, threshold_quantile=1.0
    )
    one_episode()
    assert practice.imagination.filter.threshold == 0.0  # this model is certain


def test_diagnostics_count_what_model_only_training_imagined(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = make(monkeypatch)
    live(agent, range(4), np.random.default_rng(0))
    train_in_model(agent)
    read = agent.diagnostics()
    assert read["imagined_transitions"] == len(agent.state().arrays["model_only/memory/z"]) > 8
    assert read["time/model_only_s"] > 0.0 and "time/imagination_s" not in read


def test_a_filter_without_dropout_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    for maker in (model_only.make_uncertainty, imagination_agents.make_uncertainty):
        with pytest.raises(InvalidValueError, match=r"model.members 1 .* Set model.dropout above 0"):
            maker(context(monkeypatch, {"model.dropout": 0.0}))
        assert maker(context(monkeypatch, {"model.dropout": 0.0, "model.members": 2})).imagination.filter.active


@pytest.mark.parametrize("temperature", [0.0, 1.0])
def test_model_only_training_imagines_with_the_noise_of_the_model(temperature: float) -> None:
    """A model whose every step has a standard deviation of 0.5; the temperature scales the variance."""

    class Noisy(CountingModel):
        def predict(self, z: torch.Tensor, action: torch.Tensor, weights: None) -> Mixture:
            certain = super().predict(z, action, weights)
            return Mixture(certain.log_weights, certain.means, torch.full_like(certain.means, np.log(0.5)))

    practice, one_episode = model_only_training(Noisy(), depth=200, temperature=temperature)
    one_episode()
    rows = practice.arrays()
    steps = rows["memory/next_z"][:, 1] - rows["memory/z"][:, 1]
    assert len(steps) == 200
    assert steps.mean() == pytest.approx(1.0, abs=0.15)
    assert steps.std() == pytest.approx(0.5 if temperature else 0.0, abs=0.08)
