"""Agents with memory, on a stand-in for an encoder: memory, replay and imagination."""

from __future__ import annotations

from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from fake_latents import ACTIONS, CODES, LATENTS, FakeEncoder, built, frame, transition, with_own_settings
from imagine_bench.agents.encoders.perception import Perception
from imagine_bench.agents.imagination.vector_env import imagined_env
from imagine_bench.agents.replay import Batch
from imagine_bench.agents.world_models import latent
from imagine_bench_controls.memory import drqn, imagination, readout, world_model
from imagine_bench_controls.memory.agent import RememberingAgent
from imagine_bench_controls.memory.imagination import ImaginingMemoryAgent
from imagine_bench_controls.memory.sequences import START, Recurrence, SequenceMemory

from imagine_bench.interfaces import AgentState, Frame, Observation
from imagine_bench.interfaces.episodes import joined

UNITS = 16
RECURRENT: dict[str, Any] = {
    "recurrence.units": UNITS,
    "recurrence.burn_in": 2,
    "recurrence.sequence": 3,
    "model.members": 3,
    "model.dropout": 0.0,
    "model.batch_size": 16,
    "model.spread": 1.0,
    "model.learning_rate": 5e-3,
    "model.reward_hidden": (32,),
    "controller.learning_rate": 5e-3,
    "controller.epsilon_decay": 0.01,
    "memory.imagined": 200,
    "memory.real": 1000,
}
MAKERS = {"drqn": drqn.make, "imagination_memory": imagination.make}


def make(name: str, **overrides: Any) -> RememberingAgent:
    return built(with_own_settings(name, MAKERS[name]), {**RECURRENT, **overrides}, hyperparameters="fast")


def recall(agent: RememberingAgent, episodes: range, rng: np.random.Generator) -> None:
    """Training in a world where the second macro-action is to be as the first frame said."""
    for number in episodes:
        agent.begin_episode()
        cue = int(rng.integers(ACTIONS))
        for step, shown in enumerate((1 + cue, 0)):
            action = agent.act(Observation(frame=frame(shown)), explore=True)
            reward = (1.0 if action == cue else -1.0) if step else 0.0
            agent.observe(transition(shown, action, reward, 0, terminated=step == 1), episode=number)


def second(agent: RememberingAgent, cue: int) -> int:
    """The greedy action after the cue was shown and something was done."""
    agent.begin_episode()
    agent.act(Observation(frame=frame(1 + cue)), explore=False)
    return agent.act(Observation(frame=frame(0)), explore=False)


def remembered(agent: RememberingAgent, frames: list[int], actions: list[int]) -> torch.Tensor:
    """The state of the last frame."""
    return agent.perception.recall([frame(each) for each in frames], actions)[0]


@pytest.mark.parametrize(
    ("name", "episodes"), [("drqn", 120), pytest.param("imagination_memory", 260, marks=pytest.mark.slow)]
)
def test_what_the_first_frame_said_is_done_later(name: str, episodes: int) -> None:
    agent = make(name)
    recall(agent, range(episodes), np.random.default_rng(0))
    assert [second(agent, cue) for cue in range(ACTIONS)] == list(range(ACTIONS))


def test_what_is_seen_while_acting_is_the_state_and_is_forgotten() -> None:
    agent = make("drqn")
    frames = [frame(1), frame(0), frame(2)]
    actions = [agent.act(Observation(frame=each), explore=False) for each in frames[:2]]
    whole = remembered(agent, [1, 0, 2], actions)
    assert torch.equal(agent.perceive(frames[1]), remembered(agent, [1, 0], actions[:1])), "it was acted on"
    assert torch.equal(agent.perceive(frames[2]), whole), "it would be the next"
    kept = agent.state()
    for forget in (agent.begin_episode, lambda: agent.restore(kept)):
        agent.act(Observation(frame=frames[0]), explore=False)
        forget()
        assert torch.equal(agent.perceive(frames[2]), remembered(agent, [2], []))


def test_what_is_lived_is_stored_by_step() -> None:
    agent = make("drqn", **{"controller.updates_per_step": 0})
    agent.observe(transition(1, 2, 0.0, 4), episode=0)  # of a demonstrator: the agent did not act
    agent.observe(transition(4, 0, 0.0, 5, truncated=True), episode=0)
    agent.observe(transition(3, 1, 0.0, 2), episode=1)
    rows = agent.real.arrays()
    assert rows["step"].tolist() == [0, 1, 0]
    assert rows["before"].tolist() == [START, 2, START]
    first = remembered(agent, [1], [])[LATENTS:].numpy()
    assert np.allclose(rows["stored"], np.stack([0.0 * first, first, 0.0 * first]), atol=1e-6)


