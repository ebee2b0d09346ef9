"""One agent with several settings in one bench, and worlds that a protocol changes."""

from __future__ import annotations

from pathlib import Path

import pytest
from small_runs import Inline

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError, UnknownNameError
from imagine_bench.protocols.control import protocol
from imagine_bench.registry.entries import file_name, parse_configuration
from imagine_bench.report.bench import bench_page
from imagine_bench.report.figures import color
from imagine_bench.running.bench import bench, plan
from imagine_bench.running.control import resolved_settings
from imagine_bench.running.trained import load_trained
from imagine_bench.store.loading import archive_files, load_so_far

SLOW = "dqn:controller.discount=0.99"
_FEW = {"budgets": (2,), "evaluation_episodes": 3, "execution": "kinematic", "recorded_episodes": 0}


@pytest.mark.parametrize(
    ("text", "name", "words"),
    [
        ("dqn", "dqn", ""),
        ("dqn:b.y=1,a.x=[256, 256]", "dqn:a.x=[256,256],b.y=1", "x [256,256], y 1"),
        ("dqn:b.x=1,a.x=2", "dqn:a.x=2,b.x=1", "a.x 2, b.x 1"),
        ('dqn:a.x="0.5",a.y=null', 'dqn:a.x="0.5",a.y=null', 'x "0.5", y null'),
    ],
)
def test_a_configuration_has_one_name(text: str, name: str, words: str) -> None:
    one = parse_configuration(text)
    assert (str(one), one.words) == (name, words) and parse_configuration(name) == one


@pytest.mark.parametrize("text", ["dqn:", "dqn:discount", "dqn:controller.discount", "dqn:a=1,a=2"])
def test_settings_that_are_none_are_refused(text: str) -> None:
    with pytest.raises(InvalidValueError, match=r"is not of the form name=value|twice"):
        protocol("arrow_puzzle", agents=(text,))


def test_folders_are_safe_and_differ() -> None:
    names = ["dqn", SLOW, "a:x=[1,2]", "a:x=[1;2]", "a:x=" + "9" * 300, "a:x=" + "9" * 301, "a:x=../..", "a:x=a/b"]
    folders = [file_name(name) for name in names]
    assert folders[:2] == ["dqn", "dqn-controller.discount=0.99"] and len(set(folders)) == len(names)
    assert all(len(each) < 120 and not set(each) & set('/\\:*?"<>|[] ') for each in folders)


def test_a_configurations_settings_are_its_own_and_checked() -> None:
    wanted = protocol("arrow_puzzle", agents=("dqn", SLOW), overrides=(("controller.discount", 0.5),))
    found = resolved_settings(wanted)
    assert found["dqn"]["controller"]["discount"] == 0.5 and found[SLOW]["controller"]["discount"] == 0.99
    assert registry.agent_entry(SLOW).title == "DQN (discount 0.99)" and color(SLOW) != color("dqn")
    with pytest.raises(UnknownNameError, match=r"'controller\.discont'"):
        plan("arrow_puzzle", "smoke", agents=("dqn:controller.discont=0.99",))
    with pytest.raises(InvalidValueError, match="none of them twice"):
        protocol("arrow_puzzle", agents=(SLOW, "dqn:controller.discount=0.990"))


def test_one_agent_with_two_settings_in_one_table(tmp_path: Path) -> None:
    both = bench(*plan("arrow_puzzle", "smoke", agents=("dqn", SLOW), **_FEW), root=tmp_path, launcher=Inline())
    trained = load_trained(both.folder / "dqn-controller.discount=0.99" / "seed_0")
    assert trained.agent.settings.controller.discount == 0.99
    assert [both.of(agent)[0].settings["controller"]["discount"] for agent in ("dqn", SLOW)] == [0.95, 0.99]
    assert bench_page(both).summary.count(SLOW) >= 1
    for name, content in archive_files(both).items():
        (tmp_path / name).write_text(content)
    assert load_so_far(tmp_path).of(SLOW)[0].checkpoints[0].successes == both.of(SLOW)[0].checkpoints[0].successes


def test_physics_is_said_in_one_way_and_felt() -> None:
    wanted = protocol("arrow_puzzle", physics=(("pad_friction", 0.5), ("object_mass", 1.0)))
    assert wanted.physics == (("pad_friction", 0.5),)
    assert wanted.world == {"execution": "physics", "physics": {"pad_friction": 0.5}}
