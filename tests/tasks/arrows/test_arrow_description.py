"""The description of a world: names, values, and worlds that there are not."""

from __future__ import annotations

import functools
import re

import gymnasium
import numpy as np
import pytest
from imagine_bench.tasks.arrows.rules import COUPLINGS, FORBIDS, GOALS, Arrows
from imagine_bench.tasks.continuous.instructions import instruction
from imagine_bench.tasks.parameters.parameters import GESTURES
from whole_outputs import KEPT

from imagine_bench import registry
from imagine_bench.errors import ArtefactError, ImagineBenchError, InvalidValueError
from imagine_bench.protocols.control import protocol
from imagine_bench.registry.entries import file_name, parse_options

KINDS = {name: str(Arrows.__dataclass_fields__[field].type) for name, field in Arrows.spellings().items()}


def drawn(rng):
    """A world with any values, or None where they contradict each other."""
    cubes = int(rng.integers(1, 7))
    pattern = "".join(map(str, rng.integers(4, size=cubes).tolist()))
    choices = {
        "cubes": cubes,
        "goal": str(rng.choice([*GOALS, pattern])),
        "forbid": str(rng.choice([*FORBIDS, "neighbours+agent", "equal+agent"])),
        "coupling": str(rng.choice(COUPLINGS)),
        "shuffle": int(rng.integers(2**32)),
        "horizon": int(rng.integers(1, 1001)),
        "slip": float(rng.uniform(0, 0.99)),
        "goal_change": float(rng.choice([0.25, 1.0, rng.uniform()])),
        "gesture": [*GESTURES, float(rng.uniform())][rng.integers(3)],
        "lag": int(rng.integers(11)),
        "distractors": int(rng.integers(5)),
    }
    named = {name: value for name, value in choices.items() if name == "cubes" or rng.random() < 0.5}
    try:
        return Arrows(**named)
    except InvalidValueError:
        return None


def test_a_canonical_name_says_its_world_and_only_it():
    rng = np.random.default_rng(0)
    worlds = [world for world in (drawn(rng) for _ in range(600)) if world is not None]
    assert len(worlds) > 300
    for world in worlds:
        _, _, said = str(world).partition(":")
        again = Arrows.taken_from(parse_options(said, KINDS, "")) if said else Arrows()
        assert again == world and str(again) == str(world) and again.hash == world.hash
    assert len({str(world) for world in worlds}) == len(set(worlds)) == len({world.hash for world in worlds})
    assert len({file_name(str(world)) for world in worlds}) == len(set(worlds))


def test_one_world_has_one_name(expected):
    """Its name, encoder, horizon, options of its environment, a wish, and macro-actions with the turns of cubes."""
    said = re.findall(r"^\$ (.*)$", (KEPT / "worlds_by_name.txt").read_text(), re.MULTILINE)
    answers = []
    for each in said:
        spec, entry = registry.task(each), registry.task_entry(each)
        assert registry.task_name(each) == spec.id == registry.task(spec.id).id
        one, other = (protocol(name, "smoke", agents=("random",)) for name in (each, spec.id))
        assert (one.hash, one.task) == (other.hash, spec.id)
        assert each != spec.id or gymnasium.spec(spec.env_id).kwargs == dict(entry.options)
        options = dict(registry.task_entry(spec.id).options)
        answers += [f"$ {each}", f"{spec.id}  {spec.encoder}  {spec.horizon}  {entry.env_id}  {options}"]
        answers.append(f"  {instruction(spec, spec.rules.start_states[0])}")
        turns = spec.rules.world.turns if spec.id.startswith("arrow") else [()] * spec.n_actions
        for name, cubes in zip(spec.action_names, turns, strict=True):
            signs = [f"{turn.cube}{'+' if turn.clockwise else '-'}" for turn in cubes]
            answers.append(f"  {name} {' '.join(signs)}")
    expected("worlds_by_name", "\n".join(answers))


def test_a_world_may_lie_in_a_file(tmp_path):
    file = tmp_path / "world.json"
    file.write_text('{"cubes": 4, "goal": "0123", "slip": 0.1}')
    assert registry.task_name(f"arrows:@{file}") == "arrows:cubes=4,goal=0123,slip=0.1"
    for content in ("[1]", "{", '{"cubes": 9}', '{"cube": 3}', '{"goal": 12}'):
        file.write_text(content)
        with pytest.raises(ImagineBenchError):
            registry.task(f"arrows:@{file}")
    file.write_text('{"slip": 0.1, "cubes": 4, "slip": 0.3}')
    with pytest.raises(ArtefactError, match="one of slip, cubes, slip is given twice"):
        registry.task(f"arrows:@{file}")


@pytest.mark.parametrize("kind", ["", "-vector"])
def test_a_horizon_beside_an_id_with_its_own_limit_is_refused(kind):
    """Gymnasium would go on cutting episodes off after ten macro-actions."""
    make = functools.partial(gymnasium.make_vec, num_envs=1) if kind else gymnasium.make
    for horizon in (3, 20):
        env = make(f"imagine_bench/ArrowPuzzle{kind}-v0", horizon=horizon, execution="kinematic", observation="state")
        with pytest.raises(InvalidValueError, match=f"-v0 ends after 10 macro-actions.*max_episode_steps={horizon}"):
            env.reset(seed=0)
        env.close()


@pytest.mark.parametrize(("given", "ends"), [(2, 2), (50, 3)])
def test_lanes_end_where_a_single_environment_of_a_world_does(given, ends):
    world = {"goal": "012", "forbid": "none", "horizon": 3, "max_episode_steps": given}
    options = {"execution": "kinematic", "observation": "state", **world}
    one = gymnasium.make("imagine_bench/Arrows-v0", **options)
    many = gymnasium.make_vec("imagine_bench/Arrows-vector-v0", num_envs=1, **options)
    for env in (one, many):
        env.reset(seed=0, options={"macrostate": (2, 2, 2, 0)})
    cut = [(one.step(0)[3], many.step(np.array([0]))[3].item()) for _ in range(ends)]
    assert cut == [(False, False)] * (ends - 1) + [(True, True)]
    one.close()
    many.close()