def filled(
    capacity: int, lengths: list[int], burn_in: int, stored: bool = True
) -> tuple[SequenceMemory, Recurrence, list[torch.Tensor]]:
    """A memory of random episodes, and each episode's states, latents and memory side by side: (length + 1, 1 + UNITS).

    Without ``stored``, the memory stored at all steps but the first is wrong.
    """
    network = Recurrence(1, 2, UNITS, torch.Generator().manual_seed(0))
    memory = SequenceMemory(capacity, 1, torch.device("cpu"), units=UNITS, burn_in=burn_in, recurrence=lambda: network)
    truth: list[torch.Tensor] = []
    rng = np.random.default_rng(0)
    for number, length in enumerate(lengths, start=1):
        seen = torch.tensor(rng.normal(size=(length + 1, 1)), dtype=torch.float32)
        actions = rng.integers(2, size=length).tolist()
        previous = [START, *actions]
        with torch.no_grad():
            after = network(seen.unsqueeze(0), torch.tensor([previous]), network.blank(1))[0]
        truth.append(torch.cat([seen, after], dim=1))
        before = [network.blank(1)[0], *(after if stored else torch.full_like(after, 9.0))]
        for t, action in enumerate(actions):
            now, then = ((seen[t + by], torch.zeros(1)) for by in (0, 1))
            held = {"step": t, "before": previous[t], "stored": before[t]}
            memory.add_step(now, action, 100.0 * number + t, then, t == length - 1, **held)
    return memory, network, truth


@pytest.mark.parametrize(("burn_in", "stored"), [(0, True), (2, True), (9, False)])
def test_replayed_states_are_those_of_the_episode(burn_in: int, stored: bool) -> None:
    """Burn-in that reaches back to the start of an episode needs nothing that was stored."""
    memory, network, truth = filled(64, [3, 5, 1, 4], burn_in, stored)
    sequences = memory.draw(200, 3, torch.Generator().manual_seed(1))
    states = sequences.states(network)
    batch = sequences.transitions(states, states)
    assert len(batch.z) == int(sequences.valid.sum()) > 200
    starts = set()
    for z, next_z, reward, terminated in zip(batch.z, batch.next_z, batch.reward, batch.terminated, strict=True):
        number, t = divmod(int(reward), 100)
        own = truth[number - 1]
        assert torch.allclose(torch.stack([z, next_z]), own[t : t + 2], atol=1e-6)
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
        assert torch.allclose(z, truth[number - 1][t], atol=1e-6), "the stored memory stands in for overwritten steps"


@pytest.mark.parametrize(("rate", "moves"), [(1e-6, False), (1.0, True)])
def test_targets_remember_with_the_target_network(rate: float, moves: bool) -> None:
    """Updates move the states of the values. The states of the targets move at the rate of the target network."""
    agent = make("drqn", **{"controller.target_rate": rate})
    recall(agent, range(4), np.random.default_rng(0))
    begun = agent.state()
    before = agent.draw_batch(agent.real)
    for _ in range(5):
        agent.controller.update(agent.draw_batch(agent.real))
    generator = "generator/replay"
    learned = agent.state()
    arrays = {**learned.arrays, generator: begun.arrays[generator]}
    agent.restore(AgentState(arrays=arrays, values=learned.values))
    after = agent.draw_batch(agent.real)
    assert torch.equal(after.action, before.action) and torch.equal(after.reward, before.reward), "the same transitions"
    assert (after.z - before.z).abs().max() > 1e-3
    assert ((after.next_z - before.next_z).abs().max() > 1e-3) == moves


def test_no_gradient_goes_through_the_burn_in() -> None:
    memory, network, _ = filled(64, [6, 6], burn_in=9)
    sequences = memory.draw(16, 2, torch.Generator().manual_seed(3))
    for part in (sequences.burn_z, sequences.z):
        part.requires_grad_()
    sequences.states(network).sum().backward()
    assert sequences.burn_z.grad is None
    assert sequences.z.grad is not None and sequences.z.grad.any()


