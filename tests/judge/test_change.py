"""A changed rule is noticed as soon as it shows; with equal draws another macro-action leads where it must."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections import Counter

import numpy as np
import pytest
from judged import STILL, Altered, judged_world

from imagine_bench.arrays import Ints
from imagine_bench.exact.changed_rules import SLIP, coupled, slipping
from imagine_bench.interfaces import Frame
from imagine_bench.interfaces.model import Imagined
from imagine_bench.judge.change import (
    FALSE_ALARMS,
    LENGTH,
    STREAMS,
    alarms,
    change_detection_delay,
    joint_outcomes,
    streams_of,
)
from imagine_bench.judge.questions import FRAMES

ARROWS, BOTH = "arrows:cubes=2", pytest.mark.parametrize("task", ["arrows:cubes=2", "pick_place"])


@BOTH
def test_streams_walk_as_the_rules_say(task: str) -> None:
    there = judged_world(task)
    streams = there.streams["usual"]
    asked = there.one_step.pairs
    walks = Counter(
        (*asked[row], streams.states[after]) for row, after in zip(streams.rows.flat, streams.reached.flat, strict=True)
    )
    totals = Counter(asked[row] for row in streams.rows.flat)
    for (state, action, reached), count in walks.items():
        (p,) = (o.probability for o in there.spec.rules.outcomes(state, action) if o.macrostate == reached)
        total = totals[state, action]
        assert abs(count / total - p) <= 5.0 * math.sqrt(p * (1.0 - p) / total) + 1e-12
    assert {there.one_step.states[row] for row in streams.rows[:, 0]} == set(there.spec.rules.start_states)
    each = np.bincount(streams.rows.ravel() % (there.spec.n_actions * FRAMES))
    assert len(each) == there.spec.n_actions * FRAMES, "every macro-action, in either frame"
    assert each / streams.rows.size == pytest.approx(1.0 / len(each), rel=0.03)


def test_a_part_of_the_world_has_no_streams() -> None:
    """Also where all starts are in that part."""
    there = judged_world("pick_place")
    asked = there.one_step
    elsewhere = next(state for state in asked.states if state not in there.spec.rules.start_states)
    rows = [row for row, state in enumerate(asked.states) if state != elsewhere]
    states, truth = (tuple(each[row] for row in rows) for each in (asked.states, asked.truth))
    part = dataclasses.replace(
        asked, states=states, truth=truth, frames=asked.frames[rows], actions=asked.actions[rows]
    )
    assert streams_of(there.spec, part) is None


@BOTH
def test_an_episode_of_a_stream_ends_by_the_rules_or_the_horizon(task: str) -> None:
    there = judged_world(task)
    found = streams_of(dataclasses.replace(there.spec, horizon=2), there.one_step)
    assert found is not None
    streams, asked = found["usual"], there.one_step.pairs
    stayed = []
    for rows, reached in zip(streams.rows[:20], streams.reached[:20], strict=True):
        lived = 0
        for row, after, following in zip(rows, reached, rows[1:], strict=False):
            lived += 1
            outcomes = there.spec.rules.outcomes(*asked[row])
            (over,) = {each.terminated for each in outcomes if each.macrostate == streams.states[after]}
            if over or lived == 2:
                assert asked[following][0] in there.spec.rules.start_states
                stayed += [] if over else [asked[following][0] == streams.states[after]]
                lived = 0
            else:
                assert asked[following][0] == streams.states[after]
    assert len(stayed) > 50 and np.mean(stayed) < 0.5


@BOTH
def test_changed_rules_are_still_rules(task: str) -> None:
    there = judged_world(task)
    rules, states = there.spec.rules, tuple(dict.fromkeys(there.one_step.states))
    both = coupled(rules, states)
    pairs = list(itertools.product(states, range(rules.n_actions)))
    for dynamics in (slipping(rules), both):
        for state, action in pairs:
            assert sum(each.probability for each in dynamics(state, action)) == pytest.approx(1.0)
    assert len({action for state, action in pairs if both(state, action) != rules.outcomes(state, action)}) == 1
    if task == ARROWS:
        moved = {sum(a != b for a, b in zip(state, both(state, 0)[0].macrostate, strict=True)) for state in states}
        assert moved == {2}, "a coupled turn turns another cube too"


def test_exact_notices_what_cannot_happen_at_once() -> None:
    there = judged_world(ARROWS)
    found = change_detection_delay(there.streams, there.predictions(there.exact, there.one_step))
    # every macro-action turns a cube, so a slip shows; one macro-action is coupled
    assert found["notice_slip"] == pytest.approx(1.0 / SLIP, rel=0.1)
    assert found["notice_coupling"] == pytest.approx(there.spec.n_actions, rel=0.1)


def test_a_model_that_is_always_surprised_notices_nothing() -> None:
    there = judged_world(ARROWS)
    answers = there.predictions(STILL, there.one_step)
    assert change_detection_delay(there.streams, answers) == {"notice_slip": LENGTH, "notice_coupling": LENGTH}
    assert all(math.isnan(value) for value in change_detection_delay(None, answers).values())


def unsure(right: Imagined, frames: Frame, actions: Ints) -> Imagined:
    """Nothing changes is as likely as all else together; so surprise is never certain."""
    still = STILL.imagine(frames, actions, 1, np.random.default_rng(0))
    weights = [0.5 * np.asarray(each.probabilities) for each in (right, still)]
    images = np.concatenate([right.pictures, still.pictures], axis=1)
    return Imagined(pictures=images, probabilities=np.concatenate(weights, axis=1))


def test_false_alarms_are_as_rare_as_promised() -> None:
    there = judged_world("pick_place")
    answers = there.predictions(Altered(there, unsure), there.one_step)
    other_seed = streams_of(dataclasses.replace(there.spec, id="with other streams"), there.one_step)
    assert other_seed is not None
    walks = [there.streams["usual"], other_seed["usual"], there.streams["coupling"]]
    shares = [float((first <= LENGTH).mean()) for first in alarms(walks, answers)]
    assert 0.0 < shares[0] <= FALSE_ALARMS
    assert shares[1] <= FALSE_ALARMS + 4.0 * math.sqrt(FALSE_ALARMS / STREAMS)
    assert shares[2] > 0.9


def test_alarms_depend_on_the_unchanged_world_and_their_own() -> None:
    """Streams of a second changed world in the same call change no alarm."""
    there = judged_world("pick_place")
    answers = there.predictions(Altered(there, unsure), there.one_step)
    usual, *changed = (there.streams[name] for name in ("usual", "slip", "coupling"))
    (quiet,) = alarms([usual], answers)
    both = alarms([usual, *changed], answers)
    assert np.array_equal(both[0], quiet)
    for found, streams in zip(both[1:], changed, strict=True):
        assert np.array_equal(alarms([usual, streams], answers), [quiet, found])
    assert len(np.unique(both[2])) > 10, "the moments of these alarms differ"


@BOTH
def test_copy_is_right_where_nothing_changes_exact_everywhere(task: str) -> None:
    there = judged_world(task)
    assert there.counterfactual_error(there.exact) == 0.0
    rules, states = there.spec.rules, there.counterfactuals[0].states
    stays = [[rules.outcomes(state, a)[0].macrostate == state for a in range(rules.n_actions)] for state in states]
    right = [a and b for row in stays for a, b in itertools.combinations(row, 2)]
    assert there.counterfactual_error(STILL) == pytest.approx(1.0 - np.mean(right))


def unlucky(found: Imagined, _: Frame, actions: Ints) -> Imagined:
    """Right of every macro-action alone, with other luck for odd ones: it draws in the opposite order."""
    odd = (actions[:, 0] % 2 == 1)[:, None, None]
    assert found.probabilities is not None
    return Imagined(
        pictures=np.where(odd[..., None, None, None], found.pictures[:, ::-1], found.pictures),
        probabilities=np.where(odd, found.probabilities[:, ::-1], found.probabilities),
    )


def test_other_draws_are_no_counterfactual() -> None:
    there = judged_world("arrows:cubes=2,slip=0.3")
    other = Altered(there, unlucky)
    answers = [there.predictions(model, there.one_step) for model in (there.exact, other)]
    for row in range(len(there.one_step.states)):
        assert answers[0].distribution(row, 0) == pytest.approx(answers[1].distribution(row, 0))
    assert there.counterfactual_error(there.exact) == 0.0
    assert there.counterfactual_error(other) > 0.1


def test_one_number_chooses_from_both_distributions_in_their_order() -> None:
    one, other = [((1,), 0.3), ((2,), 0.7)], [((3,), 0.5), ((4,), 0.5)]
    expected = {((1,), (3,)): 0.3, ((2,), (3,)): 0.2, ((2,), (4,)): 0.5}
    assert joint_outcomes(one, other) == pytest.approx(expected)
    assert joint_outcomes(one, one) == pytest.approx({((1,), (1,)): 0.3, ((2,), (2,)): 0.7})
    assert joint_outcomes([((1,), 0.5), ((1,), 0.5)], other) == {((1,), (3,)): 0.5, ((1,), (4,)): 0.5}
