"""Conformal acceptance keeps its promise where it promises something; fidelity is that of enumeration."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections import defaultdict

import numpy as np
import pytest
from judged import STILL, Altered, asked_pairs, judged_world

from imagine_bench.arrays import Floats, Frame, Ints
from imagine_bench.interfaces import State, TaskSpec
from imagine_bench.interfaces.model import Imagined, WorldModel
from imagine_bench.judge import questions
from imagine_bench.judge.policies.acceptance import ALPHA, acceptance_scores, conformal_threshold, occupancies
from imagine_bench.judge.policies.agreement import DenseModel, dense
from imagine_bench.judge.policies.fidelity import fidelity, value_in_its_frames
from imagine_bench.judge.policies.policy_set import PolicyWorld, policy_world
from imagine_bench.judge.reading import RenderedFrameIndex
from imagine_bench.judge.scores import acceptance_scores as scores_by_policy
from imagine_bench.judge.scores import imagined_models, light_scores, risk_coverage
from imagine_bench.rules import states_of_play
from imagine_bench.running.collect import POLICIES
from imagine_bench.seeding import SeedTree

ARROWS = "arrows:cubes=2"


def world_of(task: str) -> PolicyWorld:
    found = policy_world(judged_world(task).spec, judged_world(task).one_step.macrostates)
    assert found is not None
    return found


# Conformal acceptance ----------------------------------------------------------------------------------------------


def test_the_threshold_is_that_by_hand() -> None:
    uncertainty = np.arange(39.0)
    wrong = np.zeros(39, dtype=bool)
    wrong[[3, 7, 20]] = True
    assert conformal_threshold(uncertainty, wrong, 0.05) == 7.0  # floor(0.05 * 40) - 1 = 1 wrong one may be before it
    assert conformal_threshold(uncertainty[:38], wrong[:38], 0.05) == 3.0  # floor(1.95) - 1 = 0
    assert conformal_threshold(uncertainty[:18], wrong[:18], 0.05) == -math.inf, "too few to promise anything"
    assert conformal_threshold(uncertainty, np.zeros(39, dtype=bool), 0.05) == math.inf


@pytest.mark.parametrize("levels", [3, 1_000], ids=["with ties", "hardly a tie"])
@pytest.mark.parametrize("useful", [True, False])
def test_wrong_exchangeable_transitions_are_seldom_accepted(*, levels: int, useful: bool) -> None:
    rng = np.random.default_rng(0)
    failures = 0
    rounds = 4_000
    for _ in range(rounds):
        wrong = rng.random(60) < 0.3
        uncertainty = rng.integers(levels, size=60) + (levels // 2 * wrong if useful else 0)
        below = uncertainty[-1] < conformal_threshold(uncertainty[:-1], wrong[:-1], 0.1)
        failures += int(below and wrong[-1])
    promised = math.floor(0.1 * 60) / 60
    noise = 3.0 * math.sqrt(promised / rounds)
    assert failures / rounds <= promised + noise
    if levels == 1_000:
        assert failures / rounds >= promised - noise, "without ties it is not stricter than it need be"


def planted(world: PolicyWorld, wrong_states: Floats, knows: float) -> dict[str, float]:
    """The scores of a model that is wrong in some macrostates; ``knows`` 1 says just that."""
    frames = 2
    size = world.truth.reward.size * frames
    wrong = np.repeat(wrong_states, size // len(wrong_states)) > 0.0
    uncertainty = knows * wrong + np.random.default_rng(1).random(size) * 0.5
    data = occupancies(world, world.policies.tables[:1])[0]
    return acceptance_scores(world, data, uncertainty, wrong, np.random.default_rng(0))


def test_an_exact_model_is_accepted_and_known_errors_are_not() -> None:
    world = world_of(ARROWS)
    rng = np.random.default_rng(2)
    exact = planted(world, np.zeros(len(world.states)), knows=0.0)
    assert exact["accepts"] == pytest.approx(1.0)
    assert exact["wrong_on_data"] == exact["wrong_worst_policy"] == 0.0
    wrong = (rng.random(len(world.states)) < 0.3).astype(float)
    known = planted(world, wrong, knows=1.0)
    knows_nothing = planted(world, wrong, knows=0.0)
    assert known["accepts"] > 0.5 > knows_nothing["accepts"]
    assert known["wrong_on_data"] <= ALPHA
    assert knows_nothing["wrong_on_data"] <= ALPHA


def test_the_guarantee_breaks_where_data_is_rare() -> None:
    world = world_of("arrows:cubes=2,goal=clockwise")
    often = occupancies(world, world.policies.tables[:1])[0].sum(axis=1)
    rare = np.zeros(len(often))
    rare[np.argsort(often, kind="stable")[: math.ceil(len(often) / 4)]] = 1.0
    found = planted(world, rare, knows=-1.0)  # it is surest where it is wrong
    assert often[rare > 0].sum() < 0.2
    assert found["wrong_on_data"] <= ALPHA < min(found["wrong_rare"], found["wrong_worst_policy"])


def test_errors_where_the_data_never_was_are_counted() -> None:
    """No threshold is learned from them, so all are accepted; the rarest quarter of the macrostates is all wrong."""
    world = world_of(ARROWS)
    n_states, n_actions = world.truth.reward.shape
    never = np.zeros(n_states, dtype=bool)
    never[-math.ceil(n_states / 4) :] = True
    data = np.repeat(~never[:, None], n_actions, axis=1) / ((~never).sum() * n_actions)
    wrong = np.repeat(never, n_actions)
    found = acceptance_scores(world, data, np.zeros(wrong.size), wrong, np.random.default_rng(0))
    there = occupancies(world, world.policies.tables)[:, never].sum(axis=(1, 2))
    assert (found["accepts"], found["wrong_on_data"]) == (pytest.approx(1.0), 0.0)
    assert found["wrong_rare"] == pytest.approx(1.0)
    assert found["wrong_policies"] == pytest.approx(there.mean())
    assert found["wrong_worst_policy"] == pytest.approx(there.max()) != pytest.approx(there.mean())


def collected(spec: TaskSpec, policy: str) -> dict[tuple[State, int], float]:
    """How often a policy takes each macro-action, up to a factor: every course of its episodes."""
    found = defaultdict[tuple[State, int], float](float)
    starts, steps = (states_of_play(spec.rules), 1) if policy == "uniform" else (spec.rules.start_states, spec.horizon)
    reached = dict.fromkeys(starts, 1.0)
    for _ in range(steps):
        after = defaultdict[State, float](float)
        for (state, share), action in itertools.product(reached.items(), range(spec.n_actions)):
            found[state, action] += share
            for outcome in spec.rules.outcomes(state, action):
                after[outcome.macrostate] += share * outcome.probability * (not outcome.terminated) / spec.n_actions
        reached = after
    return found


@pytest.mark.parametrize("policy", [*POLICIES, ""])
def test_the_scores_are_those_of_the_transitions_that_a_policy_collects(policy: str) -> None:
    """Those of other policies, and of none, are not known."""
    judged, world = judged_world(ARROWS), world_of(ARROWS)

    def alter(found: Imagined, frames: Frame, actions: Ints) -> Imagined:
        """Nothing comes of the first macro-action; it is no surer of one transition than of another."""
        pictures = found.pictures.copy()
        missed = [action == 0 for _, action in asked_pairs(judged, frames, actions)]
        pictures[missed] = frames[missed, -1][:, None, None]
        return dataclasses.replace(found, pictures=pictures, epistemic=frames[:, -1, 1, : actions.shape[1], 0] / 255.0)

    predictions = judged.predictions(Altered(judged, alter), judged.one_step)
    found = scores_by_policy(world, policy, judged.one_step, predictions, SeedTree(0))
    if policy not in ("random", "uniform"):
        assert all(map(math.isnan, found.values()))
        return
    counts = collected(judged.spec, policy)
    data = np.array([[counts[state, action] for action in range(judged.spec.n_actions)] for state in world.states])
    uncertainty = predictions.of_one_step("epistemic")
    assert uncertainty is not None
    wrong = np.array([action == 0 for _, action in judged.one_step.pairs])
    expected = acceptance_scores(world, data / data.sum(), uncertainty, wrong, SeedTree(0).generator())
    assert found == pytest.approx({f"conformal_{name}": value for name, value in expected.items()})
    assert found["conformal_wrong_on_data"] > 0.0


def test_the_risk_coverage_area_is_that_by_hand() -> None:
    wrong = np.array([False, True, False, True])
    assert risk_coverage(np.array([0.0, 1.0, 2.0, 3.0]), wrong) == pytest.approx((0 + 1 / 2 + 1 / 3 + 1 / 2) / 4)
    assert risk_coverage(np.zeros(4), wrong) == pytest.approx(0.5), "who knows nothing has the share of wrong ones"
    best = risk_coverage(wrong.astype(float), wrong)
    assert best == pytest.approx((0 + 0 + 1 / 3 + 1 / 2) / 4)


# Fidelity ----------------------------------------------------------------------------------------------------------


def test_the_exact_model_keeps_all_and_a_copy_one_action_s_part() -> None:
    world, judged = world_of(ARROWS), judged_world(ARROWS)
    rules = judged.spec.rules

    def kept(model: WorldModel) -> float:
        held = imagined_models(judged.one_step, judged.predictions(model, judged.one_step), rules)
        return fidelity(world, dense(held["ruled"]))

    def again(state: State, action: int, left: int) -> float:
        return sum(
            o.probability * (o.reward + (0.0 if o.terminated or left == 1 else again(o.macrostate, action, left - 1)))
            for o in rules.outcomes(state, action)
        )

    best = world.policies.names.index("optimal")
    chosen = dict(zip(world.states, world.policies.tables[best].argmax(axis=1).tolist(), strict=True))
    earned = np.mean([again(start, chosen[start], world.horizon) for start in rules.start_states])
    uniform = world.real[world.policies.names.index("uniform")]
    part = (earned - uniform) / (world.real[best] - uniform)
    assert kept(judged.exact) == pytest.approx(1.0) and kept(STILL) == pytest.approx(part) and part < 1.0


def test_returns_in_imagined_frames_are_those_of_all_pairs() -> None:
    """Macrostate 2 of the model is the end, of which no frame tells what to do."""
    rng = np.random.default_rng(0)
    truth, model = (DenseModel(rng.dirichlet(np.ones(3), size=(2, 2))[..., :2], rng.normal(size=(2, 2))) for _ in "ab")
    policy = rng.dirichlet(np.ones(2), size=2)
    chosen = np.vstack([policy, [0.5, 0.5]])
    ends = np.concatenate([model.onward, 1.0 - model.onward.sum(axis=2, keepdims=True)], axis=2)
    imagined = np.concatenate([ends, np.tile([0.0, 0.0, 1.0], (1, 2, 1))])

    def of(state: int, seen: int, left: int) -> float:
        if left == 0:
            return 0.0
        return sum(
            chosen[seen, action]
            * (
                truth.reward[state, action]
                + sum(
                    truth.onward[state, action, after] * imagined[seen, action, then] * of(after, then, left - 1)
                    for after, then in itertools.product(range(2), range(3))
                )
            )
            for action in range(2)
        )

    assert value_in_its_frames(truth, model, policy, 4) == pytest.approx([of(state, state, 4) for state in range(2)])


# Light -------------------------------------------------------------------------------------------------------------


def test_pairs_in_another_light_must_both_be_right() -> None:
    judged = judged_world(ARROWS)
    asked = questions.light_alone(judged.spec, judged.index.render)
    assert asked is not None
    assert asked.states[::2] == asked.states[1::2]
    assert (asked.actions[::2] == asked.actions[1::2]).all()
    exact, copied = (judged.predictions(model, asked) for model in (judged.exact, STILL))
    states = exact.states.copy()
    states[1::2] = np.array(asked.states[1::2])[:, None, None]  # in the second light nothing changes
    blind = dataclasses.replace(exact, states=states)
    pairs = questions.about_light(judged.spec, asked)
    scores = [light_scores(asked, each, pairs)["only the light"] for each in (exact, copied, blind)]
    assert scores[0]["right"] == scores[0]["exact"] == 1.0
    assert scores[1]["right"] == pytest.approx(scores[1]["copy"]) and scores[1]["right"] < 0.3
    assert scores[2]["right"] < 0.5
    dark = dataclasses.replace(judged.spec, render_macrostates=lambda states, *_: np.zeros((len(states), 64, 64, 3)))
    assert questions.light_alone(dark, RenderedFrameIndex(dark, "clean").render) is None
