"""The agent factored: structure from evidence, known unknowns, planning, exact resumption, learning in few episodes."""

from __future__ import annotations

import dataclasses
import itertools
from types import SimpleNamespace
from unittest import mock

import fake_codes
import numpy as np
import pytest
from fake_codes import ACTIONS, SIZES, agent, frame, live, starts, success
from imagine_bench_factored.agent import ACCEPTED, FactoredAgent
from imagine_bench_factored.factors import CodeTransition, contradictions
from imagine_bench_factored.model import FactoredModel, Moves, Results
from imagine_bench_factored.perception import CodePerception
from imagine_bench_factored.planner import TIE, Planner
from imagine_bench_factored.rewards import reward_classes
from imagine_bench_factored.settings import DynamicsSettings, FactoredSettings
from imagine_bench_factored.structured import StructuredModel
from numpy.typing import NDArray

from imagine_bench.errors import ArtefactError
from imagine_bench.interfaces import AgentContext, AgentState, Observation
from imagine_bench.interfaces.episodes import joined
from imagine_bench.seeding import SeedTree
from imagine_bench.testing.checks import same_state

PLANNING = FactoredSettings().planning
Code = tuple[int, ...]


def rows(codes: list[Code]) -> list[CodeTransition]:
    """Every macro-action in these codes."""
    pairs = itertools.product(codes, range(ACTIONS))
    return [CodeTransition(code, action, *fake_codes.step(code, action)) for code, action in pairs]


def fitted(seen: list[CodeTransition], sizes: Code = SIZES, n_actions: int = ACTIONS) -> FactoredModel:
    model = FactoredModel(sizes, n_actions, FactoredSettings())
    for row in seen:
        model.add(row)
    model.outcomes.fit()
    return model


@pytest.mark.parametrize("sizes", [(3, 4, 4, 4), (7, 7)])
def test_what_an_untried_action_does_is_imagined_as_expected(sizes: Code) -> None:
    """Whether a tie between experience and the prior is rounded up or down must not decide it."""
    code, rng = (0,) * len(sizes), np.random.default_rng(0)
    model = fitted([CodeTransition(code, 0, code, -1.0, False)] * 3, sizes, 2)
    expected = [part.expected[0, 1] for part in model.dynamics.predict(np.array([code]))]
    drawn = [model.sample(code, 1, rng) for _ in range(400)]
    assert [sure for _, sure in drawn] == pytest.approx([np.prod([chance.max() for chance in expected])] * 400)
    stayed = np.mean([not any(following) for following, _ in drawn])
    assert stayed == pytest.approx(np.prod([chance[0] for chance in expected]), abs=0.1) and stayed < 0.8
    assert all(not any(model.sample(code, 0, rng)[0]) for _ in range(20)), "seen to stay"


def test_nothing_is_learned_from_transitions_that_are_not_clear() -> None:
    seen = rows(starts())
    false = [row._replace(reward=-row.reward, terminated=not row.terminated, is_first=True) for row in seen]
    unclear = [row._replace(**{which: False}) for row in false for which in ("code_is_clear", "following_is_clear")]
    alone, both, misled = (fitted([*seen, *more]) for more in ([], unclear, false))
    expected = alone.probabilities(seen)
    np.testing.assert_array_equal(both.probabilities(seen), expected)
    assert not np.array_equal(misled.probabilities(seen), expected)
    assert contradictions([*seen, *unclear]) == 0 < contradictions([*seen, *false])
    assert reward_classes([*seen, *unclear]) == reward_classes(seen)


def structured() -> StructuredModel:
    context = AgentContext(n_actions=ACTIONS, preprocessing="gray_strips", encoder=None, seeds=SeedTree(0))
    return StructuredModel(CodePerception(fake_codes.FakeCodes(), factored=True), context)  # type: ignore[arg-type]


