"""The seed tree: stable, addressable in any order, and with evaluation apart from training by construction."""

import itertools
import subprocess
import sys
import typing

import numpy as np
import pytest

from imagine_bench.errors import InvalidValueError, UnknownNameError
from imagine_bench.seeding import Purpose, SeedTree, episode_seed, seed_range, seeds_text


def test_children_differ_and_do_not_depend_on_order():
    tree = SeedTree(7)
    first, second = tree.child("agent").integer(), tree.child("agent", "masks").integer()
    again = SeedTree(7)
    assert (again.child("agent").child("masks").integer(), again.child("agent").integer()) == (second, first)
    assert tree.child("a", "b").child("c", 1).integer() == tree.child("a").child("b", "c", 1).integer()
    nodes = [SeedTree(seed).child(name, i) for seed in (3, 4) for name in ("a", "b") for i in range(50)]
    assert len({node.integer() for node in nodes}) == 200
    draws = [node.generator().random(5).tolist() for node in nodes]
    assert len(set(map(tuple, draws))) == 200
    assert draws == [node.generator().random(5).tolist() for node in nodes], "each call begins the stream anew"


def test_seeds_are_equal_in_another_process():
    code = "from imagine_bench.seeding import SeedTree; print(SeedTree(11).child('agent', 2).integer())"
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert int(printed) == SeedTree(11).child("agent", 2).integer()


def test_episode_seeds_never_meet():
    purposes = typing.get_args(Purpose)
    edges = (0, 1, 2**24 - 1), (0, 1, 9_999, 2**32 - 1)
    seeds = [episode_seed(p, s, e) for p, s, e in itertools.product(purposes, *edges)]
    assert len(set(seeds)) == len(purposes) * 12
    assert max(seeds) < 2**63


def test_seeds_as_text_are_read_back_and_neighbours_are_one_word():
    rng = np.random.default_rng(0)
    for _ in range(50):
        seeds = np.flatnonzero(rng.random(30) < 0.7).tolist()
        words = seeds_text(seeds).split()
        assert list(itertools.chain.from_iterable(map(seed_range, words))) == seeds
    assert seeds_text([0, 1, 3, 4, 5, 9]) == "0 1 3-5 9"


def test_bad_values_say_what_is_allowed():
    with pytest.raises(
        UnknownNameError, match=r"No seed purpose 'evaluate'. Did you mean 'evaluation'\? Known: training"
    ):
        episode_seed("evaluate", 0, 0)
    with pytest.raises(InvalidValueError, match=r"seed 16777216 and episode 0 must lie in \[0, 2\*\*24\)"):
        episode_seed("training", 2**24, 0)
    with pytest.raises(InvalidValueError, match="Seed -1 is negative"):
        SeedTree(-1)
    assert len(seed_range("5-1004")) == 1000, "the most"