def test_rollouts_carry_what_they_imagine() -> None:
    agent = make("imagination_memory")
    assert isinstance(agent, imagination.ImaginingMemoryAgent)
    own = agent.imagination
    state = agent.perceive(frame(2)).unsqueeze(0)
    generator = torch.Generator().manual_seed(0)
    weights = own.draw_weights(generator)
    latents = [state[:, :LATENTS]]
    actions = [1, 2, 0]
    for action in actions:
        state = own.step(state, torch.tensor([action]), weights, generator).next_z
        latents.append(state[:, :LATENTS])
    previous = torch.tensor([[START, *actions]])
    with torch.no_grad():
        whole = own.model.recurrence(torch.stack(latents, dim=1), previous, torch.zeros(1, UNITS))
    assert torch.allclose(state[:, LATENTS:], whole[:, -1], atol=1e-6)


def test_the_world_model_remembers_frames_and_macro_actions(monkeypatch: pytest.MonkeyPatch) -> None:
    """In its training, where each reward names a transition, and before it imagines."""
    monkeypatch.setattr(
        FakeEncoder,
        "encode",
        lambda self, frames: (CODES[frames[:, 0, 0, 0].astype(int)], torch.zeros(len(frames), LATENTS)),
    )
    monkeypatch.setattr(latent, "UPDATES", 5)
    with mock.patch(
        "imagine_bench_controls.memory.world_model.load_perception", lambda context: Perception(FakeEncoder())
    ):
        model = built(world_model.make, hyperparameters="minimal")
    rng = np.random.default_rng(0)
    lived = []
    for number, length in enumerate((4, 1, 3)):
        actions = rng.integers(ACTIONS, size=length)
        lived.append(
            {
                "frames": np.stack([frame(int(each)) for each in rng.integers(6, size=length + 1)]),
                "actions": actions, "rewards": 10.0 * number + np.arange(length),
                "terminated": np.arange(length) == length - 1, "truncated": np.zeros(length, dtype=bool),
                "success": True, "action_masks": np.ones((length + 1, ACTIONS), dtype=np.int8),
            }
        )  # fmt: skip
    recurrence = model.imagination.model.recurrence

    def states(frames: Frame, actions: list[int]) -> torch.Tensor:
        z = CODES[frames[:, 0, 0, 0].astype(int)].unsqueeze(0)
        with torch.no_grad():
            memory = recurrence(z, torch.tensor([[START, *actions]]), recurrence.blank(1))
        return torch.cat([z, memory], dim=-1)[0]

    dataset = joined(lived)
    batches: list[Batch] = []
    monkeypatch.setattr(model.imagination.model, "update", lambda batch, generator: batches.append(batch))
    model.fit(dataset, np.random.default_rng(1))
    assert len(batches) == 5
    met = set()
    for batch in batches:
        for z, next_z, reward in zip(batch.z.detach(), batch.next_z.detach(), batch.reward.tolist(), strict=True):
            number, step = divmod(int(reward), 10)
            own = states(lived[number]["frames"], lived[number]["actions"].tolist())
            assert torch.allclose(torch.stack([z, next_z]), own[step : step + 2], atol=1e-6)
            met.add((number, step))
    assert len(met) == 8
    first = lived[0]
    asked = np.array([[*first["actions"][:2], other] for other in range(ACTIONS)])
    found = model.states(np.repeat(first["frames"][None, :3], ACTIONS, axis=0), asked)
    own = states(first["frames"][:3], first["actions"][:2].tolist())[-1]
    assert torch.allclose(found, own.expand(ACTIONS, -1), atol=1e-6), (
        "a macro-action that is asked about is none before it"
    )


def test_a_new_task_keeps_dynamics_and_recurrence() -> None:
    agent = make("imagination_memory")
    recall(agent, range(4), np.random.default_rng(1))
    old = agent.imagination.model
    agent.reset_for_new_task()
    new = agent.imagination.model

    def kept(part: str) -> bool:
        pairs = zip(getattr(old, part).parameters(), getattr(new, part).parameters(), strict=True)
        return all(torch.equal(one, other) for one, other in pairs)

    assert [part for part in ("dynamics", "recurrence", "head") if kept(part)] == ["dynamics", "recurrence"]
    assert len(agent.real) == 0
    recall(agent, range(1), np.random.default_rng(1))
    assert not kept("recurrence")


class _Sign:
    """Reads the sign of a latent of one dimension."""

    device = torch.device("cpu")

    def read_macrostate(self, z: torch.Tensor) -> np.ndarray:
        return (z > 0.0).long().numpy()