def test_by_chance_imagined_factors_change_independently() -> None:
    """Every factor goes one further in half of all steps: none tells of another, nor of another step or start."""
    rng = np.random.default_rng(0)
    found = []
    for _ in range(100):
        codes = rng.integers(2, size=(7, len(SIZES))).cumsum(axis=0) % SIZES
        found.append(
            {
                "frames": np.stack([frame(code) for code in codes.tolist()]), "actions": [0] * 6, "rewards": [-1.0] * 6,
                "terminated": [False] * 6, "truncated": [False] * 5 + [True], "success": False,
                "action_masks": np.ones((7, ACTIONS), dtype=np.int8),
            }
        )  # fmt: skip
    model = structured()
    model.fit(joined(found), rng)
    begun = np.array([(0, 1, 0), (2, 1, 1)])
    asked = np.stack([frame(code) for code in begun.tolist()])[:, None], np.zeros((2, 3), dtype=np.int64)
    reached = model.imagine(*asked, 400, rng).pictures[..., 0, : len(SIZES)].astype(int)  # [start, future, step, P]
    before = np.concatenate([np.broadcast_to(begun[:, None, None], (2, 400, 1, 3)), reached[:, :, :-1]], axis=2)
    changes = (reached != before).swapaxes(0, 1).reshape(400, -1)
    assert changes.mean(axis=0) == pytest.approx(0.5, abs=0.15)
    between = np.corrcoef(changes, rowvar=False)
    assert np.abs(between - np.eye(len(between))).max() < 0.25


def test_a_learned_graph_has_an_edge_from_parent_to_child() -> None:
    """Action 0 turns the first wheel if the lamp is lit, 1 the second if the first is at 2, 2 the lamp; 3 nothing."""
    model, codes = structured(), list(itertools.product(*map(range, SIZES)))
    for code in codes:
        for action, turns in enumerate(np.diag([code[2], code[0] == 2, 1])):
            following = tuple(((code + turns) % SIZES).tolist())
            model.model.add(CodeTransition(code, action, following, 0.0, False))
        model.model.add(CodeTransition(code, 3, code, 0.0, False))
    model.model.outcomes.fit()
    graph = model.factor_graph(np.stack(list(map(frame, codes))))
    assert graph.values.tolist() == [list(code) for code in codes]
    of_actions = [np.argwhere(edges).tolist() for edges in graph.edges]
    assert of_actions == [[[0, 0], [0, 2]], [[1, 0], [1, 1]], [[2, 2]], []]


def _backed_up(code: Code, action: int, values: dict[Code, float]) -> float:
    following, reward, ended = fake_codes.step(code, action)
    return reward + (0.0 if ended else 0.95 * values[following])


def test_plans_are_optimal_where_everything_is_known() -> None:
    planner = Planner(fitted(rows(starts()) * 30), PLANNING)
    values = dict.fromkeys(starts(), 0.0)
    for _ in range(PLANNING.depth):
        values = {code: max(_backed_up(code, action, values) for action in range(ACTIONS)) for code in values}
    for code in starts():
        exact = [_backed_up(code, action, values) for action in range(ACTIONS)]
        assert exact[planner.values(code).argmax()] == pytest.approx(max(exact))
        assert planner.values(code) == pytest.approx(exact, abs=1.3), "a noisy-OR is never quite certain"
        assert planner.values(code, "novelty").max() < 0.1


class _Chain:
    """Codes (0,) to (4,): the only macro-action goes one further; the last is rewarded, unknown, and ends.

    The effect of the others is unknown in part.
    """

    n_actions = 1
    sizes = (5,)
    outcomes = SimpleNamespace(rewards=np.array([10.0]))

    def __init__(self, unknown: float = 0.0) -> None:
        self.unknown = unknown

    def moves(self, codes: NDArray[np.int64]) -> Moves:
        following = np.zeros((len(codes), 1, PLANNING.branches, 1), dtype=np.int64)
        following[:, 0, 0] = np.minimum(codes + 1, 4)
        chance = np.zeros((len(codes), 1, PLANNING.branches))
        chance[:, :, 0] = 1.0
        return Moves(following, chance, np.ones((len(codes), 1)))

    def results(self, codes: NDArray[np.int64], moves: Moves) -> Results:
        ends = (codes[:, :1] == 4).astype(float)  # [N, A]
        p_continues = moves.chance * (1.0 - ends[:, :, None])
        unknown = np.full_like(ends, self.unknown) if self.unknown else ends
        return Results(p_continues=p_continues, reward=10.0 * ends, unknown=unknown, p_terminated=ends)


