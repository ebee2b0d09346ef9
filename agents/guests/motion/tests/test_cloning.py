"""Behaviour cloning: instructions, demonstrations, and the commands of a policy."""

from __future__ import annotations

import functools
import itertools
from collections import Counter
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, cast
from unittest import mock

import numpy as np
import pytest
import torch
from imagine_bench.tasks.motion.arm_model import ArmModel
from imagine_bench.tasks.scenes.constants import OBSERVATION_QPOS_RAD, TABLE_HEIGHT_M
from imagine_bench_motion import trials
from imagine_bench_motion.cloned_env import BUNDLED
from imagine_bench_motion.cloning import Clone, Standardisation, Training, _varied, train
from imagine_bench_motion.demonstrations import DemonstrationData, collect, turn_of
from imagine_bench_motion.instruction import GO_BACK, words_vector
from imagine_bench_motion.network import ChunkPolicy, PointEncoder, PolicyLayout, new_network
from imagine_bench_motion.skills import begin, skill_env
from imagine_bench_motion.trials import MOST_PERIODS, Try, share_done, summary, tries
from numpy.typing import NDArray
from scripted_clone import ScriptedClone

from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.registry import task

VECTORS = "proprio,objects"


@functools.cache
def demonstrations() -> DemonstrationData:
    return collect(4, seed=5, observation=VECTORS)


@functools.cache
def clone() -> Clone:
    return train(demonstrations(), seed=0, observation=VECTORS, settings=Training(updates=50))


def test_each_macro_action_has_words_of_its_own_in_any_order_and_case() -> None:
    for cubes in (1, 6):
        names = (*task(f"arrows:cubes={cubes}").action_names, GO_BACK)
        assert len({words_vector(name).tobytes() for name in names}) == len(names)
    np.testing.assert_array_equal(words_vector("Turn the left cube."), words_vector("cube left the turn"))


def first_rows(data: DemonstrationData) -> NDArray[np.int64]:
    return np.unique(data.episode, return_index=True)[1]


def test_demonstrations_ask_for_the_turns_and_after_each_to_go_back() -> None:
    """Both appearances in turn, from different poses of the arm; every second one is disturbed."""
    data = demonstrations()
    names = task("arrow_puzzle").action_names
    joints_rad = data.numbers[:, -16:-9]
    hand_m = [ArmModel().tcp_in_base(command[:7])[0] for command in data.commands[::25]]
    np.testing.assert_allclose(data.hand_m[::25], hand_m, atol=1e-6, err_msg="the commands kept are the expert's own")
    for episode in range(data.count):
        rows = data.episode == episode
        words = data.instructions[rows].tolist()
        turn = names[turn_of(episode, 2, 6).macro_action]
        n_turn = words.count(turn)
        assert words == [turn] * n_turn + [GO_BACK] * (len(words) - n_turn)
        assert 20 < n_turn < len(words)
        jerk_rad = np.abs(np.diff(joints_rad[rows], n=4, axis=0)).mean()
        assert (jerk_rad > 0.0033) == (episode % 2 == 1), "a disturbed arm moves jerkily"
    assert (joints_rad[first_rows(data)].std(axis=0) > 0.01).all()


def test_demonstrations_depend_on_the_seed_and_come_back(tmp_path: Path) -> None:
    data = demonstrations()
    again = collect(4, seed=5, observation=VECTORS)
    np.testing.assert_array_equal(again.numbers, data.numbers)
    np.testing.assert_array_equal(again.commands, data.commands)
    assert not np.array_equal(collect(1, seed=6, observation=VECTORS).numbers[0], data.numbers[0])
    data.save(tmp_path / "some")
    kept = DemonstrationData.load(tmp_path / "some")
    assert kept.observation == kept.first(2).observation == VECTORS
    assert kept.world == kept.first(2).world == "arrow_puzzle"
    with pytest.raises(InvalidValueError, match="The demonstrations show proprio,objects, not front,proprio; give"):
        train(kept, seed=0, observation="front,proprio", settings=Training(updates=1))
    with pytest.raises(InvalidValueError, match="chunk is 0; give an integer from 1 on"):
        train(kept, seed=0, observation=VECTORS, settings=Training(updates=1), layout={"chunk": 0})
    with pytest.raises(InvalidValueError, match="updates is 0; give an integer from 1 on"):
        Training(updates=0)
    np.testing.assert_array_equal(kept.commands, data.commands)
    assert kept.instructions.tolist() == data.instructions.tolist()
    assert kept.first(2).count == 2


