"""``check --physics``: fidelity and margins of any task, and refusals."""

import json
from contextlib import suppress
from dataclasses import replace
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

from imagine_bench import registry
from imagine_bench.cli import exit_code as main
from imagine_bench.interfaces import PhysicsSettings
from imagine_bench.seeding import episode_seed
from imagine_bench.testing import physics
from imagine_bench.testing.physics import (
    Fidelity,
    fidelity_figures,
    figure_of,
    measure_fidelity,
    slips,
)


def test_fidelity_and_margins_are_measured_and_kept(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(physics, "SWEEPS", {"pad_friction": (1.2, 0.01)})
    monkeypatch.setattr(physics, "_WALKS", 2)
    monkeypatch.setattr(physics, "_WALK_ACTIONS", 3)
    out = tmp_path / "deep" / "margins.json"
    words = ["check", "--physics", "pick_place", "--turns", "4", "--trials", "4", "--out", str(out)]
    assert main([*words, "--appearances", "clean", "mild"]) == 0
    kept = json.loads(out.read_text())
    first, last = kept["curves"]["pad_friction"]
    assert (first["value"], first["as_ruled"], first["trials"], first["high"]) == (1.2, 4, 4, 1.0)
    assert (last["as_ruled"], last["low"]) == (0, 0.0)
    walks = [(each["sense"], each["actions"], each["lengths"]) for each in kept["walks"]]
    assert walks == [("true", 6, [3, 3]), ("nominal", 6, [3, 3])]
    assert kept["built"]["pad_friction"] == 1.2 and kept["environment"]["commit"]
    assert kept["figures"][0]["required"] == ">= 99.5%" and kept["figures"][0]["met"]
    worlds = [each["what"].partition(": ")[0] for each in kept["figures"]]
    assert list(dict.fromkeys(worlds)) == ["pick_place", "pick_place at mild"]
    assert "| pad_friction | 0.01 | 0 of 4 | 0.000 to " in capsys.readouterr().out


SEEDS = []
NOTHING = (0, 0, 0)
SCRIPT = {
    0: ("", (3, 4, 0), (0, -0.5, 0), 92),
    1: ("slips", (0, -2, 0), NOTHING, 0),
    2: ("dropped", NOTHING, NOTHING, 0),
    3: ("", NOTHING, (50, 0, 100), 0),
}
"""By macro-action: what happens, and how far the object that it moves, and the other one, are off then, in mm and
degrees.
"""


class Scripted(gymnasium.Env):
    """Two cubes on a table. In physics they are moved as is written down, otherwise exactly."""

    def __init__(self, execution="physics", appearance="clean", physics=None):
        self.real = execution == "physics"
        self.count = 2 * (physics == PhysicsSettings(sense="nominal"))
        self.world = self

    def reset(self, *, seed, options=None):
        SEEDS.append(seed)
        self.state = (options or {"macrostate": (1, 2, 0)})["macrostate"]
        self.poses = np.array([[0.0, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0]])
        return None, {"macrostate": np.array(self.state), "fault": False}

    def step(self, action):
        what, mine_mm, others_mm, turned_deg = SCRIPT.get(self.count, ("", NOTHING, NOTHING, 0))
        self.count += 1
        if what != "slips":
            self.state = two_cubes(0).rules.turned(self.state, action)
        if self.real:
            cube = action // 2
            self.poses[[cube, 1 - cube], :3] += 1e-3 * np.array([mine_mm, others_mm])
            self.poses[cube, [3, 6]] = np.cos(np.radians(turned_deg) / 2), np.sin(np.radians(turned_deg) / 2)
        fault = self.real and what == "dropped"
        return None, 0.0, True, False, {"macrostate": np.array(self.state), "fault": fault, "fault_reason": what}

    def object_poses(self):
        return self.poses.copy()

    def motion(self):
        return SimpleNamespace(body_names=("cube_1", "cube_0"), poses_in_world=self.poses[None, ::-1])


gymnasium.register("scripted/TwoCubes-v0", Scripted)


def two_cubes(slip):
    """The task of the scripted scene; nothing is forbidden."""
    spec = registry.task(f"arrows:cubes=2,forbid=none,slip={slip}")
    targets = replace(spec.targets, as_ruled_varied=0.5, error_mm=6.0)
    return replace(spec, env_id="scripted/TwoCubes-v0", targets=targets)


def test_figures_of_fidelity_have_their_units_and_targets():
    """An object that is lifted counts as none that stands, and a yaw to the nearest quarter turn."""
    spec = two_cubes(0.5)
    for level, world, required, met in (("clean", "", "99.9%", False), ("mild", " at mild", "50.0%", True)):
        SEEDS.clear()
        figures = fidelity_figures(spec, 4, level)
        found = [(each.what, each.required, each.measured, each.met) for each in figures]
        assert [(what.removeprefix(f"{spec.id}{world}: "), *values) for what, *values in found] == [
            ("macro-actions exactly as the rules say, of 4", f">= {required}", "75.00%", met),
            ("other objects moved, worst, mm", "< 1", "0.500", True),
            ("position error, p99, mm", "< 6", "4.95", True),
            ("yaw error, p99, degrees", "< 1", "1.98", False),
            ("macro-actions that slip, of 3", "0.0% to 100.0%", "33.3%", True),
            ("objects that slip move, worst, mm", "< 5", "2.00", True),
        ]
        assert len(set(SEEDS)) == 3, "one to measure heights, one at first, and one after the fault"
    (figure,) = fidelity_figures(replace(two_cubes(0), targets=None), 3, level)
    assert (figure.required, figure.measured, figure.met) == ("–", "66.67%", True)


@pytest.mark.parametrize(
    ("level", "goes_on", "begun"), [("clean", True, [0, 3]), ("mild", True, [0, 3, 5, 10]), ("mild", False, range(12))]
)
def test_a_walk_beside_the_rules_begins_anew_after_a_fault_and_where_it_must(level, goes_on, begun):
    """Where poses vary, every fifth macro-action; and at each end of an episode unless the task goes on."""
    spec = two_cubes(0)
    SEEDS.clear()
    measure_fidelity(replace(spec, targets=replace(spec.targets, goes_on=goes_on)), 12, level)
    assert set(SEEDS) == {episode_seed("tuning", 0, step) for step in (12, *begun)}


def test_a_walk_ends_with_its_first_fault_and_drifts_as_far_as_a_standing_object():
    """Each walk and each trial has a start of its own."""
    SEEDS.clear()
    found = physics.walk(two_cubes(0), "true")
    assert found.pop("drift_mm") == pytest.approx(5.0)
    assert found == {
        "sense": "true", "actions": 803, "as_ruled": 802, "lengths": [3, 200, 200, 200, 200], "faults": ["dropped"],
    }  # fmt: skip
    assert len(set(SEEDS)) == len(SEEDS) == 5
    assert physics.as_ruled(two_cubes(0), PhysicsSettings(), 5) == 4 and len(set(SEEDS)) == 10
    assert physics.walk(two_cubes(0), "nominal")["lengths"][0] == 1


@pytest.mark.parametrize("name", physics.SWEEPS)
def test_every_sweep_begins_as_the_scene_is_built(name):
    assert physics.SWEEPS[name][0] == getattr(PhysicsSettings(), name)


@pytest.mark.parametrize("world", ["arrows:slip=0.3", "pick_place:slip=0.5"])
def test_where_grips_slip_by_chance_there_are_no_margins(world, tmp_path, capsys):
    """Since a slip by the rules is no slip of the physics."""
    out = tmp_path / "margins.json"
    assert main(["check", "--physics", world, "--turns", "0", "--trials", "1", "--out", str(out)]) == 0
    assert f"No margins: in {world} no macro-action is certain to move an object" in capsys.readouterr().out
    assert json.loads(out.read_text()).keys() == {"task", "seed", "environment"}


def test_fidelity_of_any_world_counts_what_slips():
    found = measure_fidelity(registry.task("arrows:cubes=5,coupling=neighbour,slip=0.3"), 20, "strong")
    assert found.as_ruled == found.actions == len(found.slips) == 20, found.faults
    assert [said for _, said in found.slips] == pytest.approx([0.3] * 20)
    assert 0 < found.slipped_mm < 4 and found.other_objects_mm < 1
    turned = sum(not slipped for slipped, _ in found.slips)
    assert 8 < turned < 20
    assert turned < len(found.error_deg) < 2 * turned  # all but turns of the last cube turn two


@pytest.mark.parametrize(("worst", "passes"), [("clean", False), ("mild", False), (None, True)])
def test_every_appearance_decides_a_check_of_continuous_control(worst, passes, monkeypatch, tmp_path):
    def segments(make, levels, trials, turns):
        return {
            level: {"as_ruled": 98 if level == worst else 99, "faults": {}, "random_episodes": 0} for level in levels
        }

    def exact_facts(spec, kept):
        return SimpleNamespace(as_ruled=kept["as_ruled"], segments=100, shown=1.0)

    monkeypatch.setattr(physics, "_segments", segments)
    monkeypatch.setattr(physics, "motion", SimpleNamespace(certificate=exact_facts, evidence=str, chance=str))
    wanted = {"turns": 0, "trials": 1, "random_episodes": 0, "appearances": ("clean", "mild")}
    assert physics.check_motion("ArrowPuzzleEasyMotion", tmp_path / "x.json", **wanted) is passes


def test_random_episodes_add_up_over_blocks_and_calls(monkeypatch, tmp_path):
    """And over one that is killed in the middle of a block: each seed counts once."""
    out = tmp_path / "kept.json"
    none = {"random_episodes": 0, "random_solved": 0, "faults": {}}
    out.write_text(json.dumps({"task": "arrow_puzzle_easy", "appearances": {"clean": none, "mild": none}}))
    exact_facts = SimpleNamespace(as_ruled=1, segments=1, shown=1.0)
    stand_in = SimpleNamespace(certificate=lambda spec, kept: exact_facts, evidence=str, chance=str)
    monkeypatch.setattr(physics, "motion", stand_in)
    monkeypatch.setattr(physics, "_BLOCK", 3)
    killed_at = [9]

    def random_episode(env, seed):
        if seed in killed_at:
            raise KeyboardInterrupt(killed_at.clear())
        return seed in (1, 2, 4, 5, 9)

    monkeypatch.setattr("imagine_bench.tasks.continuous.segments.random_episode", random_episode)
    wanted = {"turns": 0, "trials": 0, "appearances": ("clean",)}
    counted = []
    for until in (5, 11, 11, 11):
        with suppress(KeyboardInterrupt):
            physics.check_motion("ArrowPuzzleEasyMotion", out, random_episodes=until, **wanted)
        kept = json.loads(out.read_text())["appearances"]
        counted.append((kept["clean"]["random_episodes"], kept["clean"]["random_solved"]))
        assert kept["mild"] == none
    assert counted == [(5, 3), (8, 4), (11, 5), (11, 5)]


def test_a_rate_is_judged_by_its_binomial_interval():
    for slipped, met in ((0, False), (20, True), (40, False)):
        found = Fidelity(slips=[(each < slipped, 0.2) for each in range(100)], slipped_mm=0.1)
        rate, moved = slips("w", found)
        assert (rate.required, rate.met, moved.met) == ("10.0% to 31.0%", met, True)


def test_a_figure_meets_its_target_or_not():
    for sign, met in ((">=", (False, True, True)), ("<=", (True, True, False)), ("<", (True, False, False))):
        found = [figure_of("what", value, ".2f", sign, 0.5) for value in (0.4999, 0.5, 0.5001)]
        assert tuple(figure.met for figure in found) == met
        assert (found[0].required, found[0].measured) == (f"{sign} 0.5", "0.50"), "a rounded value decides nothing"
