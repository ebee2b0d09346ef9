"""``imagine-bench margins``: what it keeps, with how many trials, and what it refuses."""

import json

import pytest

from imagine_bench.cli import main
from imagine_bench.tools import margins


def test_curves_and_walks_are_measured_and_kept(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(margins, "SWEEPS", {"pad_friction": (1.2, 0.01)})
    monkeypatch.setattr(margins, "_WALKS", 2)
    monkeypatch.setattr(margins, "_WALK_ACTIONS", 3)
    out = tmp_path / "deep" / "margins.json"
    assert main(["margins", "--task", "pick_place", "--trials", "4", "--out", str(out)]) == 0
    kept = json.loads(out.read_text())
    first, last = kept["curves"]["pad_friction"]
    assert (first["value"], first["as_ruled"], first["trials"], first["high"]) == (1.2, 4, 4, 1.0)
    assert (last["as_ruled"], last["low"]) == (0, 0.0)
    assert [(each["sense"], each["actions"], each["lengths"]) for each in kept["walks"]] == [
        ("true", 6, [3, 3]),
        ("nominal", 6, [3, 3]),
    ]
    assert kept["built"]["pad_friction"] == 1.2 and kept["environment"]["commit"]
    assert "| pad_friction | 0.01 | 0 of 4 | 0.000 to " in capsys.readouterr().out


def test_a_walk_ends_with_its_first_fault(monkeypatch):
    monkeypatch.setattr(margins, "_WALKS", 2)
    monkeypatch.setattr(
        margins, "_env", lambda spec, _: margins.gymnasium.make(spec.env_id, physics=_SLIPPERY).unwrapped
    )
    found = margins.walk(margins.registry.task("pick_place"), "true")
    assert (found["lengths"], found["as_ruled"], len(found["faults"])) == ([1, 1], 0, 2)


_SLIPPERY = {"pad_friction": 0.01}


def test_no_trials_are_refused(tmp_path, capsys):
    assert main(["margins", "--task", "pick_place", "--trials", "0", "--out", str(tmp_path / "x.json")]) == 2
    assert "trials is 0; give at least 1 macro-action a value." in capsys.readouterr().err


@pytest.mark.parametrize("name", margins.SWEEPS)
def test_every_sweep_begins_as_the_scene_is_built(name):
    assert margins.SWEEPS[name][0] == getattr(margins.PhysicsSettings(), name)
