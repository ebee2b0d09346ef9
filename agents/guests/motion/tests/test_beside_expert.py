"""A recording of a clone and the expert: the same start, each one's own motion, and the distance of their hands."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from imagine_bench.tasks.continuous.expert import Expert
from imagine_bench_motion.__main__ import main
from imagine_bench_motion.cloned_env import BUNDLED
from imagine_bench_motion.control.beside_expert import record_beside_expert
from imagine_bench_motion.trials import MOST_PERIODS
from recordings import contents, times
from scripted_clone import ScriptedClone


def test_a_clone_of_the_expert_has_its_hand_beside_the_expert_s(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And one that does nothing is recorded for the longest time of a try, from the same start."""
    commands: list[Any] = []
    act = Expert.act

    def kept(expert: Expert) -> Any:
        commands.append(act(expert))
        return commands[-1]

    monkeypatch.setattr(Expert, "act", kept)
    still = ScriptedClone()
    found = record_beside_expert(tmp_path / "still.rrd", still, 3, seed=570, placement=0.03)
    assert found.expert.done and not found.clone.done
    assert found.clone.periods == MOST_PERIODS > found.expert.periods
    assert found.apart_m.max() > 0.1
    assert times(tmp_path / "still.rrd", "/motion/command/grip", "env_step") == set(range(MOST_PERIODS))

    alike = ScriptedClone(commands)
    again = record_beside_expert(tmp_path / "alike.rrd", alike, 3, seed=570, placement=0.03)
    assert again.clone.done
    assert again.clone.periods == again.expert.periods == found.expert.periods
    assert again.apart_m.max() < 1e-6
    np.testing.assert_array_equal(alike.seen[0]["objects"], still.seen[0]["objects"])
    assert alike.instruction == "turn the middle cube counter-clockwise"
    shown = {"/scene/hand_target", "/scene/expert_hand_target", "/motion/distance/distance_from_the_expert_s_hand_mm"}
    assert set(contents(tmp_path / "alike.rrd")) >= shown
    assert len(times(tmp_path / "alike.rrd", "/scene/expert_hand_target", "env_step")) == again.clone.periods


def test_the_command_records_the_bundled_clone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    path = tmp_path / "clone.rrd"
    monkeypatch.setattr(sys, "argv", ["motion", "record", str(path), "--macro-action", "4", "--seed", "571"])
    main()
    printed = capsys.readouterr().out
    assert BUNDLED.is_file()
    assert "expert: done" in printed
    assert "clone: done" in printed
    assert "/motion/front" in contents(path)