def chain_planner(unknown: float = 0.0, **planning: float) -> Planner:
    return Planner(_Chain(unknown), dataclasses.replace(PLANNING, discount=0.9, **planning))  # type: ignore[arg-type]


@pytest.mark.parametrize("depth", [1, 4, 5, 20])
def test_values_are_discounted_by_the_step_and_end_at_the_depth(depth: int) -> None:
    planner = chain_planner(depth=depth, novelty_discount=0.8)
    for place in range(5):
        steps = 4 - place  # before the one that is rewarded
        within = steps < depth
        assert planner.values((place,)) == pytest.approx([10.0 * 0.9**steps if within else 0.0], abs=1e-12)
        assert planner.values((place,), "novelty") == pytest.approx([0.8**steps if within else 0.0], abs=1e-12)
        for left in (1, 2, 5, 30):
            worth = 10.0 * 0.9**steps if within and steps < left else 0.0
            assert planner.values((place,), left=left) == pytest.approx([worth], abs=1e-12)


@pytest.mark.parametrize(("unknown", "hopes"), [(0.5, True), (0.21, True), (0.19, False)])
def test_optimism_and_r_max_value_the_unknown_at_the_best_reward(unknown: float, hopes: bool) -> None:
    planner = chain_planner(unknown, depth=9, r_max_threshold=0.2)
    known = value = 10.0  # in part known, and in part hoped for
    for place in (4, 3, 2, 1, 0):
        assert planner.values((place,)) == pytest.approx([known])
        assert planner.values((place,), "optimistic") == pytest.approx([value])
        assert planner.values((place,), "r_max") == pytest.approx([10.0 if hopes else known])
        known = 0.9 * known
        value = (1.0 - unknown) * 0.9 * value + unknown * 10.0


@pytest.mark.parametrize("states", [8, 18])
def test_a_plan_depends_on_the_model_alone(states: int) -> None:
    planning = dataclasses.replace(PLANNING, states=states)
    model = fitted([])
    seen = rows(starts())
    used = Planner(model, planning)
    for first in range(0, len(seen), 12):
        for row in seen[first : first + 12]:
            model.add(row)
        model.outcomes.fit()
        used.learned()
        for code in starts():
            used.values(code, "novelty")
            assert np.array_equal(used.values(code), Planner(model, planning).values(code))
            assert np.array_equal(used.values(code, "optimistic"), Planner(model, planning).values(code, "optimistic"))
            assert np.array_equal(used.outcome(code), Planner(model, planning).outcome(code))
            assert used.expanded <= states
    assert states >= len(starts()) or used.expanded < len(starts()), "the bound must bind"


@pytest.mark.parametrize("discount", [0.95, 0.5])
def test_a_search_that_ends_early_finds_the_same_best_actions(discount: float) -> None:
    planning = dataclasses.replace(PLANNING, novelty_discount=discount)
    seen, rng, early = rows(starts()), np.random.default_rng(0), 0
    for few in (1, 3, 8, 20, 60):
        model = fitted([seen[index] for index in rng.integers(len(seen), size=few)])
        ending, whole = Planner(model, planning), Planner(model, planning)
        for code in starts():
            found = ending.values(code, "novelty")
            with mock.patch.object(whole, "_discovery", return_value=None):
                wanted = whole.values(code, "novelty")
            assert found.max() == wanted.max() and (found <= wanted).all()
            assert np.array_equal(found >= found.max() - TIE, wanted >= wanted.max() - TIE)
            early += ending.expanded < whole.expanded
    assert early > 10, "searches must end early"


