"""Splits of starts: what training must never show, and that they are data with a hash."""

from __future__ import annotations

import numpy as np
import pytest
from machines import Wheels

from imagine_bench.certificates.splits import Split, by_pairs, by_plan_length, by_values
from imagine_bench.errors import InvalidValueError
from imagine_bench.rules import fewest_actions

RULES = Wheels()


def test_a_split_by_plan_length_has_longer_plans_in_tests():
    split = by_plan_length(RULES, 2)
    assert max(fewest_actions(RULES, state) for state in split.train) == 2
    assert min(fewest_actions(RULES, state) for state in split.test) == 3
    assert sorted(split.train + split.test) == sorted(RULES.start_states)


def test_held_out_pairs_are_never_trained_on_but_their_values_are():
    split = by_pairs(RULES, 0, 3, 3, np.random.default_rng(0))
    trained, tested = ({(s[0], s[3]) for s in starts} for starts in (split.train, split.test))
    assert len(tested) == 3 and not trained & tested
    for i in (0, 1):
        assert {pair[i] for pair in tested} <= {pair[i] for pair in trained}
    with pytest.raises(InvalidValueError, match=r"pairs can be held out, not 99"):
        by_pairs(RULES, 0, 3, 99, np.random.default_rng(0))


def test_a_split_is_known_by_its_content():
    split = by_values(RULES, 3, {2})
    assert {state[3] for state in split.test} == {2} and {state[3] for state in split.train} == {0, 1}
    again = Split(name="another", train=split.train[::-1], test=split.test)
    assert split.hash == again.hash != by_values(RULES, 3, {1}).hash
    with pytest.raises(InvalidValueError, match="leaves no start for test"):
        by_values(RULES, 3, {9})
