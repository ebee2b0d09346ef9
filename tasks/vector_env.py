"""Many environments at once: each lane's macro-action runs on a thread, and contact physics uses all cores.

MuJoCo simulates without holding Python's lock, each lane on its own data, so the lanes are equal to single environments
bit for bit. Kinematic lanes have nothing to simulate, and a command of continuous control is shorter than handing it to
a thread: they act one after another. For continuous control on several cores take
``gymnasium.make_vec(..., vectorization_mode="async")``.
One camera draws all lanes, in the thread that calls.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from gymnasium.envs.registration import load_env_creator
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array
from gymnasium.wrappers import TimeLimit
from numpy.typing import NDArray

from imagine_bench.arrays import Floats, Frame, Info, Observed
from imagine_bench.cores import usable_cores
from imagine_bench.errors import InvalidValueError, brief, require_integer, require_known

from .scene_env import SceneEnv, Step, options_of

_MODES = {mode.value: mode for mode in AutoresetMode}
Batch = tuple[Observed, Floats, NDArray[np.bool_], NDArray[np.bool_], Info]


class _Acting(NamedTuple):
    """A lane in the middle of a macro-action, or of the reset that takes its place."""

    begun_s: float  #: when it began, on the clock that all lanes share
    step: Future[Step] | None  #: its result; None for a reset

    def due_s(self) -> float:
        """When it ends on that clock; waits until it has been simulated."""
        return self.begun_s if self.step is None else self.begun_s + float(self.step.result()[-1]["sim_time_s"])


class MacroVectorEnv(VectorEnv[Observed, NDArray[np.int64], NDArray[np.generic]]):
    """Several environments of one task in step, or each at its own pace by :meth:`send` and :meth:`recv`.

    Spaces, info and seeds are those of ``gymnasium.vector.SyncVectorEnv``: lane i is seeded ``seed + i``, info holds
    arrays with a mask ``_key`` for each ``key``. A lane whose simulation blows up is truncated, with the fault in its
    info and the observation before; the others go on.

    Args:
        lanes: The environments, made alike; ``envs`` holds them. The first one's cameras draw all.
        max_episode_steps: Macro-actions before truncation, or None.
        autoreset_mode: ``"SameStep"`` (the observation after an end is the next episode's first, the last is
            ``final_obs`` in info), ``"NextStep"`` (the action after an end is ignored) or ``"Disabled"`` (whoever acts
            resets, by ``reset(options={"reset_mask": ...})``), or Gymnasium's enum.
        threads: Macro-actions simulated at once; one a core if None.

    Raises:
        UnknownNameError: Another mode.
        InvalidValueError: No lanes or threads, a limit below 1, or a lane that is no environment of this suite.
    """

    def __init__(
        self,
        lanes: Sequence[SceneEnv],
        *,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,
        threads: int | None = None,
    ) -> None:
        name = autoreset_mode.value if isinstance(autoreset_mode, AutoresetMode) else autoreset_mode
        self.autoreset_mode = _MODES[require_known("autoreset mode", name, _MODES)]
        self.envs = tuple(lanes)
        self.num_envs = require_integer("num_envs", len(self.envs), 1)
        for lane in self.envs:
            if not isinstance(lane, SceneEnv):
                raise InvalidValueError(
                    f"{brief(lane)} is no environment that this suite can run in one process with others; give "
                    "gymnasium.make_vec the id of the single environment."
                )
        lanes = self.envs
        self._n_threads = require_integer("threads", usable_cores() if threads is None else threads, 1)
        if max_episode_steps is not None:
            max_episode_steps = require_integer("max_episode_steps", max_episode_steps, 1)
        self._pools: dict[int, ThreadPoolExecutor] = {}
        self._horizon = max_episode_steps
        fps = lanes[0].metadata["render_fps"]
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": fps, "autoreset_mode": self.autoreset_mode}
        mode = lanes[0].render_mode
        self.render_mode = None if mode is None else require_known("render mode", mode, ("rgb_array",))
        self.single_observation_space = lanes[0].observation_space
        self.single_action_space = lanes[0].action_space
        self.action_names = lanes[0].action_names
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._seen: list[Observed | None] = [None] * self.num_envs
        self._elapsed = np.zeros(self.num_envs, dtype=np.int64)
        self._over = np.ones(self.num_envs, dtype=np.bool_)
        self._acting: dict[int, _Acting] = {}
        self._clock_s = 0.0
        self._simulates = lanes[0].takes_long

    # --- Gymnasium -----------------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Info | None = None
    ) -> tuple[Observed, Info]:
        """Start an episode in every lane, whatever it was doing, or in those of ``options["reset_mask"]``.

        Args:
            seed: One number, which lane i adds i to, or one for each lane.
            options: Those of the task, the same for all lanes, and ``reset_mask``, bool of shape (num_envs,).

        Raises:
            InvalidValueError: Seeds or mask of another length or type, a macrostate that is none, or as
                :meth:`.SceneEnv.require_limit`.
            UnknownNameError: An unknown option.
        """
        self.envs[0].require_limit(self.spec)
        options = options_of(options)
        chosen = self._masked(options.pop("reset_mask", None))
        seeds = self._seeds(seed)
        for lane in chosen:
            acting = self._acting.pop(lane, None)
            if acting is not None and acting.step is not None:
                acting.step.result()  # its data is in use until then
        infos = self._restart(chosen, seeds, options, {})
        return self._stacked(range(self.num_envs)), infos

    def step(self, actions: NDArray[np.int64]) -> Batch:
        """One macro-action in every lane.

        Raises:
            InvalidValueError: As :meth:`send`; nothing has moved then.
        """
        self.send(actions)
        return self._received(list(range(self.num_envs)))

    def render(self) -> tuple[Frame, ...] | None:
        """An image of each lane, or None without a render mode."""
        return None if self.render_mode is None else tuple(self.envs[0].rendered(self.envs))

    def close_extras(self, **kwargs: object) -> None:
        """Free threads and OpenGL contexts."""
        del kwargs
        self._pool.shutdown()
        for lane in self.envs:
            lane.close()

    # --- at its own pace -----------------------------------------------------------------------------------------

    def send(self, actions: NDArray[np.int64] | Sequence[int], ids: Sequence[int] | None = None) -> None:
        """Begin a macro-action in each of these lanes, or all; :meth:`recv` returns its result.

        Args:
            actions: One for each lane. Shape (n,).
            ids: Different lanes, none of which is acting. Shape (n,).

        Raises:
            InvalidValueError: No such action or lane, a lane that acts already, or whose episode is over in the mode
                without autoreset; nothing has moved then.
        """
        lanes = self._named(ids)
        given = _one_each("Actions", actions, len(lanes))
        for lane in lanes:
            if lane in self._acting:
                raise InvalidValueError(f"Lane {lane} is acting; receive it first.")
            if self._seen[lane] is None or (self._over[lane] and self.autoreset_mode == AutoresetMode.DISABLED):
                raise InvalidValueError(f"Lane {lane} has no episode to go on with; reset it first.")
        chosen = [self.envs[lane].checked(action) for lane, action in zip(lanes, given, strict=True)]
        for lane, action in zip(lanes, chosen, strict=True):
            step = None if self._over[lane] else self._begin(self.envs[lane], action)
            self._acting[lane] = _Acting(self._clock_s, step)

    def recv(self, n: int | None = None) -> Batch:
        """The results of the ``n`` lanes, or all, that end first.

        First is first in simulated time, where lanes act side by side; it never depends on how fast anything runs.
        ``info["env_id"]`` says which they are, as every array of shape (n, ...) in this order.

        Raises:
            InvalidValueError: Not so many lanes are acting.
        """
        n = len(self._acting) if n is None else require_integer("n", n, 1)
        if not 1 <= n <= len(self._acting):
            raise InvalidValueError(f"{brief(n)} lanes cannot be received: {len(self._acting)} are acting.")
        due_s = {lane: acting.due_s() for lane, acting in self._acting.items()}
        first = sorted(due_s, key=due_s.__getitem__)[:n]
        self._clock_s = due_s[first[-1]]
        batch = self._received(first)
        infos = _rows(batch[-1], first)
        infos["env_id"] = np.array(first)
        return (*batch[:-1], infos)

    # --- details -------------------------------------------------------------------------------------------------

    def __getstate__(self) -> dict[str, Any]:
        """The attributes of a copy or a pickle: all but the threads, of which a copy has its own.

        Raises:
            InvalidValueError: A lane is acting.
        """
        if self._acting:
            raise InvalidValueError(f"Lanes {sorted(self._acting)} are acting; receive them before you copy or pickle.")
        return {**vars(self), "_pools": {}}

    @property
    def _pool(self) -> ThreadPoolExecutor:
        """The threads of this process; a parent's do not survive a fork."""
        if os.getpid() not in self._pools:
            self._pools[os.getpid()] = ThreadPoolExecutor(self._n_threads, "simulation")
        return self._pools[os.getpid()]

    def _received(self, lanes: list[int]) -> Batch:
        """Observations, rewards and ends of these lanes in this order; infos of all, masked."""
        rewards = np.zeros(len(lanes))
        terminated = np.zeros(len(lanes), dtype=np.bool_)
        truncated = np.zeros(len(lanes), dtype=np.bool_)
        acted: dict[int, Info] = {}
        for row, lane in enumerate(lanes):
            pending = self._acting.pop(lane).step
            if pending is not None:
                rewards[row], terminated[row], blew_up, acted[lane] = pending.result()
                self._elapsed[lane] += 1
                truncated[row] = blew_up or (self._horizon is not None and self._elapsed[lane] >= self._horizon)
        self._over[lanes] = terminated | truncated
        self._look([lane for lane in acted if self.envs[lane].begun])  # not those that blew up
        infos = Info()
        again = [lane for lane in lanes if lane not in acted]
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            again = [lane for lane in lanes if self._over[lane]]
            for lane in again:
                final = {"final_obs": self._seen[lane], "final_info": acted.pop(lane)}
                infos = self._add_info(infos, final, lane)
        for lane, info in acted.items():
            infos = self._add_info(infos, info, lane)
        infos = self._restart(again, [None] * self.num_envs, {}, infos)
        return self._stacked(lanes), rewards, terminated, truncated, infos

    def _begin(self, env: SceneEnv, action: Any) -> Future[Step]:
        """Begin a macro-action on another thread; a kinematic one is done here and now."""
        if self._simulates:
            env.prepare()  # one thread at a time may compile
            return self._pool.submit(env.act, action)
        done = Future[Step]()
        done.set_result(env.act(action))
        return done

    def _restart(self, lanes: list[int], seeds: Sequence[int | None], options: Info, infos: Info) -> Info:
        """Begin an episode in each of these lanes, and observe it; their infos beside the given ones."""
        for lane in lanes:
            infos = self._add_info(infos, self.envs[lane].restart(seed=seeds[lane], options=options), lane)
        self._elapsed[lanes] = 0
        self._over[lanes] = False
        self._look(lanes)
        return infos

    def _look(self, lanes: Sequence[int]) -> None:
        """Observe lanes anew, all by the cameras of the first."""
        if lanes:
            seen = self.envs[0].observe([self.envs[lane] for lane in lanes])
            for lane, observation in zip(lanes, seen, strict=True):
                self._seen[lane] = observation

    def _stacked(self, lanes: Sequence[int]) -> Observed:
        """The latest observations of these lanes, copied."""
        space = self.single_observation_space
        empty: Any = create_empty_array(space, n=len(lanes))
        stacked: Any = concatenate(space, [self._seen[lane] for lane in lanes], empty)
        return stacked

    def _named(self, ids: Sequence[int] | None) -> list[int]:
        if ids is None:
            return list(range(self.num_envs))
        lanes = [require_integer("A lane", each, 0) for each in _listed(ids)]
        if not lanes or len(set(lanes)) < len(lanes) or not 0 <= min(lanes) <= max(lanes) < self.num_envs:
            raise InvalidValueError(f"Lanes {brief(ids)}: give different integers from 0 to {self.num_envs - 1}.")
        return lanes

    def _masked(self, mask: NDArray[np.bool_] | None) -> list[int]:
        if mask is None:
            return list(range(self.num_envs))
        mask = np.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
            words = f"a bool array of shape ({self.num_envs},) in which one at least is True"
            raise InvalidValueError(f"reset_mask is {brief(mask)}; give {words}.")
        lanes: list[int] = np.flatnonzero(mask).tolist()
        if any(self._seen[lane] is None for lane in np.flatnonzero(~mask)):
            raise InvalidValueError("reset_mask leaves out lanes that were never reset; reset all lanes first.")
        return lanes

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if not isinstance(seed, (Sequence, np.ndarray)):
            first = require_integer("seed", seed, 0)
            return [first + lane for lane in range(self.num_envs)]
        seeds = _one_each("Seeds", seed, self.num_envs)
        return [None if each is None else require_integer("seed", each, 0) for each in seeds]


