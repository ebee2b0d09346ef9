"""Splits of starts: the starts that training must never show, and that they are data with a hash."""

from __future__ import annotations

import copy
import dataclasses
import pickle

import pytest
from machines import Wheels

from imagine_bench.errors import InvalidValueError
from imagine_bench.exact.splits import Split, StartingFrom, split_of

RULES = Wheels()


@pytest.mark.parametrize(("first", "second"), [(0, 3), (3, 0)])
@pytest.mark.parametrize("held_out", [3, 6])
def test_held_out_pairs_are_never_trained_on_but_their_values_are(first, second, held_out):
    split = split_of(RULES, f"pairs={first}:{second}:{held_out}")
    trained, tested = ({(s[first], s[second]) for s in starts} for starts in (split.train, split.test))
    assert len(tested) == held_out and not trained & tested
    for i in (0, 1):
        assert {pair[i] for pair in tested} <= {pair[i] for pair in trained}


class _Jammed(Wheels):
    """The last wheel never turns: no start whose finger is at it can be solved."""

    def outcomes(self, state, action):
        if action // 2 == self.n - 1:
            return (self.judge(state, action, state),)
        return super().outcomes(state, action)


def test_a_split_by_plan_length_leaves_out_unsolvable_starts():
    """The others need one turn where the pointed wheel is at 1 or 3, and two turns where it is at 2."""
    rules = _Jammed(forbid=False)
    split = split_of(rules, "plan_length=1")
    solvable = {state for state in rules.start_states if state[-1] != rules.n - 1}
    far = {state for state in solvable if state[state[-1]] == 2}
    assert set(split.test) == far and set(split.train) == solvable - far
    assert 0 < len(solvable) < len(rules.start_states)


def test_a_split_is_known_by_its_content():
    split = split_of(RULES, "values=3:2")
    assert {state[3] for state in split.test} == {2} and {state[3] for state in split.train} == {0, 1}
    assert sorted(split.train + split.test) == sorted(RULES.start_states)
    again = Split(name="another", train=split.train[::-1], test=split.test)
    assert split.hash == again.hash != split_of(RULES, "values=3:1").hash
    fewer = (dataclasses.replace(split, train=split.train[1:]), dataclasses.replace(split, test=split.test[1:]))
    assert len({split.hash, *(each.hash for each in fewer)}) == 3
    with pytest.raises(InvalidValueError, match="leaves no start for test"):
        split_of(RULES, "plan_length=99")


def test_a_split_names_no_value_that_no_start_has():
    for wrong in ("values=3:9", "values=3:2:9", "values=3:-1"):
        with pytest.raises(
            InvalidValueError, match=r"^No start has the value (9|-1) of coordinate 3; .* \[0, 1, 2\]\.$"
        ):
            split_of(RULES, wrong)


def test_rules_with_fewer_starts_are_copied_and_pickled_and_are_the_rules_in_all_else():
    rules = StartingFrom(RULES, RULES.start_states[:2])
    for each in (rules, copy.deepcopy(rules), pickle.loads(pickle.dumps(rules))):
        assert each.start_states == RULES.start_states[:2] and each.rules == RULES
        assert each.outcomes(each.start_states[0], 0) == RULES.outcomes(RULES.start_states[0], 0)
        with pytest.raises(AttributeError, match="no_such_thing"):
            _ = each.no_such_thing


def test_a_text_names_a_split_and_no_other_text_the_same():
    kept = {"plan_length=2": "187e0e3e93f2", "values=3:0:2": "e5b59b3f26f2", "pairs=0:3:2": "a7381b86e41b"}
    for text, digits in kept.items():
        found = split_of(RULES, text)
        assert found.identity == f"{text}@{digits}", "kept protocols name it so"
        assert split_of(RULES, found.identity) == found
        assert split_of(RULES, text.replace("=", "=+")).identity == found.identity  # however a number is written
    for same in ("values=3:2:0", "values=3:0:2:0"):
        assert split_of(RULES, same).identity == split_of(RULES, "values=3:0:2").identity
    with pytest.raises(InvalidValueError, match=r"is .{12} here, not 000000000000"):
        split_of(RULES, "plan_length=2@000000000000")
    for wrong in (
        "",
        "plan_length",
        "plan_length=long",
        "length=2",
        "values=99:1",
        "pairs=0:3",
        "values=-1:2",
        "pairs=0:-1:2",
        "pairs=-4:3:2",
    ):
        with pytest.raises(InvalidValueError, match="names no split of"):
            split_of(RULES, wrong)
    for too_many in (8, 99):
        with pytest.raises(InvalidValueError, match=rf"^Only 7 pairs can be held out, not {too_many}\.$"):
            split_of(RULES, f"pairs=0:3:{too_many}")
    assert len({(state[0], state[3]) for state in split_of(RULES, "pairs=0:3:7").test}) == 7
