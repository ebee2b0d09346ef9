"""Agents with memory, on a stand-in for an encoder: what is remembered, replayed and imagined."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from fake_latents import ACTIONS, CODES, LATENTS, SMALL, FakeEncoder, context, frame, transition
from imagine_bench.agents.memory import imagination
from imagine_bench.agents.memory.agent import RememberingAgent
from imagine_bench.agents.memory.readout import last_seen
from imagine_bench.agents.memory.recurrence import START, Recurrence
from imagine_bench.agents.memory.sequences import SequenceMemory
from imagine_bench_controls import drqn

from imagine_bench import registry
from imagine_bench.interfaces import Observation

UNITS = 5
RECURRENT: dict[str, Any] = {
    "recurrence.units": UNITS, "recurrence.burn_in": 2, "recurrence.sequence": 3, "model.members": 3,
    "model.dropout": 0.0, "controller.epsilon_decay": 0.02,
}  # fmt: skip
MAKERS = {"drqn": drqn.make, "imagination_memory": imagination.make}


def make(monkeypatch: pytest.MonkeyPatch, name: str, **overrides: Any) -> RememberingAgent:
    given = registry.own_settings(name, {**SMALL, **RECURRENT, **overrides})
    return MAKERS[name](replace(context(monkeypatch, hyperparameters="fast"), overrides=given))


def recall(agent: RememberingAgent, episodes: range, rng: np.random.Generator) -> None:
    """Training in a world where the second macro-action is to be what the first frame said."""
    for number in episodes:
        agent.begin_episode()
        cue = int(rng.integers(ACTIONS))
        for step, shown in enumerate((1 + cue, 0)):
            action = agent.act(Observation(frame=frame(shown)), explore=True)
            reward = (1.0 if action == cue else -1.0) if step else 0.0
            agent.observe(transition(shown, action, reward, 0, terminated=step == 1), episode=number)


def second(agent: RememberingAgent, cue: int) -> int:
    """What is done greedily after the cue was shown and something was done."""
    agent.begin_episode()
    agent.act(Observation(frame=frame(1 + cue)), explore=False)
    return agent.act(Observation(frame=frame(0)), explore=False)


def remembered(agent: RememberingAgent, frames: list[int], actions: list[int]) -> torch.Tensor:
    """The state of the last frame."""
    return agent.perception.recall([frame(each) for each in frames], actions)[0]


LEARNING: dict[str, Any] = {
    "recurrence.units": 16, "controller.learning_rate": 5e-3, "model.batch_size": 16, "model.spread": 1.0,
    "model.learning_rate": 5e-3, "model.reward_hidden": (32,), "controller.epsilon_decay": 0.01,
    "memory.imagined": 200, "memory.real": 1000,
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "episodes"), [("drqn", 120), pytest.param("imagination_memory", 260, marks=pytest.mark.slow)]
)
def test_what_the_first_frame_said_is_done_later(monkeypatch: pytest.MonkeyPatch, name: str, episodes: int) -> None:
    agent = make(monkeypatch, name, **LEARNING)
    recall(agent, range(episodes), np.random.default_rng(0))
    assert [second(agent, cue) for cue in range(ACTIONS)] == list(range(ACTIONS))


@pytest.mark.parametrize("name", MAKERS)
def test_acting_greedily_changes_nothing(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    agent = make(monkeypatch, name)
    recall(agent, range(4), np.random.default_rng(1))
    before = agent.state()
    chosen = [second(agent, cue) for cue in (1, 2, 1)]
    after = agent.state()
    assert chosen[0] == chosen[2]
    assert all(np.array_equal(before.arrays[key], after.arrays[key]) for key in before.arrays)
    assert before.values == after.values


@pytest.mark.parametrize("name", MAKERS)
def test_a_restored_agent_goes_on_in_the_same_bits(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    whole, again = make(monkeypatch, name), make(monkeypatch, name)
    recall(whole, range(5), np.random.default_rng(2))
    again.restore(whole.state())
    for agent in (whole, again):
        recall(agent, range(5, 9), np.random.default_rng(3))
    one, other = whole.state(), again.state()
    assert [key for key in one.arrays if one.arrays[key].tobytes() != other.arrays[key].tobytes()] == []


def test_memory_depends_on_every_frame_and_action(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = make(monkeypatch, "drqn")
    found = remembered(agent, [1, 0, 0], [0, 2])
    assert torch.equal(found[:LATENTS], CODES[0])
    for frames, actions in (([2, 0, 0], [0, 2]), ([1, 0, 0], [1, 2]), ([1, 0, 0], [0, 0]), ([0], [])):
        state = remembered(agent, frames, actions)
        assert torch.equal(state[:LATENTS], found[:LATENTS]) and not torch.allclose(state[LATENTS:], found[LATENTS:])


def test_what_is_seen_while_acting_is_the_state_and_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = make(monkeypatch, "drqn")
    frames = [frame(1), frame(0), frame(2)]
    actions = [agent.act(Observation(frame=each), explore=False) for each in frames[:2]]
    whole = remembered(agent, [1, 0, 2], actions)
    assert torch.equal(agent.perceive(frames[1]), remembered(agent, [1, 0], actions[:1])), "it was acted on"
    assert torch.equal(agent.perceive(frames[2]), whole), "it would be the next"
    agent.begin_episode()
    assert torch.equal(agent.perceive(frames[2]), remembered(agent, [2], []))


def test_what_is_lived_is_stored_by_step(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = make(monkeypatch, "drqn", **{"controller.updates_per_step": 0})
    agent.observe(transition(1, 2, 0.0, 4), episode=0)  # of a demonstrator: the agent did not act
    agent.observe(transition(4, 0, 0.0, 5, truncated=True), episode=0)
    agent.observe(transition(3, 1, 0.0, 2), episode=1)
    rows = agent.real.arrays()
    assert rows["step"].tolist() == [0, 1, 0] and rows["before"].tolist() == [START, 2, START]
    first = remembered(agent, [1], [])[LATENTS:].numpy()
    assert np.allclose(
        rows["stored"], np.stack([np.zeros(UNITS, np.float32), first, np.zeros(UNITS, np.float32)]), atol=1e-6
    )


def filled(
    capacity: int, lengths: list[int], burn_in: int, stored: bool = True
) -> tuple[SequenceMemory, Recurrence, list[list[torch.Tensor]]]:
    """A memory of episodes whose latents are their numbers, and the memory after each observation of each episode."""
    network = Recurrence(1, 2, UNITS, torch.Generator().manual_seed(0))
    memory = SequenceMemory(capacity, 1, torch.device("cpu"), units=UNITS, burn_in=burn_in, recurrence=lambda: network)
    truth, rng = [], np.random.default_rng(0)
    for length in lengths:
        seen, actions = (
            torch.tensor(rng.normal(size=(length + 1, 1)), dtype=torch.float32),
            rng.integers(2, size=length),
        )
        previous = torch.tensor([[START, *actions.tolist()]])
        with torch.no_grad():
            after = network(seen.unsqueeze(0), previous, network.blank(1))[0]
        truth.append([torch.cat([seen, after], dim=1)[t] for t in range(length + 1)])
        for t in range(length):
            before = after[t - 1] if t else network.blank(1)[0]
            memory.add_step(
                (seen[t], torch.zeros(1)), int(actions[t]), 100.0 * len(truth) + t, (seen[t + 1], torch.zeros(1)),
                t == length - 1, step=t, before=int(previous[0, t]),
                stored=before if stored else torch.full((UNITS,), 9.0),
            )  # fmt: skip
    return memory, network, truth


@pytest.mark.parametrize(("burn_in", "stored"), [(0, True), (2, True), (9, True), (9, False)])
def test_replayed_states_are_those_of_the_episode(burn_in: int, stored: bool) -> None:
    # burn-in that reaches back to the start of an episode needs nothing that was stored... but where it begins blank
    memory, network, truth = filled(64, [3, 5, 1, 4], burn_in)
    if not stored:
        memory._columns["stored"][memory._columns["step"] > 0] = 9.0
    sequences = memory.draw(200, 3, torch.Generator().manual_seed(1))
    states = sequences.states(network)
    batch = sequences.transitions(states, states)
    assert len(batch.z) == int(sequences.valid.sum()) > 200
    starts = set()
    for z, next_z, reward, terminated in zip(batch.z, batch.next_z, batch.reward, batch.terminated, strict=True):
        number, t = divmod(int(reward), 100)
        own = truth[number - 1]
        assert torch.allclose(z, own[t], atol=1e-6) and torch.allclose(next_z, own[t + 1], atol=1e-6)
        assert bool(terminated) == (t == len(own) - 2)
        starts.add((number, t))
    assert len(starts) == 13, "every transition is replayed"


def test_a_full_ring_replays_whole_pieces_only() -> None:
    memory, _, truth = filled(7, [4, 4, 5], burn_in=9)
    batch = memory.sample(300, torch.Generator().manual_seed(2))
    kept = {divmod(int(reward), 100) for reward in batch.reward}
    assert kept == {(2, 2), (2, 3), *((3, t) for t in range(5))}
    for z, reward in zip(batch.z, batch.reward, strict=True):
        number, t = divmod(int(reward), 100)
        assert torch.allclose(z, truth[number - 1][t], atol=1e-6), "what was overwritten is stood in for by the stored"


def test_no_gradient_goes_through_the_burn_in() -> None:
    memory, network, _ = filled(64, [6, 6], burn_in=9)
    sequences = memory.draw(16, 2, torch.Generator().manual_seed(3))
    sequences.burn_z.requires_grad_()
    sequences.z.requires_grad_()
    sequences.states(network).sum().backward()
    assert sequences.burn_z.grad is None and sequences.z.grad is not None and bool(sequences.z.grad.any())


def test_rollouts_carry_what_they_imagine(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = make(monkeypatch, "imagination_memory")
    assert isinstance(agent, imagination.ImaginingMemoryAgent)
    own, model = agent.imagination, agent.imagination.model
    state = agent.perceive(frame(2)).unsqueeze(0)
    generator = torch.Generator().manual_seed(0)
    weights = own.draw_weights(generator)
    latents, actions = [state[:, :LATENTS]], [1, 2, 0]
    for action in actions:
        state = own.step(state, torch.tensor([action]), weights, generator).next_z
        latents.append(state[:, :LATENTS])
    with torch.no_grad():
        whole = model.recurrence(torch.stack(latents, dim=1), torch.tensor([[START, *actions]]), torch.zeros(1, UNITS))
    assert torch.allclose(state[:, LATENTS:], whole[:, -1], atol=1e-6)


def test_a_model_trained_on_sequences_learns_to_remember(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = make(monkeypatch, "imagination_memory")
    recall(agent, range(3), np.random.default_rng(1))
    before = [weight.detach().clone() for weight in agent.recurrence.parameters()]
    agent.learn_model()
    assert all(not torch.equal(old, new) for old, new in zip(before, agent.recurrence.parameters(), strict=True))


def test_a_new_task_keeps_dynamics_and_what_remembers(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = make(monkeypatch, "imagination_memory")
    recall(agent, range(4), np.random.default_rng(1))
    old = agent.imagination.model
    agent.reset_for_new_task()
    new = agent.imagination.model
    for part in ("dynamics", "recurrence"):
        pairs = zip(getattr(old, part).parameters(), getattr(new, part).parameters(), strict=True)
        assert all(torch.equal(one, other) for one, other in pairs)
    heads = zip(old.head.parameters(), new.head.parameters(), strict=True)
    assert not all(torch.equal(one, other) for one, other in heads) and len(agent.real) == 0


def test_lone_frames_begin_without_a_past(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = make(monkeypatch, "imagination_memory")
    lone, _ = agent.perception.posterior(frame(3))
    assert torch.allclose(lone, agent.perceive(frame(3)), atol=1e-6)
    mu, sigma = agent.perception.encoder.encode(np.stack([frame(3), frame(1)]))
    assert torch.allclose(mu[0], lone, atol=1e-6) and not sigma[:, LATENTS:].any()
    assert agent.read_frames(np.stack([frame(4)])).tolist() == FakeEncoder().read_macrostate(CODES[4:5]).tolist()


def test_last_seen_is_the_newest_value_of_each_coordinate() -> None:
    read = np.array([[1, 2], [0, 0], [1, 1], [1, 2]])  # of coordinates of 2 and 2 values: 2 is "not seen"
    assert last_seen(read, (2, 2)).tolist() == [[1, -1], [0, 0], [1, 1], [1, 1]]


NOT_SEEN = 99


def read_cue(_: Any, z: torch.Tensor) -> np.ndarray:
    """The cue that a frame shows, if it shows one."""
    state = torch.cdist(z, CODES).argmin(dim=1, keepdim=True).numpy()
    return np.where(state == 0, NOT_SEEN, state - 1)


def test_a_read_out_finds_what_the_first_frame_said(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = make(monkeypatch, "drqn", **{"recurrence.units": 32, "controller.updates_per_step": 0})
    monkeypatch.setattr(FakeEncoder, "read_macrostate", read_cue)
    recall(agent, range(60), np.random.default_rng(4))
    before, blank = agent.state(), frame(0)
    for cue in range(ACTIONS):
        agent.begin_episode()
        for shown in (frame(1 + cue), blank):
            agent.act(Observation(frame=shown), explore=False)
        assert agent.read_memory(blank, (ACTIONS,)).tolist() == [cue], "and the blank frame shows no cue"
    after = agent.state()
    assert all(np.array_equal(before.arrays[key], after.arrays[key]) for key in before.arrays)
