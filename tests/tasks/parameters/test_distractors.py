"""Distractors: where they are seen, that they hide nothing that matters, and that nothing else notices."""

from __future__ import annotations

import itertools

import gymnasium
import mujoco
import numpy as np
import pytest
from imagine_bench.tasks.parameters import distractors
from scipy import stats

from imagine_bench import registry

ARROWS, PICK_PLACE = "imagine_bench/Arrows", "imagine_bench/PickPlace"
IDS = {ARROWS: "arrows", PICK_PLACE: "pick_place"}
WITHDRAWN = (0, 0, 0, 4)


def make(id_, **options):
    return gymnasium.make(f"{id_}-v0", **{"execution": "kinematic", "disable_env_checker": True, **options}).unwrapped


def on_the_screen(env):
    """Which pixels look at the screen or at a ball on it: by the pinhole camera, not by drawing. Shape (64, 64)."""
    camera = env.model.camera("wrist").id
    place_m, turn = env.data.cam_xpos[camera], env.data.cam_xmat[camera].reshape(3, 3)
    across = (np.arange(64) + 0.5) / 32 - 1
    right, up = np.meshgrid(across, -across)
    tangent = np.tan(np.radians(env.model.cam_fovy[camera]) / 2)
    rays = np.stack([right * tangent, up * tangent, -np.ones_like(right)], axis=-1) @ turn.T  # [64, 64, 3]
    depth = (place_m[2] - env.data.geom_xpos[env.model.geom("screen_0").id, 2]) / -rays[..., 2]
    hit_m = place_m[:2] + depth[..., None] * rays[..., :2]
    wide_m = 2 * distractors.RADIUS_M  # a ball, and how much further away it seems for its height
    low_m, high_m = np.array(distractors.LOW_M) - wide_m, np.array(distractors.HIGH_M) + wide_m
    return ((hit_m > low_m) & (hit_m < high_m)).all(axis=-1)


@pytest.mark.parametrize(
    ("id_", "options", "states"),
    [
        *((ARROWS, {"cubes": n}, [(*(0, 1, 2, 3, 0, 1)[:n], each) for each in range(n)]) for n in range(1, 7)),
        (PICK_PLACE, {}, [(0, 0, 0, 0), (0, 0, 0, 2), (0, 1, 0, 0), (0, 0, 1, 3), (2, 0, 0, 3)]),
    ],
)
def test_frames_differ_only_where_distractors_are(id_, options, states):
    plain, hidden, noisy = make(id_, **options), make(id_, gesture=0.0, **options), make(id_, distractors=4, **options)
    screen = on_the_screen(noisy)
    for state in states:
        usual, _ = plain.reset(seed=3, options={"macrostate": state})
        elsewhere = {"macrostate": WITHDRAWN if id_ == PICK_PLACE else state}
        without_hand, _ = hidden.reset(seed=3, options=elsewhere)
        hand = (usual != without_hand).any(axis=-1)
        assert hand.sum() > 40
        seen = [noisy.reset(seed=3, options={"macrostate": state})[0]]
        drawn = noisy.task.render_macrostates(np.array([state]), "clean", np.random.default_rng(3))
        np.testing.assert_array_equal(drawn[0], seen[0])
        for _ in range(4):
            noisy.world.vary(noisy.np_random)
            seen.append(noisy.agent_view())
        for frame in seen:
            changed = (frame != usual).any(axis=-1)
            assert changed.sum() > 200 and not changed[~screen].any()
            assert not changed[hand].any()
        for one, other in itertools.pairwise(seen):
            assert 150 < (one != other).any(axis=-1).sum() <= screen.sum()


@pytest.mark.parametrize("id_", IDS)
def test_neither_rules_nor_physics_notice(id_):
    named = f"{IDS[id_]}:distractors=4"
    rules, plain = registry.task(named).rules, registry.task(IDS[id_]).rules
    assert rules.start_states == plain.start_states and registry.task(named).id == named
    actions = range(rules.n_actions)
    assert all(rules.outcomes(s, a) == plain.outcomes(s, a) for s in plain.start_states for a in actions)
    scenes = [make(id_, execution="physics", distractors=count) for count in (0, 4)]
    start = plain.start_states[0]
    for env in scenes:
        env.reset(seed=1, options={"macrostate": start})
    for action in (0, 1, 3):
        steps = [env.step(action) for env in scenes]
        assert steps[0][1:4] == steps[1][1:4] and not steps[0][4]["fault"]
        for name in ("qpos", "qvel", "ctrl"):
            np.testing.assert_array_equal(*(getattr(env.data, name) for env in scenes))


def test_balls_are_anywhere_on_the_screen_equally_often():
    """Also at its edge, from which they roll back: by at most 3 cm, each its own way, each in a color of its own."""
    spec = mujoco.MjSpec()
    distractors.add_distractors(spec, 4)
    model = spec.compile()
    data, rng, what = mujoco.MjData(model), np.random.default_rng(0), distractors.Distraction(model, 4)
    low_m = np.array(distractors.LOW_M) + distractors.RADIUS_M
    wide_m = np.array(distractors.HIGH_M) - distractors.RADIUS_M - low_m
    starts_m = []
    of_starts = np.random.default_rng(1)
    for _ in range(1000):
        what.place(data, of_starts)
        starts_m.append(data.mocap_pos[:, :2].ravel().copy())
    together = np.corrcoef(np.array(starts_m).T)
    assert np.abs(together[~np.eye(len(together), dtype=bool)]).max() < 0.12, "each ball has a place of its own"
    what.place(data, rng)
    middles_m = []
    for _ in range(6000):
        what.vary(data, rng)
        middles_m.extend(data.mocap_pos[:, :2].copy())
    moves_m = np.diff(np.array(middles_m).reshape(6000, -1), axis=0)
    assert 0.0299 < np.abs(moves_m).max() < 0.03 + 1e-9
    assert np.abs(np.corrcoef(moves_m.T) - np.eye(6)).max() < 0.06
    colors = {name: model.mat_rgba[model.material(name).id, :3] for name in (m.name for m in spec.materials)}
    tiles, balls = ([colors[name] for name in colors if name.startswith(what)] for what in ("screen", "distractor"))
    assert len(np.unique(tiles)) == 3 * 32 and len(np.unique(balls, axis=0)) == 3
    for share in (np.array(middles_m) - low_m).T / wide_m[:, None]:
        assert stats.kstest(share, "uniform").statistic < 0.02
        assert (np.minimum(share, 1.0 - share) < 0.01).mean() == pytest.approx(0.02, rel=0.25)


@pytest.mark.parametrize("appearance", ["clean", "mild", "patched", "harsh"])
def test_balls_roll_between_the_frames_of_every_appearance(appearance):
    env = make(ARROWS, distractors=2, appearance=appearance)
    env.reset(seed=0)
    for action in (0, 1):
        before_m = env.data.mocap_pos.copy()
        env.step(action)
        assert (env.data.mocap_pos[-1] != before_m[-1]).any()
