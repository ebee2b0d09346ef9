"""The description of a world: names, values, and worlds that there are not."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from imagine_bench.tasks.arrows.rules import COUPLINGS, FORBIDS, GOALS, Arrows, Turn
from imagine_bench.tasks.parameters.parameters import GESTURES

from imagine_bench import registry
from imagine_bench.errors import ImagineBenchError, InvalidValueError
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


@pytest.mark.parametrize(
    ("said", "name"),
    [
        ("arrows:slip=1e-1,cubes=5", "arrows:cubes=5,slip=0.1"),
        ("arrows:cubes=3,coupling=none,fickle=1", "arrows:fickle=1.0"),
        ("arrows:shuffle=4294967295", "arrows:shuffle=4294967295"),
        ("arrows:goal_change=0.5", "arrows:fickle=0.5"),
        ("arrows:horizon=10", "arrow_puzzle"),
        ("arrows:horizon=1000,slip=0.99,gesture=1,lag=10", "arrows:horizon=1000,slip=0.99,gesture=1.0,lag=10"),
        ("arrows:forbid=equal+agent,horizon=10", "arrow_puzzle_hard"),
        ("arrow_puzzle:cubes=1,horizon=2", "arrow_puzzle_easy"),
        ("arrow_puzzle:horizon=null", "arrows"),
        ("pick_place:fickle=0.5,slip=0.1", "pick_place:slip=0.1,fickle=0.5"),
        ("pick_place:slip=0", "pick_place"),
    ],
)
def test_one_world_has_one_name(said, name):
    spec = registry.task(said)
    assert registry.task_name(said) == spec.id == registry.task(spec.id).id == name
    assert registry.task_entry(said).env_id == spec.env_id
    assert gymnasium.spec(spec.env_id).kwargs == dict(registry.task_entry(spec.id).options) or said != name
    assert protocol(said, "smoke", agents=("random",)).task == name
    assert protocol(said, "smoke", agents=("random",)).hash == protocol(name, "smoke", agents=("random",)).hash


def test_a_world_may_lie_in_a_file(tmp_path):
    file = tmp_path / "world.json"
    file.write_text('{"cubes": 4, "goal": "0123", "slip": 0.1}')
    assert registry.task_name(f"arrows:@{file}") == "arrows:cubes=4,goal=0123,slip=0.1"
    for content in ("[1]", "{", '{"cubes": 9}', '{"cube": 3}', '{"goal": 12}'):
        file.write_text(content)
        with pytest.raises(ImagineBenchError):
            registry.task(f"arrows:@{file}")


def test_turns_are_coupled_to_the_right_and_shuffled():
    plain, coupled, shuffled = Arrows(), Arrows(coupling="neighbour"), Arrows(coupling="neighbour", shuffle=4)
    assert plain.turns[:2] == ((Turn(0, clockwise=True),), (Turn(0, clockwise=False),))
    assert coupled.turns[3] == (Turn(1, clockwise=False), Turn(2, clockwise=False))
    assert coupled.turns[4] == (Turn(2, clockwise=True),)
    assert set(shuffled.turns) == set(coupled.turns) and shuffled.turns != coupled.turns
    assert Arrows(shuffle=4).turns != Arrows(shuffle=5).turns
    named, spec = registry.task("arrows").action_names, registry.task("arrows:shuffle=4")
    assert set(spec.action_names) == set(named) and spec.action_names != named


def test_a_world_ends_at_its_own_horizon():
    for options, horizon in (({"horizon": 3}, 3), ({"cubes": 1}, registry.task("arrows:cubes=1").horizon)):
        env = gymnasium.make("imagine_bench/Arrows-v0", goal="toward_agent", execution="kinematic", **options)
        assert env.get_wrapper_attr("_max_episode_steps") == horizon
        env.close()


def test_a_seed_of_the_order_shuffles_also_if_it_is_zero():
    orders = [Arrows(shuffle=seed).turns for seed in (None, 0, 1)]
    assert len(set(orders)) == 3 and len({frozenset(order) for order in orders}) == 1
