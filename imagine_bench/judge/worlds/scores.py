"""Scores of answers to questions about a whole world.

The score of an answer is the exact probability of the option that was held to be likeliest; of options that are held
equally likely it is the mean. So *exact* scores the mean of the largest probabilities, and chance one divided by the
number of options.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from imagine_bench.arrays import Bools, Floats, Ints
from imagine_bench.exact.values import TIE
from imagine_bench.interfaces.model import LearnedGraph
from imagine_bench.judge.worlds.families import SingleCausePairs
from imagine_bench.judge.worlds.graph import hamming_distance
from imagine_bench.judge.worlds.making import WorldQuestions
from imagine_bench.judge.worlds.tables import TransitionTable, copying_table

GRAPH = "factor graph"
MARGIN = 0.02  # by which copying must be above chance to be said so
FamilyScores = dict[str, float]
"""``right``, the mean score, and ``brier``, the mean squared distance of the probabilities from the exact ones; and
beside them ``chance``, ``copy`` and ``exact``, the mean scores of guessing, of saying that nothing changes and of the
rules.
"""


def scores_right(exact: Floats, held: Floats) -> Floats:
    """The score of each question, of probabilities (..., C). Shape (...)."""
    best = held >= held.max(axis=-1, keepdims=True) - TIE
    return (exact * best).sum(axis=-1) / best.sum(axis=-1)


def world_scores(asked: WorldQuestions, table: TransitionTable) -> dict[str, FamilyScores]:
    """The scores of a model by family, and of pairs by cause.

    A pair counts only if both its members are right; its score is the product of theirs.
    """
    copying = copying_table(asked.truth)
    found: dict[str, FamilyScores] = {}
    for family in asked.families:
        exact = family.answer(asked.truth)
        held = {"right": family.answer(table), "copy": family.answer(copying), "exact": exact}
        held["chance"] = np.full_like(exact, 1.0 / exact.shape[-1])
        right = {name: scores_right(exact, each) for name, each in held.items()}
        brier = float(((held["right"] - exact) ** 2).sum(axis=-1).mean())
        if isinstance(family, SingleCausePairs):
            right = {name: each.prod(axis=1) for name, each in right.items()}
        found[family.name] = {name: float(each.mean()) for name, each in right.items()} | {"brier": brier}
        if isinstance(family, SingleCausePairs):
            found |= _by_cause(family, right)
    return found


def graph_scores(learned: LearnedGraph, edges: Bools, coordinates: Ints) -> dict[str, FamilyScores]:
    """The structural Hamming distance of a learned factor graph, ``edges_wrong``, and the ``edges`` of the rules.

    ``coordinates`` are the macrostates (N, M) of the frames whose values ``learned`` holds.
    """
    wrong = hamming_distance(learned, edges, coordinates)
    return {GRAPH: {"edges_wrong": float(wrong), "edges": float(edges.sum())}}


def _by_cause(family: SingleCausePairs, right: Mapping[str, Floats]) -> dict[str, FamilyScores]:
    """Scores of the pairs with each cause."""
    causes = np.array(family.causes)
    found = {}
    for cause in dict.fromkeys(family.causes):
        found[f"only the {cause}"] = {name: float(each[causes == cause].mean()) for name, each in right.items()}
    return found
