"""Protocols: complete, hashed, and strict about their values."""

import dataclasses

import pytest

from imagine_bench.errors import ArtefactError, InvalidValueError, UnknownNameError
from imagine_bench.interfaces import APPEARANCES
from imagine_bench.protocols.control import PRESETS, Protocol, protocol
from imagine_bench.registry import TASKS, task
from imagine_bench.running.control import plan_control

BUNDLED = [name for name in TASKS if name != "arrow_puzzle_easy"]
"""Tasks whose encoders are bundled."""


@pytest.mark.parametrize("name", TASKS)
def test_success_thresholds_lie_between_chance_and_optimum(name):
    facts, success_threshold = task(name).facts(), task(name).success_threshold
    assert facts.chance_level <= 0.5 < success_threshold <= facts.optimum


@pytest.mark.parametrize("name", BUNDLED)
def test_photo_has_latents_and_says_that_it_has_no_codes(name):
    wanted, paths = plan_control(name, "quick", appearance="photo", agents=("dqn",))
    assert set(paths) == {"latents"} and "-photo@" in wanted.encoder
    with pytest.raises(ArtefactError, match=r"No encoder '.*-photo-codes' is bundled; train one"):
        plan_control(name, "quick", appearance="photo")


@pytest.mark.parametrize("appearance", [name for name in APPEARANCES if name not in ("patched", "harsh")])
@pytest.mark.parametrize("name", BUNDLED)
def test_quick_finds_encoders_at_every_appearance(name, appearance):
    wanted, paths = plan_control(name, "quick", appearance=appearance)
    assert set(paths) == {"latents", "codes"} and wanted.codes is not None


def test_any_change_changes_the_hash():
    base = protocol("arrow_puzzle", overrides=(("imagination.depth", 5),))
    changes = {
        "task": "arrow_puzzle_hard", "preset": "smoke", "hyperparameters": "minimal", "config_group": "chapter_3",
        "agents": ("dqn",),
        "seeds": (5,), "budgets": (7,),
        "evaluation_episodes": 3, "execution": "kinematic", "appearance": "mild",
        "overrides": (("imagination.depth", 6),), "open_loop_starts": 1, "sampled_futures": 1, "recorded_episodes": 1,
        "encoder": "other@0123456789ab", "codes": "other@0123456789ab", "device": "cuda",
        "after": ("arrow_puzzle",), "demonstrations": 1, "queries": 1, "feedback": 1.0, "split": "plan_length=2",
        "dataset": "random-3@0123456789ab", "settings_digest": "0123456789ab", "test_appearance": "strong",
        "physics": (("pad_friction", 0.5),), "observation": "state", "observation_size": 128,
        "headlines": (("imagination", "dqn"),), "most_looks": 2, "recorded_seeds": 2, "few_seeds": (("dqn", 0),),
        "code": (("my_agent", "0123456789ab"),),
    }  # fmt: skip
    others = {
        "after_episodes",
        "unannounced",
        "feedback_error",
        "agent_names",
    }  # the last one says how names are written
    assert {*changes, *others} >= {field.name for field in dataclasses.fields(Protocol)}
    after = dataclasses.replace(base, after=("arrow_puzzle",))
    assert dataclasses.replace(after, after_episodes=7).hash != after.hash
    assert dataclasses.replace(after, unannounced=True).hash != after.hash
    taught = dataclasses.replace(base, feedback=1.0)
    assert dataclasses.replace(taught, feedback_error=0.1).hash != taught.hash
    hashes = {dataclasses.replace(base, **{name: value}).hash for name, value in changes.items()}
    assert len(hashes | {base.hash}) == len(changes) + 1


@pytest.mark.parametrize(
    ("agents", "moved"), [(("dqn",), True), (("random", "imagination"), True), (("random", "oracle"), False)]
)
def test_a_preset_that_changes_is_another_bench(
    monkeypatch: pytest.MonkeyPatch, agents: tuple[str, ...], moved: bool
) -> None:
    from imagine_bench.agents.dqn_settings import HYPERPARAMETERS as DQN
    from imagine_bench.agents.imagination.settings import HYPERPARAMETERS
    from imagine_bench.agents.settings import Override

    before, _ = plan_control("arrow_puzzle", "quick", agents=agents)
    again, _ = plan_control("arrow_puzzle", "quick", agents=agents)
    assert before == again and len(before.settings_digest) == 12
    for one in (DQN, HYPERPARAMETERS):
        monkeypatch.setitem(one.groups["chapter_5"].sets["fast"], "controller.discount", Override(0.9, "a test"))
    after, _ = plan_control("arrow_puzzle", "quick", agents=agents)
    assert (after.hash != before.hash) is moved
    asked, _ = plan_control("arrow_puzzle", "quick", agents=agents, budgets=(5,))
    assert asked.settings_digest == after.settings_digest


def test_the_caller_overrides_the_task_overrides_the_preset(monkeypatch):
    own = {"quick": {"seeds": (7, 8), "budgets": (5,)}}
    spec = dataclasses.replace(task("arrow_puzzle"), config_group="chapter_3", presets=own)
    monkeypatch.setattr("imagine_bench.protocols.control.task", lambda name: spec)
    wanted = protocol("arrow_puzzle", "quick", budgets=(6,))
    assert (wanted.config_group, wanted.seeds, wanted.budgets) == ("chapter_3", (7, 8), (6,))
    assert protocol("arrow_puzzle", "smoke").seeds == PRESETS["smoke"]["seeds"]


def test_agents_of_a_file_that_are_no_names_are_refused():
    for agents in (-1, "dqn", [5], None):
        with pytest.raises(InvalidValueError, match="agents was given"):
            Protocol.from_dict({**protocol("arrow_puzzle").as_dict(), "agents": agents})


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"task": "arrow_puzle"}, UnknownNameError, r"No task 'arrow_puzle'. Did you mean 'arrow_puzzle'\?"),
        (
            {"preset": "fast"},
            UnknownNameError,
            "No preset 'fast'.* Known: smoke, quick, thesis, full, ",
        ),
        ({"budgets": (100, 100)}, InvalidValueError, r"budgets \(100, 100\) must be .* ascending"),
        ({"seeds": (999, 1000)}, InvalidValueError, "mix tuning seeds .from 1000 on"),
        ({"seeds": (2**24,)}, InvalidValueError, "must be one or more different integers from 0 to 16777215"),
        ({"after_episodes": 50}, InvalidValueError, "after_episodes is 50, but no task comes before"),
    ],
)
def test_bad_fields_say_what_is_allowed(changes, error, message):
    fields = {"task": "arrow_puzzle", **changes}
    with pytest.raises(error, match=message):
        protocol(fields.pop("task"), fields.pop("preset", "quick"), **fields)