def novelty(least_unknown: float, times: int) -> float:
    """Of a lamp that is drawn anew at every step, after each action was tried so often in each code."""
    settings = FactoredSettings(dynamics=DynamicsSettings(least_unknown=least_unknown))
    model, rng = FactoredModel((3, 2), 2, settings), np.random.default_rng(0)
    codes = list(itertools.product(range(3), range(2)))
    for _, code, action in itertools.product(range(times), codes, range(2)):
        won = (*code, action) == (2, 1, 0)
        model.add(CodeTransition(code, action, (int(rng.integers(3)), code[1] ^ action), float(won), won))
    model.outcomes.fit()
    planner = Planner(model, PLANNING)
    return max(planner.values(code, "novelty").max() for code in codes)


def test_exploration_rests_once_only_chance_is_left() -> None:
    default, threshold = DynamicsSettings().least_unknown, PLANNING.exploration_threshold
    assert novelty(default, 2) > threshold, "two draws of a lamp say little"
    assert novelty(default, 5) < threshold < novelty(0.0, 5), "of chance there is always more to learn"


@pytest.mark.parametrize(("name", "value"), [("code_sizes", [3, 3, 5]), ("n_actions", ACTIONS + 2)])
def test_a_snapshot_of_other_factors_or_actions_is_refused(name: str, value: object) -> None:
    learner = agent()
    before = learner.state()
    with pytest.raises(ArtefactError, match=f"{name!r} is .* in the snapshot and"):
        learner.restore(AgentState(arrays=before.arrays, values={**before.values, name: value}))
    assert same_state(before, learner.state())


@pytest.fixture(scope="module")
def trained() -> FactoredAgent:
    """An agent after forty episodes; tests leave it as it is."""
    learner = agent()
    live(learner, range(40), np.random.default_rng(0))
    return learner


def test_forty_episodes_solve_every_start_of_the_tiny_task(trained: FactoredAgent) -> None:
    """A random agent solves 14.5 % of the starts: an exact number, by enumeration."""
    assert success(trained) == 1.0


def test_imagined_rollouts_go_and_end_as_in_the_world(trained: FactoredAgent) -> None:
    code, actions = (0, 2, 1), np.array([0, 1, 3, 1])
    rollout = trained.imagine(frame(code), actions=actions, depth=4, rng=np.random.default_rng(1))
    model = structured()
    model.model = trained.model
    found = model.imagine(frame(code)[None, None], np.append(actions, 0)[None], 2, np.random.default_rng(2))
    assert np.array_equal(found.pictures[0, 1, :4], (255.0 * rollout.frames).round())
    assert found.rewards is not None and found.rewards[0, 1] == pytest.approx([*rollout.rewards, 0.0], abs=0.5)
    assert found.p_ended is not None and found.p_ended[0, 1] == pytest.approx([*rollout.p_terminated, 1.0], abs=0.1)
    greedy = trained.imagine(frame(code), actions=None, depth=6, rng=np.random.default_rng(1))
    assert np.array_equal(rollout.actions, actions) and rollout.accepted.all()
    drawn = 255.0 * np.array([rollout.start_frame, *rollout.frames])[:, 0, : len(SIZES)]
    for index, action in enumerate(actions.tolist()):
        assert tuple(drawn[index].round()) == code
        assert np.array_equal(rollout.q_values[index], trained.q_values(Observation(frame=frame(code))))
        code, reward, ended = fake_codes.step(code, action)
        assert tuple(rollout.macrostates[index]) == tuple(drawn[index + 1].round()) == code
        assert rollout.modal[index] < 0.1, "nothing is left to chance"
        assert rollout.rewards[index] == pytest.approx(reward, abs=1.6)
        assert ended == (index == 3) == (rollout.p_terminated[index] > 0.5)
    assert (greedy.p_terminated > 0.5).tolist() == [False] * (len(greedy.p_terminated) - 1) + [True]


