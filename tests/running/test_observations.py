"""The observation of agents is a choice of the protocol: shown as named, refused where an agent cannot take it,
reported.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from bench_fakes import Pupil
from recordings import contents
from small_runs import Inline

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError
from imagine_bench.protocols.control import Protocol
from imagine_bench.running.bench import bench, plan
from imagine_bench.running.trained import load_trained

_FEW: dict[str, Any] = {"budgets": (3,), "evaluation_episodes": 2, "execution": "kinematic", "recorded_episodes": 1}


@pytest.fixture(autouse=True)
def pupils(own_names: None) -> list[Pupil]:
    """Those that are made, as an agent that takes all but the human's view."""
    entry = dataclasses.replace(registry.AGENTS["pupil"], observes=("frame", "state", "proprio"))
    registry.AGENTS["pupil"] = entry
    Pupil.made.clear()
    return Pupil.made


@pytest.mark.parametrize(("choice", "size"), [("frame", 64), ("frame", 96), ("state", 64), ("proprio,frame", 64)])
def test_agents_are_shown_what_is_chosen(tmp_path: Path, pupils: list[Pupil], choice: str, size: int) -> None:
    shown = {"observation": choice, "observation_size": size}
    wanted, paths = plan("arrow_puzzle", "smoke", agents=("pupil",), **_FEW, **shown)
    result = bench(wanted, paths, root=tmp_path, launcher=Inline())
    shapes = {"frame": (size, size, 3), "state": (15,), "proprio": (16,)}
    parts = {part: shapes[part] for part in choice.split(",")}
    told = parts.pop("frame", (0, 0, 3)), parts
    pupil = pupils[-1]
    assert pupil.told == {part: shapes[part] for part in choice.split(",")} and len(pupil.shown) > 5
    for each in (*pupil.seen, *(transition.next_observation for _, transition in pupil.shown)):
        assert (each.frame.shape, {name: part.shape for name, part in each.more.items()}) == told
        assert each.macrostate is None and ("state" not in parts or each.more["state"].sum() == 4.0)
    assert "/real/frame" in contents(result.folder / "pupil/seed_0/recording.rrd")


def test_choices_in_any_order_are_one_bench() -> None:
    one, other = (
        Protocol(task="arrow_puzzle", preset="quick", observation=each) for each in ("state,frame", "frame,state")
    )
    assert one == other and one.world["observation"] == "frame,state" and "privileged" in one.appearance_in_words
    assert Protocol(task="arrow_puzzle", preset="quick", test_appearance="clean").appearance_in_words == "clean"


def test_what_an_agent_cannot_be_shown_is_one_sentence() -> None:
    with pytest.raises(InvalidValueError, match="takes frame, state, proprio alone; leave it out"):
        plan("arrow_puzzle", "smoke", agents=("pupil",), observation="human")


def test_a_run_that_saw_something_else_is_not_asked_with_frames(tmp_path: Path) -> None:
    wanted, paths = plan("arrow_puzzle", "smoke", agents=("pupil",), observation="state", **_FEW)
    folder = bench(wanted, paths, root=tmp_path, launcher=Inline()).folder / "pupil/seed_0"
    with pytest.raises(InvalidValueError, match="is of an agent that sees state at 64 pixels, and it would be asked"):
        load_trained(folder)
