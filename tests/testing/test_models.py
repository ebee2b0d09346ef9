"""The contract's checks of world models: content with our own, and each finds the fault that it is for."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from imagine_bench.agents.world_models.limits import Copy

from imagine_bench import registry
from imagine_bench.cli import exit_code as main
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces.model import Imagined
from imagine_bench.testing.contract import checks


class _Wrong(Copy):
    drawn = np.random.default_rng(0)


class _Lacking:
    __init__ = Copy.__init__
    fit = imagine = Copy.fit
    parameters = 7  # a number, and no method


class _Spoils(_Wrong):
    def fit(self, dataset: Any, rng: Any) -> None:
        dataset.rewards[0] += 1.0


class _Sneaks(_Wrong):
    def fit(self, dataset: Any, rng: Any) -> None:
        dataset.rewards.base[0] += 1.0


class _Uncounted(_Wrong):
    def parameters(self) -> Any:
        return None


class _Short(_Wrong):
    def imagine(self, frames: Any, actions: Any, samples: int, rng: Any) -> Imagined:
        return super().imagine(frames, actions[:, :1], samples, rng)


class _Paints(_Wrong):
    def imagine(self, frames: Any, actions: Any, samples: int, rng: Any) -> Imagined:
        frames[:, -1, 0, 0, 0] += 1
        return super().imagine(frames, actions, samples, rng)


class _Moody(_Wrong):
    asked = 0.0

    def imagine(self, frames: Any, actions: Any, samples: int, rng: Any) -> Imagined:
        self.asked += 1.0
        given = super().imagine(frames, actions, samples, rng)
        return dataclasses.replace(given, epistemic=np.full((len(frames), given.pictures.shape[2]), self.asked))


class _Drawn(_Wrong):
    def fit(self, dataset: Any, rng: Any) -> None:
        self.level = self.drawn.random()

    def imagine(self, frames: Any, actions: Any, samples: int, rng: Any) -> Imagined:
        depth = actions.shape[1] - frames.shape[1] + 1
        return Imagined(pictures=np.full((len(frames), samples, depth, 4, 4), self.level))


@pytest.mark.parametrize(
    ("made", "holds", "words"),
    [
        (_Lacking, "it is made", "_Lacking lacks parameters"),
        (_Spoils, "it learns", "fit() failed (ValueError: assignment destination is read-only)"),
        (_Sneaks, "it learns", "fit() alters the episodes"),
        (_Uncounted, "it learns", "parameters() gave None; give how many numbers were fitted"),
        (_Short, "it imagines pictures", "imagine() gave pictures of shape"),
        (_Paints, "it imagines pictures", "imagine() alters the frames or actions"),
        (_Moody, "asked again", "asked twice with equal generators, it imagines otherwise"),
        (_Drawn, "the same episodes", "two models with equal episodes and generators differ"),
    ],
)
@pytest.mark.usefixtures("own_names")
def test_wrong_models_are_found(made: type, holds: str, words: str) -> None:
    copy = registry.WORLD_MODELS["copy"]
    registry.WORLD_MODELS["copy"] = dataclasses.replace(copy, make=f"{__name__}:{made.__name__}")
    assert main(["check", "arrow_puzzle_easy", "--model", "copy"]) == 1
    found = checks(task="arrow_puzzle_easy", model="copy")
    for what, check in found.items():
        if what.startswith(holds):
            with pytest.raises(InvalidValueError) as caught:
                check()
            assert words in str(caught.value)
        elif made not in (_Lacking, _Spoils, _Short, _Paints):
            check()
