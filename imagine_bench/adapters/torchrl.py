"""Our environments in TorchRL 0.14, whose reader of infos takes numbers only.

A single one, with its infos::

    env = GymWrapper(NumericInfo(gymnasium.make("imagine_bench/ArrowPuzzle-v0"))).auto_register_info_dict()

A vector environment is wrapped as it is, in the mode that leaves resets to TorchRL, and without infos::

    env = GymWrapper(gymnasium.make_vec("imagine_bench/ArrowPuzzle-vector-v0", num_envs=4, autoreset_mode="Disabled"))
"""

from __future__ import annotations

from imagine_bench.arrays import Action, Info, Observed, State
from imagine_bench.environments import Wrapper


class NumericInfo(Wrapper):
    """The environment without the texts of its infos, such as ``fault_reason``."""

    def reset(self, *, seed: int | None = None, options: dict[str, State] | None = None) -> tuple[Observed, Info]:
        """Begin an episode."""
        seen, info = self.env.reset(seed=seed, options=options)
        return seen, _numbers(info)

    def step(self, action: Action) -> tuple[Observed, float, bool, bool, Info]:
        """Carry out one macro-action."""
        seen, reward, terminated, truncated, info = self.env.step(action)
        return seen, float(reward), terminated, truncated, _numbers(info)


def _numbers(info: Info) -> Info:
    return {key: value for key, value in info.items() if not isinstance(value, str)}
