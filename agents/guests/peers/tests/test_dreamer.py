"""DreamerV3 of sheeprl, an episode at a time: its memory, its random numbers, its learning."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_runs import context

from imagine_bench.interfaces import Observation, Transition

pytest.importorskip("sheeprl")
with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import torch
    from imagine_bench.agents.encoders.encoder import Encoder, bundled_encoder
    from imagine_bench_peers import dreamer
    from imagine_bench_peers.dreamer import Dreamer, SequenceReplay, make


def learner(seed: int = 0, encoder: Path | None = None, **overrides: Any) -> Dreamer:
    changes = {"n_actions": 3, "encoder": encoder, "hyperparameters": "minimal", "overrides": overrides}
    return make(replace(context(seed), **changes))


def seen(value: int) -> Observation:
    return Observation(frame=np.full((64, 64, 3), value, dtype=np.uint8))


def episode(agent: Dreamer, number: int, length: int = 3) -> list[int]:
    """Rewards and frames count on; every second episode is terminated, the others are truncated."""
    actions = []
    agent.begin_episode()
    for step in range(length):
        last = step == length - 1
        at = 10 * number + step
        actions.append(agent.act(seen(at), explore=True))
        transition = Transition(
            observation=seen(at), action=actions[-1], reward=float(at + 1), next_observation=seen(at + 1),
            terminated=last and number % 2 == 0, truncated=last and number % 2 == 1,
        )  # fmt: skip
        agent.observe(transition, episode=number)
    return actions


def test_rows_are_what_the_library_expects() -> None:
    agent = learner(learning_starts=1000)
    actions = episode(agent, 0) + episode(agent, 1, length=1)
    rows = agent.state().arrays
    assert rows["replay/rgb"][:, 0, 0, 0].tolist() == [0, 1, 2, 3, 10, 11], "each frame once, an episode's last too"
    assert rows["replay/rewards"].ravel().tolist() == [0, 1, 2, 3, 0, 11], "a reward stands where it arrives"
    assert rows["replay/is_first"].ravel().tolist() == [1, 0, 0, 0, 1, 0]
    assert rows["replay/terminated"].ravel().tolist() == [0, 0, 0, 1, 0, 0]
    assert rows["replay/truncated"].ravel().tolist() == [0, 0, 0, 0, 0, 1]
    taken = [*actions[:3], None, actions[3], None]
    assert [int(row.argmax()) if row.any() else None for row in rows["replay/actions"]] == taken


def test_sequences_are_whole_and_begin_anywhere() -> None:
    memory = SequenceReplay(capacity=5)
    for value in range(8):
        memory.add({"n": np.array([value])})
    drawn = memory.sample(200, 3, np.random.default_rng(0))["n"][..., 0]
    assert drawn.shape == (3, 200) and (np.diff(drawn, axis=0) == 1).all()
    assert set(drawn[0].tolist()) == {3, 4, 5}, "the oldest are forgotten, the newest are reached"
    assert memory.sample(2, 9, np.random.default_rng(0))["n"].shape == (5, 2, 1), "as many as there are"


def test_the_target_follows_the_critic(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = learner(learning_starts=1000)
    episode(agent, 0)
    monkeypatch.setattr(dreamer.library, "train", lambda *_: None)
    critic, target = (next(network.parameters()) for network in (agent.critic, agent.target))
    rate = agent.config.algo.critic.tau
    for number, share in ((1.0, 1.0), (2.0, rate)):
        before = target.detach().clone()
        with torch.no_grad():
            critic.fill_(number)
        agent.update()
        assert (critic == number).all(), "the critic learns by its own loss alone"
        torch.testing.assert_close(target.detach(), before + share * (number - before))


def test_settings_reach_the_part_that_they_name() -> None:
    """The first step of Adam moves weights by at most the learning rate, and some by nearly that."""
    given = {"discount": 0.9, "return_decay": 0.8, "entropy": 0.01}
    rates = {"actor": 1e-3, "critic": 1e-5}
    agent = learner(learning_starts=1000, **given, **{f"{part}_learning_rate": rate for part, rate in rates.items()})
    algo = agent.config.algo
    assert [algo.gamma, algo.lmbda, algo.actor.ent_coef] == [*given.values()]
    episode(agent, 0)
    before = agent.state().arrays
    agent.update()
    moved = {name: np.abs(agent.state().arrays[name] - before[name]).max() for name in before if "/weight" in name}
    for part, rate in rates.items():
        assert max(moved[name] for name in moved if name.startswith(part)) == pytest.approx(rate, rel=0.1)


def test_it_sees_latents_where_there_is_an_encoder() -> None:
    file = bundled_encoder("arrow_puzzle-clean")
    agent = learner(encoder=file, learning_starts=2)
    episode(agent, 0)
    rows = agent.state().arrays
    assert "replay/rgb" not in rows and not any("conv" in name for name in rows)
    wanted = Encoder.load(file).latents(seen(2).frame)
    assert np.array_equal(rows["replay/latents"][2], wanted) and agent.updates == 1


@pytest.mark.parametrize("validated", [True, False])
def test_updates_follow_the_ratio_and_what_is_global_is_left_alone(validated: bool) -> None:
    """The generator, and whether distributions of others are validated."""
    agent = learner(learning_starts=2, replay_ratio=0.7)
    distribution = torch.distributions.Distribution
    default = distribution._validate_args
    before = torch.get_rng_state()
    distribution.set_default_validate_args(validated)
    try:
        episode(agent, 0)
        episode(agent, 1, length=1)
        assert distribution._validate_args is validated
    finally:
        distribution.set_default_validate_args(default)
    assert torch.equal(before, torch.get_rng_state()) and agent.updates == 2, "0.7 a step, from the second of four"


def test_a_memory_of_the_episode_decides_its_beliefs() -> None:
    agent = learner()
    beliefs = []
    for begins in (True, False, True):
        if begins:
            agent.begin_episode()
        agent.act(seen(0), explore=False)
        beliefs.append(agent.player.recurrent_state.clone())
    assert torch.equal(beliefs[0], beliefs[2]) and not torch.equal(beliefs[0], beliefs[1])
