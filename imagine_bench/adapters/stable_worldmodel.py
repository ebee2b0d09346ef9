"""Our tasks in the ``World`` of stable-worldmodel (Maes et al. 2026, arXiv 2605.21800), version 0.1.1.

Its evaluation counts every termination as a success, and ours also end where nothing can be won any more: without this
wrapper a random policy scores 100 %::

    import stable_worldmodel as swm
    from imagine_bench.adapters.stable_worldmodel import SuccessTerminates

    world = swm.World(
        "imagine_bench/ArrowPuzzle-v0", num_envs=4, image_shape=(64, 64), max_episode_steps=10,
        pre_wrappers=[SuccessTerminates],
    )

``max_episode_steps`` is the task's horizon (``imagine-bench describe``); the library's own default is another. An
evaluation from a dataset takes ``observation="proprio"`` (it cannot read back a second column of images) and, to begin
where the recorded episodes do, ``callables=[{"method": "start_at", "args": {"macrostate": {"value": "macrostate"}}}]``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from imagine_bench.arrays import Action, Info, Observed, State
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces import Frame
from imagine_bench.interfaces.environments import Env, Wrapper


class SuccessTerminates(Wrapper):
    """Terminates on success alone; every other end of an episode is a truncation.

    The ``pixels`` that the library records and shows its models are the frames of our agents, info holds Python's
    bools, which it records as columns. With equal seeds episodes are those of the environment itself: the library's
    draws for its bookkeeping come from a generator of the wrapper.

    Raises:
        InvalidValueError: An environment of something else, or one whose frames are late.
    """

    def __init__(self, env: Env) -> None:
        if not hasattr(env.unwrapped, "agent_view"):
            raise InvalidValueError(f"{env} is no task of imagine_bench; give one.")
        sight = getattr(getattr(env.unwrapped, "task", None), "sight", None)
        if sight is not None and sight.lag:
            raise InvalidValueError("The library records how the scene looks now; give a world without lag.")
        super().__init__(env)
        self._bookkeeping = np.random.default_rng(0)

    def reset(self, *, seed: int | None = None, options: dict[str, State] | None = None) -> tuple[Observed, Info]:
        """Begin an episode."""
        if seed is not None:
            self._bookkeeping = np.random.default_rng(seed)
        seen, info = self.env.reset(seed=seed, options=options)
        return seen, _plain(info)

    def step(self, action: Action) -> tuple[Observed, float, bool, bool, Info]:
        """Carry out one macro-action."""
        seen, reward, terminated, truncated, info = self.env.step(action)
        success = bool(info["success"])
        return seen, float(reward), success, not success and (terminated or truncated), _plain(info)

    def render(self) -> Frame:
        """The observation of the agent. Shape (64, 64, 3)."""
        return self.env.unwrapped.agent_view()  # type: ignore[attr-defined]

    def start_at(self, macrostate: ArrayLike) -> None:
        """Begin an episode in a recorded macrostate, one of ``callables`` of an evaluation from a dataset."""
        self.reset(options={"macrostate": tuple(np.asarray(macrostate).reshape(-1).tolist())})

    @property
    def unwrapped(self) -> SuccessTerminates:
        """This wrapper: the library looks for methods here."""
        return self

    @property
    def np_random(self) -> np.random.Generator:
        """The generator of the library's bookkeeping."""
        return self._bookkeeping

    @np_random.setter
    def np_random(self, value: np.random.Generator) -> None:
        self._bookkeeping = value


def _plain(info: Info) -> Info:
    return {key: bool(value) if isinstance(value, np.bool_) else value for key, value in info.items()}