@pytest.mark.parametrize("appearances", [1, 2, 3])
def test_half_of_each_macro_actions_demonstrations_are_disturbed(appearances: int) -> None:
    turns = [turn_of(index, appearances, 6) for index in range(4 * 6 * appearances)]
    cells = {turn[:2]: [other.disturbed for other in turns if other[:2] == turn[:2]] for turn in turns}
    assert len(cells) == 6 * appearances
    assert all(disturbed in ([False, True] * 2, [True, False] * 2) for disturbed in cells.values())
    if appearances == 2:
        assert sorted(turn.macro_action for turn in turns[:12] if turn.disturbed) == list(range(6))


def test_a_chunk_stays_within_its_demonstration() -> None:
    data = demonstrations()
    chunks = data.chunks(16)
    assert (data.episode[chunks] == data.episode[:, None]).all()
    assert (chunks[:, 0] == np.arange(len(chunks))).all()
    ends = np.flatnonzero(np.diff(data.episode))
    assert (chunks[ends] == ends[:, None]).all()
    grips = data.grips()
    assert (data.episode[grips] == data.episode).all()
    assert (data.hand_m[grips][:, 2] < TABLE_HEIGHT_M + 0.04).all()
    starts_m = data.numbers[first_rows(data)][:, :21].reshape(-1, 3, 7)[:, :, :2]
    off_m = np.linalg.norm(starts_m - data.hand_m[np.unique(grips)][:, None, :2], axis=2)
    assert (off_m.min(axis=1) < 1e-3).all(), "above a cube, as it stood at the start"


def test_fingers_that_start_close_do_not_grip_there() -> None:
    grips = [[0.02, 0.02, 0.6, 0.3, 0.05, 0.04, 0.6], [0.0, 0.0, 0.7], [0.6, 0.04, 0.04]]
    commands = np.concatenate(grips).astype(np.float32)[:, None]
    episode = np.repeat(np.arange(3), [len(each) for each in grips])
    data = replace(demonstrations(), commands=commands, episode=episode)
    assert np.unique(data.grips()).tolist() == [4, 7, 11]


def test_images_are_moved_as_far_as_is_said() -> None:
    images = np.zeros((5, 64, 64, 3), dtype=np.uint8)
    images[:, 30, 40] = 255
    generator = torch.Generator().manual_seed(0)
    settings = Training(shift_px=4)
    places = []
    for _ in range(20):
        varied, moved = _varied({"front": images}, torch.arange(5), settings, generator)
        row, column = divmod(int(varied["front"][0, 0].argmax()), 64)
        torch.testing.assert_close(moved, torch.tensor([column - 40.0, row - 30.0]) * 2 / 60)
        places.append((row, column))
    assert len(set(places)) > 10


class Brightness(torch.nn.Sequential):
    """Heat maps that mark what is bright."""

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return 100.0 * torch.nn.functional.avg_pool2d(images.mean(1, keepdim=True), 4).expand(-1, 2, -1, -1)


def test_a_point_moves_with_the_thing_that_it_marks() -> None:
    """By one cell of the heat map for four pixels, whatever the weights; the instruction alone says where to look.

    A place does not move with an image that was moved, as far as is told.
    """
    layout = PolicyLayout(cameras=("front",), numbers=1, commands=1, heat_maps=2)
    network = new_network(layout, 64, torch.Generator().manual_seed(0))
    encoder = cast(PointEncoder, network.encoders["front"])
    images = torch.full((1, 3, 64, 64), 0.4)
    moved = images.clone()
    images[:, :, 20:30, 20:30] = 1.0
    moved[:, :, 20:30, 24:34] = 1.0
    with torch.inference_mode():
        torch.testing.assert_close(encoder.what(images)[..., 3:12, 3:11], encoder.what(moved)[..., 3:12, 4:12])
        words = torch.from_numpy(np.stack([words_vector("left"), words_vector("right")]))
        left, right = encoder(images.expand(2, -1, -1, -1), words)
        encoder.what = Brightness()
        encoder.where.weight.zero_()
        encoder.where.bias.zero_()
        places = [
            network.look({"front": each}, words[:1], torch.tensor([px, 0.0]) * 2 / 60)
            for each, px in ((images, 0.0), (moved, 4.0), (moved, 0.0))
        ]
    assert not torch.equal(left, right)
    assert left.abs().max() <= 1.0
    torch.testing.assert_close(places[1], places[0])
    assert not torch.allclose(places[2], places[0])


