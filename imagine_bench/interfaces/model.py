"""The interface of a world model that is judged: frames and actions in, imagined pictures out; numpy only.

Shapes: ``N`` questions, ``K`` frames of history, ``D`` imagined depth, ``S`` imagined futures of one question.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from imagine_bench.arrays import Array, Arrays, Bools, Floats, Frame, Images, Ints, Pixels, State
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces.episodes import Episodes
from imagine_bench.rules import Outcomes

Reals = NDArray[np.floating]
UNCERTAINTIES = ("epistemic", "aleatoric", "modal")
_SUM_TOLERANCE = 1e-4


@dataclass(frozen=True, kw_only=True)
class Imagined:
    """The imagination of a model. Whatever it does not offer stays None, and is judged as not offered."""

    #: Pictures, gray or RGB, uint8 or floats in [0, 1]. Shape (N, S, D, H, W) or (N, S, D, H, W, 3).
    pictures: Images
    #: Probability of each picture among those of its question and depth, summing to 1 over S. Shape (N, S, D). None
    #: makes all equally likely; a model that gives them may give any number S of pictures.
    probabilities: Array | None = None
    rewards: Array | None = None  #: Reward of that action, 0 once that future has ended. Shape (N, S, D).
    p_ended: Array | None = None  #: Probability that the episode ended there or before. Shape (N, S, D).
    epistemic: Array | None = None  #: How much it does not know for want of data, in any unit. Shape (N, D).
    aleatoric: Array | None = None  #: How much is noise. Shape (N, D).
    modal: Array | None = None  #: How far several possible outcomes are apart. Shape (N, D).
    #: Whether a filter of its own would let it learn from, or act on, its imagination there. Shape (N, D), bool.
    accepted: Array | None = None


class WorldModel(Protocol):
    """A world model from anyone. It sees frames and actions only; an instance is fitted once."""

    def fit(self, dataset: Episodes, rng: np.random.Generator) -> None:
        """Learn from real episodes; everything random is drawn from ``rng``."""

    def imagine(self, frames: Frame, actions: Ints, samples: int, rng: np.random.Generator) -> Imagined:
        """Imagine D macro-actions from each of N histories, in S = ``samples`` futures.

        Args:
            frames: The K latest frames of each, oldest first. Shape (N, K, 64, 64, 3), uint8.
            actions: The K - 1 macro-actions between them, then the D to imagine. Shape (N, K - 1 + D).
            samples: Futures wanted of each question.
            rng: Draws whatever is random.
        """

    def parameters(self) -> int:
        """Numbers that were fitted."""


@dataclass(frozen=True, kw_only=True)
class LearnedGraph:
    """Which factors of a model decide which, by its own account."""

    #: Value of each factor in N frames. Shape (N, P).
    values: Ints
    #: By macro-action, factor that it changes, and factor that decides the change. Shape (A, P, P), bool.
    edges: Bools


@runtime_checkable
class GraphLearner(Protocol):
    """A world model that learns a factor graph, which is compared with that of the rules."""

    def factor_graph(self, frames: Frame) -> LearnedGraph | None:
        """The graph, with the values of its factors in frames (N, 64, 64, 3); None where there is none."""


class Untaught:
    """The methods that a world model that learns nothing shares with others."""

    def fit(self, dataset: object, rng: np.random.Generator) -> None:
        """Learn nothing."""

    def parameters(self) -> int:
        """None were fitted."""
        return 0


def require_imagined(imagined: object, *, name: str, rows: int, depth: int, samples: int) -> Imagined:
    """The answer of a model, checked.

    Raises:
        InvalidValueError: A wrong type or shape, NaN, or probabilities out of range or not summing to 1; the message
            names the model, the method and the field.
    """
    said = f"World model {name}: imagine()"
    if not isinstance(imagined, Imagined):
        raise InvalidValueError(f"{said} gave {type(imagined).__name__}; give an Imagined.")
    given = {field.name: getattr(imagined, field.name) for field in fields(Imagined)}
    offered = {each: array for each, array in given.items() if array is not None}
    for each, array in offered.items():
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
            raise InvalidValueError(f"{said} gave {each} of {type(array).__name__}; give an array of numbers.")
        if each == "accepted" and array.dtype.kind != "b":
            raise InvalidValueError(f"{said} gave {each} of {array.dtype}; give an array of bool.")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise InvalidValueError(f"{said} gave {each} with NaN or infinity; give finite numbers.")
    _require_shapes(offered, said, (rows, samples, depth))
    _require_ranges(offered, said)
    return imagined


def require_graph(learned: LearnedGraph, *, name: str, rows: int, n_actions: int) -> LearnedGraph:
    """The graph of a model, checked.

    Raises:
        InvalidValueError: Arrays of a wrong type or shape.
    """
    said = f"World model {name}: factor_graph()"
    values = np.asarray(learned.values)
    edges = np.asarray(learned.edges)
    if values.dtype.kind not in "iu" or edges.dtype.kind != "b":
        raise InvalidValueError(f"{said} gave values of {values.dtype} and edges of {edges.dtype}; give int and bool.")
    factors = values.shape[-1] if values.ndim else 0
    wanted = ((rows, factors), (n_actions, factors, factors))
    if (values.shape, edges.shape) != wanted or not values.size:
        given = f"values of shape {values.shape} and edges of {edges.shape}"
        raise InvalidValueError(f"{said} gave {given}; give (N, P) of {rows} frames and (A, P, P), P at least 1.")
    return learned


def _require_shapes(offered: Arrays, said: str, asked: tuple[int, int, int]) -> None:
    """Raise InvalidValueError for arrays of other shapes than those of pictures (N, S, D, ...)."""
    rows, samples, depth = asked
    given = offered["pictures"].shape
    futures = given[1] if len(given) > 1 and "probabilities" in offered and given[1] else samples
    for each, array in offered.items():
        if each == "pictures":
            right = len(given) in (5, 6) and given[:3] == (rows, futures, depth) and given[5:] in ((), (3,))
            wanted = f"({rows}, {futures}, {depth}, H, W) or ({rows}, {futures}, {depth}, H, W, 3)"
            right = right and 0 not in given
        else:
            shape = (rows, depth) if each in (*UNCERTAINTIES, "accepted") else (rows, futures, depth)
            right = array.shape == shape
            wanted = str(shape)
        if not right:
            raise InvalidValueError(f"{said} gave {each} of shape {array.shape}; give {wanted}.")


def _require_ranges(offered: Arrays, said: str) -> None:
    """Raise InvalidValueError for pixels or probabilities out of range."""
    pixels = offered["pictures"]
    if pixels.dtype != np.uint8 and not (pixels.dtype.kind == "f" and pixels.min() >= 0.0 and pixels.max() <= 1.0):
        raise InvalidValueError(f"{said} gave pictures of {pixels.dtype}; give uint8, or floats from 0 to 1.")
    for each in offered.keys() & {"probabilities", "p_ended"}:
        if offered[each].min() < 0.0 or offered[each].max() > 1.0 + _SUM_TOLERANCE:
            raise InvalidValueError(f"{said} gave {each} outside of [0, 1]; give probabilities.")
    if "probabilities" in offered:
        sums = offered["probabilities"].sum(axis=1, dtype=np.float64)
        worst = sums.flat[int(np.abs(sums - 1.0).argmax())]
        if abs(worst - 1.0) > _SUM_TOLERANCE:
            raise InvalidValueError(f"{said} gave probabilities that sum to {worst:.4g} over S; they must sum to 1.")


def until_the_end(rewards: Reals, ends: Reals) -> tuple[Reals, Reals]:
    """Rewards that count, and whether the episode has ended, of futures that were imagined beyond its end.

    Args:
        rewards: Reward of each action as if the episode went on before it. Shape (N, S, D).
        ends: Probability that the episode ends with it, likewise. Shape (N, S, D).

    Returns:
        ``rewards`` and ``p_ended`` of :class:`Imagined`.
    """
    survived = np.cumprod(1.0 - ends, axis=2)
    before = np.pad(survived[:, :, :-1], ((0, 0), (0, 0), (1, 0)), constant_values=1.0)
    return before * rewards, 1.0 - survived


def imagined_outcomes(found: Sequence[Sequence[Outcomes]], draw: Callable[[State], Pixels]) -> Imagined:
    """Every outcome, with its probability, as pictures.

    Args:
        found: Of each question, the outcomes after each of its macro-actions. N of length D.
        draw: Draws a macrostate, or whatever else a model's states are; each in one shape.
    """
    futures = max(len(outcomes) for steps in found for outcomes in steps)
    shape = (len(found), futures, len(found[0]))
    pictures = np.zeros((*shape, *draw(next(iter(found[0][0]))[0]).shape), dtype=np.uint8)
    weights = np.zeros(shape)
    rewards = np.zeros(shape)
    ended = np.zeros(shape)
    for row, steps in enumerate(found):
        for step, outcomes in enumerate(steps):
            for slot, ((state, over), (share, reward)) in enumerate(outcomes.items()):
                place = (row, slot, step)
                pictures[place] = draw(state)
                weights[place] = share
                rewards[place] = reward
                ended[place] = over
    return Imagined(pictures=pictures, probabilities=weights, rewards=rewards, p_ended=ended)


def weights_of(imagined: Imagined) -> Floats:
    """The probability of each picture at its depth. Shape (N, S, D)."""
    if imagined.probabilities is not None:
        return np.asarray(imagined.probabilities, dtype=np.float64)
    shape = imagined.pictures.shape[:3]
    return np.full(shape, 1.0 / shape[1])
