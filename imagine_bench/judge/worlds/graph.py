"""The distance of a learned factor graph from that of the rules.

A graph has an edge for each macro-action, factor that it changes, and factor that decides the change. The structural
Hamming distance is the number of edges that only one of two graphs has (Tsamardinos, Brown and Aliferis 2006). A
learned factor stands for the coordinate of the macrostate that it shares most information with; each stands for one at
most, and the edges of the others count as wrong.

Shapes: ``A`` macro-actions, ``M`` coordinates, ``P`` learned factors, ``N`` frames.
"""

from __future__ import annotations

import numpy as np
import scipy  # its parts load, slowly, when they are first used

from imagine_bench.arrays import Bools, Floats, Ints
from imagine_bench.exact.factors import factor_graph, machine, numbered
from imagine_bench.interfaces.model import LearnedGraph
from imagine_bench.rules import Rules


def edges_of_rules(rules: Rules) -> Bools:
    """The edges by macro-action, coordinate that changes, and coordinate that decides. Shape (A, M, M)."""
    n_coordinates = len(rules.start_states[0])
    edges = np.zeros((rules.n_actions, n_coordinates, n_coordinates), dtype=bool)
    for factor in factor_graph(machine(rules)).factors:
        for child in factor.children:
            edges[factor.action, child, list(factor.parents)] = True
    return edges


def hamming_distance(learned: LearnedGraph, edges: Bools, coordinates: Ints) -> int:
    """How many edges only one of two graphs has.

    Args:
        learned: The learned graph; its values are of the N frames.
        edges: Those of the rules. Shape (A, M, M).
        coordinates: The macrostates of the N frames. Shape (N, M).
    """
    place = _places(learned.values, coordinates)
    size = max(coordinates.shape[1], int(place.max(initial=-1)) + 1)
    both = np.zeros((2, len(edges), size, size), dtype=bool)
    both[0, :, : edges.shape[1], : edges.shape[2]] = edges
    both[1][:, place[:, None], place] = learned.edges
    return int((both[0] != both[1]).sum())


def _places(values: Ints, coordinates: Ints) -> Ints:
    """The coordinate of each learned factor, a number of its own from M on where it stands for none. Shape (P,)."""
    shared = np.array([[_information(own, true) for true in coordinates.T] for own in values.T])
    place = coordinates.shape[1] + np.arange(values.shape[1])
    if shared.size:
        rows, columns = scipy.optimize.linear_sum_assignment(-shared)
        known = shared[rows, columns] > 0.0
        place[rows[known]] = columns[known]
    return place


def _information(one: Ints, other: Ints) -> float:
    """Mutual information of two columns, divided by the larger of their entropies; 0 if one is constant."""
    joint = np.zeros((int(numbered(one).max()) + 1, int(numbered(other).max()) + 1))
    np.add.at(joint, (numbered(one), numbered(other)), 1.0 / len(one))
    entropies = (_entropy(joint.sum(axis=1)), _entropy(joint.sum(axis=0)))
    if min(joint.shape) == 1:
        return 0.0
    return max(0.0, sum(entropies) - _entropy(joint.ravel())) / max(entropies)


def _entropy(shares: Floats) -> float:
    some = shares[shares > 0.0]
    return float(-(some * np.log(some)).sum())