def _rows(infos: Info, lanes: list[int]) -> Info:
    """Those lanes of arrays over all lanes."""
    return {key: _rows(value, lanes) if isinstance(value, dict) else value[lanes] for key, value in infos.items()}


_Values = NDArray[np.int64] | Sequence[int | None]


def _listed(given: _Values) -> list[Any]:
    """A sequence or an array as a list, which is empty where it is something else."""
    values = given.tolist() if hasattr(given, "tolist") else given
    return list(values) if isinstance(values, Sequence) else []


def _one_each(what: str, given: _Values, n_lanes: int) -> list[Any]:
    values = _listed(given)
    if len(values) != n_lanes:
        raise InvalidValueError(f"{what} {brief(given)}: give a sequence of {n_lanes}, one for each lane.")
    return values


def make(
    num_envs: int,
    *,
    env: str,
    max_episode_steps: int | None = None,
    autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,
    threads: int | None = None,
    **options: Any,
) -> MacroVectorEnv:
    """The vector environment of a task, for ``gymnasium.make_vec``.

    Args:
        num_envs: Lanes.
        env: ``"module:attr"`` of the environment's constructor.
        max_episode_steps: As :class:`MacroVectorEnv`; an environment's own limit ends episodes before, as it does of a
            single one.
        autoreset_mode: As :class:`MacroVectorEnv`.
        threads: As :class:`MacroVectorEnv`.
        **options: Keyword arguments of the constructor, the same for all lanes.

    Raises:
        InvalidValueError: A number out of range, or a constructor of something else.
    """
    creator = load_env_creator(env)
    lanes: list[Any] = [creator(**options) for _ in range(require_integer("num_envs", num_envs, 1))]
    if isinstance(lanes[0], TimeLimit):  # one that limits itself
        own = lanes[0]._max_episode_steps
        given = own if max_episode_steps is None else require_integer("max_episode_steps", max_episode_steps, 1)
        max_episode_steps = min(given, own)
        lanes = [lane.unwrapped for lane in lanes]
    return MacroVectorEnv(lanes, max_episode_steps=max_episode_steps, autoreset_mode=autoreset_mode, threads=threads)
