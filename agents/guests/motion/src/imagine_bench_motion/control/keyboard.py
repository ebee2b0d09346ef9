"""``imagine-bench play`` of continuous control: keys move the hand, and a window shows the scene and the images of its
cameras.
"""

from __future__ import annotations

import itertools
import textwrap
from contextlib import closing
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from imagine_bench.tasks.scenes.constants import CONTROL_CAMERAS
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from imagine_bench import registry
from imagine_bench.arrays import Arrays, Frame, Info
from imagine_bench.errors import require_integer, require_known
from imagine_bench.interfaces import TaskSpec
from imagine_bench.rules import ending
from imagine_bench.tools import play

Command = NDArray[np.float32]
SPEED = 0.25
"""Of the hand while a key is down, as a share of the largest twist: 0.25 m/s, 1.5 rad/s."""
_TOWARD_PERSON, _LEFT, _UP, _TURN, _GRIP = 0, 1, 2, 5, 6
"""Places in a command by twist: velocity along x, y and z of the world, turning about z, and the grip."""
KEYS = {
    "w": (_TOWARD_PERSON, 1.0, "toward the person"),
    "s": (_TOWARD_PERSON, -1.0, "toward the robot"),
    "a": (_LEFT, 1.0, "left, as the robot sees it"),
    "d": (_LEFT, -1.0, "right"),
    "r": (_UP, 1.0, "up"),
    "f": (_UP, -1.0, "down"),
    "q": (_TURN, 1.0, "turn counter-clockwise, from above"),
    "e": (_TURN, -1.0, "turn clockwise"),
    "g": (_GRIP, 1.0, "close or open the fingers"),
}
"""Place in a command, sign, and meaning of each key. Two keys may be down at once."""
_FPS = 25
_HOLD = 50
"""Images a second, and for how many the end of an episode stands still."""
_WIDTH, _HEIGHT, _BAND = 640, 480, 40
_PANEL = 300
_FRAME = 140
"""Pixels of the scene, of the band below it, of the panel beside it, and of the edge of a camera's image in that."""