@pytest.mark.parametrize("family", ["arrows", "pick_place"])
def test_a_skill_begins_where_its_macro_action_moves_an_object(family: str) -> None:
    """What is held at the start is held when the arm has gone off its observation pose."""
    env = skill_env("proprio", family=family)
    rng = np.random.default_rng(0)
    for macro_action in [*range(env.task.n_actions)] * 2:
        begin(env, macro_action, rng)
        state = env.episode.macrostate
        outcomes = env.task.rules.outcomes(state, macro_action)
        assert any(each.macrostate[:-1] != state[:-1] for each in outcomes)
        assert (env.episode.events, env.world.read().macrostate) == (0, state)
        off_rad = np.abs(env.servo_targets()[:7] - OBSERVATION_QPOS_RAD)
        assert 0.02 < off_rad.max() <= 0.08


def test_tries_are_counted_by_appearance_and_macro_action() -> None:
    done = Try(macro_action=1, appearance="clean", done=True, periods=10, fault="")
    failed = replace(done, appearance="mild", done=False, periods=76, fault="no event")
    assert summary([done, failed, done]) == {
        "count": 3,
        "done": 2,
        "mean_periods": 32.0,
        "by_appearance": {"clean": (2, 2), "mild": (0, 1)},
        "by_macro_action": {"1": (2, 3)},
        "failed": [asdict(failed)],
    }


def test_swapped_images_are_those_of_another_start() -> None:
    """Of the start that the same seed gives first; proprioception is that of the start that is tried."""
    watching = ScriptedClone(observation="front,proprio", size_px=32)
    for swapped in (False, True):
        tries(watching, 1, seed=3, appearances=["clean"], swapped=swapped, placement=0.03)
    assert len(watching.seen) == 2 * MOST_PERIODS
    first, second = watching.seen[:MOST_PERIODS], watching.seen[MOST_PERIODS:]
    for own, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(own["front"], other["front"])
    assert np.abs(first[0]["proprio"] - second[0]["proprio"]).max() > 0.01
    with pytest.raises(InvalidValueError, match="no images to swap"):
        tries(ScriptedClone(), 1, seed=3, swapped=True)


def test_every_macro_action_is_tried_at_every_appearance() -> None:
    def noted(env: Any, clone: object, macro_action: int, *others: object) -> tuple[str, int]:
        return env.world.level.name, macro_action

    with mock.patch.object(trials, "one_try", noted):
        found = tries(ScriptedClone(), 2 * 12, seed=0)
    assert Counter(found) == dict.fromkeys(itertools.product(("clean", "mild"), range(6)), 2)


class Counting(ChunkPolicy):
    """Predicts 10 n, 10 n + 1, ... at its n-th call."""

    def __init__(self) -> None:
        super().__init__(PolicyLayout(cameras=(), numbers=1, commands=1, chunk=3))
        self.calls = 0

    def forward(self, images: object, numbers: object, words: object) -> torch.Tensor:
        self.calls += 1
        return 10.0 * self.calls + torch.arange(3.0).reshape(1, 3, 1)


def test_a_command_is_the_mean_of_predictions_for_its_period() -> None:
    unit = Standardisation(mean=np.zeros(1, dtype=np.float32), deviation=np.ones(1, dtype=np.float32))
    policy = Clone(Counting(), unit, unit, {})
    policy.begin(GO_BACK)
    seen = {"proprio": np.zeros(1, dtype=np.float32)}
    found = [policy.act(seen).item() for _ in range(4)]
    due = ([10.0], [11.0, 20.0], [12.0, 21.0, 30.0], [22.0, 31.0, 40.0])
    expected = [np.average(each, weights=np.exp(-0.01 * np.arange(len(each)))) for each in due]
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    policy.begin(GO_BACK)
    assert policy.act(seen).item() == 50.0


