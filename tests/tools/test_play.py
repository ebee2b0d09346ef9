"""A person plays: scripted keys under SDL's dummy driver, in the task and beside a model that imagines."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import sys
import textwrap
from types import SimpleNamespace
from unittest import mock

import gymnasium
import matplotlib
import numpy as np
import pytest
from fake_agents import FakeImaginer
from imagine_bench_motion.control.keyboard import HandGame, keys_to_commands
from PIL import Image, ImageDraw, ImageFont, ImageSequence
from scipy.spatial.transform import Rotation

from imagine_bench import registry
from imagine_bench.cli import exit_code as main
from imagine_bench.errors import InvalidValueError, SetupError
from imagine_bench.running.player import played_run, protocol_of_player
from imagine_bench.seeding import episode_seed
from imagine_bench.tools import play as module
from imagine_bench.tools.play import KEYS, KeyboardGame, film, play

pygame = pytest.importorskip("pygame")  # of the extra play
WAIT = 6
START = (1, 2, 0, 1)


pytestmark = pytest.mark.usefixtures("without_shadows")


def game_of(imaginer=None, seed=0, **options):
    view = {"render_mode": "rgb_array", "width": 64, "height": 48}
    env = gymnasium.make("imagine_bench/ArrowPuzzle-v0", disable_env_checker=True, **view, **options)
    return KeyboardGame(env, registry.task("arrow_puzzle"), imaginer, seed)


def until_done(game, action):
    """Press and let go; everything that steps return until the macro-action's result, and the images shown."""
    assert game.step(WAIT)[1:4] == (0.0, False, False)
    seen, images = [game.step(action)], []
    while seen[-1][1] == 0.0:
        images.append(game.render())
        seen.append(game.step(WAIT))
    return seen, images


def panel(column):
    """The frame that stands enlarged in a panel beside the scene."""
    return column[36 : 36 + 192 : 3, 8 : 8 + 192 : 3]


def written(words, place, shape, **options):
    """A white image with words."""
    image = Image.new("RGB", shape[1::-1], "white")
    ImageDraw.Draw(image).multiline_text(place, words, "black", ImageFont.load_default(14), **options)
    return np.array(image)


def test_keys_do_what_the_environment_does():
    game, plain = game_of(), game_of().env
    frame, _ = game.reset(seed=99)  # play gives its seed again and again
    np.testing.assert_array_equal(frame, plain.reset(seed=0)[0])
    plain.unwrapped.capture_motion_hz = game.unwrapped.capture_motion_hz = 5
    seen, images = until_done(game, 0)
    expected = plain.step(0)
    np.testing.assert_equal(seen[-1], expected)
    assert all(each[1:4] == (0.0, False, False) for each in seen[:-1])
    assert len(images) == pytest.approx(5 * expected[4]["sim_time_s"], abs=3 + 50 * expected[2])
    assert len({image.tobytes() for image in images}) > 5
    game.close()
    plain.close()