def test_all_outcomes_of_a_step_are_those_that_it_imagines(trained: FactoredAgent) -> None:
    frames, rng = np.stack(list(map(frame, starts()))), np.random.default_rng(0)
    found = trained.predict_outcomes(frames, rng)
    for (row, code), action in itertools.product(enumerate(starts()), range(ACTIONS)):
        one = trained.imagine(frames[row], actions=np.array([action]), depth=1, rng=rng)
        goes_on = found.p_continues[row, action]
        assert goes_on.sum() == pytest.approx(1.0 - one.p_terminated[0], abs=1e-6)
        assert found.reward[row, action] == pytest.approx(one.rewards[0], abs=1e-5)
        following, _, ended = fake_codes.step(code, action)
        assert ended or tuple(found.macrostates[row, action, goes_on.argmax()]) == following
    nothing = agent().predict_outcomes(frames, rng)
    assert not nothing.p_continues.any() and not nothing.reward.any()


def test_whole_codes_are_read_and_drawn_as_the_encoder_does() -> None:
    eyes = CodePerception(fake_codes.FakeCodes(), factored=False)  # type: ignore[arg-type]
    codes = eyes.codes(np.stack(list(map(frame, starts()))))
    assert eyes.sizes == (18,) and len(set(codes)) == len(starts())
    assert [*map(tuple, eyes.macrostates(codes).tolist())] == starts()
    assert [*map(tuple, (255.0 * eyes.images(codes)[:, 0, : len(SIZES)]).round())] == starts()


def test_what_follows_from_what_is_unknown_is_not_accepted_either() -> None:
    learner, rng, known_again = agent(), np.random.default_rng(0), 0
    live(learner, range(3), rng)
    model = structured()
    model.model = learner.model
    for code in starts():
        rollout = learner.imagine(frame(code), actions=rng.integers(ACTIONS, size=6), depth=6, rng=rng)
        unknown = rollout.epistemic > ACCEPTED
        found = model.imagine(frame(code)[None, None], rollout.actions[None], 2, np.random.default_rng(0))
        assert found.modal is not None and found.modal[0, 0] == pytest.approx(rollout.modal[0], abs=1e-6)
        first = int(unknown.argmax()) if unknown.any() else len(unknown)
        assert rollout.accepted.tolist() == [True] * first + [False] * (len(unknown) - first)
        known_again += not unknown[first:].all()
    assert known_again > 0, "after the first rejection something known is imagined"


def test_what_draws_it_can_be_read() -> None:
    learner = agent(planning__exploration="curiosity")
    seen, rng = Observation(frame=frame((0, 1, 0))), np.random.default_rng(0)
    assert learner.novelty(seen, rng) is None, "before anything was seen there is no measure"
    live(learner, range(2), rng)
    novelty = learner.novelty(seen, rng)
    assert novelty is not None and novelty.shape == (ACTIONS,) and 0.5 < novelty.max() <= 1.0
    assert novelty[learner.act(seen, explore=True)] == novelty.max()