class HandGame(gymnasium.Wrapper[Arrays, Command, Arrays, Command]):
    """Continuous control for ``gymnasium.utils.play``: a step is a control period, and one image of a window.

    The last number of an action is 1 while the key of the grip is down; each press closes or opens the fingers.

    Args:
        env: The environment, controlled by twist.
        task: Its task.
        seed: Seed of the first episode.
    """

    render_mode = "rgb_array"

    def __init__(self, env: gymnasium.Env[Arrays, Command], task: TaskSpec, seed: int) -> None:
        super().__init__(env)
        scene: Any = env.unwrapped
        scene.draws_quickly = True
        self._scene = scene
        self._task = task
        self._seed: int | None = seed
        self.episodes = 0
        self.solved = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Arrays, Info]:
        """Begin an episode; only the first one is seeded, or all would begin alike."""
        self._seen, info = self.env.reset(seed=self._seed, options=options)
        self._seed = None
        self._opens = 1.0
        self._was_down = False
        self._due: tuple[Arrays, SupportsFloat, bool, bool, Info] | None = None
        self._waits = 0
        self._said = "The fingers are open."
        self._event = "No event so far."
        self._info = info
        return self._seen, info

    def step(self, action: Command) -> tuple[Arrays, SupportsFloat, bool, bool, Info]:
        """Move the hand for a control period; at the end of an episode stand still for two seconds first."""
        if self._due is not None:
            self._waits -= 1
            return self._due if self._waits == 0 else (self._seen, 0.0, False, False, self._info)
        is_down = bool(action[_GRIP] > 0)
        if is_down and not self._was_down:
            self._opens = -self._opens
        self._was_down = is_down
        command = np.append(SPEED * action[:_GRIP], self._opens).astype(np.float32)
        step = self.env.step(command)
        self._seen, reward, terminated, truncated, self._info = step
        self._said = self._words(float(reward))
        if self._info["event"]:
            self._event = f"Latest event: {self._said}"
        if not (terminated or truncated):
            return step
        self.episodes += 1
        self.solved += bool(self._info["is_success"])
        self._said = f"Over: {ending(self._info, terminated=terminated)}."
        self._due = step
        self._waits = _HOLD
        return self._seen, 0.0, False, False, self._info

    def _words(self, reward: float) -> str:
        """The event of this period, or the limit of the hand, or how the fingers are."""
        info = self._info
        if info["event"]:
            action = int(info["macro_action"])
            done = self._task.action_names[action] if action >= 0 else info["fault_reason"]
            return f"{done}: reward {reward:+g}."
        if info["limited"]:
            return f"The hand cannot go there: {info['limited']}."
        return "The fingers are open." if self._opens > 0 else "The fingers are closed."

    def summary(self) -> str:
        """How often the person solved the task, beside the optimum."""
        said = play.solved_words(self.solved, self.episodes)
        optimum = self._scene.task.facts().optimum  # of grips that do not slip, for one that slips costs nothing
        return f"{said}; optimum {optimum:.1%} if all is seen." if self.episodes else f"{said}."

    def render(self) -> Frame:
        """The window: the scene, both cameras, the person's wish, and the keys. Shape (H, W, 3)."""
        canvas = Image.new("RGB", (_WIDTH + _PANEL, _HEIGHT + _BAND), "white")
        canvas.paste(Image.fromarray(self._scene.human_view(_WIDTH, _HEIGHT)))
        draw = ImageDraw.Draw(canvas)
        font = ImageFont.load_default(14)
        left = _WIDTH + 8
        for name in CONTROL_CAMERAS:
            draw.text((left, 8), f"{name} camera", "black", font)
            canvas.paste(
                Image.fromarray(self._seen[name]).resize((_FRAME, _FRAME), Image.Resampling.NEAREST), (left, 30)
            )
            left += _FRAME + 4
        goal = "\n".join(textwrap.wrap(self._scene.instruction, _PANEL // 8))
        left_s = self._scene.time_limit_s - self._scene.elapsed_s
        keys = "\n".join(f"{key}  {meaning}" for key, (_, _, meaning) in KEYS.items())
        time = f"{left_s:.0f} s left. Solved: {self.solved} of {self.episodes}."
        said = "\n".join(textwrap.wrap(self._said, _PANEL // 8))
        words = f"{goal}\n\n{said}\n{self._event}\n{time}\n\n{keys}\n\nEsc  end the game"
        draw.multiline_text((_WIDTH + 8, _FRAME + 40), words, "black", font)
        return np.array(canvas)


def keys_to_commands() -> dict[tuple[str, ...], Command]:
    """The command of every key, and of every two at once."""
    found = {}
    for keys in (*itertools.combinations(KEYS, 1), *itertools.combinations(KEYS, 2)):
        command = np.zeros(_GRIP + 1, np.float32)
        for key in keys:
            place, sign, _ = KEYS[key]
            command[place] += sign
        found[keys] = command
    return found


def play_motion(task: str, *, seed: int = 0, appearance: str = "clean", camera: str = "human") -> str:
    """Open a window in which keys move the hand until it is closed, and say how often the person succeeded.

    Raises:
        ImagineBenchError: Unknown names, or neither pygame nor desktop.
    """
    require_integer("seed", seed, 0)
    require_known("camera", camera, play.CAMERAS)
    spec = registry.task(task)
    keyboard = play.keyboard_player()
    env_id = registry.motion_id(spec.env_id)
    env = gymnasium.make(env_id, disable_env_checker=True, appearance=appearance, camera=camera)
    noop = np.zeros(_GRIP + 1, np.float32)
    with closing(HandGame(env, spec, seed)) as game:
        keyboard(game, fps=_FPS, keys_to_action=keys_to_commands(), noop=noop)
    return game.summary()
