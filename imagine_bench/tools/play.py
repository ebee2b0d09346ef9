"""``imagine-bench play``: a task by keyboard, and beside it a learned world model's imagination of the same keys.

Or, with ``--film``, an episode of optimal macro-actions in the same window, as a GIF.
"""

from __future__ import annotations

import io
import string
import textwrap
import warnings
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, SupportsFloat, cast
from unittest import mock

import gymnasium
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from imagine_bench import registry
from imagine_bench.appearance import appearance_name
from imagine_bench.arrays import Action, Frame, Info, State
from imagine_bench.errors import InvalidValueError, SetupError, require_integer, require_known
from imagine_bench.interfaces import TaskSpec
from imagine_bench.interfaces.capabilities import ImaginedRollout, Imaginer
from imagine_bench.protocols.control import Protocol
from imagine_bench.rules import ending
from imagine_bench.running.player import FinishedError, played_run
from imagine_bench.running.trained import load_trained
from imagine_bench.seeding import episode_seed
from imagine_bench.statistics import wilson
from imagine_bench.store.files import make_folder, write_bytes

KEYS = "123456789" + string.ascii_lowercase
"""Of the macro-actions, in their order."""
CAMERAS = ("human", "far")
"""From where a person sees the scene: near the table, or far enough for the whole arm."""
_FPS = 25
_FILM_FPS = 10
"""Images a second of the window, and of a film."""
_HOLD = 50
_FILM_HOLD = 8
"""Images for which the end of an episode stands still, and in a film the scene between two macro-actions."""
_WIDTH = 640
_HEIGHT = 480
_PANEL = 284
_FRAME = 192
_TOP = 36
_BAND = 88
_LETTERS = 128
"""Pixels: the scene, the width of a panel beside it, the edge of a frame in that, and where it begins; the height of
the band below the scene, and how many letters fit into a line of it."""
_Step = tuple[Frame, SupportsFloat, bool, bool, Info]


