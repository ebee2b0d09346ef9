"""The Gymnasium environments of a scene, whatever an action is: a whole macro-action, or the command of a moment."""

from __future__ import annotations

import abc
import contextlib
import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec

from imagine_bench.arrays import Frame, Info, Observed, State
from imagine_bench.errors import InvalidValueError, brief, require_integer, require_known, why
from imagine_bench.interfaces import PhysicsSettings, TaskSpec
from imagine_bench.rules import states_of

from .rendering.cameras import human_camera_view
from .rendering.window import HAS_PYGAME, Window
from .scene_reader import FilmedScene
from .scenes.appearance import Appearance
from .world import World

Step = tuple[float, bool, bool, Info]
"""Reward, whether the episode has terminated, whether it is truncated, and info."""
BUILT = PhysicsSettings()
RENDER_MODES = ["rgb_array", "human"][: 1 + HAS_PYGAME]
"""As ``metadata`` of an environment takes them: Gymnasium's checker opens a window for "human"."""
WINDOW_HZ = 25.0
"""Images a second of a window."""


class SceneEnv(FilmedScene, gymnasium.Env[Observed, Any]):
    """An environment of one scene, which can also be a lane of a vector environment.

    Args:
        spec: The task.
        make_world: Its world, at an appearance level.
        level: The appearance.
        physics: The physics of grasping.
        motion_hz: As :attr:`.FilmedScene.capture_motion_hz`.
        render_mode: None, ``"rgb_array"`` or ``"human"``.
        image: Camera, width and height of :meth:`render`.
        cameras: Names of the cameras that :meth:`render` can draw.

    Raises:
        UnknownNameError: An unknown render mode, camera or physics setting.
        InvalidValueError: A width, height, rate or physics setting out of range.
    """

    begun: bool
    """Whether there is an episode to go on with."""
    action_names: tuple[str, ...]
    """The effect of each macro-action; or, in continuous control, the meaning of each number of an action."""
    takes_long: bool = False
    """Whether an action is worth a thread of its own."""

    def __init__(
        self,
        spec: TaskSpec,
        make_world: Callable[[Appearance], World],
        level: Appearance,
        *,
        physics: PhysicsSettings | Mapping[str, float | str],
        motion_hz: float,
        render_mode: str | None,
        image: tuple[str, int, int],
        cameras: Sequence[str],
    ) -> None:
        modes = ("rgb_array", "human")
        self.render_mode = None if render_mode is None else require_known("render mode", render_mode, modes)
        self.physics = PhysicsSettings.of(physics)
        self.task = spec
        self._rules = spec.rules
        self._known = {state: state for state in states_of(spec.rules)}
        self._window = Window(spec.title) if self.render_mode == "human" else None
        FilmedScene.__init__(self, make_world(level), motion_hz or (WINDOW_HZ if self._window else 0.0))
        self.world.set_physics(self.physics)
        camera, width, height = image
        require_known("camera", camera, cameras)
        human_camera_view(camera, width, height)  # refuses a size out of range now, not at the first image
        self._image_of = image
        self.camera_for_people = image[0]
        self.begun = False
        self._sight = spec.sight
        self._lag = spec.sight.lag if spec.sight else 0

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Observed, Info]:
        """Start an episode.

        Args:
            seed: Seeds everything random in this environment.
            options: ``{"macrostate": ...}`` to start there; any macrostate of the rules, terminal ones included.

        Raises:
            UnknownNameError: An unknown option.
            InvalidValueError: A seed that is no integer from 0 on, not a macrostate of this task, or as
                :meth:`require_limit`.
        """
        info = self.restart(seed=seed, options=options)
        self._show()
        return self.observe([self])[0], info

    def restart(self, *, seed: int | None = None, options: Info | None = None) -> Info:
        """As :meth:`reset`, without an observation."""
        self.require_limit(self.spec)
        super().reset(seed=None if seed is None else require_integer("seed", seed, 0))
        return self._begin(self._start(options_of(options)))

    def require_limit(self, spec: EnvSpec | None) -> None:
        """Raise InvalidValueError: the id that this was made by ends episodes elsewhere than at the world's horizon."""
        registered = None if spec is None else gymnasium.registry.get(spec.id)
        limit = None if registered is None else registered.max_episode_steps
        if registered is not None and limit not in (None, self.task.horizon):
            horizon = self.task.horizon
            raise InvalidValueError(
                f"{registered.id} ends after {limit} macro-actions, so leave out horizon={horizon} and give "
                f"max_episode_steps={horizon}."
            )

    def step(self, action: Any) -> tuple[Observed, float, bool, bool, Info]:
        """Carry out one action.

        Raises:
            InvalidValueError: No such action, or no episode was begun.
        """
        reward, terminated, truncated, info = self.act(action)
        self._show()
        seen = self.observe([self])[0] if self.begun else copy.deepcopy(self._latest_observation())
        return seen, reward, terminated, truncated, info

    @abc.abstractmethod
    def act(self, action: Any) -> Step:
        """As :meth:`step`, without an observation. Nothing is drawn, so any thread may call it.

        A simulation that blows up truncates the episode, and no episode is begun then.
        """

    def set_state(self, state: Any) -> None:
        """Go on from where :meth:`get_state` was called, in this or another environment of the same kind, to the bit.

        Raises:
            InvalidValueError: A state of another kind of environment, a damaged one, or none at all; then nothing has
                changed.
        """
        before = self.get_state()
        if not isinstance(state, type(before)) or state.kind != before.kind:
            given = state.kind if isinstance(state, type(before)) else state
            words = "get_state() of an environment made alike"
            raise InvalidValueError(f"{brief(given)} is no state of {brief(before.kind)}; give one of {words}.")
        try:
            self._put_state(state)
        except Exception as error:  # a damaged state can be wrong in any way
            self._put_state(before)
            raise InvalidValueError(f"The state is damaged: {why(error)}. The environment stands as before.") from error

    @abc.abstractmethod
    def get_state(self) -> Any:
        """All that decides how the episode goes on, copied; of a wrapper it knows nothing."""

    @abc.abstractmethod
    def _put_state(self, state: Any) -> None:
        """Take over a state of this kind of environment; one that is damaged may raise anything halfway."""

    def _require_begun(self) -> None:
        if not self.begun:
            raise InvalidValueError("There is no episode to go on with; call reset() first.")

    def _require_values(self, macrostate: State) -> None:
        """Raise InvalidValueError: a macrostate has not one value for each of its names."""
        values = self.task.macrostate_values
        if len(macrostate) != len(values) or any(
            value not in range(len(names)) for value, names in zip(macrostate, values, strict=True)
        ):
            raise InvalidValueError(f"its macrostate is {brief(macrostate)}")

    def prepare(self) -> None:
        """Make the parts that actions need, in the thread that calls; nothing by default."""

    @abc.abstractmethod
    def checked(self, action: Any) -> Any:
        """An action in the form that :meth:`act` works with. Raises InvalidValueError: no such action."""

    @abc.abstractmethod
    def observe(self, envs: Sequence[Self]) -> list[Observed]:
        """The observations of :meth:`reset` and :meth:`step` for environments like this, by its cameras; once a
        moment.
        """

    @abc.abstractmethod
    def _begin(self, start: State) -> Info:
        """Begin an episode there."""

    @abc.abstractmethod
    def _latest_observation(self) -> Observed:
        """The observation before the simulation blew up."""

    @abc.abstractmethod
    def _show(self) -> None:
        """Show the latest action in the window, if there is one."""

    def render(self) -> Frame | None:
        """The scene as ``camera`` sees it, for ``"rgb_array"``; else None. Shape (height, width, 3)."""
        return self.rendered([self])[0] if self.render_mode == "rgb_array" else None

    def rendered(self, envs: Sequence[SceneEnv]) -> list[Frame]:
        """The images of :meth:`render` for environments like this, drawn by its camera."""
        return self.renderer_for_people(*self._image_of).frames([(env.model, env.data) for env in envs])

    def close(self) -> None:
        """Free the OpenGL contexts and close the window; may be called again."""
        for camera in self._cameras:
            camera.close()
        if self._window is not None:
            self._window.close()

    def _start(self, options: Info) -> State:
        for key in options:
            require_known("reset option", key, ("macrostate",))
        starts = self._rules.start_states
        if "macrostate" not in options:
            return starts[int(self.np_random.integers(len(starts)))]
        given = options["macrostate"]
        start: State | None = None
        with contextlib.suppress(Exception):  # a value without numbers can fail in any way
            start = self._known.get(tuple(np.asarray(given)))
        if start is None:
            listed = f"one of the {len(self._known)} of imagine_bench.registry.task({self.task.id!r}).rules.states"
            raise InvalidValueError(f"No macrostate {brief(given)}; give {listed}, such as {starts[0]}.")
        return start


def options_of(options: Info | None) -> Info:
    """Options of a reset, copied. Raises InvalidValueError: they are no mapping."""
    if options is not None and not isinstance(options, Mapping):
        raise InvalidValueError(
            f"Reset options {brief(options)} are no mapping; give {{'macrostate': ...}} or nothing."
        )
    return dict(options or {})
