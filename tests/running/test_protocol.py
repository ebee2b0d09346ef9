"""Protocols: complete, hashed, and strict about their values."""

import copy
import dataclasses
import shutil

import pytest

from imagine_bench import registry
from imagine_bench.errors import ArtefactError, InvalidValueError, UnableError
from imagine_bench.interfaces import APPEARANCES
from imagine_bench.protocols.control import Protocol, protocol
from imagine_bench.protocols.presets import PRESETS
from imagine_bench.registry import TASKS, task
from imagine_bench.running.control import plan_control
from imagine_bench.store import encoders

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


@pytest.mark.parametrize("appearance", ["clean", "mild"])
@pytest.mark.parametrize("kind", ["latents", "codes"])
def test_given_latents_are_for_readers_and_codes_for_all(kind, appearance, tmp_path):
    spec = task("arrow_puzzle")
    own = {each: encoders.own(spec, appearance, each) for each in ("latents", "codes")}
    given = tmp_path / "given.safetensors"
    shutil.copy(own[kind], given)
    how = {"agents": ("dqn", "factored:given"), "appearance": appearance, "encoder": str(given)}
    _, paths = plan_control("arrow_puzzle", "quick", **how)
    assert paths == ({"latents": given, "codes": given} if kind == "codes" else {**own, "latents": given})


def test_any_change_changes_the_hash():
    """Of whatever field, before a protocol refuses or completes it; the spelling of names is tested in tests/store."""
    base = protocol("arrow_puzzle", after=("arrow_puzzle",), feedback=1.0)
    names = [field.name for field in dataclasses.fields(Protocol) if field.name != "agent_names"]
    hashes = {base.hash}
    for name in names:
        changed = copy.copy(base)
        object.__setattr__(changed, name, ("another",))
        hashes.add(changed.hash)
    assert len(hashes) == 1 + len(names) > 30


@pytest.mark.parametrize("changes", [{"feedback": 1}, {"physics": {"pad_friction": 1}}])
def test_a_whole_number_is_spelled_as_any_other(changes):
    (name, value), *_ = changes.items()
    other = {name: 1.0 if value == 1 else {"pad_friction": 1.0}}
    assert protocol("arrow_puzzle", **changes).hash == protocol("arrow_puzzle", **other).hash


def test_tests_at_the_appearance_of_training_change_no_hash():
    factors = "light=0.25,camera=0.5"
    for appearance, same in (("clean", "clean"), ("photo", "photo"), (factors, "camera=0.5,light=0.25")):
        alone = protocol("arrow_puzzle", appearance=appearance)
        assert protocol("arrow_puzzle", appearance=appearance, test_appearance=same).hash == alone.hash
        assert protocol("arrow_puzzle", appearance=appearance, test_appearance="strong").hash != alone.hash


@pytest.mark.parametrize("name", ["report", "tensorboard", "wandb", "why"])
def test_no_agent_shares_a_folder_with_files_of_the_bench(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setitem(registry.AGENTS, name, registry.AGENTS["random"])
    with pytest.raises(InvalidValueError, match=f"A bench has a folder '{name}' of its own"):
        protocol("arrow_puzzle", agents=("dqn", name))
    assert protocol("arrow_puzzle", agents=("dqn", "random")).agents == ("dqn", "random")


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


def test_the_caller_overrides_the_task_overrides_the_preset():
    own = task("pick_place").presets["quick"]
    assert own["seeds"] != PRESETS["quick"]["seeds"] and own["budgets"] != (6,)
    wanted = protocol("pick_place", "quick", budgets=(6,))
    assert (wanted.config_group, wanted.seeds, wanted.budgets) == ("chapter_3", own["seeds"], (6,))
    assert protocol("pick_place", "smoke").seeds == PRESETS["smoke"]["seeds"]


def test_each_option_of_training_is_known_as_help_that_needs_a_learner():
    together = {"after": ("arrow_puzzle_hard",), "after_episodes": 3, "unannounced": True, "feedback": 1.0}
    used = {**together, "demonstrations": 2, "queries": 1, "feedback_error": 0.1}
    made = Protocol(task="arrow_puzzle", preset="check", agents=("dqn",), **used)
    assert sorted(made.helps) == sorted(used)
    assert not dataclasses.replace(made, **{name: getattr(Protocol, name) for name in used}, budgets=(7,)).helps
    for changes in ({"demonstrations": 2}, {"queries": 1}, {"feedback": 1.0}):
        with pytest.raises(UnableError, match=f"No agent of this bench learns .*--{next(iter(changes))} changes"):
            plan_control("arrow_puzzle", "smoke", agents=("random",), **changes)
    with pytest.raises(InvalidValueError, match="with it a probability of at most"):
        dataclasses.replace(made, feedback_error=0.6)


def test_agents_of_a_file_that_are_no_names_are_refused():
    for agents in (-1, "dqn", [5], None):
        with pytest.raises(InvalidValueError, match="agents was given"):
            Protocol.from_dict({**protocol("arrow_puzzle").as_dict(), "agents": agents})
