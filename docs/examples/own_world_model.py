"""A world model of your own, judged against the exact truth of the rules. Run it: python own_world_model.py.

The model remembers the outcomes of each macro-action in each code of a frame, and draws from them. Of unseen ones
it says that nothing changes, and that it does not know.
"""

from __future__ import annotations

import sys

import numpy as np
import torch
from imagine_bench.agents.encoders.encoder import Encoder
from numpy.typing import NDArray

from imagine_bench.cli import main
from imagine_bench.interfaces import AgentContext, Frame
from imagine_bench.interfaces.episodes import Episodes
from imagine_bench.interfaces.model import Imagined
from imagine_bench.registry import WORLD_MODELS, WorldModelEntry

Outcome = tuple[str, float, bool]  # code of the next frame, reward, whether the episode ended


class OwnModel:
    """``memory[code, action]`` holds every outcome that was seen."""

    def __init__(self, context: AgentContext) -> None:
        assert context.encoder is not None
        self.encoder = Encoder.load(context.encoder)
        self.memory: dict[tuple[str, int], list[Outcome]] = {}

    def fit(self, dataset: Episodes, rng: np.random.Generator) -> None:
        codes, columns = self._codes(dataset.frames), (dataset.actions, dataset.rewards, dataset.terminated)
        for row, action, reward, ended in zip(dataset.rows[0], *columns, strict=True):
            self.memory.setdefault((codes[row], int(action)), []).append((codes[row + 1], float(reward), bool(ended)))

    def imagine(self, frames: Frame, actions: NDArray[np.int64], samples: int, rng: np.random.Generator) -> Imagined:
        asked = actions[:, frames.shape[1] - 1 :]
        shape = (len(frames), samples, asked.shape[1])
        rewards, ended, unknown, drawn = np.zeros(shape), np.zeros(shape), np.zeros(shape), np.empty(shape, dtype="U99")
        starts = self._codes(frames[:, -1])
        for row, sample in np.ndindex(shape[:2]):
            code, over = starts[row], False
            for step, action in enumerate(asked[row].tolist()):
                seen = self.memory.get((code, action))
                code, reward, ends = seen[int(rng.integers(len(seen)))] if seen else (code, 0.0, False)
                rewards[row, sample, step], over = 0.0 if over else reward, over or ends
                ended[row, sample, step], unknown[row, sample, step], drawn[row, sample, step] = over, not seen, code
        different, which = np.unique(drawn, return_inverse=True)
        pictures = self.encoder.decode(torch.tensor([list(map(float, code)) for code in different]))
        return Imagined(
            pictures=pictures[which.reshape(shape)], rewards=rewards, p_ended=ended, epistemic=unknown.mean(axis=1)
        )

    def parameters(self) -> int:
        return sum(map(len, self.memory.values()))

    def _codes(self, frames: Frame) -> list[str]:
        return ["".join(map(str, row)) for row in self.encoder.encode(frames)[0].round().int().tolist()]


WORLD_MODELS["own_model"] = WorldModelEntry(make="own_world_model:OwnModel", title="own model", encoder_kind="codes")
JUDGE = "judge --task pick_place --models copy own_model exact --sizes 30 300"

if __name__ == "__main__":
    main([*JUDGE.split(), *sys.argv[1:]])