@pytest.mark.parametrize("lengths", [[6], [3, 9]])
def test_a_read_out_is_fitted_on_every_episode_the_newest_too(lengths: list[int]) -> None:
    """Of T + 1 dimensions in T steps a ridge regression finds every label: those of the newest episode, too."""
    memory, network, truth = filled(64, lengths, burn_in=0)
    found = readout.fit(memory, network, _Sign(), (2,))  # type: ignore[arg-type]
    assert found.sizes == (2,), "something was seen"
    newest = truth[-1][:-1]
    read = [int(found(state[1:])[0]) for state in newest]
    assert np.mean(np.array(read) == (newest[:, 0] > 0.0).numpy()) > 0.7


def test_the_newest_value_stays_until_another_is_seen() -> None:
    """Of two and of three values: 2 and 3 are none."""
    read = np.array([[2, 0], [0, 9], [1, 3], [2, 1]])
    assert readout.last_seen(read, (2, 3)).tolist() == [[readout.NEVER_SEEN, 0], [0, 0], [1, 0], [1, 1]]


class CueEncoder(FakeEncoder):
    """Reads the cue that a frame shows, or that it shows none."""

    def read_macrostate(self, z: torch.Tensor) -> np.ndarray:
        state = super().read_macrostate(z)
        return np.where(state == 0, 99, state - 1)


def test_a_read_out_finds_what_the_first_frame_said() -> None:
    agent = make("drqn", **{"recurrence.units": 32, "controller.updates_per_step": 0})
    agent.perception.plain.encoder = CueEncoder()
    rng = np.random.default_rng(4)
    blank = frame(0)
    recall(agent, range(1), rng)
    agent.read_memory(blank, (ACTIONS,))  # which is made anew after more steps
    recall(agent, range(1, 60), rng)
    for cue in range(ACTIONS):
        agent.begin_episode()
        for shown in (frame(1 + cue), blank):
            agent.act(Observation(frame=shown), explore=False)
        assert agent.read_memory(blank, (ACTIONS,)).tolist() == [cue], "and the blank frame shows no cue"


@pytest.mark.parametrize("how", ["reset_for_new_task", "restore"])
def test_a_read_out_is_of_the_present_world_alone(how: str) -> None:
    """As many steps as in the world before, where frames showed a cue."""

    def live(agent: RememberingAgent, shown: int) -> list[int]:
        agent.perception.plain.encoder = CueEncoder()
        for episode in range(3):
            agent.begin_episode()
            agent.observe(transition(shown, 0, 0.0, 0, terminated=True), episode=episode)
        agent.begin_episode()
        return agent.read_memory(frame(0), (ACTIONS,)).tolist()

    agent, other = (make("imagination_memory") for _ in range(2))
    assert live(agent, shown=2) == [1]
    assert live(other, shown=0) == [readout.NEVER_SEEN]
    if how == "restore":
        agent.restore(other.state())
        assert agent.read_memory(frame(0), (ACTIONS,)).tolist() == [readout.NEVER_SEEN]
    else:
        agent.reset_for_new_task()
        assert live(agent, shown=0) == [readout.NEVER_SEEN]


def test_an_imagined_world_begins_in_states_with_their_memory() -> None:
    """A state is the latents and the memory after a frame, from the memory that was stored before it."""
    agent = make("imagination_memory", **{"controller.updates_per_step": 0, "imagination.start_episode": 100})
    assert isinstance(agent, ImaginingMemoryAgent)
    with mock.patch.object(agent, "learn_model"):  # the network stays as it was, so that nothing stored is out of date
        recall(agent, range(3), np.random.default_rng(0))
    env = imagined_env(agent, num_envs=2)
    actions = agent.real.arrays()["action"]
    for row, cue in enumerate(agent.real.arrays()["mu"][::2]):
        frames = [frame(int(FakeEncoder().read_macrostate(torch.as_tensor(cue)[None])[0, 0])), frame(0)]
        for step in (0, 1):
            wanted = agent.perception.recall(frames[: step + 1], actions[2 * row : 2 * row + step].tolist())[0]
            assert env.starts[2 * row + step] == pytest.approx(wanted.numpy(), abs=1e-6)
    assert env.reset(seed=0)[0].shape == (2, LATENTS + UNITS)
    assert np.isfinite(env.step(np.array([0, 1]))[1]).all()
