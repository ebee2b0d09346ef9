"""``check --physics``: fidelity and margins of any task, and refusals."""

import json
from contextlib import suppress
from types import SimpleNamespace

import pytest

from imagine_bench import registry
from imagine_bench.cli import exit_code as main
from imagine_bench.testing import physics
from imagine_bench.testing.physics import (
    Fidelity,
    fidelity_figures,
    figure_of,
    measure_fidelity,
    slips,
)

SLIPPERY = physics.PhysicsSettings.of({"pad_friction": 0.01})


def test_fidelity_and_margins_are_measured_and_kept(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(physics, "SWEEPS", {"pad_friction": (1.2, 0.01)})
    monkeypatch.setattr(physics, "_WALKS", 2)
    monkeypatch.setattr(physics, "_WALK_ACTIONS", 3)
    out = tmp_path / "deep" / "margins.json"
    words = ["check", "--physics", "pick_place", "--turns", "4", "--trials", "4", "--out", str(out)]
    assert main(words) == 0
    kept = json.loads(out.read_text())
    first, last = kept["curves"]["pad_friction"]
    assert (first["value"], first["as_ruled"], first["trials"], first["high"]) == (1.2, 4, 4, 1.0)
    assert (last["as_ruled"], last["low"]) == (0, 0.0)
    walks = [(each["sense"], each["actions"], each["lengths"]) for each in kept["walks"]]
    assert walks == [("true", 6, [3, 3]), ("nominal", 6, [3, 3])]
    assert kept["built"]["pad_friction"] == 1.2 and kept["environment"]["commit"]
    assert kept["figures"][0]["required"] == ">= 99.5%" and kept["figures"][0]["met"]
    assert "| pad_friction | 0.01 | 0 of 4 | 0.000 to " in capsys.readouterr().out


def test_each_walk_and_each_trial_has_a_start_of_its_own(monkeypatch):
    """And a walk ends with its first fault."""
    monkeypatch.setattr(physics, "_WALKS", 2)
    make, seeds = physics.make_env, []

    def slippery(spec, **_):
        env = make(spec, physics=SLIPPERY)
        reset = env.reset
        monkeypatch.setattr(env, "reset", lambda **given: (seeds.append(given["seed"]), reset(**given))[1])
        return env

    monkeypatch.setattr(physics, "make_env", slippery)
    spec = registry.task("pick_place")
    found = physics.walk(spec, "true")
    assert (found["lengths"], found["as_ruled"], len(found["faults"])) == ([1, 1], 0, 2)
    assert len(set(seeds)) == 2
    seeds.clear()
    assert physics.as_ruled(spec, SLIPPERY, 5) == 0 and len(set(seeds)) == 5


@pytest.mark.parametrize("name", physics.SWEEPS)
def test_every_sweep_begins_as_the_scene_is_built(name):
    assert physics.SWEEPS[name][0] == getattr(physics.PhysicsSettings(), name)


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


def test_a_task_without_targets_is_only_measured():
    (figure,) = fidelity_figures(registry.task("arrow_puzzle_hard"), 2)
    assert (figure.required, figure.measured, figure.met) == ("–", "100.00%", True)


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