@pytest.mark.parametrize(
    ("value", "r_max", "explores_by", "planning"),
    [
        (30.0, 40.0, "r_max", {}),
        (30.0, 30.0, "r_max", {}),
        (10.0, 10.0, "novelty", {}),
        (10.0, 12.0, "r_max", {}),
        (10.0, 10.0, "novelty", {"exploration_threshold": 0.9}),
        (10.0, 10.0, "value", {"exploration_threshold": 0.91}),
        (30.0, 40.0, "novelty", {"exploration": "curiosity"}),
        (30.0, 40.0, "optimistic", {"exploration": "optimism"}),
        (30.0, 40.0, "value", {"exploration": "random", "epsilon": 0.0}),
    ],
)
def test_it_is_curious_only_where_the_unknown_earns_no_more(
    value: float, r_max: float, explores_by: str, planning: dict[str, object]
) -> None:
    """50 is the best reward seen; after the 20 macro-actions of a plan it is worth 17.9."""
    learner = agent(**{f"planning__{name}": given for name, given in planning.items()})
    learner.model.outcomes.rewards = np.array([-1.0, 50.0])
    found = {"value": np.array([value, 0.0]), "r_max": np.array([r_max, 1.0]), "novelty": np.array([0.5, 0.9])}
    found["optimistic"] = np.array([2.0, 3.0])
    with mock.patch.object(learner, "_values", lambda _, objective="value": found[objective]):
        assert learner.exploring_values((0, 0, 0)) is found[explores_by]


def test_a_likely_transition_is_still_a_surprise_while_unknown() -> None:
    surprises = []
    for threshold in (0.0, 0.5):
        learner = agent(planning__exploration_threshold=threshold)
        for _ in range(51):
            learner.diagnostics()
            learner.observe(fake_codes.transition((0, 1, 0), 1), episode=0)
        surprises.append(learner.diagnostics()["model/unexpected"])
    assert surprises == [1.0, 0.0], "nothing is ever wholly known, but after fifty times it is expected"


def _visits(learner: FactoredAgent, start: Code) -> list[Code]:
    """The codes that the greedy agent reaches in one episode of six macro-actions."""
    learner.begin_episode()
    visited = [start]
    for _ in range(6):
        action = learner.act(Observation(frame=frame(visited[-1])), explore=False)
        visited.append(fake_codes.step(visited[-1], action)[0])
    return visited


def test_a_test_does_not_hope_again_for_a_reward_that_did_not_come() -> None:
    learner = agent()
    for row in rows([code for code in starts() if code[2] == 1]):  # nothing is seen under a dark lamp
        learner.begin_episode()
        learner.observe(fake_codes.transition(row.code, row.action), episode=0)
    start = (0, 1, 0)
    observation = Observation(frame=frame(start))
    learner.begin_episode()
    before = learner.q_values(observation)
    visited = _visits(learner, start)
    assert visited.count((2, 1, 0)) == 1, "under the dark lamp these wheels end nothing"
    assert not np.array_equal(learner.q_values(observation), before), "it knows this until the episode is over"
    learner.begin_episode()
    assert np.array_equal(learner.q_values(observation), before), "and nothing is learned"
    assert _visits(learner, start) == visited


def test_only_an_unlikely_going_on_after_an_unseen_transition_is_news() -> None:
    by_chance = CodeTransition((0, 1, 0), 1, (2, 1, 0), 10.0, True)
    seen = [row for row in rows(starts()) if row.following != (2, 1, 0) and row[:2] != ((1, 0, 0), 0)]
    outcomes = fitted([*seen, by_chance]).outcomes
    assert not outcomes.goes_on((2, 0, 1), 2, (2, 1, 1)), "seen: chance decides"
    assert not outcomes.goes_on((1, 0, 0), 0, (2, 0, 0)), "it is expected to go on"
    assert outcomes.goes_on((2, 0, 0), 2, (2, 1, 0))
    codes, nexts = np.array([(2, 0, 0), (0, 1, 0)]), np.array([(2, 1, 0)] * 2)
    probability, _ = outcomes.predict(codes, np.array([2, 1]), nexts)
    assert probability.sum(axis=1) == pytest.approx(1.0)
    unseen, known = (probability @ outcomes.ends).tolist()
    assert unseen == 0.0
    assert known > 0.9, "an end that was seen may come again"
    assert outcomes.forget_going_on()
    assert not outcomes.forget_going_on()
    probability, _ = outcomes.predict(codes, np.array([2, 1]), nexts)
    assert (probability @ outcomes.ends).min() > 0.9