def test_training_follows_its_seed_and_comes_nearer_to_the_expert() -> None:
    losses: list[float] = []
    settings = Training(updates=200, batch=32)
    train(demonstrations(), seed=0, observation=VECTORS, settings=settings, told=lambda _, loss: losses.append(loss))
    assert losses[1] < 0.7 * losses[0]
    again = train(demonstrations(), seed=0, observation=VECTORS, settings=Training(updates=50))
    for mine, other in zip(clone().network.parameters(), again.network.parameters(), strict=True):
        assert torch.equal(mine, other)


@pytest.mark.parametrize("heat_maps", [0, 4])
def test_a_clone_goes_where_its_two_cameras_show_the_thing(heat_maps: int) -> None:
    """One shows how far along, the other how far aside. The expert grips there in the second of three periods."""

    def shown(places: NDArray[np.int64]) -> NDArray[np.uint8]:
        return (
            (255 * (abs(np.arange(32) - places[:, None] - 2.5) < 3))[:, None, :, None]
            .repeat(32, 1)
            .repeat(3, 3)
            .astype(np.uint8)
        )

    places = np.random.default_rng(0).integers(2, 25, size=(100, 2)).repeat(3, axis=0)
    grips = np.tile([1.0, 0.0, 1.0], 100)
    data = DemonstrationData(
        images={"front": shown(places[:, 0]), "hand": shown(places[:, 1])},
        numbers=np.random.default_rng(1).normal(size=(300, 1)).astype(np.float32),
        instructions=np.tile(["turn", "turn", GO_BACK], 100),
        commands=np.column_stack([places, grips]).astype(np.float32),
        hand_m=np.column_stack([np.where(grips[:, None], 0.0, places), grips]).astype(np.float32),
        episode=np.arange(100).repeat(3),
    )
    settings = Training(updates=150, encoder_updates=150, shift_px=1)
    policy = train(
        data, seed=0, observation="front,hand,proprio", settings=settings, layout={"heat_maps": heat_maps, "chunk": 1}
    )
    for asked in itertools.product((5, 20), repeat=2):
        along, aside = shown(np.array(asked))
        policy.begin("turn")
        found = policy.act({"front": along, "hand": aside, "proprio": np.zeros(1, np.float32)})
        assert found[:2] == pytest.approx(asked, abs=5.0)
    assert policy.about | {"cpu_s": 0.0} == {
        "world": "", "observation": "front,hand,proprio", "size_px": 32, "demonstrations": 100, "periods": 300,
        "seed": 0, "training": asdict(settings), "cpu_s": 0.0,
    }  # fmt: skip


def test_a_saved_clone_acts_as_before(tmp_path: Path) -> None:
    clone().save(tmp_path / "skill.pt")
    again = Clone.load(tmp_path / "skill.pt")
    seen = {"proprio": np.zeros(16, dtype=np.float32), "objects": np.zeros((3, 7), dtype=np.float32)}
    for each in (clone(), again):
        each.begin("turn the left cube clockwise")
    np.testing.assert_array_equal(clone().act(seen), again.act(seen))
    assert again.world == "arrow_puzzle" and Clone.load(BUNDLED).world == "", "the bundled file is older"
    (tmp_path / "other.pt").write_bytes(b"no clone")
    with pytest.raises(ArtefactError, match="train one first"):
        Clone.load(tmp_path / "other.pt")


def test_a_scene_with_other_objects_is_refused_by_a_clone() -> None:
    clone().begin("turn the left cube clockwise")
    seen = {"proprio": np.zeros(16, dtype=np.float32), "objects": np.zeros((2, 7), dtype=np.float32)}
    with pytest.raises(InvalidValueError, match=r"learned from 37 numbers .* gives 30.*those of arrow_puzzle\."):
        clone().act(seen)


@pytest.mark.parametrize(
    ("options", "name"), [({"cubes": 1}, "arrows:cubes=1,horizon=10"), ({"family": "pick_place"}, "pick_place")]
)
def test_demonstrations_say_their_family_and_number_of_cubes(options: dict[str, Any], name: str) -> None:
    assert collect(1, seed=5, observation=VECTORS, **options).world == name


@pytest.mark.slow
def test_a_clone_of_sixty_demonstrations_turns_cubes() -> None:
    data = collect(60, seed=11, observation=VECTORS)
    policy = train(data, seed=0, observation=VECTORS, settings=Training(updates=2_000))
    assert share_done(tries(policy, 60, seed=12)) > 0.7