def test_the_model_imagines_from_the_first_frame_by_the_same_keys():
    asked, told = [], []

    class Imaginer(FakeImaginer):
        def imagine(self, frame, *, actions, depth, rng):
            asked.append((actions.tolist(), frame.tobytes(), rng.random()))
            rollout = super().imagine(frame, actions=actions, depth=depth, rng=rng)
            right = registry.task("arrow_puzzle").rules.outcomes(START, 4)[0].macrostate
            told.append(dataclasses.replace(rollout, macrostates=np.array([right] * depth)))  # of the first alone
            return told[-1]

    game = game_of(Imaginer(), execution="kinematic")
    frame, _ = game.reset(options={"macrostate": START})
    for _ in range(2):
        seen, _ = until_done(game, 4)
    same_draws = (frame.tobytes(), asked[0][2])
    assert asked == [([4], *same_draws), ([4, 4], *same_draws)], "the imagined past stays"
    sees, imagines = game.render()[:, -568:-284], game.render()[:, -284:]
    np.testing.assert_allclose(panel(imagines)[..., 0], 0.9 * frame.mean(axis=2), atol=1)
    np.testing.assert_array_equal(panel(sees), seen[-1][0])
    last = {name: getattr(told[1], name)[-1] for name in ("rewards", "p_terminated", "epistemic", "aleatoric", "modal")}
    kinds = "".join(f"    {name} {value:.3g}\n" for name, value in list(last.items())[2:])
    words = f"reward {last['rewards']:+.1f}, end {last['p_terminated']:.0%}\n\nuncertainty\n{kinds}"
    words += "would be learned from\n\nforeseen 1 of 2"
    np.testing.assert_array_equal(imagines[232:], written(words, (8, 236), imagines.shape)[232:])
    assert game.summary().endswith("\nThe model foresaw 1 of 2 macrostates.")
    frame, _ = game.reset()
    until_done(game, 4)
    assert asked[2:] == [([4], frame.tobytes(), asked[0][2])], "another episode is imagined from its own first frame"
    game.close()


def test_a_model_foresees_what_the_next_frame_shows():
    """Which is a macro-action late, and hides the gesture after the first one: it is read as one more than the last."""

    class Imaginer(FakeImaginer):
        def imagine(self, frame, *, actions, depth, rng):
            rollout = super().imagine(frame, actions=actions, depth=depth, rng=rng)
            late = START if depth == 1 else (*outcomes[0].macrostate[:-1], 3)
            return dataclasses.replace(rollout, macrostates=np.array([late] * depth))

    task = registry.task("arrows:gesture=first,lag=1")
    outcomes = task.rules.outcomes(START, 4)
    env = gymnasium.make(task.env_id, disable_env_checker=True, render_mode="rgb_array", execution="kinematic")
    game = KeyboardGame(env, task, Imaginer(), 0)
    game.reset(options={"macrostate": START})
    for _ in range(2):
        until_done(game, 4)
    assert game.summary().endswith("\nThe model foresaw 2 of 2 macrostates.")
    game.close()


