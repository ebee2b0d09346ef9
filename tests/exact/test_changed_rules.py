"""Rules with one thing changed, against their outcomes by hand."""

from __future__ import annotations

import pytest
from machines import Wheels

from imagine_bench.exact.changed_rules import one_change_each
from imagine_bench.rules import states_of_play

RULES = Wheels(n=2)
CHANGES = {
    "failures cost nothing": "0. 50! -1 0.",
    "failures pay": "50. 50! -1 50.",
    "failures end nothing": "-5 50! -1 -5",
    "steps cost nothing": "-5. 50! 0 -5.",
    "successes pay nothing": "-5. 0! -1 -5.",
    "successes cost": "-5. -50! -1 -5.",
    "macro-actions are reversed": "-5. -1 50! -5.",
    "macro-actions are shifted": "50! -1 -5. -5.",
    "macro-actions slip": "-5. 0 50! 0 -1 0 -5. 0",
    "one macro-action has another's effect, too": "-1 50! -1 -5.",
    "the goal is here": "-5. 0 50! -5.",
}
"""By rule: the rewards of four macro-actions that fail (.), succeed (!), go on, and fail, if nothing is changed.

The first one also turns the other wheel forth, so that they are not alike.
"""


@pytest.mark.parametrize("name", CHANGES)
def test_each_changes_one_thing(name):
    dynamics = one_change_each(RULES, states_of_play(RULES), {"here": (1, 3, 0)})[name]
    found = [each for action in range(4) for each in dynamics((1, 2, 0), action)]
    said = (f"{each.reward:g}{'!' if each.success else '.' if each.terminated else ''}" for each in found)
    assert " ".join(said) == CHANGES[name]