class KeyboardGame(gymnasium.Wrapper[Frame, Action, Frame, Action]):
    """A task for ``gymnasium.utils.play``: a step is one image of a window.

    Action ``A`` waits and lets go of the key; one that stays down acts once. While a macro-action is shown, steps
    change nothing; the last one returns its result. An ``imaginer`` sees the first frame of each episode, then keys
    alone. ``seed`` is of the first episode, and of the draws of the imagination.
    """

    render_mode = "rgb_array"

    def __init__(self, env: gymnasium.Env[Frame, Action], task: TaskSpec, imaginer: Imaginer | None, seed: int) -> None:
        super().__init__(env)
        self.action_space = gymnasium.spaces.Discrete(task.n_actions + 1)
        self._task = task
        self._imaginer = imaginer
        self._seed = seed
        self._reset_seed: int | None = seed
        scene: Any = env.unwrapped
        scene.capture_motion_hz = float(_FPS)
        self._scene = scene
        self.episodes = 0
        self.solved = 0
        self.foreseen = 0
        self.imagined = 0

    def play_by(self, keyboard: Callable[..., None]) -> None:
        """Let a person play until the window is closed."""
        n_actions = self._task.n_actions
        keys = dict(zip(KEYS, range(n_actions), strict=False))
        keyboard(self, fps=_FPS, keys_to_action=keys, noop=n_actions)

    def reset(self, *, seed: int | None = None, options: dict[str, State] | None = None) -> tuple[Frame, Info]:
        """Begin an episode; only the first one is seeded, or all would begin alike."""
        self._frame, self._info = self.env.reset(seed=self._reset_seed, options=options)
        self._reset_seed = None
        self._start = self._frame
        self._actions: list[int] = []
        self._moves = getattr(self.env, "moves", 0)
        self._rollout: ImaginedRollout | None = None
        self._due: _Step | None = None
        self._said = "press a key"
        self._released = False
        self._images: Iterator[Frame] = iter(())
        self._image = self._window()
        return self._frame, self._info

    def step(self, action: Action) -> _Step:
        """Show one more image, else return the result of a macro-action, else wait or carry one out."""
        waits = action == self._task.n_actions
        self._released |= waits
        image = next(self._images, None)
        due = self._due
        if image is not None:
            self._image = image
        elif due is not None:
            self._due = None
            return due
        elif self._released and not waits:
            self._released = False
            self._due, self._images = self.act(int(action))
        return self._frame, 0.0, False, False, self._info

    def render(self) -> Frame:
        """The window as it is now. Shape (H, W, 3)."""
        return self._image

    def summary(self) -> str:
        """How often the person solved the task, beside chance and optimum, and how often the model foresaw it."""
        facts = self._task.facts()
        said = solved_words(self.solved, self.episodes)
        foreseen = f"\nThe model foresaw {self.foreseen} of {self.imagined} macrostates." if self.imagined else ""
        return f"{said}; chance {facts.chance_level:.1%}, optimum {facts.optimum:.1%} if all is seen.{foreseen}"

    def act(self, action: int) -> tuple[_Step, Iterator[Frame]]:
        """Carry out a macro-action: its result, and images of it, each drawn when it is due."""
        self._said = self._task.action_names[action]
        self._moves += 1
        if self._imaginer is not None:  # the same draws each time, so that the earlier imagination stays as it was
            self._actions.append(action)
            actions = np.array(self._actions)
            rng = np.random.default_rng(self._seed)
            rollout = self._imaginer.imagine(self._start, actions=actions, depth=len(actions), rng=rng)
            self._rollout = rollout.in_range()
        done = self.env.step(action)
        return done, self._showing(done)

    def _showing(self, done: _Step) -> Iterator[Frame]:
        for _ in getattr(self._scene, "replay", tuple)():
            yield self._window()
        self._frame, reward, terminated, truncated, self._info = done
        solved = bool(self._info["is_success"])
        self.episodes += terminated or truncated
        self.solved += solved
        if self._rollout is not None:
            self.imagined += 1
            shown = self._task.as_observed(self._info.get("shown", self._info["macrostate"]))
            self.foreseen += tuple(self._rollout.macrostates[-1].tolist()) == shown
        end = textwrap.fill(ending(self._info, terminated=terminated), _PANEL // 8) if terminated or truncated else ""
        self._said += f"\nreward {float(reward):+g}" + f"\n{end}" * bool(end) + ", a fault" * bool(self._info["fault"])
        yield from [self._window()] * (_HOLD if end else 1)

    def _window(self) -> Frame:
        """The scene with the goal below it, the agent's frame, the imagined frame, and words."""
        keys = "\n".join(f"{key}  {name}" for key, name in zip(KEYS, self._task.action_names, strict=False))
        panels = [("the agent's frame", self._frame, f"{self._said}\n\n{keys}\n\nEsc  end the game")]
        if self._imaginer is not None:
            panels.append(("the model's imagination", *self._imagination()))
        canvas = Image.new("RGB", (_WIDTH + len(panels) * _PANEL, _HEIGHT + _BAND), "white")
        if hasattr(self._scene, "human_view"):
            canvas.paste(Image.fromarray(self._scene.human_view(_WIDTH, _HEIGHT)))
        else:  # others' tasks may show the agent's frame alone
            canvas.paste(Image.fromarray(self._frame).resize((_HEIGHT, _HEIGHT)))
        draw = ImageDraw.Draw(canvas)
        font = ImageFont.load_default(14)
        draw.multiline_text((8, _HEIGHT + 4), self._goal(), "black", font, spacing=2)
        for column, (title, image, words) in enumerate(panels):
            left = _WIDTH + 8 + column * _PANEL
            draw.text((left, _TOP // 3), title, "black", font)
            canvas.paste(Image.fromarray(image).resize((_FRAME, _FRAME), Image.Resampling.NEAREST), (left, _TOP))
            draw.multiline_text((left, _TOP + _FRAME + 8), words, "black", font)
        return np.array(canvas)

    def _goal(self) -> str:
        """The goal, the directions in the agent's frame, and how many macro-actions are left."""
        task = self._task
        goal = textwrap.wrap(f"Goal: {task.description}", _LETTERS)
        directions = "In the frame, up is toward the human and down toward the robot. "
        kept = getattr(self.env, "words", "")
        left = "" if task.horizon is None else f"Moves left: {task.horizon - self._moves} of {task.horizon}. "
        return "\n".join([*goal, directions + left + f"Solved: {self.solved} of {self.episodes}. {kept}"])

    def _imagination(self) -> tuple[Frame, str]:
        """The latest imagined image, gray or RGB, and in words its predictions and uncertainty."""
        rollout = self._rollout
        if rollout is None:
            return np.full_like(self._start, 200), "nothing yet"
        kept = "would be learned from" if rollout.accepted[-1] else "would be filtered out"
        return np.rint(255 * rollout.frames[-1]).astype(np.uint8), (
            f"reward {rollout.rewards[-1]:+.1f}, end {rollout.p_terminated[-1]:.0%}\n\nuncertainty\n"
            f"    epistemic {rollout.epistemic[-1]:.3g}\n    aleatoric {rollout.aleatoric[-1]:.3g}\n"
            f"    modal {rollout.modal[-1]:.3g}\n{kept}\n\nforeseen {self.foreseen} of {self.imagined}"
        )


def play(
    task: str | None,
    *,
    model: Path | None = None,
    seed: int = 0,
    execution: str | None = None,
    appearance: str | None = None,
    encoder: str | None = None,
    camera: str = "human",
) -> str:
    """Open a window in which a person plays until it is closed, and say how often the person succeeded.

    ``model`` is a run's folder, whose agent imagines beside the person; it also says what is None, else the task's
    environment does. ``encoder`` is as of :func:`imagine_bench.running.trained.load_trained`, ``camera`` as of
    :func:`film`. :func:`keep_playing` keeps the episodes.

    Raises:
        ImagineBenchError: Nothing to play, unknown names, a model of another task or that does not imagine, the errors
            of
            ``load_trained``, or neither pygame nor desktop.
    """
    chosen: dict[str, Any] = {}
    imaginer = None
    if model is not None:
        trained = load_trained(model, encoder=encoder)
        if task is not None and registry.task_name(task) != trained.task.id:
            raise InvalidValueError(f"{model} was trained on {trained.task.id!r}, not on {task!r}; leave the task out.")
        task = trained.task.id
        imaginer = trained.imaginer
        chosen = {**trained.spec.protocol.world, "appearance": trained.spec.protocol.appearance}
    if task is None:
        raise InvalidValueError("There is nothing to play; give a task or --model.")
    if encoder is not None and model is None:
        raise InvalidValueError("--encoder goes with --model; a person needs none.")
    spec = registry.task(task)
    chosen |= _view(camera)
    if execution is not None:
        chosen["execution"] = spec.execution(execution)
    if appearance is not None:
        chosen["appearance"] = appearance_name(appearance)
    require_integer("seed", seed, 0)
    keyboard = keyboard_player()
    env = gymnasium.make(spec.env_id, disable_env_checker=True, **chosen)
    with closing(KeyboardGame(env, spec, imaginer, seed)) as game:
        game.play_by(keyboard)
    return game.summary()


def keep_playing(wanted: Protocol, root: Path, *, camera: str = "human") -> str:
    """Open a window in which a person plays the episodes of a protocol, which are kept below ``root``.

    Returns how often the person succeeded now, and where the episodes lie. Raises as :func:`play`, or as
    :func:`imagine_bench.running.player.played_run`.
    """
    keyboard = keyboard_player()
    spec = wanted.spec(testing=True)  # its exact facts are those of the tests' starts
    with played_run(wanted, root, **_view(camera)) as run:
        game = KeyboardGame(cast("gymnasium.Env[Frame, Action]", run), spec, None, 0)
        with suppress(FinishedError), closing(game):
            game.play_by(keyboard)
        bench = run.folder.parent.parent
        return f"{game.summary()}\nNow {run.words}; kept in {bench}. The same command goes on."


def solved_words(solved: int, episodes: int) -> str:
    """How often a person solved a task, with its 95 % interval."""
    if not episodes:
        return "No episode was finished"
    low, high = wilson(solved, episodes)
    share = f"{solved / episodes:.1%}, 95 % interval {low:.1%} to {high:.1%}"
    return f"Solved {solved} of {episodes} episodes ({share})"


def keyboard_player() -> Callable[..., None]:
    """Gymnasium's loop of keys and windows. Raises SetupError: neither pygame nor desktop."""
    registry.load("imagine_bench.tasks.rendering.window:open_display")(seen=True)
    with warnings.catch_warnings(), mock.patch("matplotlib.use"):  # it would let matplotlib open windows, too
        warnings.simplefilter("ignore")
        from gymnasium.utils.play import play as keyboard  # noqa: PLC0415 - an extra
    return keyboard


def _view(camera: str) -> dict[str, Any]:
    """The keyword of an environment that is seen by a camera other than its own."""
    return {} if require_known("camera", camera, CAMERAS) == CAMERAS[0] else {"camera": camera}


def film(task: str, out: Path, *, seed: int = 0, appearance: str = "clean", camera: str = "human") -> Path:
    """Film one episode of optimal macro-actions in contact physics.

    Args:
        task: Registered task.
        out: The GIF; an existing file is not overwritten.
        seed: Chooses the episode.
        appearance: Appearance level.
        camera: ``"human"`` looks at the table from nearby, ``"far"`` at the whole arm.

    Raises:
        UnknownNameError: No such task, appearance or camera.
        InvalidValueError: ``out`` is no GIF.
        SetupError: ``out`` exists or cannot be written, or there is no GL.
    """
    if out.suffix.lower() != ".gif":
        raise InvalidValueError(f"{out} does not end in .gif, the only format of films; give such an --out.")
    if out.exists():
        raise SetupError(f"{out} exists and is not overwritten; delete it or give another --out.")
    make_folder(out.parent)
    spec = registry.task(task)
    env = gymnasium.make(spec.env_id, appearance=appearance, disable_env_checker=True, **_view(camera))
    scene: Any = env.unwrapped
    with closing(KeyboardGame(env, spec, None, episode_seed("recording", seed, 0))) as game:
        scene.capture_motion_hz = float(_FILM_FPS)
        _, info = game.reset()
        images = [game.render()] * _FILM_HOLD
        over = False
        while not over:
            action = spec.rules.optimal_action(tuple(info["macrostate"].tolist()))
            (_, _, terminated, truncated, info), shown = game.act(action)
            images += shown
            images += images[-1:] * _FILM_HOLD
            over = terminated or truncated
    colors = Image.fromarray(images[0]).quantize(128)
    frames = [Image.fromarray(each).quantize(palette=colors, dither=Image.Dither.NONE) for each in images]
    whole = io.BytesIO()
    duration = 1000 // _FILM_FPS
    frames[0].save(whole, "GIF", save_all=True, append_images=frames[1:], duration=duration, loop=0, optimize=True)
    write_bytes(out, whole.getvalue())
    return out