@pytest.fixture
def keyboard(monkeypatch):
    """Keys pressed one after another, each held for three images, then the window is closed."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr(module, "_HOLD", 1)
    importlib.import_module("matplotlib.pyplot").switch_backend("svg")

    def press(keys):
        flip, script = pygame.display.flip, []
        for key in keys:
            script += [None, (pygame.KEYDOWN, key), None, None, (pygame.KEYUP, key), *[None] * 6]
        script.append((pygame.QUIT, None))
        events = iter(script)

        def flipped():
            flip()
            if (event := next(events, None)) is not None:
                kind, key = event
                pygame.event.post(pygame.event.Event(kind, {"key": ord(key)} if key else {}))

        monkeypatch.setattr(pygame.display, "flip", flipped)
        monkeypatch.setattr(pygame.time, "Clock", lambda: SimpleNamespace(tick=lambda fps: None))

    yield press
    pygame.quit()


def test_keyboard_events_play_the_task(keyboard, capsys):
    rules = registry.task("arrow_puzzle").rules
    twin = gymnasium.make("imagine_bench/ArrowPuzzle-v0", execution="kinematic")
    twin.reset(seed=5)  # the window's first episode ...
    _, info = twin.reset()  # ... is the second: play begins twice
    macrostate, keys = tuple(info["macrostate"].tolist()), ""
    while not rules.is_terminal(macrostate):
        action = rules.optimal_action(macrostate)
        keys, macrostate = keys + KEYS[action], rules.outcomes(macrostate, action)[0].macrostate
    keyboard(keys)
    backend = matplotlib.get_backend()
    assert main(["play", "arrow_puzzle", "--execution", "kinematic", "--seed", "5"]) == 0
    said = capsys.readouterr().out
    assert "Solved 1 of 1 episodes (100.0%, 95 % interval 20.7% to 100.0%); " in said
    assert "chance 4.6%, optimum 100.0% if all is seen." in said
    assert matplotlib.get_backend() == backend
    twin.close()


def test_a_window_keeps_the_episodes_and_goes_on_where_it_was_closed(keyboard, capsys, tmp_path):
    wanted = protocol_of_player("arrow_puzzle", "person", "anna", tests=2, execution="kinematic")
    words = "play arrow_puzzle --keep anna --tests 2 --execution kinematic --out"

    def said_after(keys):
        keyboard(keys)
        assert main([*words.split(), str(tmp_path)]) == 0
        return capsys.readouterr().out

    assert "Now test 1 of 2; kept in" in said_after("1")
    with played_run(wanted, tmp_path) as run:
        run.reset()
        assert run.moves == 1, "one key was pressed before the window was closed"
    assert "Now all 2 episodes are played" in said_after("1" * 12 + "2" * 12)
    assert main(["verify", *map(str, tmp_path.glob("arrow_puzzle/quick-*"))]) == 0
    assert "No episode was finished" in said_after("1"), "no episode more is played"


def test_who_comes_back_is_told_how_many_moves_are_left(tmp_path):
    wanted = protocol_of_player("arrow_puzzle", "person", "anna", tests=2, execution="kinematic")
    task = registry.task("arrow_puzzle")
    words = []
    for comes_back in (False, True):
        with played_run(wanted, tmp_path) as run:
            game = KeyboardGame(run, task, None, 0)
            _, info = game.reset()
            words.append(game.render()[480:])
            if not comes_back:
                start = tuple(info["macrostate"].tolist())
                going_on = [each for each in range(WAIT) if not task.rules.outcomes(start, each)[0].terminated]
                until_done(game, going_on[0])
                words.append(game.render()[480:])
    begun, left, back = words
    assert not np.array_equal(begun, left), "one move fewer"
    np.testing.assert_array_equal(back, left)


def test_only_a_success_counts_as_solved(hand):
    """An episode can also be lost before its time is over: by hand, where a cube has fallen."""
    game = game_of(execution="kinematic")
    for action in (2, 0, 2):
        game.reset(options={"macrostate": (3, 1, 2, 0)})
        until_done(game, action)
    assert game.summary().startswith("Solved 1 of 3 episodes (33.3%, 95 % interval 6.1% to 79.2%); chance 4.6%")
    goal = textwrap.wrap(f"Goal: {registry.task('arrow_puzzle').description}", 128)
    for left in (9, 10):  # after the last one's macro-action, and in the next one
        more = f"Moves left: {left} of 10. Solved: 1 of 3. "
        more = f"In the frame, up is toward the human and down toward the robot. {more}"
        band = game.render()[480:]
        np.testing.assert_array_equal(band, written("\n".join([*goal, more]), (8, 4), band.shape, spacing=2))
        game.reset()
    game.close()
    scene = hand.env.unwrapped
    row = scene.world.object_qpos[0]
    for sinks_m in (0.2, 0.0, 0.2):
        hand.reset(options={"macrostate": (1, 0)})
        scene.data.qpos[row[3:]] = (1, 0, 0, 0)
        scene.data.qpos[row[2]] -= sinks_m
        while not any(hand.step(np.zeros(7, np.float32))[2:4]):
            pass
    assert hand.summary().startswith("Solved 1 of 3 episodes")


class Bare(gymnasium.Wrapper):
    """A task by the contract alone, and no more: no scene to look at."""

    unwrapped = property(lambda self: self)

    def step(self, action):
        return self.env.unwrapped.step(action)


def test_a_task_of_others_shows_the_agent_s_frame():
    bare = Bare(gymnasium.make("imagine_bench/ArrowPuzzle-v0", execution="kinematic"))
    game = KeyboardGame(bare, registry.task("arrow_puzzle"), None, 0)
    frame, _ = game.reset()
    assert np.abs(game.render()[:480, :480][::15, ::15].astype(int) - frame[::2, ::2]).mean() < 8
    seen, _ = until_done(game, 3)
    assert not np.array_equal(seen[-1][0], frame)
    np.testing.assert_array_equal(panel(game.render()[:, 640:]), seen[-1][0])
    game.close()


def test_a_model_brings_its_task_and_its_appearance(keyboard, monkeypatch, tmp_path):
    world = {"execution": "kinematic"}
    spec = SimpleNamespace(protocol=SimpleNamespace(world=world, appearance="mild"))
    trained = SimpleNamespace(task=registry.task("arrow_puzzle"), imaginer=FakeImaginer(), spec=spec)
    monkeypatch.setattr(module, "load_trained", lambda folder, encoder: trained)
    make = mock.Mock(side_effect=gymnasium.make)
    monkeypatch.setattr(gymnasium, "make", make)
    keyboard("1")
    assert "The model foresaw 0 of 1 macrostates." in play(None, model=tmp_path)
    keyboard("1")
    play(None, model=tmp_path, execution="physics", appearance="strong", camera="far")
    chosen = ("execution", "appearance", "camera")
    made = [[call.kwargs.get(name, "human") for name in chosen] for call in make.call_args_list]
    assert made == [["kinematic", "mild", "human"], ["physics", "strong", "far"]], "options are above the model's"
    monkeypatch.setattr(trained, "task", registry.task("arrows:cubes=1,slip=0.1"))
    keyboard("1")
    assert "1 macrostates" in play("arrows:slip=0.10,cubes=1", model=tmp_path), "written in another way"
    monkeypatch.setattr(trained, "task", registry.task("arrow_puzzle"))
    with pytest.raises(InvalidValueError, match="trained on 'arrow_puzzle', not on 'pick_place'; leave the task out"):
        play("pick_place", model=tmp_path)
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(SetupError, match=r"imagine-bench\[play\]"):
        play("arrow_puzzle")


@pytest.fixture
def hand():
    """In a world in which nearly every macro-action slips; a hand that slips grips again."""
    options = {"slip": 0.9, "size": 32, "time_limit_s": 0.4}
    env = gymnasium.make("imagine_bench/ArrowPuzzleEasyMotion-v0", disable_env_checker=True, **options)
    with contextlib.closing(HandGame(env, registry.task("arrow_puzzle_easy:slip=0.9"), 0)) as game:
        yield game


def test_keys_move_the_hand_where_they_say(hand):
    for place, key in enumerate("wsadrf"):
        seen, _ = hand.reset()
        before_m = seen["proprio"][9:12].copy()
        for _ in range(6):
            seen, *_ = hand.step(keys_to_commands()[(key,)])
        moved_m = (-1) ** place * (seen["proprio"][9:12] - before_m)
        assert moved_m.argmax() == place // 2 and moved_m.max() > 0.02, key
    for sign, key in ((1.0, "q"), (-1.0, "e")):
        seen, _ = hand.reset()
        before = seen["proprio"][12:16]
        for _ in range(6):
            seen, *_ = hand.step(keys_to_commands()[(key,)])
        turned = Rotation.from_quat([before, seen["proprio"][12:16]], scalar_first=True)
        assert sign * (turned[1] * turned[0].inv()).as_rotvec()[2] > 0.1, f"{key}: about the vertical, from above"


def test_two_keys_at_once_do_what_both_do():
    commands = keys_to_commands()
    pairs = [keys for keys in commands if len(keys) == 2]
    assert (len(commands), len(pairs)) == (9 + 36, 36)
    for one, other in pairs:
        np.testing.assert_array_equal(commands[one, other], commands[one,] + commands[other,])


class Told(gymnasium.Wrapper):
    """Says something else of each period."""

    def __init__(self, env, told):
        super().__init__(env)
        self.told = told

    def step(self, action):
        *rest, info = self.env.step(action)
        return *rest, {**info, **self.told}


@pytest.mark.parametrize("event", [True, False])
def test_an_event_is_said_also_where_the_hand_is_held_up(event):
    """So the limit changes nothing on the screen then; in any other period it does."""
    env = gymnasium.make("imagine_bench/ArrowPuzzleEasyMotion-v0", disable_env_checker=True, size=32)
    images = []
    for limited in ("", "workspace"):
        told = {"event": event, "macro_action": 1, "limited": limited}
        game = HandGame(Told(env, told), registry.task("arrow_puzzle_easy"), 0)
        game.reset()
        game.step(np.zeros(7, np.float32))
        images.append(game.render())
    env.close()
    assert np.array_equal(*images) == event


def test_a_press_closes_the_fingers_and_the_end_stands_still(hand):
    game = hand
    game.reset()
    grip, nothing = keys_to_commands()[("g",)], np.zeros(7, np.float32)
    openings = []
    for command in (nothing, grip, grip, nothing, nothing, grip):
        seen, *_ = game.step(command)
        openings.append(float(seen["proprio"][7]))
    assert openings[0] > 0.03 and min(openings) == openings[4] < 0.02 < openings[5] + 0.01
    images = [game.render()]
    steps = [game.step(nothing) for _ in range(4 + 50)]
    assert [step[3] for step in steps] == [False] * 53 + [True], "time is over after ten periods"
    assert game.render().shape == images[0].shape and not np.array_equal(game.render(), images[0])
    said = "Solved 0 of 1 episodes (0.0%, 95 % interval 0.0% to 79.3%); optimum 100.0% if all is seen."
    assert game.summary() == said


def test_keyboard_events_move_the_hand(keyboard, capsys):
    keyboard("wgf")
    assert main(["play", "ArrowPuzzleEasyMotion", "--seed", "5"]) == 0
    assert capsys.readouterr().out == "No episode was finished.\n"


@pytest.mark.parametrize("option", ["--execution kinematic", "--film", "--quiz 3", "--keep anna", "--out x.gif"])
def test_continuous_control_is_told_which_options_it_does_not_take(option, capsys):
    assert main(["play", "ArrowPuzzleMotion", *option.split()]) == 2
    assert f"{option.split()[0]} goes with a task of macro-actions" in capsys.readouterr().err


def test_a_film_lasts_as_long_as_its_motions_and_is_never_overwritten(tmp_path):
    """At ten images a second; 0.8 s before and after each macro-action, and 5 s more at the goal."""
    seen = {"appearance": "strong", "camera": "far"}
    out = film("arrow_puzzle_easy", tmp_path / "new" / "turn.gif", seed=1, **seen)
    with Image.open(out) as gif:
        first = np.float32(gif.convert("RGB"))[:480, :640]
        shown = [(np.float32(each.convert("L")), each.info["duration"]) for each in ImageSequence.Iterator(gif)]
    pictures = np.stack([picture for picture, _ in shown])
    images, over = 8 + 50 - 1, False
    with contextlib.closing(gymnasium.make("imagine_bench/ArrowPuzzleEasy-v0", motion_hz=10.0, **seen)) as env:
        _, info = env.reset(seed=episode_seed("recording", 1, 0))
        assert np.abs(first - env.unwrapped.human_view(640, 480)).mean() < 8, "but for the colors of a GIF"
        while not over:
            action = registry.task("arrow_puzzle_easy").rules.optimal_action(info["macrostate"])
            *_, over, _, info = env.step(action)
            images += len(env.unwrapped.arm_motion().time_s) + 1 + 8
    assert info["is_success"] and sum(duration for _, duration in shown) == 100 * images
    assert pictures.shape[1:] == (568, 924)
    assert np.abs(np.diff(pictures[:, :, :640], axis=0)).max() > 50, "the arm is seen moving"
    frames = pictures[:, 36 : 36 + 192, 648 : 648 + 192]
    assert np.abs(frames[-1] - frames[0]).max() > 50, "the agent's last frame is not its first one"
    with pytest.raises(SetupError, match="exists and is not overwritten"):
        film("arrow_puzzle_easy", out, seed=1)
