"""A changed rule is noticed as soon as it shows; with equal draws another macro-action leads where it must."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math

import numpy as np
import pytest
from fake_reader import BlindReader
from numpy.typing import NDArray

from imagine_bench import registry
from imagine_bench.interfaces import Frame, TaskSpec
from imagine_bench.interfaces.model import Imagined, WorldModel
from imagine_bench.judge.models import change
from imagine_bench.judge.models.asking import Answers, ask, counterfactuals, one_step
from imagine_bench.judge.models.change import (
    FALSE_ALARMS,
    LENGTH,
    SLIP,
    STREAMS,
    Streams,
    counterfactual_error,
    coupled,
    noticing,
    slipping,
    streams_of,
    unchanged,
)
from imagine_bench.judge.models.ends import Copy, Exact, Gallery
from imagine_bench.judge.models.truth import Questions

BOTH = pytest.mark.parametrize("task", ["arrow_puzzle", "pick_place"])


@dataclasses.dataclass(frozen=True)
class World:
    spec: TaskSpec
    gallery: Gallery
    one_step: Questions
    streams: dict[str, Streams]
    counterfactuals: tuple[Questions, ...]

    def answers(self, model: WorldModel, questions: Questions) -> Answers:
        reader = BlindReader(len(self.spec.macrostate_names))
        rng = np.random.default_rng(0)
        return ask(model, "it", questions, samples=4, reader=reader, gallery=self.gallery, rng=rng)

    def counterfactual_error(self, model: WorldModel) -> float:
        return counterfactual_error(self.counterfactuals, [self.answers(model, each) for each in self.counterfactuals])


@functools.cache
def world(task: str) -> World:
    spec = registry.task(task)
    gallery = Gallery(spec, "clean")
    asked = one_step(spec, gallery)
    streams = streams_of(spec, asked)
    assert streams is not None
    return World(spec, gallery, asked, streams, counterfactuals(spec, gallery))


@BOTH
def test_streams_walk_as_the_rules_say(task: str) -> None:
    there = world(task)
    rules, streams = there.spec.rules, there.streams["usual"]
    shares: dict[tuple[object, int], dict[object, int]] = {}
    for row, reached in zip(streams.rows.ravel().tolist(), streams.reached.ravel().tolist(), strict=True):
        pair = there.one_step.states[row], int(there.one_step.asked[row, 0])
        found = shares.setdefault(pair, {})
        found[streams.states[reached]] = found.get(streams.states[reached], 0) + 1
    for (state, action), found in shares.items():
        exact = {o.macrostate: o.probability for o in rules.outcomes(state, action)}  # type: ignore[arg-type]
        assert found.keys() <= exact.keys()
        total = sum(found.values())
        for macrostate, count in found.items():
            p = exact[macrostate]  # type: ignore[index]
            assert abs(count / total - p) <= 5.0 * math.sqrt(p * (1.0 - p) / total) + 1e-12
    before = [there.one_step.states[row] for row in streams.rows[:, 0]]
    assert set(before) == set(rules.start_states)


@BOTH
def test_changed_rules_are_still_rules(task: str) -> None:
    there = world(task)
    rules, states = there.spec.rules, tuple(dict.fromkeys(there.one_step.states))
    for dynamics in (slipping(rules), coupled(rules, states)):
        for state, action in itertools.product(states, range(rules.n_actions)):
            assert sum(share for share, _, _ in dynamics(state, action)) == pytest.approx(1.0)
    usual, both = unchanged(rules), coupled(rules, states)
    changed = {a for s, a in itertools.product(states, range(rules.n_actions)) if both(s, a) != usual(s, a)}
    assert len(changed) == 1, "one rule changes"


def test_a_coupled_turn_turns_another_cube_too() -> None:
    there = world("arrow_puzzle")
    rules, states = there.spec.rules, tuple(dict.fromkeys(there.one_step.states))
    both = coupled(rules, states)
    moved = [sum(a != b for a, b in zip(state, both(state, 0)[0][1], strict=True)) for state in states]
    assert set(moved) == {2}


def test_exact_notices_what_cannot_happen_at_once() -> None:
    there = world("arrow_puzzle")
    found = noticing(there.streams, there.answers(Exact(there.spec, there.gallery), there.one_step))
    # every macro-action turns a cube, so a slip shows; a sixth of the macro-actions are the coupled one
    assert found["notice_slip"] == pytest.approx(1.0 / SLIP, rel=0.1)
    assert found["notice_coupling"] == pytest.approx(there.spec.n_actions, rel=0.1)


def test_a_model_that_is_always_surprised_notices_nothing() -> None:
    there = world("arrow_puzzle")
    found = noticing(there.streams, there.answers(Copy(), there.one_step))
    assert found == {"notice_slip": LENGTH, "notice_coupling": LENGTH}
    assert all(math.isnan(value) for value in noticing(None, there.answers(Copy(), there.one_step)).values())


class Unsure(Exact):
    """Exact, but that nothing changes is as likely to it as all else together; so surprise is never certain."""

    def imagine(self, frames: Frame, actions: NDArray[np.int64], samples: int, rng: np.random.Generator) -> Imagined:
        right, still = super().imagine(frames, actions, samples, rng), Copy().imagine(frames, actions, samples, rng)
        weights = [0.5 * np.asarray(each.probabilities) for each in (right, still)]
        return Imagined(
            pictures=np.concatenate([right.pictures, still.pictures], axis=1),
            probabilities=np.concatenate(weights, axis=1),
        )


def test_false_alarms_are_as_rare_as_promised() -> None:
    there = world("pick_place")
    answers = there.answers(Unsure(there.spec, there.gallery), there.one_step)
    fresh = change._walked(there.spec, there.one_step, unchanged(there.spec.rules), np.random.default_rng(7))
    usual, coupling = (there.streams[name] for name in ("usual", "coupling"))
    shares = [float((first <= LENGTH).mean()) for first in change.alarms([usual, fresh, coupling], answers)]
    assert 0.0 < shares[0] <= FALSE_ALARMS
    assert shares[1] <= FALSE_ALARMS + 4.0 * math.sqrt(FALSE_ALARMS / STREAMS)
    assert shares[2] > 0.9


@BOTH
def test_exact_knows_every_counterfactual(task: str) -> None:
    there = world(task)
    assert there.counterfactual_error(Exact(there.spec, there.gallery)) == 0.0


def test_copy_is_right_where_two_macro_actions_change_nothing() -> None:
    there = world("pick_place")
    rules, states = there.spec.rules, there.counterfactuals[0].states
    stays = [[rules.outcomes(state, a)[0].macrostate == state for a in range(rules.n_actions)] for state in states]
    right = [a and b for row in stays for a, b in itertools.combinations(row, 2)]
    assert there.counterfactual_error(Copy()) == pytest.approx(1.0 - np.mean(right))


class Unlucky(Exact):
    """Right of every macro-action alone, with other luck for odd ones: it draws in the opposite order."""

    def imagine(self, frames: Frame, actions: NDArray[np.int64], samples: int, rng: np.random.Generator) -> Imagined:
        found = super().imagine(frames, actions, samples, rng)
        odd = (actions[:, 0] % 2 == 1)[:, None]
        flipped = {
            "pictures": np.where(odd[..., None, None, None, None], found.pictures[:, ::-1], found.pictures),
            "probabilities": np.where(odd[..., None], found.probabilities[:, ::-1], found.probabilities),  # type: ignore[index]
        }
        return Imagined(**flipped)


def test_other_draws_are_no_counterfactual() -> None:
    there = world("arrows:cubes=2,slip=0.3")
    exact, unlucky = (kind(there.spec, there.gallery) for kind in (Exact, Unlucky))
    answers = [there.answers(model, there.one_step) for model in (exact, unlucky)]
    for row in range(len(there.one_step.states)):
        assert answers[0].distribution(row, 0) == pytest.approx(answers[1].distribution(row, 0))
    assert there.counterfactual_error(exact) == 0.0
    assert there.counterfactual_error(unlucky) > 0.1
